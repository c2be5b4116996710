"""The default test: a t-test of paired differences clustered by session and by training run."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import ndtri, stdtrit

from edp.errors import DataError
from edp.stats.checks import Array, check_tested_cells, lower_p, two_sided_p


@dataclass(frozen=True, eq=False)
class MeanTest:
    """One-sided test of ``mean < 0``; fields are arrays over the leading axes of the tested data (0-d for one test).

    Attributes:
        mean: mean difference, in the unit of the scores.
        error: standard error.
        statistic: mean over error.
        df: degrees of freedom; infinite for a z-test.
        p: one-sided p-value, small where the module is better.
    """

    mean: Array
    error: Array
    statistic: Array
    df: float
    p: Array

    @property
    def two_sided(self) -> Array:
        """Two-sided p-value; 1 for a mean of zero, also where all differences are zero."""
        return two_sided_p(self.statistic, self.df)

    def interval(self, level: float = 0.95) -> tuple[Array, Array]:
        """Return two-sided interval of the mean at `level`."""
        tail = 0.5 + 0.5 * level
        reach = (ndtri(tail) if np.isinf(self.df) else stdtrit(self.df, tail)) * self.error
        return np.asarray(self.mean - reach), np.asarray(self.mean + reach)


def clustered_t(differences: ArrayLike, tested: ArrayLike | None = None) -> MeanTest:
    """Return two-way clustered t-test over sessions and training runs.

    Cells of one session share its difficulty, and cells of one run share its weights. Each cell belongs to one session
    and one run, so the variances of both add, minus the part that is counted twice. With e the differences less their
    mean, N cells, R sessions and G runs::

        V_S = R / (R - 1) * sum_r (sum_f e)^2 / N^2
        V_F = G / (G - 1) * sum_f (sum_r e)^2 / N^2
        V   = max(V_S + V_F - sum(e^2) / N^2, V_S, V_F),    df = min(R, G) - 1

    After Cameron, Gelbach and Miller (2011); the maximum keeps V positive with few clusters.

    Args:
        differences: ``(..., run, session)``, module minus baseline; values outside `tested` are not read.
        tested: mask of the existing cells ``(run, session)``; None uses all cells.

    Raises:
        DataError: fewer than two runs or sessions, or cells that are not finite.
    """
    array, mask = check_tested_cells(differences, tested)
    runs, sessions = mask.shape
    if min(runs, sessions) < 2:
        raise DataError(f"{runs} runs on {sessions} sessions came; a clustered test needs at least two of each")
    cells = int(mask.sum())
    mean = array.sum(axis=(-2, -1)) / cells
    rest = np.where(mask, array - mean[..., None, None], 0.0)
    by_session = sessions / (sessions - 1) * np.square(rest.sum(axis=-2)).sum(axis=-1) / cells**2
    by_run = runs / (runs - 1) * np.square(rest.sum(axis=-1)).sum(axis=-1) / cells**2
    by_cell = np.square(rest).sum(axis=(-2, -1)) / cells**2
    # With few clusters the sum less the cells can be below either part, or negative.
    variance = np.maximum(by_session + by_run - by_cell, np.maximum(by_session, by_run))
    # Equal differences leave rounding errors in the sums, which do not count as variance.
    dust = (1e-14 * np.abs(array).max(axis=(-2, -1))) ** 2
    error = np.sqrt(np.where(variance > dust, variance, 0.0))
    # The smaller number of clusters determines the degrees of freedom.
    df = float(min(runs, sessions) - 1)
    statistic, p = lower_p(mean, error, df)
    return MeanTest(np.asarray(mean), error, statistic, df, p)
