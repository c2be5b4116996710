"""What arrays of scores must be before a test reads them; the type of a result that may be many."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import stdtr

from edp.errors import DataError

Array: TypeAlias = NDArray[np.float64]
Mask: TypeAlias = NDArray[np.bool_]


def finite(values: ArrayLike, what: str, axes: int) -> Array:
    """`values` in double precision with at least `axes` axes.

    Raises:
        DataError: too few axes, an empty axis, or values that are not finite.
    """
    array = np.asarray(values, dtype=np.float64)
    if array.ndim < axes or array.size == 0:
        raise DataError(f"the {what} has shape {array.shape}; it needs {axes} axes, none of them empty")
    if not np.isfinite(array).all():
        raise DataError(
            f"the {what} holds {int((~np.isfinite(array)).sum())} NaN or infinite values; fill planned cells that are "
            "missing or diverged with `stats.paired`, which counts them as the worst"
        )
    return array


def tested_mask(tested: ArrayLike | None, shape: tuple[int, ...]) -> Mask:
    """Which session each run was judged on, ``(run, session)``; None: every one on all.

    Raises:
        DataError: another shape, or a run or session without a cell.
    """
    if tested is None:
        return np.ones(shape[-2:], dtype=bool)
    mask = np.asarray(tested, dtype=bool)
    if mask.shape != shape[-2:]:
        raise DataError(f"the mask of tested cells has shape {mask.shape}, the differences have {shape[-2:]}")
    if not (mask.any(axis=0).all() and mask.any(axis=1).all()):
        raise DataError("a run was judged on no session or a session by no run; leave such rows and columns out")
    return mask


def lower_p(mean: Array, error: Array, df: float) -> tuple[Array, Array]:
    """Statistic and one-sided p-value for a mean below zero; equal differences have no error and speak for themselves.

    Where the error is zero the p-value is 0 for a negative mean and 1 otherwise: a module that changes nothing,
    to the last bit, is no improvement.
    """
    mean, error = np.asarray(mean, dtype=np.float64), np.asarray(error, dtype=np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        statistic = np.where(error > 0.0, mean / error, np.where(mean == 0.0, 0.0, np.copysign(np.inf, mean)))
    p = np.where(error > 0.0, stdtr(df, statistic), np.where(mean < 0.0, 0.0, 1.0))
    return statistic, p
