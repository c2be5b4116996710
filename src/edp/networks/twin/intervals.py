"""Intervals of a free run that grow with its horizon, calibrated on free runs that no training saw (conformal)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from edp.data.twin_channels import TwinChannels
from edp.settings.bounds import MAX_ROWS, SHARE, integer
from edp.storage.reading import Table

Array = NDArray[np.float32]
KNOTS_A_DECADE = 12
"""Number of horizons per decade at which interval widths are calibrated. Errors at neighbouring samples are nearly
equal."""
TICKS = integer(1, MAX_ROWS)


@dataclass(frozen=True, eq=False)
class FreeRunIntervals:
    """Half widths of the intervals of each output by horizon, for runs with all ports free.

    Between knots, half widths are linear in the logarithm of the horizon. Beyond the last knot they are constant, and
    the coverage is not validated there.

    Attributes:
        coverage: intended fraction of the runs within the interval, equal for all horizons.
        ticks: horizons of the knots, growing.
        half_width: ``(knot, output)``, SI units, never shrinking with the horizon.
        runs: free runs that calibrated them.

    Raises:
        ValueError: shapes that do not fit, horizons that do not grow, or widths that shrink or are no numbers.
    """

    coverage: float
    ticks: tuple[int, ...]
    half_width: Array
    runs: int

    def __post_init__(self) -> None:
        width, ticks = self.half_width, self.ticks
        if not SHARE.holds(self.coverage) or not all(TICKS.holds(n) for n in (*ticks, self.runs)):
            raise ValueError("its intervals have a coverage, a horizon or a number of runs that cannot be")
        if not ticks or width.ndim != 2 or len(width) != len(ticks):
            raise ValueError(f"its intervals have {len(ticks)} horizons and widths of shape {width.shape}")
        if any(later <= earlier for earlier, later in pairwise(ticks)):
            raise ValueError("the horizons of its intervals do not grow")
        if not np.isfinite(width).all() or (width < 0).any() or (np.diff(width, axis=0) < 0).any():
            raise ValueError("the widths of its intervals shrink with the horizon, or are no numbers")

    def at(self, ticks: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return half widths ``(tick, output)`` at these horizons, SI units.

        Tick 1 is the first output of a free run.
        """
        at_log, knots_log = np.log(np.maximum(ticks, 1)), np.log(self.ticks)
        return np.stack([np.interp(at_log, knots_log, column) for column in self.half_width.T], axis=1)

    def to_dict(self) -> dict[str, object]:
        """Convert to JSON types."""
        widths = [[float(value) for value in row] for row in self.half_width]
        return {"coverage": self.coverage, "ticks": list(self.ticks), "half_width": widths, "runs": self.runs}

    @staticmethod
    def from_dict(entry: Table, channels: TwinChannels) -> FreeRunIntervals:
        """Create intervals from the result of `to_dict`.

        Raises:
            ValueError: not the intervals of a twin with these channels.
            KeyError, TypeError: not intervals at all.
        """
        widths = np.array(entry["half_width"], dtype=np.float32)
        intervals = FreeRunIntervals(entry["coverage"], tuple(entry["ticks"]), widths, entry["runs"])
        if widths.shape[1] != len(channels.answers):
            raise ValueError(f"its intervals are of {widths.shape[1]} answers, it has {len(channels.answers)}")
        return intervals


def calibrate(errors: Array, coverage: float) -> FreeRunIntervals:
    """Return split-conformal half widths by horizon, from free runs not used for training or selection.

    At each knot the width is the quantile of the absolute errors around it whose level is ``ceil((n + 1) coverage) /
    n`` of the n runs that reach it, the finite-sample level of split conformal prediction; the largest error where
    that is above 1. Widths are then made to grow with the horizon by isotonic regression.

    Args:
        errors: errors of free-run simulations ``(run, tick, output)``, SI units, tick 1 first; NaN after the end of a
            run. At least one run reaches the last tick.
        coverage: intended fraction of the runs within the interval.
    """
    # Here, since every command with a network imports this module, and scipy.optimize takes a second.
    from scipy.optimize import isotonic_regression

    runs, longest, answers = errors.shape
    count = 1 + math.ceil(KNOTS_A_DECADE * math.log10(longest)) if longest > 1 else 1
    ticks = np.unique(np.geomspace(1, longest, count).round().astype(np.int64))
    # Up to the middle of the way to the neighbours, so that each tick counts at one knot.
    middles = np.sqrt(ticks[1:] * ticks[:-1].astype(np.float64))
    first = np.concatenate([[0], np.floor(middles).astype(np.int64)])
    last = np.concatenate([first[1:], [longest]])
    widths = np.empty((len(ticks), answers))
    for knot, (start, stop) in enumerate(zip(first, last, strict=True)):
        window = errors[:, start : max(stop, start + 1)]
        window = window[~np.isnan(window[:, -1, 0])]
        rank = min(len(window), math.ceil((len(window) + 1) * coverage))
        around = np.abs(window).reshape(-1, answers)
        # A whole number of ticks of each run is pooled, so the rank among runs stays exact.
        row = rank * window.shape[1] - 1
        widths[knot] = np.partition(around, row, axis=0)[row]
    for column in range(answers):
        widths[:, column] = isotonic_regression(widths[:, column]).x
    # Rounding to single precision may not turn equal widths into shrinking ones.
    growing = np.maximum.accumulate(widths.astype(np.float32), axis=0)
    return FreeRunIntervals(coverage, tuple(int(tick) for tick in ticks), growing, runs)
