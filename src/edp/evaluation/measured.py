"""What predictions of one model measure, recording by recording: parts of it can be gathered apart and added."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from edp.evaluation.by_situation import SituationTally
from edp.evaluation.scores_file import ByTarget, SpeedBin
from edp.evaluation.tally import Tally, Values

# Six bins show where an error grows with speed and leave enough samples in each.
SPEED_BINS = 6


class Measured:
    """Sums and ticks of which scores are made, at each horizon.

    `state` gives all that it holds as plain values and arrays, `add` takes that in: a process or a node may gather a
    part of the recordings. Parts that are added in their order give the bits of one process that does the same.

    Attributes:
        tallies, by_situation, speeds: of each horizon.
        integrals: by target that is integrated its ticks, and the sum of squares of the integral's error.
        recordings: scores by number of the recording and horizon.
    """

    def __init__(self, targets: Sequence[str], horizons: int, edges: Values, integrate: Sequence[str]) -> None:
        self.tallies = [Tally(targets) for _ in range(horizons)]
        self.by_situation = [SituationTally(targets) for _ in range(horizons)]
        self.speeds = [SpeedTally(edges) for _ in range(horizons)]
        self.integrals = {target: np.zeros(2) for target in integrate}
        self.recordings: dict[int, dict[str, ByTarget]] = {}

    def state(self) -> dict[str, object]:
        """All that it holds, as plain values and arrays."""
        return {
            "tallies": [tally.state() for tally in self.tallies],
            "by_situation": [tally.state() for tally in self.by_situation],
            "speeds": [tally.state() for tally in self.speeds],
            "integrals": dict(self.integrals),
            "recordings": dict(self.recordings),
        }

    def add(self, state: Mapping[str, Any]) -> None:
        """Take in what another one held, by its `state`."""
        for name in ("tallies", "by_situation", "speeds"):
            for own, other in zip(getattr(self, name), state[name], strict=True):
                own.add(other)
        for target, sums in state["integrals"].items():
            self.integrals[target] += sums
        self.recordings |= state["recordings"]


class MeasuredIntervals:
    """Sums of which scores of intervals are made, ``(horizon, coverage, target)``, and the ticks that are in them."""

    def __init__(self, shape: tuple[int, int, int]) -> None:
        self.covered, self.wide, self.scored, self.ticks = np.zeros(shape), np.zeros(shape), np.zeros(shape), 0

    def state(self) -> dict[str, Any]:
        """All that it holds, as plain values and arrays."""
        return {"covered": self.covered, "wide": self.wide, "scored": self.scored, "ticks": self.ticks}

    def add(self, state: Mapping[str, Any]) -> None:
        """Take in what another one held, by its `state`."""
        self.covered += state["covered"]
        self.wide += state["wide"]
        self.scored += state["scored"]
        self.ticks += state["ticks"]


class SpeedTally:
    """Mean absolute error in bins of the target's magnitude, outputs pooled; `edges` are those of the bins."""

    def __init__(self, edges: Values) -> None:
        self.edges = edges
        self.count, self.total = np.zeros(SPEED_BINS, dtype=np.int64), np.zeros(SPEED_BINS)

    def update(self, predicted: Values, truth: Values) -> None:
        """Take in ticks, each ``(tick, target)``."""
        # Speeds beyond the last edge belong to the last bin.
        places = np.clip(np.digitize(np.abs(truth), self.edges) - 1, 0, SPEED_BINS - 1).ravel()
        self.count += np.bincount(places, minlength=SPEED_BINS)
        self.total += np.bincount(places, weights=np.abs(predicted - truth).ravel(), minlength=SPEED_BINS)

    def state(self) -> dict[str, object]:
        """All that it holds, as arrays."""
        return {"count": self.count, "total": self.total}

    def add(self, state: Mapping[str, Any]) -> None:
        """Take in what another one held, by its `state`."""
        self.count += state["count"]
        self.total += state["total"]

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
