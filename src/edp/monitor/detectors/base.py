"""Detectors: many parallel streams of residuals with one statistic each, and an alarm above a limit."""

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
    """Running detector on `lanes` independent streams with `channels` residuals each.

    Residuals are standardised and uncorrelated on a healthy machine (`edp.monitor.whitening.Whitening`). One that is
    missing, NaN or infinite, says nothing and counts as 0.

    Args:
        channels: residuals of a stream.
        lanes: streams.
    """

    def __init__(self, channels: int, lanes: int = 1) -> None:
        self.channels, self.lanes = channels, lanes

    def step(self, residuals: Array) -> Array:
        """Process one row per stream, shape (streams, channels).

        Return the statistics, shape (streams,), large for a fault.

        Raises:
            DataError: the rows have another shape.
        """
        rows = np.asarray(residuals, dtype=float)
        if rows.shape != (self.lanes, self.channels):
            raise DataError(f"residuals of shape {rows.shape}; shape ({self.lanes}, {self.channels}) must hold")
        return self._take(np.where(np.isfinite(rows), rows, 0.0))

    @abstractmethod
    def _take(self, rows: Array) -> Array:
        """Return `step` on rows that are finite."""

    @abstractmethod
    def reset(self, lanes: Bools | None = None) -> None:
        """Reset the given streams, shape (streams,); all by default."""


class DetectorSpec(ABC):
    """Options of a detector; frozen dataclasses entered in `DETECTORS`."""

    @abstractmethod
    def build(self, channels: int, lanes: int = 1) -> Detector:
        """Create a new detector."""


DETECTORS: Registry[type[DetectorSpec]] = Registry("detector")


def statistics(detector: Detector, sessions: Array) -> Array:
    """Return statistics of whole sessions, without alarms: shape (time, streams) for (time, streams, channels)."""
    detector.reset()
    return np.array([detector.step(rows) for rows in sessions]).reshape(len(sessions), detector.lanes)


def in_order(terms: Array) -> Array:
    """Sum over the last axis in order, like C; NumPy's `sum` adds in pairs."""
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
    """Return the alarms of sessions with shape (time, streams, channels); a stream is reset at each of its alarms.

    Args:
        detector: is reset first.
        sessions: residuals.
        limit: limit of the statistic, common or one per stream.
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
