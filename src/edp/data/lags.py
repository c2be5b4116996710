"""Lag tasks: predictions from the last few samples, and the sums required to fit linear maps to them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edp.data.series import Series
from edp.errors import ConfigError
from edp.recording import FloatArray

DoubleArray = NDArray[np.float64]


@dataclass(frozen=True)
class LagTask:
    """Predict each target at t + horizon from the inputs of the last `history` ticks, all in SI units.

    Attributes:
        horizons: horizons in samples, each 0 or more; 0 estimates the target at the current sample.
        present: per target the input column with its present value, or None when no input measures it.
        history: samples up to and including the present one that a prediction may use.

    Raises:
        ConfigError: no or negative or repeated horizons, no targets, no history, or a horizon of 0 for a target
            that the inputs already hold.
    """

    horizons: tuple[int, ...]
    present: tuple[int | None, ...]
    history: int

    def __post_init__(self) -> None:
        if not self.horizons or min(self.horizons) < 0 or len(set(self.horizons)) != len(self.horizons):
            raise ConfigError(f"lag task horizons are {self.horizons}; give one or more distinct values, 0 or above")
        if not self.present:
            raise ConfigError("the lag task has no targets; name at least one")
        if self.history < 1:
            raise ConfigError(f"lag history is {self.history} samples; it must be at least 1 (the present one)")
        present_targets = [target for target, column in enumerate(self.present) if column is not None]
        if 0 in self.horizons and present_targets:
            raise ConfigError(
                f"horizon 0 asks for target {present_targets[0]} at the very tick at which input column "
                f"{self.present[present_targets[0]]} holds it; drop that input or predict from horizon 1"
            )

    @property
    def outputs(self) -> int:
        """Number of predicted values per tick: horizons times targets."""
        return len(self.horizons) * len(self.present)


def origins(series: Series, task: LagTask) -> range:
    """Return the ticks with a full history behind them and the longest horizon before them.

    The same ones for all horizons.
    """
    # Empty instead of negative for a series that is too short.
    return range(task.history - 1, max(task.history - 1, series.samples - max(task.horizons)))


def future(series: Series, task: LagTask, ticks: NDArray[np.int64]) -> DoubleArray:
    """Return the targets at sample + horizon, ``(tick, horizon, target)``."""
    return np.stack([series.targets[ticks + horizon] for horizon in task.horizons], axis=1).astype(np.float64)


def target_means(series: Sequence[Series]) -> DoubleArray:
    """Return the mean of each target over all ticks, ``(target,)``."""
    total = sum(one.targets.sum(axis=0, dtype=np.float64) for one in series)
    return np.asarray(total / sum(one.samples for one in series), dtype=np.float64)


def anchors(inputs: FloatArray, task: LagTask, means: DoubleArray) -> DoubleArray:
    """Return the reference value of each prediction: the present measurement, or the training mean if missing.

    Args:
        inputs: ``(row, input)``.
        task: task that defines the column with the present value of each target.
        means: training means ``(target,)``.

    Returns:
        ``(row, target)``.
    """
    starts = np.tile(means, (len(inputs), 1))
    for target, column in enumerate(task.present):
        if column is not None:
            starts[:, target] = inputs[:, column]
    return starts
