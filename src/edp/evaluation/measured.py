"""Metrics of one model's predictions, recording by recording; partial metrics can be computed separately and added."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edp.evaluation.by_situation import SituationTally
from edp.evaluation.scores_file import ByTarget, SpeedBin
from edp.evaluation.tally import Tally, TallyState, Values

# Six bins show where an error grows with speed and leave enough samples in each.
SPEED_BINS = 6


@dataclass(frozen=True, eq=False)
class SpeedState:
    """Content of a `SpeedTally`."""

    count: NDArray[np.int64]
    total: Values


@dataclass(frozen=True, eq=False)
class IntervalsState:
    """Content of `MeasuredIntervals`."""

    covered: Values
    wide: Values
    scored: Values
    ticks: int


@dataclass(frozen=True, eq=False)
class MeasuredState:
    """Content of `Measured`."""

    tallies: tuple[TallyState, ...]
    by_situation: tuple[Mapping[str, NDArray[Any]], ...]
    speeds: tuple[SpeedState, ...]
    integrals: Mapping[str, Values]
    recordings: Mapping[int, Mapping[str, ByTarget]]


class Measured:
    """Sums and ticks of which scores are made, at each horizon.

    `state` gives all that it holds as plain values and arrays, `add` takes that in: a process or a node may gather a
    part of the recordings. Parts that are added in their order give the bits of one process that does the same.

    Attributes:
        tallies, by_situation, speeds: accumulated values of each horizon.
        integrals: by integrated target, the number of samples and the sum of squared errors of the integral.
        recordings: scores by number of the recording and horizon.
    """

    def __init__(self, targets: Sequence[str], horizons: int, edges: Values, integrate: Sequence[str]) -> None:
        self.tallies = [Tally(targets) for _ in range(horizons)]
        self.by_situation = [SituationTally(targets) for _ in range(horizons)]
        self.speeds = [SpeedTally(edges) for _ in range(horizons)]
        self.integrals = {target: np.zeros(2) for target in integrate}
        self.recordings: dict[int, dict[str, ByTarget]] = {}

    def state(self) -> MeasuredState:
        """Return the content, for another process."""
        return MeasuredState(
            tallies=tuple(tally.state() for tally in self.tallies),
            by_situation=tuple(tally.state() for tally in self.by_situation),
            speeds=tuple(tally.state() for tally in self.speeds),
            integrals=dict(self.integrals),
            recordings=dict(self.recordings),
        )

    def add(self, state: MeasuredState) -> None:
        """Add the content of another one."""
        for tally, other in zip(self.tallies, state.tallies, strict=True):
            tally.add(other)
        for situations, ticks in zip(self.by_situation, state.by_situation, strict=True):
            situations.add(ticks)
        for speeds, bins in zip(self.speeds, state.speeds, strict=True):
            speeds.add(bins)
        for target, sums in state.integrals.items():
            self.integrals[target] += sums
        self.recordings |= {number: dict(scores) for number, scores in state.recordings.items()}


class MeasuredIntervals:
    """Sums of which scores of intervals are made, ``(horizon, coverage, target)``, and the ticks that are in them."""

    def __init__(self, shape: tuple[int, int, int]) -> None:
        self.covered, self.wide, self.scored, self.ticks = np.zeros(shape), np.zeros(shape), np.zeros(shape), 0

    def state(self) -> IntervalsState:
        """Return the content, for another process."""
        return IntervalsState(self.covered, self.wide, self.scored, self.ticks)

    def add(self, state: IntervalsState) -> None:
        """Add the content of another one."""
        self.covered += state.covered
        self.wide += state.wide
        self.scored += state.scored
        self.ticks += state.ticks


class SpeedTally:
    """Mean absolute error in bins of the target's magnitude, outputs pooled; `edges` bound the bins."""

    def __init__(self, edges: Values) -> None:
        self.edges = edges
        self.count, self.total = np.zeros(SPEED_BINS, dtype=np.int64), np.zeros(SPEED_BINS)

    def update(self, predicted: Values, truth: Values) -> None:
        """Take in ticks, each ``(tick, target)``."""
        # Speeds beyond the last edge belong to the last bin.
        places = np.clip(np.digitize(np.abs(truth), self.edges) - 1, 0, SPEED_BINS - 1).ravel()
        self.count += np.bincount(places, minlength=SPEED_BINS)
        self.total += np.bincount(places, weights=np.abs(predicted - truth).ravel(), minlength=SPEED_BINS)

    def state(self) -> SpeedState:
        """Return the content, for another process."""
        return SpeedState(self.count, self.total)

    def add(self, state: SpeedState) -> None:
        """Add the content of another one."""
        self.count += state.count
        self.total += state.total

    def rows(self) -> tuple[SpeedBin, ...]:
        """Return the bins from slow to fast."""
        return tuple(
            SpeedBin(
                low=float(self.edges[i]),
                high=float(self.edges[i + 1]),
                count=int(self.count[i]),
                mae=float(self.total[i] / self.count[i]) if self.count[i] else None,
            )
            for i in range(SPEED_BINS)
        )
