"""Data split of a model search.

Its frozen sessions are identified by content and never used for training, even if renamed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from edp.data.splits import PART, ByRecording, Split, SplitSpec, Stretch
from edp.data.splits import SPLITS as SPLITS  # those who need the split `frozen` registered import it from here
from edp.errors import ConfigError, DataError
from edp.recording import Recording
from edp.settings.bounds import SEED, check_bounds, shown

SECOND_TEST_SET = "second test sessions"
"""Name of the second sealed test set of a search in ledgers."""
SHARED_SHARE, SHARED_ROWS = 0.2, 50
"""A recording is a piece of another one where so large a share of its different rows, and so many, stand in both.
Rows of a machine in steady state repeat, but are few among the different ones; sensors that move never repeat all
channels."""


@dataclass(frozen=True, kw_only=True)
class Session:
    """A session by its content.

    Attributes:
        name: name at the time of the division, for messages.
        digest: hash of its content (`edp.recording.Recording.digest`).
    """

    name: str
    digest: str


@SPLITS.register("frozen")
@dataclass(frozen=True, kw_only=True)
class ByFrozen:
    """Sessions as a model search divided them; each is known by the hash of its content, not by its name.

    Frozen sessions never train or validate. Of two copies of one the second is left out. Sessions that the search did
    not know train, unless they are a piece of a frozen one.

    Attributes:
        test: frozen sessions that test: the first sealed test set of the search.
        second_test: frozen sessions of the second sealed test set, for what is compressed; left out of all parts
            otherwise.
        validation: development sessions that validate.
        train: development sessions that train.
        study: folder of the search, whose ledger records each look at the second sealed test set.
        on_missing: action if a frozen session is not among the recordings: ``error``, or ``resample`` for other data.
            ``draw`` tests on a fraction of the remaining recordings, and also validates on them if no session of
            `validation` is present.
        validation_fraction: share that is drawn to validate.
        test_fraction: share that is drawn to test.
        seed: random seed of the draw.

    Raises:
        ConfigError: a session in two parts, or an unknown `on_missing`.
    """

    test: tuple[Session, ...] = ()
    second_test: tuple[Session, ...] = ()
    validation: tuple[Session, ...] = ()
    train: tuple[Session, ...] = ()
    study: str = ""
    on_missing: str = "error"
    validation_fraction: float = 0.15
    test_fraction: float = 0.2
    seed: int = 0

    def __post_init__(self) -> None:
        check_bounds("split", self, seed=SEED, validation_fraction=PART, test_fraction=PART)
        if self.on_missing not in ("error", "resample"):
            raise ConfigError(f"split: on_missing = {shown(self.on_missing)}; expected 'error' or 'resample'")
        part_of: dict[str, str] = {}
        for part in ("test", "second_test", "validation", "train"):
            for session in getattr(self, part):
                other = part_of.setdefault(session.digest, part)
                if other != part:
                    raise ConfigError(
                        f"split: session '{session.name}' is in {other} and in {part}; each must be in one part"
                    )

    @property
    def frozen(self) -> dict[str, str]:
        """Names of all frozen sessions by digest."""
        return {session.digest: session.name for session in (*self.test, *self.second_test)}

    def opened(self) -> ByFrozen:
        """Return the split with the second sealed test set in place of the test sessions.

        Raises:
            ConfigError: the search set no second sealed test set apart.
        """
        if not self.second_test:
            raise ConfigError("split: the search set no second sealed test set apart, so it cannot be opened")
        return replace(self, test=self.second_test, second_test=self.test)

    def split(self, recordings: Sequence[Recording], gap: int) -> Split:
        """Divide by content; `gap` is not needed between whole recordings.

        Raises:
            ConfigError: it names no test sessions.
            DataError: a frozen session is missing or changed, a recording is a piece of one, or a part is empty.
        """
        if not self.test:
            raise ConfigError(
                "split: kind = 'frozen' names no test sessions; edp search writes such a split into teacher.toml, "
                "others are kind = 'recordings', 'time', 'blocks' or 'machines'"
            )
        first: dict[str, int] = {}
        for i, recording in enumerate(recordings):
            first.setdefault(recording.digest, i)
        self._check_there(recordings, first)
        _refuse_pieces(recordings, self.frozen, {s.digest for s in (*self.train, *self.validation)})
        test = [first[s.digest] for s in self.test if s.digest in first]
        validation = [first[s.digest] for s in self.validation if s.digest in first]
        free = [
            i for i, recording in enumerate(recordings) if recording.digest not in self.frozen and i not in validation
        ]
        if self.on_missing == "resample" or not validation:
            return self._draw_parts(recordings, free, test, validation, gap)
        return _whole(recordings, {"train": free, "validation": validation, "test": test})

    def _draw_parts(
        self, recordings: Sequence[Recording], free: list[int], test: list[int], validation: list[int], gap: int
    ) -> Split:
        """Fill the parts that have no session by a random draw from the free sessions."""
        candidates = [recordings[i] for i in (*free, *validation, *test)]
        # The second sealed test set stays out of the draw.
        names = {i: recordings[i].name for i in (*free, *validation, *test)}
        rule = ByRecording(
            validation_fraction=self.validation_fraction,
            test_fraction=self.test_fraction,
            seed=self.seed,
            validation=tuple(names[i] for i in validation),
            test=tuple(names[i] for i in test),
        )
        recording_index = dict(enumerate(names))
        drawn_split = rule.split(candidates, gap)

        def moved(stretches: Sequence[Stretch]) -> tuple[Stretch, ...]:
            return tuple(sorted((replace(s, recording=recording_index[s.recording]) for s in stretches), key=_order))

        return Split(moved(drawn_split.train), moved(drawn_split.validation), moved(drawn_split.test))

    def _check_there(self, recordings: Sequence[Recording], there: Mapping[str, int]) -> None:
        """Refuse data that lack a frozen session, unless other data are expected."""
        lacking = {digest: name for digest, name in self.frozen.items() if digest not in there}
        if self.on_missing == "resample" or not lacking:
            return
        by_name = {recording.name: recording for recording in recordings}
        changed = [name for name in lacking.values() if name in by_name]
        how = f"'{changed[0]}' is there with another content" if changed else "no recording has their content"
        raise DataError(
            f"split: {len(lacking)} of {len(self.frozen)} frozen sessions of the search are missing: "
            f"{', '.join(sorted(lacking.values()))}; {how} (hash {next(iter(lacking))} is wanted for "
            f"'{next(iter(lacking.values()))}'). What was changed could train unseen: restore the recordings and read "
            "them with the same signal map, or, for other data, --set split.on_missing=resample"
        )


def list_frozen(split: SplitSpec) -> dict[str, str]:
    """Return the names of the frozen sessions by digest; empty for a split without frozen sessions."""
    return split.frozen if isinstance(split, ByFrozen) else {}


def refuse_frozen(recordings: Sequence[Recording], frozen: Mapping[str, str], what: str) -> None:
    """See that no recording is a frozen session.

    Args:
        recordings: recordings for training, calibration or selection.
        frozen: names of frozen sessions by digest.
        what: purpose of the recordings, for the message.

    Raises:
        DataError: one is; the message names it.
    """
    for recording in recordings:
        if recording.digest in frozen:
            raise DataError(
                f"'{recording.name}' ({recording.source}) is the frozen session '{frozen[recording.digest]}' of the "
                f"search that the run comes from, and {what}; leave it out: it may only test"
            )


def keep_frozen(before: SplitSpec, after: SplitSpec) -> None:
    """See that a change of settings does not let go of frozen sessions.

    Raises:
        ConfigError: it does.
    """
    lost = set(list_frozen(before)) - set(list_frozen(after))
    if lost:
        raise ConfigError(
            f"the run comes from a search, and --set split lets go of {len(lost)} of its frozen sessions; they stay "
            "frozen: leave the change out, or, for other data, --set split.on_missing=resample"
        )


def _refuse_pieces(recordings: Sequence[Recording], frozen: Mapping[str, str], development: set[str]) -> None:
    """Raise an error if a recording unknown to the search shares rows with a frozen recording."""
    strange = [
        recording for recording in recordings if recording.digest not in frozen and recording.digest not in development
    ]
    sealed = [recording for recording in recordings if recording.digest in frozen] if strange else []
    for recording in strange:
        for other in sealed:
            names = [name for name in recording.channel_names if name in other.channel_names]
            if not names:
                continue
            # Different rows only: a machine at rest repeats one row thousands of times.
            own, theirs = (np.unique(_rows(one.select(names))) for one in (recording, other))
            shared = len(np.intersect1d(own, theirs, assume_unique=True))
            if shared >= min(SHARED_ROWS, len(own)) and shared >= SHARED_SHARE * len(own):
                raise DataError(
                    f"'{recording.name}' ({recording.source}) shares {shared} of its {len(own)} different rows with "
                    f"the frozen session '{frozen[other.digest]}' of the search; a piece of it must not train: "
                    "remove it"
                )


def _rows(values: np.ndarray) -> np.ndarray:
    """Return each row as one value that can be compared."""
    # Rows as bytes: two equal rows are equal to the last bit, and sorting needs no tolerance.
    solid = np.ascontiguousarray(values)
    return solid.view(np.dtype((np.void, solid.dtype.itemsize * solid.shape[1]))).ravel()


def _whole(recordings: Sequence[Recording], parts: Mapping[str, Sequence[int]]) -> Split:
    """Return the whole recordings by part.

    Raises:
        DataError: a part is empty.
    """
    for part, places in parts.items():
        if not places:
            raise DataError(
                f"split: no recording is left for {part}; {len(recordings)} recording(s) given. Give the recordings of "
                "the search, or, for other data, --set split.on_missing=resample"
            )
    stretches = {
        part: tuple(Stretch(i, 0, recordings[i].samples) for i in sorted(places)) for part, places in parts.items()
    }
    return Split(stretches["train"], stretches["validation"], stretches["test"])


def _order(stretch: Stretch) -> tuple[int, int]:
    return stretch.recording, stretch.start
