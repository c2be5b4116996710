"""Residuals of healthy sessions made standard: mean zero, variance one, uncorrelated."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edp.errors import DataError

Array = NDArray[np.float64]
MIN_SHARE = 1e-9
"""Fraction of the largest variance below which a direction is rounding error of linearly dependent residuals."""


@dataclass(frozen=True, eq=False)
class Whitening:
    """A linear map of residuals.

    Attributes:
        mean: mean of healthy residuals, shape (channels,).
        matrix: shape (channels, directions); directions without variance are left out.
    """

    mean: Array
    matrix: Array

    @staticmethod
    def fit(sessions: Sequence[Array]) -> Whitening:
        """Fit to healthy sessions, shape (time, channels) each; rows with values that are not finite are omitted.

        Raises:
            DataError: there are too few rows for a covariance.
        """
        rows = (
            np.concatenate([np.asarray(session, dtype=float) for session in sessions]) if sessions else np.zeros((0, 0))
        )
        rows = rows[np.isfinite(rows).all(axis=1)]
        if len(rows) < 2 * max(rows.shape[1], 1):
            raise DataError(
                f"{len(rows)} finite rows of {rows.shape[1]} residuals are too few for their covariance; "
                f"bring {2 * max(rows.shape[1], 1)} at least"
            )
        mean = rows.mean(axis=0)
        # Scaled first: residuals of pressures and velocities differ by seven decades.
        size = rows.std(axis=0)
        size = np.where(size > 0.0, size, 1.0)
        variances, vectors = np.linalg.eigh(np.cov((rows - mean) / size, rowvar=False).reshape(len(size), len(size)))
        kept_directions = variances > MIN_SHARE * max(variances[-1], 0.0)
        if not kept_directions.any():
            raise DataError("residuals of the healthy sessions do not vary; there is nothing to compare with")
        return Whitening(mean, vectors[:, kept_directions] / np.sqrt(variances[kept_directions]) / size[:, None])

    def __call__(self, rows: Array) -> Array:
        """Return the white residuals, shape (..., directions), of rows of shape (..., channels).

        Missing ones count as healthy.
        """
        centred = np.asarray(rows, dtype=float) - self.mean
        white: Array = np.where(np.isfinite(centred), centred, 0.0) @ self.matrix
        return white
