"""Paired differences of two arms on the same cells; missing or diverged cells count as the worst."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from edp.errors import DataError
from edp.stats.checks import Array, check_tested_mask


def fill_worst(scores: ArrayLike, tested: ArrayLike | None = None, worst: ArrayLike | None = None) -> Array:
    """Return the scores of all arms with each planned cell that is missing or diverged set to the session's worst.

    Omitting such a pair would favour an arm that fails on difficult sessions, and an infinite score would dominate the
    mean. A failed cell therefore gets the largest finite score of any arm on that session, or `worst` if it is larger.
    A suitable `worst` is the score of a trivial predictor, such as persistence.

    Args:
        scores: ``(arm, run, session)``, lower is better; NaN or infinite where a run failed.
        tested: mask of the planned cells ``(run, session)``; None uses all cells.
        worst: minimum loss of a failed run ``(session,)``; None uses the recorded losses.

    Returns:
        ``(arm, run, session)``, finite; zero outside the planned cells.

    Raises:
        DataError: wrong shapes, or no arm has a score on some session.
    """
    array = np.asarray(scores, dtype=np.float64)
    if array.ndim != 3:
        raise DataError(f"the scores have shape {array.shape}; give (arm, run, session)")
    mask = check_tested_mask(tested, array.shape)
    finite = np.isfinite(array) & mask
    # The worst of all arms on that session: sessions differ in difficulty.
    seen = np.where(finite, array, -np.inf).max(axis=(0, 1))
    if worst is not None:
        floor = np.asarray(worst, dtype=np.float64)
        if floor.shape != seen.shape or not np.isfinite(floor).all():
            raise DataError(f"`worst` has shape {floor.shape}; give one finite score for each of {seen.size} sessions")
        seen = np.maximum(seen, floor)
    empty = mask.any(axis=0) & ~np.isfinite(seen)
    if empty.any():
        raise DataError(
            f"no arm has a score on sessions {np.flatnonzero(empty).tolist()}; repeat the runs there or "
            "leave these sessions out of the study"
        )
    return np.where(finite, array, np.where(mask, seen, 0.0))


def paired(
    module: ArrayLike, baseline: ArrayLike, tested: ArrayLike | None = None, worst: ArrayLike | None = None
) -> Array:
    """Return module minus baseline in each cell, ``(run, session)``; failed cells of either arm count as the worst.

    With several modules use `fill_worst` on all arms at once, so that all share one worst.

    Raises:
        DataError: see `fill_worst`.
    """
    first, second = np.asarray(module, dtype=np.float64), np.asarray(baseline, dtype=np.float64)
    if first.shape != second.shape:
        raise DataError(f"the module has scores of shape {first.shape}, the baseline {second.shape}; pair equal cells")
    filled = fill_worst(np.stack([first, second]), tested, worst)
    return np.asarray(filled[0] - filled[1])


def run_means(differences: ArrayLike, tested: ArrayLike | None = None) -> Array:
    """Return the mean over the tested sessions of each run, ``(..., run)``; the thesis calls it the score of a split.

    Raises:
        DataError: a run without a tested session, or a mask that does not fit.
    """
    array = np.asarray(differences, dtype=np.float64)
    mask = np.ones(array.shape[-2:], dtype=bool) if tested is None else np.asarray(tested, dtype=bool)
    if mask.shape != array.shape[-2:] or not mask.any(axis=1).all():
        raise DataError(
            f"a mask of shape {mask.shape} came for scores of {array.shape}; each run needs a tested session"
        )
    return np.asarray(np.where(mask, array, 0.0).sum(axis=-1) / mask.sum(axis=-1))
