"""A two-sided CUSUM for each residual by itself (Page, Biometrika 41, 1954); the largest counts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from edp.monitor.detectors.base import DETECTORS, Array, Bools, Detector, DetectorSpec
from edp.settings.bounds import check_bounds, span


class _SeparateCusums(Detector):
    def __init__(self, channels: int, lanes: int, slack: float) -> None:
        super().__init__(channels, lanes)
        self.slack = slack
        self.up, self.down = np.zeros((lanes, channels)), np.zeros((lanes, channels))

    def _take(self, rows: Array) -> Array:
        self.up = np.maximum(self.up + rows - self.slack, 0.0)
        self.down = np.maximum(self.down - rows - self.slack, 0.0)
        largest: Array = np.maximum(self.up, self.down).max(axis=1)
        return largest

    def reset(self, lanes: Bools | None = None) -> None:
        chosen = slice(None) if lanes is None else lanes
        self.up[chosen] = self.down[chosen] = 0.0


@DETECTORS.register("separate_cusums")
@dataclass(frozen=True)
class SeparateCusumsSpec(DetectorSpec):
    """A CUSUM up and one down for each residual.

    Attributes:
        slack: taken off each sum at each row, in standard deviations; half of the shift that is to be seen soonest.

    Raises:
        ConfigError: a value is out of its bounds.
    """

    slack: float = 0.5

    def __post_init__(self) -> None:
        check_bounds("separate_cusums", self, slack=span(0.0, 100.0))

    def build(self, channels: int, lanes: int = 1) -> Detector:
        """See `DetectorSpec.build`."""
        return _SeparateCusums(channels, lanes, self.slack)
