"""E-detector of the kind of Shiryaev and Roberts (Shin, Ramdas and Rinaldo, New England J. Stat. Data Sci. 2, 2024).

Each member bets on a shift of one residual by some size to one side: M <- (M + 1) exp(s x - s^2 / 2). On a healthy
machine with independent normal residuals the mean of all M less the number of rows is a martingale, so that a limit of
A gives A rows at least between false alarms on average, whatever the members. Residuals of machines are not
independent: limits are calibrated all the same.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from edp.errors import ConfigError
from edp.monitor.detectors.base import DETECTORS, Array, Bools, Detector, DetectorSpec
from edp.settings.bounds import above, check_bounds, check_count

MOST = 600.0
"""Maximum logarithm of an e-value, which keeps its exponential finite."""


class _EDetector(Detector):
    def __init__(self, channels: int, lanes: int, shifts: tuple[float, ...]) -> None:
        super().__init__(channels, lanes)
        self.shifts = np.array([side * shift for shift in shifts for side in (-1.0, 1.0)])
        self.logs = np.full((lanes, channels, len(self.shifts)), -np.inf)

    def _take(self, rows: Array) -> Array:
        gain = rows[:, :, None] * self.shifts - 0.5 * np.square(self.shifts)
        # log(M + 1) + gain, with M kept as its logarithm.
        self.logs = np.minimum(np.logaddexp(self.logs, 0.0) + gain, MOST)
        largest = self.logs.max(axis=(1, 2))
        mean = np.exp(self.logs - largest[:, None, None]).mean(axis=(1, 2))
        # The logarithm: the mean itself passes the largest number within minutes of a fault.
        statistic: Array = largest + np.log(mean)
        return statistic

    def reset(self, lanes: Bools | None = None) -> None:
        self.logs[slice(None) if lanes is None else lanes] = -np.inf


@DETECTORS.register("e_detector")
@dataclass(frozen=True)
class EDetectorSpec(DetectorSpec):
    """E-detector. Its statistic is the logarithm of the e-process, so that a limit of log A corresponds to A rows.

    Attributes:
        shifts: sizes of shifts that are bet on, in standard deviations.

    Raises:
        ConfigError: a value is out of its bounds.
    """

    shifts: tuple[float, ...] = (0.25, 0.5, 1.0, 2.0)

    def __post_init__(self) -> None:
        object.__setattr__(self, "shifts", tuple(self.shifts))
        check_count("e_detector", "shifts", self.shifts, 20, least=1)
        check_bounds("e_detector", self, shifts=above(0.0, 100.0))
        if len(set(self.shifts)) < len(self.shifts):
            raise ConfigError(f"e_detector: shifts = {list(self.shifts)}; name each once")

    def build(self, channels: int, lanes: int = 1) -> Detector:
        """See `DetectorSpec.build`."""
        return _EDetector(channels, lanes, self.shifts)
