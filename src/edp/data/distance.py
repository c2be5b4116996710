"""Distance of test data from training data, by nearest neighbours in the space of motion states."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edp.data.roles import Axis
from edp.data.splits import Split, Stretch
from edp.recording import Recording

Array = NDArray[np.float64]
REFERENCES, QUERIES = 20_000, 4_000
"""Maximum number of reference samples and of query samples. Distances decrease with the number of references, so both
data sets use equally many."""
MAX_STATES = 1 << 20
"""Maximum number of states to select from. Longer data are thinned evenly first."""
EARLIER_S = 0.2
"""Age of the second command sample in a state, s, about the delay of a hydraulic axis. The first command sample is the
current one."""


@dataclass(frozen=True)
class Distance:
    """Distance to the nearest training sample, in deviations of a signal (root mean square over the signals).

    Attributes:
        signals: number of signals in a state.
        test: median and 95 % quantile over test samples.
        train: reference distances from one half of the training segments to the other half, with equally many samples.
        beyond: fraction of the test samples farther away than 95 % of the training samples; 5 % for equally distributed
            data.
    """

    signals: int
    test: tuple[float, float]
    train: tuple[float, float]
    beyond: float


def split_distance(recordings: Sequence[Recording], axes: Sequence[Axis], split: Split) -> Distance | None:
    """Return the distance of the test data of a split; None if only one short segment is used for training."""
    halves = (split.train[::2], split.train[1::2])
    if not halves[1]:
        only = split.train[0]
        middle = (only.start + only.stop) // 2
        halves = ((Stretch(only.recording, only.start, middle),), (Stretch(only.recording, middle, only.stop),))
    first, second, whole, test = (_states(recordings, axes, part) for part in (*halves, split.train, split.test))
    size = min(REFERENCES, len(first), len(whole))
    if size < 2 or not len(second) or not len(test):
        return None
    mean, deviation = whole.mean(axis=0), whole.std(axis=0)
    # Infinity takes a constant signal out of the distance.
    scale = np.where(deviation > 0, deviation, np.inf) * max(int(np.count_nonzero(deviation)), 1) ** 0.5

    from scipy.spatial import cKDTree  # import here: modules that use coverage would otherwise load it

    def nearest(references: Array, queries: Array) -> Array:
        tree = cKDTree((_evenly(references, size) - mean) / scale)
        return np.asarray(tree.query((_evenly(queries, QUERIES) - mean) / scale)[0])

    own, other = nearest(first, second), nearest(whole, test)
    limit = float(np.quantile(own, 0.95))
    return Distance(whole.shape[1], _middle_and_end(other), _middle_and_end(own), float((other > limit).mean()))


def _states(recordings: Sequence[Recording], axes: Sequence[Axis], stretches: Sequence[Stretch]) -> Array:
    """Return the commands now and a little earlier, velocities and pressures, shape ``(sample, signal)``."""
    parts = []
    every = -(-sum(stretch.stop - stretch.start for stretch in stretches) // MAX_STATES)
    for stretch in stretches:
        recording = recordings[stretch.recording]
        # A segment shorter than the delay keeps its last sample.
        back = min(round(EARLIER_S * recording.rate_hz), stretch.stop - stretch.start - 1)
        rows = slice(stretch.start + back, stretch.stop)
        commands = [axis.read_signed_command(recording) for axis in axes if axis.command]
        columns = [u[rows] for u in commands] + [u[rows.start - back : rows.stop - back] for u in commands]
        names = [name for axis in axes for name in (axis.velocity, *axis.pressures) if name]
        parts.append(np.column_stack([*columns, recording.select(names)[rows]])[::every].astype(np.float64))
    return np.concatenate(parts) if parts else np.zeros((0, 0))


def _evenly(values: Array, count: int) -> Array:
    return values[np.unique(np.linspace(0, len(values) - 1, count).astype(np.intp))]


def _middle_and_end(values: Array) -> tuple[float, float]:
    return float(np.median(values)), float(np.quantile(values, 0.95))
