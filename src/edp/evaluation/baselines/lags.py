"""Lag features: the rows on which the trees and the small network are fitted."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edp.data.lags import DoubleArray, anchors, future, origins
from edp.data.series import Series
from edp.evaluation.baselines.base import BaselineTask
from edp.recording import FloatArray

LAGS = (0, 1, 2, 4, 8, 16, 32)
"""Lags in samples at which inputs are read, dense at small lags where a 100 Hz plant changes quickly."""

# Blocks bound the memory of the lag table, several times as wide as the inputs.
BLOCK_ROWS = 16_384


@dataclass(frozen=True, eq=False)
class LagTable:
    """Sampled training rows.

    Attributes:
        features: float32 ``(row, lag * input)``, see `lag_features`.
        changes: future value minus anchor, ``(row, horizon * target)`` in SI units.
    """

    features: FloatArray
    changes: DoubleArray

    @property
    def rows(self) -> int:
        """Number of sampled rows."""
        return len(self.features)


def lag_features(inputs: FloatArray, ticks: NDArray[np.int64], history: int) -> FloatArray:
    """Return the inputs at `ticks`, then their change since each earlier lag within `history`.

    Changes carry the same information as the values and can be split by a tree without resolving the level.

    Args:
        inputs: ``(time, input)``.
        ticks: ``(row,)``, each at least ``history - 1``.
        history: samples that may be used; lags of `history` and above are left out.

    Returns:
        float32 ``(row, lag * input)``, lag-major.
    """
    now = inputs[ticks]
    # Changes instead of past values: neighbouring samples are nearly equal, and trees split one feature at a time.
    parts = [now if lag == 0 else now - inputs[ticks - lag] for lag in LAGS if lag < history]
    return np.concatenate(parts, axis=1)


def sample_table(series: Sequence[Series], task: BaselineTask, means: DoubleArray, cap: int) -> LagTable:
    """Return at most `cap` random rows over all series without replacement, in order; equal seeds give equal rows."""
    lengths = np.array([len(origins(one, task)) for one in series], dtype=np.int64)
    total = int(lengths.sum())
    # Sorted, so that rows keep the order of their recording; without replacement, so that none counts twice.
    if total > cap:
        chosen = np.sort(np.random.default_rng(task.seed).choice(total, size=cap, replace=False))
    else:
        chosen = np.arange(total)
    ends = np.cumsum(lengths)
    features, changes = [], []
    for one, start, end in zip(series, ends - lengths, ends):
        first, last = np.searchsorted(chosen, (start, end))
        ticks = chosen[first:last] - start + task.history - 1
        if ticks.size:
            features.append(lag_features(one.inputs, ticks, task.history))
            change = future(one, task, ticks) - anchors(one.inputs[ticks], task, means)[:, None, :]
            changes.append(change.reshape(len(ticks), task.outputs))
    if not features:
        return LagTable(np.empty((0, 0), dtype=np.float32), np.empty((0, task.outputs)))
    return LagTable(np.concatenate(features), np.concatenate(changes))


def predict_from_lags(
    inputs: FloatArray, task: BaselineTask, means: DoubleArray, change_of: Callable[[FloatArray], DoubleArray]
) -> DoubleArray:
    """Return anchor plus predicted change at every tick with a full history, block by block.

    Args:
        inputs: ``(time, input)``.
        task: channels to read and to predict.
        means: training means ``(target,)``.
        change_of: maps features ``(row, lag * input)`` to changes ``(row, horizon * target)``.

    Returns:
        ``(time - history + 1, horizon, target)`` in SI units.
    """
    parts = []
    for start in range(task.history - 1, len(inputs), BLOCK_ROWS):
        ticks = np.arange(start, min(start + BLOCK_ROWS, len(inputs)))
        change = change_of(lag_features(inputs, ticks, task.history))
        change = change.reshape(len(ticks), len(task.horizons), len(task.present))
        parts.append(change + anchors(inputs[ticks], task, means)[:, None, :])
    return np.concatenate(parts)
