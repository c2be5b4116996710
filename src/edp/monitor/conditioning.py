"""Conditioning of summaries on the operating point: subtraction of the usual value, division by the usual scatter."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edp.errors import DataError
from edp.storage.arrays import POSITIVE, ArrayRule, checked_arrays

Array = NDArray[np.float64]
ARRAYS = {
    "offset": ArrayRule(("numbers",)),
    "width": ArrayRule(("numbers",), low=POSITIVE),
    "usual": ArrayRule(("summaries", "points")),
    "spread": ArrayRule(("summaries", "points")),
    "floor": ArrayRule(("summaries",), low=POSITIVE),
}
"""Arrays of the conditioning in its file, with their rules."""
POINT_LIMIT = 3.0
"""Limit of levels and spreads in healthy standard deviations. Regression lines are constant outside the limit."""
RIDGE = 1e-3
"""Ridge penalty per row, needed because some operating-point values never vary independently."""
TRIMMED = 4.0
"""Largest residual of the regression that counts in the second round, in robust standard deviations."""
GROSS = 1e3
"""Limit of a conditioned summary in healthy standard deviations, large enough to distinguish gross deviations."""
MIN_WIDTH = 0.3
"""Minimum width relative to the median width, for operating points at which the fitted width is smaller."""


@dataclass(frozen=True, eq=False)
class Conditioning:
    """z = (s - W p) / max(V p, floor), where p is the operating point, scaled and limited.

    Attributes:
        offset: offset of the operating point without its constant, shape (points - 1,).
        width: scale of the operating point, positive, same shape.
        usual: W, shape (summaries, points).
        spread: V, shape (summaries, points).
        floor: least width of each summary, above zero, shape (summaries,).
        clip: largest |z|.
    """

    offset: Array
    width: Array
    usual: Array
    spread: Array
    floor: Array
    clip: float

    def __call__(self, summaries: Array, points: Array) -> Array:
        """Return the conditioned rows, shape (blocks, summaries), within `clip`; NaN stays NaN."""
        return np.clip(self.unclipped(summaries, points), -self.clip, self.clip)

    def unclipped(self, summaries: Array, points: Array) -> Array:
        """Return the conditioned rows within `GROSS` alone.

        Each sum goes from the first operating number to the last, as in C.
        """
        scaled = np.clip((points[:, 1:] - self.offset) / self.width, -POINT_LIMIT, POINT_LIMIT)
        # The lines in single precision: a controller computes them in hardware.
        lines = self.usual.astype(np.float32), self.spread.astype(np.float32)
        usual, width = (np.repeat(line[None, :, 0], len(summaries), 0) for line in lines)
        part = scaled.astype(np.float32)
        for index in range(part.shape[1]):
            usual = usual + part[:, index, None] * lines[0][:, index + 1]
            width = width + part[:, index, None] * lines[1][:, index + 1]
        z: Array = (summaries - usual) / np.maximum(width.astype(np.float64), self.floor)
        return np.clip(z, -GROSS, GROSS)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return the arrays of its file."""
        return {name: getattr(self, name) for name in ARRAYS}

    @staticmethod
    def from_arrays(arrays: Mapping[str, NDArray[Any]], clip: float, summaries: int, points: int) -> Conditioning:
        """Create the conditioning from its arrays.

        Raises:
            ValueError: values that cannot be.
        """
        sizes = {"numbers": points - 1, "summaries": summaries, "points": points}
        values = checked_arrays(arrays, ARRAYS, "the conditioning", sizes)
        if not 0.0 < clip <= 1e6:
            raise ValueError(f"clip of the conditioning is {clip}; above 0 and at most 1e6 must hold")
        return Conditioning(**values, clip=clip)


def check_blocks(blocks: int, points: int) -> None:
    """Raise DataError if there are fewer blocks than the operating point has parameters.

    Raises:
        DataError: too few blocks.
    """
    if blocks < 4 * points:
        raise DataError(
            f"{blocks} blocks of healthy sessions are too few for an operating point of {points} numbers; bring "
            f"{4 * points} at least, or make block_s smaller"
        )


def fit_conditioning(summaries: Sequence[Array], points: Sequence[Array], clip: float) -> Conditioning:
    """Fit to healthy sessions, shapes (blocks, summaries) and (blocks, points) each.

    Two rounds of ridge regression for what is usual, the second without rows far off the first, and one for the width
    from what is left: absolute deviations, whose median is made the width.

    Raises:
        DataError: too few blocks.
    """
    s, p = np.concatenate(list(summaries)), np.concatenate(list(points))
    fine = np.isfinite(s).any(axis=1)
    s, p = s[fine], p[fine]
    check_blocks(len(s), p.shape[1])
    offset: Array = p[:, 1:].mean(axis=0)
    scatter = p[:, 1:].std(axis=0)
    width: Array = np.where(scatter > 1e-9, scatter, 1.0).astype(np.float64)
    design = np.concatenate(
        [np.ones((len(p), 1)), np.clip((p[:, 1:] - offset) / width, -POINT_LIMIT, POINT_LIMIT)], axis=1
    )
    count = s.shape[1]
    usual, spread, floor = np.zeros((count, design.shape[1])), np.zeros((count, design.shape[1])), np.ones(count)
    squares = design.T @ design
    for column in range(count):
        values = s[:, column]
        there = np.isfinite(values)
        if there.sum() < 4 * design.shape[1]:
            continue  # never there: stays at zero with width one, and NaN says nothing
        lacking = not there.all()
        x, y = (design[there], values[there]) if lacking else (design, values)
        square, product = x.T @ x if lacking else squares, x.T @ y
        line = _ridge(square, product, len(x))
        off = np.abs(y - x @ line)
        near = off <= TRIMMED * 1.4826 * max(float(np.median(off)), 1e-12)
        # Few rows are far off: their products are taken from those of all.
        far, count_near = x[~near], int(near.sum())
        square = square - far.T @ far
        line = _ridge(square, product - far.T @ y[~near], count_near)
        off = np.abs(y - x @ line)
        size = max(float(off[near].std()), float(off[near].mean()), 1e-9)
        wide = _ridge(square, x.T @ np.where(near, off, 0.0), count_near)
        floor[column] = MIN_WIDTH * size
        # The mean absolute deviation of a normal variable is 0.798 of its standard deviation.
        usual[column], spread[column] = line, wide / 0.798
    # Single precision: a controller stores half as much, and the bits stay the same.
    offset, width, usual, spread, floor = map(_single, (offset, width, usual, spread, floor))
    return Conditioning(offset, width, usual, spread, floor, clip)


def _single(values: Array) -> Array:
    return values.astype(np.float32).astype(np.float64)


def _ridge(square: Array, product: Array, rows: int) -> Array:
    """Return ridge coefficients from the products of `rows` rows; the constant is not regularised."""
    penalty = RIDGE * rows * np.eye(len(square))
    penalty[0, 0] = 0.0
    line = np.linalg.solve(square + penalty + 1e-12 * np.eye(len(square)), product)
    return np.asarray(line, dtype=np.float64)
