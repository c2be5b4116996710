"""Linear models on the pasts of channels, from lagged correlations alone: no row of the data is read again."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from edp.data.screening.result import Array

RIDGE = 3e-6
"""Ridge term added to the unit variance of each regressor: about the rounding error of single precision."""
Tap = tuple[int, int]
"""Channel index and delay in samples. A negative delay is the channel's future."""


def gram(correlations: Array, left: Sequence[Tap], right: Sequence[Tap]) -> Array:
    """Return the correlations of delayed channels with delayed channels, ``(left, right)``.

    Args:
        correlations: ``[reach + lag, i, j]`` of ``x_i[t + lag]`` and ``x_j[t]``.
        left: taps.
        right: taps; none is farther than `reach` from any of `left`.
    """
    reach = len(correlations) // 2
    first, second = np.array(left, dtype=np.int64), np.array(right, dtype=np.int64)
    lag = second[None, :, 1] - first[:, None, 1]
    return np.asarray(correlations[lag + reach, first[:, None, 0], second[None, :, 0]])


def unexplained(
    correlations: Array, channel: int, taps: Sequence[Tap], more: Sequence[Tap] = ()
) -> tuple[float, float]:
    """Share of a channel's variance that linear models leave: from `taps`, and from `taps` and `more`."""
    target_covariances = gram(correlations, [*taps, *more], [(channel, 0)])[:, 0]
    joint = gram(correlations, [*taps, *more], [*taps, *more])
    joint[np.diag_indices_from(joint)] += RIDGE
    # One factor gives both shares: its first rows are those of `taps` alone.
    lower = scipy.linalg.cholesky(joint, lower=True, check_finite=False)
    parts = np.square(scipy.linalg.solve_triangular(lower, target_covariances, lower=True, check_finite=False))
    explained = np.cumsum(parts)
    return max(0.0, 1.0 - float(explained[len(taps) - 1])), max(0.0, 1.0 - float(explained[-1]))


def peaks(correlations: Array, low: int, high: int) -> tuple[NDArray[np.int64], Array]:
    """Return the lag of the largest absolute correlation of each pair between two lags, and the correlation there."""
    reach = len(correlations) // 2
    part = correlations[reach + low : reach + high + 1]
    best = np.abs(part).argmax(axis=0)
    return best + low, np.take_along_axis(part, best[None], axis=0)[0]
