"""Mutual information of two channels by nearest neighbours (Kraskov, Stoegbauer and Grassberger, 2004, eq. 8).

The same estimator as scikit-learn's `mutual_info_regression`: distances are the larger of the two differences, and
equal values are distinguished by noise of 1e-10 deviations.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np
from numpy.typing import NDArray
from scipy.special import digamma

from edp.data.screening.compiled import compiled, spread
from edp.data.screening.result import Array
from edp.recording import FloatArray

Orders = NDArray[np.int64]


@compiled
def _count_neighbours(values: Array, row: int, radius: float) -> int:
    """Return how many other values of a sorted array are nearer than `radius` to the one at `row`."""
    # doubling steps, then halving ones
    n = len(values)
    centre = values[row]
    low, step = row, 1
    while low - step >= 0 and centre - values[low - step] < radius:
        low -= step
        step *= 2
    while step > 0:
        if low - step >= 0 and centre - values[low - step] < radius:
            low -= step
        step //= 2
    high, step = row, 1
    while high + step < n and values[high + step] - centre < radius:
        high += step
        step *= 2
    while step > 0:
        if high + step < n and values[high + step] - centre < radius:
            high += step
        step //= 2
    return high - low


@compiled
def _closer(distance: float, nearest: Array) -> None:
    """Put a distance into its place among the `nearest`, which are sorted; the largest falls out."""
    slot = len(nearest) - 1
    while slot > 0 and nearest[slot - 1] > distance:
        nearest[slot] = nearest[slot - 1]
        slot -= 1
    nearest[slot] = distance


@compiled
def _radius(x: Array, y: Array, row: int, nearest: Array) -> tuple[float, int]:
    """Return the distance to the k-th neighbour of point `row`, and how many points are nearer in x alone.

    Points are sorted by x; `nearest` is room for k values. First a few points to either side, then one side after the
    other for as long as x alone does not rule them out.
    """
    n, last = len(x), len(nearest) - 1
    x_here, y_here = x[row], y[row]
    nearest[:] = np.inf
    # 24 points give a first radius, with which one side after the other needs half the steps (journal).
    left, right = max(row - 12, 0), min(row + 12, n - 1)
    for other in range(left, right + 1):
        distance = max(abs(x_here - x[other]), abs(y[other] - y_here))
        if distance < nearest[last] and other != row:
            _closer(distance, nearest)
    left -= 1
    while left >= 0 and x_here - x[left] < nearest[last]:
        distance = max(x_here - x[left], abs(y[left] - y_here))
        if distance < nearest[last]:
            _closer(distance, nearest)
        left -= 1
    right += 1
    while right < n and x[right] - x_here < nearest[last]:
        distance = max(x[right] - x_here, abs(y[right] - y_here))
        if distance < nearest[last]:
            _closer(distance, nearest)
        right += 1
    radius = nearest[last]
    left, right = left + 1, right - 1  # both were looked at; the radius has shrunk since
    while x_here - x[left] >= radius:
        left += 1
    while x[right] - x_here >= radius:
        right -= 1
    return radius, right - left


@compiled
def _information(x_sorted: Array, y_along_x: Array, y_sorted: Array, places: Orders, psi: Array, k: int) -> float:
    """Return the KSG estimate.

    `places[i]` is the index of ``y_along_x[i]`` in `y_sorted`, `psi` is digamma of 0 to n.
    """
    n = len(x_sorted)
    nearest = np.empty(k)
    total = 0.0
    for i in range(n):
        radius, along_x = _radius(x_sorted, y_along_x, i, nearest)
        total += psi[along_x + 1] + psi[_count_neighbours(y_sorted, places[i], radius) + 1]
    result: float = psi[n] + psi[k] - total / n
    return result


class Information:
    """Mutual information in nat of the columns of a sample; each column is scaled and sorted once.

    Args:
        sample: ``(row, channel)``.
        neighbours: k.
        seed: random seed of the noise that separates equal values.
    """

    def __init__(self, sample: FloatArray, neighbours: int, seed: int = 0) -> None:
        rng = np.random.default_rng(seed)
        values = sample.astype(np.float64)
        deviation = values.std(axis=0)
        values /= np.where(deviation > 0, deviation, 1.0)
        values += 1e-10 * np.maximum(1.0, np.abs(values).mean(axis=0)) * rng.standard_normal(values.shape)
        self._k = neighbours
        self._values = np.ascontiguousarray(values.T)
        self._orders = np.argsort(self._values, axis=1)
        self._sorted = np.take_along_axis(self._values, self._orders, axis=1)
        self._places = np.empty_like(self._orders)
        np.put_along_axis(self._places, self._orders, np.arange(values.shape[0])[None, :], axis=1)
        self._psi = digamma(np.arange(values.shape[0] + 2).astype(np.float64))
        # sweeping along the channel with fewer equal values leaves fewer neighbours to look at
        self._ties = (np.diff(self._sorted, axis=1) < 1e-6).sum(axis=1)

    def estimate(self, i: int, j: int) -> float:
        """Return the mutual information of two columns, at least 0."""
        if self._ties[i] > self._ties[j]:
            i, j = j, i
        order = self._orders[i]
        value = _information(
            self._sorted[i],
            self._values[j][order],
            self._sorted[j],
            self._places[j][order],
            self._psi,
            self._k,
        )
        # The estimate of an independent pair scatters about zero.
        return max(0.0, float(value))

    def pairs(
        self, column_pairs: Iterable[tuple[int, int]], on_share: Callable[[float], None] | None = None
    ) -> list[float]:
        """Return the mutual information of several pairs of columns."""
        return spread(lambda pair: self.estimate(*pair), column_pairs, on_share)

    def matrix(self, on_share: Callable[[float], None] | None = None) -> Array:
        """Return the mutual information of all pairs, ``(channel, channel)``, with NaN on the diagonal."""
        count = len(self._values)
        information = np.full((count, count), np.nan)
        rows = spread(lambda i: [self.estimate(i, j) for j in range(i)], range(1, count), on_share)
        for i, row in enumerate(rows, start=1):
            information[i, :i] = information[:i, i] = row
        return information
