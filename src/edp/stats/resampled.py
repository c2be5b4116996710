"""Tests on one mean difference per split: corrected for overlapping training sets, and not."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import ndtr

from edp.errors import DataError
from edp.stats.checks import finite, lower_p
from edp.stats.clustered import MeanTest


def resampled_t(differences: ArrayLike, test_over_train: float) -> MeanTest:
    """Return Nadeau and Bengio's corrected resampled t-test (2003), one-sided.

    ``t = mean / (s_d sqrt(1 / J + n_test / n_train))`` with J - 1 degrees of freedom: splits that share training
    data are not independent, and 1 / J alone would let any difference become significant by more splits.

    Args:
        differences: ``(..., split)``, the mean difference of each split.
        test_over_train: size of the test part over that of the training part; 1 / (k - 1) for k folds.

    Raises:
        DataError: fewer than two splits, values that are not finite, or a ratio below zero.
    """
    if not (math.isfinite(test_over_train) and test_over_train >= 0.0):
        raise DataError(f"test_over_train is {test_over_train}; it must be finite and not negative")
    array = finite(differences, "list of split differences", 1)
    splits = array.shape[-1]
    if splits < 2:
        raise DataError(f"{splits} split came; a test over splits needs at least two")
    mean = array.mean(axis=-1)
    spread = _deviation(array)
    error = spread * math.sqrt(1.0 / splits + test_over_train)
    statistic, p = lower_p(mean, error, splits - 1.0)
    return MeanTest(np.asarray(mean), np.asarray(error), statistic, splits - 1.0, p)


def paired_t(differences: ArrayLike) -> MeanTest:
    """Return the plain one-sided paired t-test over splits.

    Its p-values are too small for overlapping splits, so it serves comparison only.

    Raises:
        DataError: fewer than two splits or values that are not finite.
    """
    return resampled_t(differences, 0.0)


def printed_p(d_z: ArrayLike, splits: int) -> np.ndarray:
    """Return the p-value printed in Table 4.5 of the thesis: ``Phi(d_z sqrt(J))``.

    A z-test with a sample standard deviation: not the mixed model of eq. 2.22, not the t-test of the table's
    note, and not adjusted for the number of modules.

    Args:
        d_z: Cohen's d_z of the differences over splits, negative where the module is better.
        splits: J, 10 at k = 1 and 7 at k = 10 in the thesis.

    Raises:
        DataError: fewer than one split.
    """
    if splits < 1:
        raise DataError(f"{splits} splits came; at least one is needed")
    return np.asarray(ndtr(np.asarray(d_z, dtype=np.float64) * math.sqrt(splits)))


def _deviation(array: np.ndarray) -> np.ndarray:
    """Return the standard deviation (n - 1) over the last axis; zero if the values are equal up to rounding."""
    spread = array.std(axis=-1, ddof=1)
    # A spread of the size of rounding errors means equal differences.
    return np.where(spread > 1e-14 * np.abs(array).max(axis=-1), spread, 0.0)
