"""Checks of score arrays before a statistical test, and the type of results that may be arrays."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtr, stdtr

from edp.errors import DataError

Array: TypeAlias = NDArray[np.float64]
Mask: TypeAlias = NDArray[np.bool_]


def finite(values: ArrayLike, what: str, axes: int) -> Array:
    """Return `values` in double precision with at least `axes` axes.

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


def check_tested_mask(tested: ArrayLike | None, shape: tuple[int, ...]) -> Mask:
    """Return the mask of the sessions on which each run was evaluated, ``(run, session)``.

    None stands for all sessions.

    Raises:
        DataError: another shape, or no cell.
    """
    if tested is None:
        return np.ones(shape[-2:], dtype=bool)
    mask = np.asarray(tested, dtype=bool)
    if mask.shape != shape[-2:] or not mask.any():
        raise DataError(
            f"a mask of shape {mask.shape} with {int(mask.sum())} tested cells came for tables of shape {shape[-2:]}"
        )
    return mask


def check_tested_cells(differences: ArrayLike, tested: ArrayLike | None) -> tuple[Array, Mask]:
    """Return the differences ``(..., run, session)``, zero outside the tested cells, and the mask of these.

    Runs and sessions without a cell, as a design that is not finished has, are left out of both.

    Raises:
        DataError: too few axes, a mask that does not fit, or tested cells that are not finite.
    """
    array = np.asarray(differences, dtype=np.float64)
    if array.ndim < 2:
        raise DataError(f"the differences have shape {array.shape}; give (..., run, session)")
    mask = check_tested_mask(tested, array.shape)
    runs, sessions = mask.any(axis=1), mask.any(axis=0)
    if not (runs.all() and sessions.all()):
        array, mask = array[..., runs, :][..., sessions], mask[runs][:, sessions]
    # Values outside the mask may be NaN, so they go before the check.
    return finite(np.where(mask, array, 0.0), "table of differences", 2), mask


def lower_p(mean: Array, error: Array, df: float) -> tuple[Array, Array]:
    """Return the statistic and one-sided p-value for a mean below zero.

    Equal differences have a standard error of zero.

    The p-value is then 0 for a negative mean and 1 otherwise, so a module without any effect is not an improvement.
    """
    mean, error = np.asarray(mean, dtype=np.float64), np.asarray(error, dtype=np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        statistic = np.where(error > 0.0, mean / error, np.where(mean == 0.0, 0.0, np.copysign(np.inf, mean)))
    p = np.where(error > 0.0, _below(statistic, df), np.where(mean < 0.0, 0.0, 1.0))
    return statistic, p


def two_sided_p(statistic: Array, df: float) -> Array:
    """Return the two-sided p-value of a statistic from `lower_p`; 1 for a statistic of zero."""
    # Twice the smaller tail of `lower_p` would be 0 for differences that are all zero, whose one-sided p-value is 1.
    return np.asarray(2.0 * _below(-np.abs(statistic), df))


def _below(statistic: Array, df: float) -> Array:
    """Return the cumulative distribution of Student's t; the normal distribution for infinite degrees of freedom."""
    return np.asarray(ndtr(statistic) if np.isinf(df) else stdtr(df, statistic))
