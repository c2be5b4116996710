"""Scaling to a uniform numerical range, fitted on training data only (eq. 3.4, 3.5)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from edp.data.features import STARTING, derive
from edp.data.series import Series
from edp.data.task import TargetMode, Task
from edp.signals import KINDS, Kind

# A standard deviation below this share of the kind's size is a constant channel, not a signal.
CONSTANT = 1e-6


@dataclass(frozen=True, eq=False)
class Scaler:
    """Affine maps to the network's space: ``scaled = (physical - offset) / scale``.

    Attributes:
        feature_offset: ``(feature,)``, SI units.
        feature_scale: ``(feature,)``, SI units, positive.
        target_offset: ``(horizon, target)``; zero in delta mode, so that the inverse is ``sigma * y``.
        target_scale: ``(horizon, target)``, positive.
        constant: names of features that did not move in the training data; they scale by the nominal size of
            their kind.
    """

    feature_offset: NDArray[np.float64]
    feature_scale: NDArray[np.float64]
    target_offset: NDArray[np.float64]
    target_scale: NDArray[np.float64]
    constant: tuple[str, ...] = ()


def least_spread(kind: Kind, largest: float) -> float:
    """Standard deviation, in SI units, at or below which a channel counts as constant.

    Args:
        kind: its nominal size is the measure: the noise of a frozen sensor is not motion.
        largest: magnitude of the channel in the recordings, which is the measure where the kind says nothing of size.
    """
    return CONSTANT * (largest if kind is Kind.GENERIC else KINDS[kind].nominal)


def feature_matrix(task: Task, series: Series) -> NDArray[np.float32]:
    """Features of a whole stretch, ``(time, feature)``, those of the start as if they were read at every tick."""
    inputs = task.features.inputs
    columns = [series.inputs[:, i] for i in range(len(task.features.channels))]
    for entry in task.features.derived:
        columns.append(derive(entry, series.inputs[:, inputs.index(entry.source)], task.rate_hz))
    if task.features.starting:
        columns += [series.inputs[:, inputs.index(name)] for name in task.features.starting]
        columns.append(np.ones(series.samples, dtype=np.float32))
    return np.stack(columns, axis=1)


def fit_scaler(task: Task, train: Sequence[Series], kinds: Sequence[Kind]) -> Scaler:
    """Fit on the training stretches: min-max to [-1, 1] for bounded kinds (position, angle, ratio), else z-score.

    Args:
        task: what is read and predicted.
        train: the training stretches, nothing else.
        kinds: kind of each feature, in order.
    """
    low, high, mean, std = _moments([partial(feature_matrix, task, series) for series in train])
    offset, scale = mean.copy(), std.copy()
    constant = []
    for i, kind in enumerate(kinds):
        facts = KINDS[kind]
        if std[i] <= least_spread(kind, max(abs(low[i]), abs(high[i]))):
            scale[i] = facts.nominal
            # It is constant by construction while channels of the start are read, and no fault of the data.
            if task.features.features[i] != STARTING:
                constant.append(task.features.features[i])
        elif facts.bounded:
            offset[i], scale[i] = (low[i] + high[i]) / 2, (high[i] - low[i]) / 2
    target_offset = np.zeros((len(task.horizons), len(task.targets)))
    target_scale = np.ones_like(target_offset)
    for row, horizon in enumerate(task.horizons):
        longer = [series for series in train if series.samples > horizon]
        _, _, target_mean, target_std = _moments([partial(_encoded, task, series, horizon) for series in longer])
        if task.mode is TargetMode.ABSOLUTE:
            target_offset[row] = target_mean
        # A target that never changes keeps its unit instead of dividing by zero.
        target_scale[row] = np.where(target_std > 0, target_std, 1.0)
    return Scaler(offset, scale, target_offset, target_scale, tuple(constant))


def _encoded(task: Task, series: Series, horizon: int) -> NDArray[np.float32]:
    future = series.targets[horizon:]
    if task.mode is TargetMode.DELTA:
        return future - series.targets[: len(future)]
    return future


Vector = NDArray[np.float64]


def _moments(parts: Sequence[Callable[[], NDArray[np.float32]]]) -> tuple[Vector, Vector, Vector, Vector]:
    """Minimum, maximum, mean and standard deviation per column, merged over parts in double precision.

    Each part is made twice instead of kept: hours of logs need not be in memory together.
    """
    count, lows, highs, sums = 0, [], [], []
    for make in parts:
        part = make()
        count += len(part)
        lows.append(part.min(axis=0))
        highs.append(part.max(axis=0))
        sums.append(part.sum(axis=0, dtype=np.float64))
    low, high = np.min(lows, axis=0).astype(np.float64), np.max(highs, axis=0).astype(np.float64)
    mean = sum(sums) / count
    # In two passes: the sum of squares less the squared mean would cancel for pressures of 30 MPa.
    spread = sum(_squares(make(), mean) for make in parts) / count
    return low, high, np.asarray(mean), np.sqrt(spread)


def _squares(part: NDArray[np.float32], mean: Vector) -> Vector:
    total = np.zeros_like(mean)
    for start in range(0, len(part), 65536):  # double-precision copies of a block, not of the whole recording
        total += np.square(part[start : start + 65536] - mean).sum(axis=0)
    return total
