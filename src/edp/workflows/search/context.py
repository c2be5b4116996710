"""Common ground of a search's phases: sealed sessions, folds, requests and outcomes."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from edp.errors import ConfigError, DataError, closest
from edp.evaluation.study import Decision, facts_of_kind
from edp.stats.folds import repeated_folds, repeated_splits
from edp.workflows.search.arms import Arm
from edp.workflows.search.modules import add_modules
from edp.workflows.search.settings import SearchSpec
from edp.workflows.search.space import WIDTHS, Candidate
from edp.workflows.search.trainings import Outcome, TrainingRequest

Array = NDArray[np.float64]
F = TypeVar("F")


@dataclass(frozen=True)
class SearchContext:
    """Common data of all phases; only decisions are added while a search runs.

    Attributes:
        spec: the settings of the search.
        base: settings of the network and its training from which everything starts.
        source: source of the recordings, as plain values.
        development: names of the sessions that train and evaluate in all phases.
        test: names of the sessions set apart.
        channels: channels of the recordings.
        unit: unit of the scores, for sentences.
        second: names of the sessions of the second test set; none without phase 6.
        decided: decisions of earlier phases, by name.
    """

    spec: SearchSpec
    base: Arm
    source: Mapping[str, object]
    development: tuple[str, ...]
    test: tuple[str, ...]
    channels: tuple[str, ...] = ()
    unit: str = "mm/s"
    decided: Mapping[str, Decision] = field(default_factory=dict)
    second: tuple[str, ...] = ()

    def facts(self, kind: type[F]) -> F:
        """Return the data of an earlier phase.

        Raises:
            ConfigError: the phase has not run.
        """
        facts = facts_of_kind(list(self.decided.values()), kind)
        if facts is None:
            raise ConfigError(f"search: {kind.__name__} is needed, and that phase has not run; run all phases in order")
        return facts

    @property
    # Sessions of the first run: choices of later phases rest on the same ones.
    def validation(self) -> tuple[str, ...]:
        """Return the validation sessions of the first run among the development sessions.

        Two or more train.
        """
        chosen = [name for name, judges in zip(self.development, self.folds(1)[0], strict=True) if judges]
        # Two sessions at least must be left to train.
        return tuple(chosen[: max(1, len(self.development) - 2)])

    @property
    def training(self) -> tuple[str, ...]:
        """The other development sessions."""
        return tuple(name for name in self.development if name not in self.validation)

    def folds(self, runs: int) -> NDArray[np.bool_]:
        """Return the evaluation sessions of each run ``(run, session)``; the first runs do not depend on their number.

        Repeated folds; in the thesis's mode independent draws of as many sessions as a fold has.
        """
        sessions, folds = len(self.development), self.spec.folds
        if self.spec.mode == "thesis":
            return repeated_splits(sessions, max(1, round(sessions / folds)), runs, self.spec.seed)
        # Whole repeats of the folds, cut to the runs: every session is judged once before any is judged twice.
        return repeated_folds(sessions, folds, -(-runs // folds), self.spec.seed)[:runs]

    def shaped(self, arm: Arm) -> Arm:
        """Return an arm with this search's widths of networks."""
        return WIDTHS[self.spec.widths](arm)

    def network(self, arm: Arm, names: Sequence[str] = (), options: Candidate | None = None) -> Arm:
        """Return an arm with modules and toggles added, and this search's widths."""
        return add_modules(arm, names, self.channels, options, self.shaped)

    def orders(self, arm: Arm, runs: Sequence[int], seed: int = 0) -> list[TrainingRequest]:
        """Return one request per run: the same folds and seeds for every arm (common random values).

        Trainings of several epochs are validated by the sessions that evaluate them, as in the thesis.

        Args:
            arm: arm to train.
            runs: their numbers, from 0.
            seed: number of the seed within a run.
        """
        # The mask is made for all runs up to the last, since folds of a run depend on those before it.
        mask = self.folds(max(runs) + 1)
        names = np.array(self.development)
        requests = []
        for run in runs:
            train, judged = (tuple(names[rows].tolist()) for rows in (~mask[run], mask[run]))
            # A seed a run and not an arm: common random numbers make differences between arms smaller.
            seed_of_run = self.seed("run", run, seed)
            requests.append(self.order(arm, train, judged, seed_of_run, self.spec.updates, judged))
        return requests

    def order(
        self,
        arm: Arm,
        train: tuple[str, ...],
        judged: tuple[str, ...],
        seed: int,
        updates: int,
        validation: tuple[str, ...],
    ) -> TrainingRequest:
        """Request a training; `validation` sessions select the best of several epochs and are unused for one epoch."""
        epochs, patience = self.spec.epochs, self.spec.patience
        chosen_by = validation if epochs > 1 else ()
        sessions = (arm.tables, self.source, train, judged)
        return TrainingRequest(*sessions, seed, updates, epochs=epochs, patience=patience, validation=chosen_by)

    def seed(self, *parts: object) -> int:
        """Return a seed for each purpose, derived from the root."""
        text = " ".join(map(str, (self.spec.seed, *parts)))
        # 31 bits: libraries take seeds as signed 32-bit numbers.
        return int.from_bytes(hashlib.blake2b(text.encode(), digest_size=4).digest(), "big") >> 1

    def table(self, outcomes: Sequence[Outcome], name: str = "composite") -> Array:
        """Return scores ``(run, session)`` of runs 0, 1, ....

        NaN for a session that a run does not evaluate, or a failure.
        """
        columns = {session: column for column, session in enumerate(self.development)}
        scores = np.full((len(outcomes), len(columns)), np.nan)
        for row, outcome in enumerate(outcomes):
            for session in outcome.order.judged:
                scores[row, columns[session]] = outcome.score(session, self.spec.horizon, name)
        return scores


def is_enough(sessions: int, spec: SearchSpec) -> bool:
    """Return whether there are enough sessions for test sets and folds; True if test sessions are named."""
    if spec.test or spec.second_test:
        return True
    test = max(1, round(spec.test_fraction * sessions))
    second = max(1, round(spec.second_test_fraction * sessions)) if spec.compression.enabled else 0
    return _fills_folds(sessions - test - second, spec)


def _fills_folds(development: int, spec: SearchSpec) -> bool:
    # Rounded up: the largest fold must leave two sessions to train.
    return development >= max(spec.folds, 3) and development - -(-development // spec.folds) >= 2


def set_apart(
    sessions: Sequence[str], families: Mapping[str, str], spec: SearchSpec
) -> tuple[tuple[str, ...], tuple[str, ...], tuple[str, ...]]:
    """Return development sessions, test sessions, and the second test set, sampled once in proportion from each family.

    Args:
        sessions: names in order.
        families: type of each session, so that tests contain all types; may be empty.
        spec: share and seed.

    Raises:
        ConfigError: a session that is to be set apart is not there, or is named for both test sets.
        DataError: too few sessions for the folds.
    """
    for part, named in (("test", spec.test), ("second", spec.second_test)):
        strange = [name for name in named if name not in sessions]
        if strange:
            raise ConfigError(
                f"search: {part} names '{strange[0]}', and there is no such session{closest(strange[0], sessions)}"
            )
    both = sorted(set(spec.test) & set(spec.second_test))
    if both:
        raise ConfigError(f"search: {', '.join(both)} is named in test and in second; each must be in one of them")
    free = [name for name in sessions if name not in spec.second_test]
    named = tuple(name for name in sessions if name in spec.test)
    # The seed differs from all others of the search, so that the same draw never serves two purposes.
    test = named or _draw_sessions(
        free, families, [spec.seed, 0x7E57], max(1, round(spec.test_fraction * len(sessions)))
    )
    rest = [name for name in free if name not in test]
    second: tuple[str, ...] = ()
    if spec.compression.enabled:
        count = max(1, round(spec.second_test_fraction * len(sessions)))
        named = tuple(name for name in sessions if name in spec.second_test)
        second = named or _draw_sessions(rest, families, [spec.seed, 0x7E58], count)
    development = tuple(name for name in sessions if name not in (*test, *second))
    if not _fills_folds(len(development), spec):
        less = "a smaller test_fraction" + (", --set search.compression.enabled=false" if second else "")
        raise DataError(
            f"{len(sessions)} sessions came: {len(test)} are set apart as test"
            + (f", {len(second)} for phase 6" if second else "")
            + f", and {len(development)} are left for {spec.folds} folds, "
            f"which must leave two to train, and they are too short (or in a store) to be divided: give more or longer "
            f"recordings, {less}, or another number of folds"
        )
    return development, test, second


def _draw_sessions(
    sessions: Sequence[str], families: Mapping[str, str], seed: list[int], session_count: int
) -> tuple[str, ...]:
    rng = np.random.default_rng(seed)
    if session_count >= len(sessions):
        return tuple(sessions)
    kinds: dict[str, list[str]] = {}
    for name in sessions:
        kinds.setdefault(families.get(name, ""), []).append(name)
    queues = [list(rng.permutation(names)) for names in kinds.values()]
    # Largest remainder: every kind gives its share, the rest comes from those with the largest part left over.
    shares = [len(queue) * session_count / len(sessions) for queue in queues]
    counts = [int(share) for share in shares]
    for which in sorted(range(len(queues)), key=lambda i: counts[i] - shares[i])[: session_count - sum(counts)]:
        counts[which] += 1
    chosen = {str(name) for queue, count in zip(queues, counts, strict=True) for name in queue[:count]}
    return tuple(name for name in sessions if name in chosen)
