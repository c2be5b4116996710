"""What a detector is: many streams of residuals side by side, one number each, and an alarm where it passes a limit."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edp.errors import DataError
from edp.registry import Registry

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]


class Detector(ABC):
    """A detector at work on `lanes` independent streams of `channels` residuals each.

    Residuals are standardised and uncorrelated on a healthy machine (`edp.monitor.whitening.Whitening`). One that is
    missing, NaN or infinite, says nothing and counts as 0.

    Args:
        channels: residuals of a stream.
        lanes: streams.
    """

    def __init__(self, channels: int, lanes: int = 1) -> None:
        self.channels, self.lanes = channels, lanes

    def step(self, residuals: Array) -> Array:
        """Take one row of every stream, shape (lanes, channels); the statistics, shape (lanes,), large for a fault.

        Raises:
            DataError: the rows have another shape.
        """
        rows = np.asarray(residuals, dtype=float)
        if rows.shape != (self.lanes, self.channels):
            raise DataError(f"residuals of shape {rows.shape}; shape ({self.lanes}, {self.channels}) must hold")
        return self._take(np.where(np.isfinite(rows), rows, 0.0))

    @abstractmethod
    def _take(self, rows: Array) -> Array:
        """`step` on rows that are finite."""

    @abstractmethod
    def reset(self, lanes: Bools | None = None) -> None:
        """Forget what these streams have brought, shape (lanes,); all of them by default."""


class DetectorSpec(ABC):
    """Options of a detector; frozen dataclasses entered in `DETECTORS`."""

    @abstractmethod
    def build(self, channels: int, lanes: int = 1) -> Detector:
        """A fresh detector."""


DETECTORS: Registry[type[DetectorSpec]] = Registry("detector")


def statistics(detector: Detector, sessions: Array) -> Array:
    """Statistics of whole sessions from a reset on, without alarms: shape (time, lanes) of (time, lanes, channels)."""
    detector.reset()
    return np.array([detector.step(rows) for rows in sessions]).reshape(len(sessions), detector.lanes)


def in_order(terms: Array) -> Array:
    """Sums over the last axis from the first term to the last, as C adds them; `sum` adds in pairs."""
    if not terms.shape[-1]:
        return np.zeros(terms.shape[:-1])
    sums: Array = np.add.accumulate(terms, axis=-1)[..., -1]
    return sums


@dataclass(frozen=True)
class Alarm:
    """One alarm: at which row of which stream, and the statistic that passed the limit."""

    row: int
    lane: int
    statistic: float


def alarms(detector: Detector, sessions: Array, limit: float | Array) -> list[Alarm]:
    """Alarms of sessions of shape (time, lanes, channels); a stream is reset at each of its alarms.

    Args:
        detector: is reset first.
        sessions: residuals.
        limit: that a statistic has to pass; one, or one a lane.
    """
    detector.reset()
    raised = []
    for row, residuals in enumerate(sessions):
        values = detector.step(residuals)
        over = values > limit
        if over.any():
            raised += [Alarm(row, lane, float(values[lane])) for lane in np.flatnonzero(over).tolist()]
            detector.reset(over)
    return raised
