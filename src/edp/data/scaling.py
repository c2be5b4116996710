"""Scaling to a uniform numerical range, fitted on training data only (eq. 3.4, 3.5)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edp.data.features import STARTING, derive
from edp.data.gathered import LastMade, make_lazy_array, some_columns
from edp.data.moments import Moments
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
    """Return the standard deviation, in SI units, up to which a channel counts as constant.

    Args:
        kind: its nominal size is the measure: the noise of a frozen sensor is not motion.
        largest: magnitude of the channel in the recordings, which is the measure where the kind says nothing of size.
    """
    return CONSTANT * (largest if kind is Kind.GENERIC else KINDS[kind].nominal)


def feature_matrix(task: Task, series: Series) -> NDArray[np.float32]:
    """Return the features of a whole segment, ``(time, feature)``, with initialisation inputs at every sample."""
    inputs = task.features.inputs
    if not task.features.derived and not task.features.init_channels:
        return series.inputs[:, : len(task.features.channels)]
    own = len(task.features.channels)
    # Filled in place: columns that are stacked one by one take five times as long.
    features = np.empty((series.samples, len(task.features.features)), dtype=np.float32)
    features[:, :own] = series.inputs[:, :own]
    for column, entry in enumerate(task.features.derived, own):
        features[:, column] = derive(entry, series.inputs[:, inputs.index(entry.source)], task.rate_hz)
    for column, name in enumerate(task.features.init_channels, len(task.features.lasting)):
        features[:, column] = series.inputs[:, inputs.index(name)]
    if task.features.init_channels:
        features[:, -1] = 1.0
    return features


def feature_columns(task: Task, series: Series, places: Sequence[int], slot: LastMade) -> NDArray[np.float32]:
    """Return selected features of a segment, ``(time, len(places))``.

    Channels are a view; derived features are computed on access.

    Args:
        task: channels to read.
        series: the segment.
        places: indices of the features, in the required order.
        slot: shared by segments that are gone through one after the other.
    """
    if max(places, default=0) < len(task.features.channels):
        return some_columns(series.inputs, places)
    shape = (series.samples, len(places))
    return make_lazy_array(shape, lambda: feature_matrix(task, series)[:, list(places)], slot)


def fit_scaler(task: Task, train: Sequence[Series], kinds: Sequence[Kind]) -> Scaler:
    """Fit a scaler to the training segments.

    Bounded kinds (position, angle, ratio) use min-max scaling to [-1, 1], other kinds the z-score.

    Args:
        task: channels to read and to predict.
        train: the training segments, nothing else.
        kinds: kind of each feature, in order.
    """
    features, changes = _moments(task, train)
    low, high, mean, std = features.low, features.high, features.mean, features.deviation
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
    for row in range(len(task.horizons)):
        target_mean, target_std = changes[row].mean, changes[row].deviation
        if task.mode is TargetMode.ABSOLUTE:
            target_offset[row] = target_mean
        # A target that never changes keeps its unit instead of dividing by zero.
        target_scale[row] = np.where(target_std > 0, target_std, 1.0)
    return Scaler(offset, scale, target_offset, target_scale, tuple(constant))


def _moments(task: Task, train: Sequence[Series]) -> tuple[Moments, list[Moments]]:
    """Return the moments of the features, and of the encoded targets at each horizon, in one pass over the series."""
    features = Moments(len(task.features.features))
    changes = [Moments(len(task.targets)) for _ in task.horizons]
    for series in train:
        features.update(feature_matrix(task, series))
        targets = np.asarray(series.targets)
        for moments, horizon in zip(changes, task.horizons, strict=True):
            if series.samples > horizon:
                moments.update(_encode_targets(task, targets, horizon))
    return features, changes


def _encode_targets(task: Task, targets: NDArray[np.float32], horizon: int) -> NDArray[np.float32]:
    future = targets[horizon:]
    return future - targets[: len(future)] if task.mode is TargetMode.DELTA else future
