"""Splits into training, validation and test data: whole recordings, or time blocks with a gap between them."""

from __future__ import annotations

import hashlib
import itertools
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from edp.errors import ConfigError, DataError, closest
from edp.recording import MACHINE, Recording
from edp.registry import Registry
from edp.settings.bounds import MAX_NAMES, SEED, above, below, check_bounds, integer, shown, span
from edp.wording import setting_text, typed

PARTS = ("train", "validation", "test")
PART = below(0.0, 1.0)
"""Fraction of a data set for test or validation. The whole data set would leave no training data."""
MAX_BLOCK_S = 31_557_600.0  # a year
MAX_MASS_T = 10_000.0  # the largest excavator weighs about a tenth of this
FAMILY = "excitation"
"""Key of the driving task in the metadata of a simulated recording."""
MASS = "mass_t"
"""Key of the machine's mass in the metadata, if known."""


@dataclass(frozen=True)
class Stretch:
    """Rows ``start:stop`` of recording number `recording`."""

    recording: int
    start: int
    stop: int


@dataclass(frozen=True)
class Split:
    """Segments of each part; every part has at least one."""

    train: tuple[Stretch, ...]
    validation: tuple[Stretch, ...]
    test: tuple[Stretch, ...]


class SplitSpec(Protocol):
    """A rule that divides a data set."""

    def split(self, recordings: Sequence[Recording], gap: int) -> Split:
        """Divide the recordings; `gap` samples (W + k) are left out between neighbouring segments of one recording."""
        ...


SPLITS: Registry[type] = Registry("split")


@SPLITS.register("recordings")
@dataclass(frozen=True, kw_only=True)
class ByRecording:
    """Split by whole recordings, chosen at random with a seed or by name.

    Simulated recordings, whose meta has an ``excitation``, are drawn so that each part has its share of every family.

    Attributes:
        validation_fraction: share of the recordings that validate (when not named).
        test_fraction: share that tests.
        seed: random seed of the draw.
        validation: names of recordings that validate. A recording that is named in no part trains.
        test: names of recordings that test.
        tail_fraction: share of every training recording, at its end, that validates where no recording does.
    """

    validation_fraction: float = 0.15
    test_fraction: float = 0.2
    seed: int = 0
    validation: tuple[str, ...] = ()
    test: tuple[str, ...] = ()
    tail_fraction: float = 0.2

    def __post_init__(self) -> None:
        shares = dict.fromkeys(("validation_fraction", "test_fraction", "tail_fraction"), PART)
        check_bounds("split", self, seed=SEED, **shares)

    def split(self, recordings: Sequence[Recording], gap: int) -> Split:
        """Divide by recording."""
        names = [recording.name for recording in recordings]
        for recording_name in (*self.validation, *self.test):
            if recording_name not in names:
                raise DataError(f"split: there is no recording '{recording_name}'{closest(recording_name, names)}")
        if set(self.validation) & set(self.test):
            raise DataError("split: a recording is named both in validation and in test; keep it in one")
        test, validation = list(self.test), list(self.validation)
        free = [name for name in names if name not in {*test, *validation}]
        families = self._families(recordings)
        drawn = _order_evenly(self._shuffle_names(free), families)
        if not test:
            test, drawn = _take(drawn, self.test_fraction, len(names))
            drawn = _order_evenly(drawn, families)
        if not validation and len(drawn) >= 3:
            validation, drawn = _take(drawn, self.validation_fraction, len(names))
        whole = [Stretch(i, 0, recording.samples) for i, recording in enumerate(recordings)]
        parts = {
            "train": [s for s in whole if names[s.recording] in drawn],
            "validation": [s for s in whole if names[s.recording] in validation],
            "test": [s for s in whole if names[s.recording] in test],
        }
        if not parts["validation"]:
            parts = _hold_tail(parts, self.tail_fraction, gap)
        return _check_parts(parts, recordings, gap)

    def _families(self, recordings: Sequence[Recording]) -> dict[str, str]:
        """Return the family of each recording by name; each part receives its fraction of every family."""
        return {recording.name: str(recording.meta.get(FAMILY, "")) for recording in recordings}

    def _shuffle_names(self, names: Sequence[str]) -> list[str]:
        """Return the names in the order of the draw."""
        return [names[i] for i in np.random.default_rng(self.seed).permutation(len(names))]


@SPLITS.register("names")
@dataclass(frozen=True, kw_only=True)
class ByName(ByRecording):
    """Split by whole recordings as in `ByRecording`, with a random draw that depends on names and seed only.

    The same logs draw the same tests in every format, in any order, beside any others of other kinds: formats differ in
    what else they keep. Kinds are names without their numbers (``dig_01`` and ``dig_02`` are of one kind), and each
    part has its share of every kind.
    """

    def _families(self, recordings: Sequence[Recording]) -> dict[str, str]:
        return {recording.name: kind_of_name(recording.name) for recording in recordings}

    def _shuffle_names(self, names: Sequence[str]) -> list[str]:
        # A hash, since a permutation of places would follow the order in which a folder is listed.
        return sorted(names, key=lambda name: hashlib.blake2b(f"{self.seed}/{name}".encode()).digest())


def kind_of_name(name: str) -> str:
    """Return the name of a recording without digits: ``m22_003_dig`` becomes ``m dig``."""
    return " ".join(re.findall(r"[^\W\d_]+", name))


@SPLITS.register("time")
@dataclass(frozen=True, kw_only=True)
class ByTime:
    """Split by time: the beginning of every recording for training, then validation, then test, with gaps between.

    Attributes:
        validation_fraction: share of each recording.
        test_fraction: share of each recording.
        train_short_recordings: recordings of which a part would be no longer than the gap train as a whole, in place
            of an error.
    """

    validation_fraction: float = 0.15
    test_fraction: float = 0.2
    train_short_recordings: bool = False

    def __post_init__(self) -> None:
        check_bounds("split", self, validation_fraction=PART, test_fraction=PART)
        if self.validation_fraction + self.test_fraction >= 1:
            raise ConfigError(
                f"split: validation_fraction = {self.validation_fraction}, test_fraction = {self.test_fraction}; "
                "validation_fraction + test_fraction must be below 1"
            )

    def split(self, recordings: Sequence[Recording], gap: int) -> Split:
        """Divide each recording by time."""
        parts: dict[str, list[Stretch]] = {part: [] for part in PARTS}
        for i, recording in enumerate(recordings):
            n = recording.samples
            # The end tests: a model is used later than it was trained.
            test = n - round(n * self.test_fraction)
            validation = test - round(n * self.validation_fraction)
            if self.train_short_recordings and min(validation - gap, test - gap - validation, n - test) <= gap:
                parts["train"].append(Stretch(i, 0, n))
                continue
            parts["train"].append(Stretch(i, 0, validation - gap))
            parts["validation"].append(Stretch(i, validation, test - gap))
            parts["test"].append(Stretch(i, test, n))
        return _check_parts(parts, recordings, gap)


@SPLITS.register("blocks")
@dataclass(frozen=True, kw_only=True)
class ByBlocks:
    """Split by blocks of equal duration: every `every`-th block for test, a fraction of the others for validation.

    Where neighbouring blocks have different parts, the gap is cut from the one that does not test. A rest shorter
    than half a block joins the block before it.

    Attributes:
        block_s: duration of a block in seconds.
        every: a block out of so many tests.
        validation_fraction: share of the other blocks, taken as whole blocks, that validate.
    """

    block_s: float = 20.0
    every: int = 3
    validation_fraction: float = 0.2

    def __post_init__(self) -> None:
        check_bounds(
            "split",
            self,
            block_s=above(0.0, MAX_BLOCK_S),
            every=integer(2, MAX_NAMES),
            validation_fraction=PART,
        )

    def split(self, recordings: Sequence[Recording], gap: int) -> Split:
        """Divide each recording into blocks."""
        parts: dict[str, list[Stretch]] = {part: [] for part in PARTS}
        # Counted over all recordings: recordings of few blocks would otherwise give none to validation.
        turn = itertools.count(1)
        for i, recording in enumerate(recordings):
            size = round(self.block_s * recording.rate_hz)
            if size <= 2 * gap:
                raise ConfigError(
                    f"split: block_s = {setting_text(self.block_s)} gives blocks of {size} samples, no more than a "
                    f"gap of {gap} "
                    "(window plus horizon) at each end; use longer blocks"
                )
            starts = list(range(0, max(1, recording.samples - size // 2), size))
            edges = [*starts, recording.samples]
            owners = [self._owner(number, turn) for number in range(len(starts))]
            for number, (part, start, stop) in enumerate(zip(owners, edges[:-1], edges[1:], strict=True)):
                after = owners[number + 1 : number + 2]
                if number and part != "test" and owners[number - 1] == "test":
                    start += gap
                if after and part != "test" and part != after[0]:
                    stop -= gap
                parts[part].append(Stretch(i, start, stop))
        return _check_parts(parts, recordings, gap)

    def _owner(self, number: int, turn: Iterator[int]) -> str:
        """Return the part of block `number`; `turn` counts the blocks that do not test, over all recordings."""
        if number % self.every == self.every - 1:
            return "test"
        other = next(turn)
        if self.validation_fraction <= 0:
            return "train"
        return "validation" if other % max(2, round(1 / self.validation_fraction)) == 0 else "train"


@SPLITS.register("machines")
@dataclass(frozen=True, kw_only=True)
class ByMachine:
    """Split by whole machines, chosen at random with a seed, by name or by mass.

    A test machine is never used for training.

    Simulated recordings say their machine in their meta, a data-set file says it of each log (``machine = "..."``).

    Attributes:
        validation_fraction: share of the machines that validate (when not named).
        test_fraction: share that tests (when neither named nor chosen by mass).
        seed: random seed of the draw.
        validation: names of machines that validate.
        test: names of machines that test.
        test_masses: machines from the first to the second mass, in t, test too; their size is never trained on.
    """

    validation_fraction: float = 0.1
    test_fraction: float = 0.15
    seed: int = 0
    validation: tuple[str, ...] = ()
    test: tuple[str, ...] = ()
    test_masses: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        check_bounds(
            "split",
            self,
            validation_fraction=PART,
            test_fraction=PART,
            seed=SEED,
            test_masses=span(0.0, MAX_MASS_T),
        )
        if self.test_masses and (len(self.test_masses) != 2 or self.test_masses[0] > self.test_masses[1]):
            raise ConfigError(
                f"split: test_masses = {shown(self.test_masses)}; the lightest and the heaviest in t must be given"
            )

    def split(self, recordings: Sequence[Recording], gap: int) -> Split:
        """Divide by machine.

        Raises:
            ConfigError: a range of masses that is none.
            DataError: a recording without a machine, a machine that is not there, or fewer than three machines.
        """
        owners = [machine_of(recording) for recording in recordings]
        machines = sorted(set(owners))
        if len(machines) < 3:
            raise DataError(
                f"split: {len(recordings)} recording(s) of {len(machines)} machine(s) ({', '.join(machines)}); at "
                "least three are needed, to train, to validate and to test on: give recordings of more machines (edp "
                'simulate --family), or split by recording (kind = "recordings")'
            )
        named = [[name.lower() for name in part] for part in (self.validation, self.test)]
        for machine_name in itertools.chain(*named):
            if machine_name not in machines:
                raise DataError(f"split: there is no machine '{machine_name}'{closest(machine_name, machines)}")
        validation, test = named[0], [*named[1], *self._heavy(recordings, owners)]
        both = sorted(set(validation) & set(test))
        if both:
            raise DataError(f"split: {', '.join(both)} would validate and test; keep each machine in one part")
        free = [name for name in machines if name not in {*validation, *test}]
        drawn = [free[i] for i in np.random.default_rng(self.seed).permutation(len(free))]
        if not test:
            test, drawn = _take(drawn, self.test_fraction, len(machines))
        if not validation:
            validation, drawn = _take(drawn, self.validation_fraction, len(machines))
        machines_by_part = {"train": set(drawn), "validation": set(validation), "test": set(test)}
        whole = [Stretch(i, 0, recording.samples) for i, recording in enumerate(recordings)]
        parts = {part: [s for s in whole if owners[s.recording] in names] for part, names in machines_by_part.items()}
        return _check_parts(parts, recordings, gap)

    def _heavy(self, recordings: Sequence[Recording], owners: Sequence[str]) -> list[str]:
        """Return the machines whose mass is in the test range."""
        if not self.test_masses:
            return []
        low, high = self.test_masses
        stated = {owner: r.meta.get(MASS) for owner, r in zip(owners, recordings, strict=True)}
        masses = {owner: float(mass) for owner, mass in stated.items() if isinstance(mass, int | float)}
        matching = [owner for owner, mass in masses.items() if low <= mass <= high]
        if not matching:
            known_masses = list(masses.values())
            span = (
                f"they go from {typed(min(known_masses))} to {typed(max(known_masses))} t"
                if known_masses
                else "no recording says its mass"
            )
            raise DataError(f"split: no machine lies within test_masses = {list(self.test_masses)}; {span}")
        return matching


def machine_of(recording: Recording) -> str:
    """Return the machine of a recording, in lower case.

    Raises:
        DataError: the recording does not say it.
    """
    name = str(recording.meta.get(MACHINE, "")).strip().lower()
    if not name:
        raise DataError(
            f"recording '{recording.name}' ({recording.source}) does not say which machine it is of; list the logs in "
            'a data-set file (.toml) with machine = "..." in each [[recordings]]'
        )
    return name


def _order_evenly(names: Sequence[str], families: Mapping[str, str]) -> list[str]:
    """Return the names in an order that distributes each family evenly."""
    size = Counter(families[name] for name in names)
    seen: Counter[str] = Counter()
    position = {}
    for name in names:
        family = families[name]
        # Half a place inwards centres a family, so that one of two recordings lies on either side of the middle.
        position[name] = (seen[family] + 0.5) / size[family]
        seen[family] += 1
    return sorted(names, key=lambda name: position[name])


def _take(names: list[str], share: float, total: int) -> tuple[list[str], list[str]]:
    # At least one: a part without recordings is no part.
    count = max(1, round(share * total))
    return names[:count], names[count:]


def _hold_tail(parts: dict[str, list[Stretch]], share: float, gap: int) -> dict[str, list[Stretch]]:
    """Use the end of each training recording for validation, for data sets with too few recordings."""
    train, validation = [], []
    for stretch in parts["train"]:
        cut = stretch.stop - round(share * (stretch.stop - stretch.start))
        # The gap is taken from training, which has more to give.
        train.append(Stretch(stretch.recording, stretch.start, cut - gap))
        validation.append(Stretch(stretch.recording, cut, stretch.stop))
    return {"train": train, "validation": validation, "test": parts["test"]}


def _check_parts(parts: dict[str, list[Stretch]], recordings: Sequence[Recording], gap: int) -> Split:
    for part in PARTS:
        if not parts[part]:
            raise DataError(
                f"split: no recording is left for {part}; {len(recordings)} recording(s) given. Give more recordings, "
                'or split by time (kind = "time")'
            )
        for stretch in parts[part]:
            if stretch.stop <= stretch.start:
                raise DataError(
                    f"split: recording '{recordings[stretch.recording].name}' is too short "
                    f"({recordings[stretch.recording].samples} samples) to leave a stretch for {part} beside a gap of "
                    f"{gap} samples (window plus largest horizon); give a longer recording, a shorter horizon or "
                    "another split"
                )
    return Split(tuple(parts["train"]), tuple(parts["validation"]), tuple(parts["test"]))
