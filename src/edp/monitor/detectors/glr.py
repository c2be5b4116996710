"""Generalised likelihood ratio of a shift of the mean that began within a window (Lai, JRSS B 57, 1995)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from edp.monitor.detectors.base import DETECTORS, Array, Bools, Detector, DetectorSpec, in_order
from edp.settings.bounds import check_bounds, integer


class _Glr(Detector):
    def __init__(self, channels: int, lanes: int, window: int) -> None:
        super().__init__(channels, lanes)
        self.window = window
        # sums[lane, n]: of the last n + 1 rows; those that reach beyond the last reset are not yet there.
        self.sums = np.zeros((lanes, window, channels))
        self.rows = np.zeros(lanes, dtype=np.int64)

    def _take(self, rows: Array) -> Array:
        self.sums[:, 1:] = self.sums[:, :-1]
        self.sums[:, 0] = 0.0
        self.sums += rows[:, None, :]
        self.rows = np.minimum(self.rows + 1, self.window)
        lengths = np.arange(1, self.window + 1)
        ratios = in_order(np.square(self.sums)) / (2.0 * lengths)
        statistic: Array = np.where(lengths <= self.rows[:, None], ratios, 0.0).max(axis=1)
        return statistic

    def reset(self, lanes: Bools | None = None) -> None:
        chosen = slice(None) if lanes is None else lanes
        self.sums[chosen], self.rows[chosen] = 0.0, 0


@DETECTORS.register("glr")
@dataclass(frozen=True)
class GlrSpec(DetectorSpec):
    """Generalised likelihood ratio.

    Attributes:
        window: rows back at which a shift may have begun.

    Raises:
        ConfigError: a value is out of its bounds.
    """

    window: int = 100

    def __post_init__(self) -> None:
        check_bounds("glr", self, window=integer(1, 10_000))

    def build(self, channels: int, lanes: int = 1) -> Detector:
        """See `DetectorSpec.build`."""
        return _Glr(channels, lanes, self.window)
