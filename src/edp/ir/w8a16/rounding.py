"""Rounding of weights to integers: to the nearest, or with the least error of the layer output.

The second way takes the columns of a matrix one after the other, rounds each, and lets the columns that follow make up
for its error (E. Frantar et al., GPTQ, 2022): with ``H`` the mean of ``x x'`` over data, the error of an output is
``(w - q)' H (w - q)``, and what the rest of w must become is its minimum given the columns already rounded.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from edp.ir.w8a16 import arithmetic as fixed

Array = NDArray[np.floating]
DAMPING = 0.01
"""Fraction of the mean diagonal that is added to ``H``. It prevents large weights for inputs that hardly change."""


@dataclass(frozen=True)
class WeightRounding:
    """Rounding of weights; without moments or given weights to the nearest.

    Attributes:
        weights: integers found before, by matrix.
        moments: mean ``x x'`` of a matrix's inputs x, ``(terms, terms)``, or ``(row, terms, terms)`` if each row has
            its own input.
    """

    weights: Mapping[str, NDArray[np.int8]] = field(default_factory=dict)
    moments: Mapping[str, Array] = field(default_factory=dict)

    def round(self, matrix: str, weight: Array, scale: Array) -> NDArray[np.int8]:
        """Return the whole multiples of a scale for each output.

        Args:
            matrix: its name.
            weight: first dimensions as `scale`, the others are summed over.
            scale: ``(out,)`` or ``(row, out)``.
        """
        if matrix in self.weights:
            return self.weights[matrix].reshape(weight.shape)
        if matrix not in self.moments:
            return nearest(weight, scale)
        flat = weight.reshape(*scale.shape, -1).astype(np.float64)
        moments = self.moments[matrix]
        if scale.ndim == 1:
            rounded = least_error(flat, scale, moments)
        else:
            rounded = np.stack([least_error(*row) for row in zip(flat, scale, moments, strict=True)])
        return rounded.reshape(weight.shape)


def nearest(weight: Array, scale: Array) -> NDArray[np.int8]:
    """Round half to even."""
    wide = scale.reshape(scale.shape + (1,) * (weight.ndim - scale.ndim))
    return np.clip(np.rint(weight / wide), -fixed.WEIGHT, fixed.WEIGHT).astype(np.int8)


def least_error(weight: Array, scale: Array, moments: Array) -> NDArray[np.int8]:
    """Round column by column in the order of decreasing input size, compensating the error in later columns.

    Args:
        weight: ``(out, terms)``.
        scale: ``(out,)``.
        moments: ``(terms, terms)``.
    """
    terms = len(moments)
    # The small constant keeps the matrix invertible where no input ever moves.
    damped = moments + (DAMPING * np.trace(moments) / terms + 1e-12) * np.eye(terms)
    # Large inputs first: their errors weigh most, and the most columns are left to make up for them. Stable: equal
    # bits.
    order = np.argsort(-np.diag(damped), kind="stable")
    # Row i of the upper factor of the inverse says how the columns after i make up for an error in column i.
    upper = np.linalg.cholesky(np.linalg.inv(damped[np.ix_(order, order)])).T
    left = weight[:, order].copy()
    rounded = np.empty(left.shape, dtype=np.int8)
    for column in range(terms):
        rounded[:, column] = nearest(left[:, column], scale)
        error = (left[:, column] - rounded[:, column] * scale) / upper[column, column]
        left[:, column:] -= error[:, None] * upper[column, column:]
    return rounded[:, np.argsort(order, kind="stable")]
