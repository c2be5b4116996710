"""Features of conditioned rows since an onset, by which faults are recognised, and their healthy scatter."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edp.errors import DataError, count_of

Array = NDArray[np.float64]
SHORT, LONG = 8, 40
"""Window lengths in blocks at which the variance of window means is measured."""
SHRUNK = 0.2
"""Weight of the identity matrix in the correlations, because healthy sessions are fewer than summaries."""
MIN_VARIANCE = 1e-6
"""Variance of a feature, relative to healthy blocks, below which the feature counts as constant."""
MIN_SESSIONS = 4
ONSET = 6
"""Number of blocks after the onset that form separate features. A sensor step is visible only in them."""


def features(rows: Array) -> Array:
    """Return the features of each block: conditioned summaries and their magnitudes, shape (blocks, 2 * summaries).

    Sizes tell faults that come and go or change their sign with the motion, whose means vanish. A missing summary
    counts as healthy: 0, and as large as it usually is is unknown, so it stays NaN for `mean_features` to leave out.
    """
    rows = np.asarray(rows, dtype=np.float64)
    return np.concatenate([rows, np.abs(rows)], axis=1)


def mean_features(rows: Array) -> Array:
    """Return the mean features over blocks, NaN for summaries that were never there, shape (2 * summaries,)."""
    values = features(rows)
    there = np.isfinite(values)
    counts = there.sum(axis=0)
    sums = np.where(there, values, 0.0).sum(axis=0)
    return np.where(counts > 0, sums / np.maximum(counts, 1), np.nan)


def parts_of(rows: Array, fresh: bool = True) -> tuple[Array | None, Array | None]:
    """Return the rows at the onset and the later rows; None for an empty part.

    Args:
        rows: conditioned rows since the onset, shape (blocks, summaries).
        fresh: whether they begin at an onset, not at an earlier alarm of a fault that has stayed.
    """
    if not fresh:
        return None, rows
    return rows[:ONSET], rows[ONSET:] if len(rows) > ONSET else None


def check_stretches(lengths: Sequence[int]) -> None:
    """Raise an error if healthy sessions have too few blocks for a diagnosis.

    Raises:
        DataError: too few segments of `LONG` blocks.
    """
    count = sum(length // LONG for length in lengths)
    if count < MIN_SESSIONS:
        raise DataError(
            f"{count_of(count, 'stretch')} of {LONG} healthy blocks {'is' if count == 1 else 'are'} too few for a "
            f"diagnosis; bring {MIN_SESSIONS} at least, or leave the dictionary out (--machine none)"
        )


@dataclass(frozen=True, eq=False)
class Scatter:
    """Means of features on healthy sessions: where they lie, and how they scatter over few and over many blocks.

    Attributes:
        mean: shape (features,).
        lasting: variance that stays however long the mean is, of each direction, shape (features,).
        passing: variance that falls with the number of blocks, for one block, shape (features,).
        matrix: features to directions in which both are uncorrelated as nearly as can be, shape (features, features).
    """

    mean: Array
    lasting: Array
    passing: Array
    matrix: Array

    @staticmethod
    def fit(sessions: Sequence[Array]) -> Scatter:
        """Fit to conditioned rows of healthy sessions, shape (blocks, summaries) each.

        Raises:
            DataError: too few sessions of `LONG` blocks.
        """
        check_stretches([len(session) for session in sessions])
        windows = {length: _windows(sessions, length) for length in (SHORT, LONG)}
        mean = windows[SHORT].mean(axis=0)
        short = np.cov(windows[SHORT], rowvar=False)
        # What never varies on healthy sessions has no scale of its own, and is left out: its row stays zero.
        varies = np.diag(short) > MIN_VARIANCE
        size = np.sqrt(np.where(varies, np.diag(short), 1.0))
        correlation = (1.0 - SHRUNK) * short / np.outer(size, size) * np.outer(varies, varies) + SHRUNK * np.eye(
            len(size)
        )
        values, vectors = np.linalg.eigh(correlation)
        matrix = vectors / np.sqrt(values) * (varies / size)[:, None]
        # Two lengths tell both parts: variance = lasting + passing / length.
        over_short = ((windows[SHORT] - mean) @ matrix).var(axis=0)
        over_long = ((windows[LONG] - mean) @ matrix).var(axis=0)
        over_short = np.where(over_short > MIN_VARIANCE, over_short, 1.0)
        passing = np.maximum((over_short - over_long) / (1.0 / SHORT - 1.0 / LONG), 0.05 * SHORT * over_short)
        lasting = np.maximum(over_short - passing / SHORT, 0.05 * over_short)
        return Scatter(mean, lasting, passing, matrix)

    def directions(self, mean: Array) -> Array:
        """Project mean features on the directions; missing features count as healthy."""
        away = np.asarray(mean, dtype=np.float64) - self.mean
        turned: Array = np.where(np.isfinite(away), away, 0.0) @ self.matrix
        return turned

    def variance(self, blocks: int) -> Array:
        """Return the variance of the directions for a mean over the given number of blocks."""
        return self.lasting + self.passing / max(blocks, 1)


def _windows(sessions: Sequence[Array], length: int) -> Array:
    """Return the mean features of segments of `length` blocks; missing summaries count as healthy zeros."""
    means = []
    for session in sessions:
        rows = np.nan_to_num(np.asarray(session, dtype=np.float64), nan=0.0)
        count = len(rows) // length
        if count:
            values = features(rows[: count * length])
            means.append(values.reshape(count, length, -1).mean(axis=1))
    return np.concatenate(means) if means else np.zeros((0, 0))
