"""T2 of exponentially weighted means (Lowry, Woodall, Champ and Rigdon, Technometrics 34, 1992)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from edp.monitor.detectors.base import DETECTORS, Array, Bools, Detector, DetectorSpec, in_order
from edp.settings.bounds import above, check_bounds


class _Ewma(Detector):
    def __init__(self, channels: int, lanes: int, weight: float) -> None:
        super().__init__(channels, lanes)
        self.weight, self.means = weight, np.zeros((lanes, channels))

    def _take(self, rows: Array) -> Array:
        self.means += self.weight * (rows - self.means)
        # The variance of the mean after long; at first it is smaller, and the detector is a little less eager.
        statistic: Array = in_order(np.square(self.means)) * ((2.0 - self.weight) / self.weight)
        return statistic

    def reset(self, lanes: Bools | None = None) -> None:
        self.means[slice(None) if lanes is None else lanes] = 0.0


@DETECTORS.register("ewma")
@dataclass(frozen=True)
class EwmaSpec(DetectorSpec):
    """T2 of exponentially weighted means.

    Attributes:
        weight: weight of the newest row; 1 gives Hotelling's T2 of single rows.

    Raises:
        ConfigError: a value is out of its bounds.
    """

    weight: float = 0.1

    def __post_init__(self) -> None:
        check_bounds("ewma", self, weight=above(0.0, 1.0))

    def build(self, channels: int, lanes: int = 1) -> Detector:
        """See `DetectorSpec.build`."""
        return _Ewma(channels, lanes, self.weight)
