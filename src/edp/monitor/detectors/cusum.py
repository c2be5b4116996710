"""Multivariate CUSUM: a vector of sums that shrinks towards zero (Crosier, Technometrics 30, 1988)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from edp.monitor.detectors.base import DETECTORS, Array, Bools, Detector, DetectorSpec, in_order
from edp.settings.bounds import check_bounds, span


class _Cusum(Detector):
    def __init__(self, channels: int, lanes: int, slack: float) -> None:
        super().__init__(channels, lanes)
        self.slack, self.sums = slack, np.zeros((lanes, channels))

    def _take(self, rows: Array) -> Array:
        self.sums += rows
        length = np.sqrt(in_order(np.square(self.sums)))
        # A sum that is shorter than the slack becomes zero; of a longer one the slack is taken off.
        left: Array = np.maximum(length - self.slack, 0.0)
        self.sums *= (left / np.maximum(length, 1e-300))[:, None]
        return left

    def reset(self, lanes: Bools | None = None) -> None:
        self.sums[slice(None) if lanes is None else lanes] = 0.0


@DETECTORS.register("cusum")
@dataclass(frozen=True)
class CusumSpec(DetectorSpec):
    """Multivariate CUSUM.

    Attributes:
        slack: taken off the sum at each row, in standard deviations; half of the shift that is to be seen soonest.

    Raises:
        ConfigError: a value is out of its bounds.
    """

    slack: float = 0.5

    def __post_init__(self) -> None:
        check_bounds("cusum", self, slack=span(0.0, 100.0))

    def build(self, channels: int, lanes: int = 1) -> Detector:
        """See `DetectorSpec.build`."""
        return _Cusum(channels, lanes, self.slack)
