"""Slow drift of conditioned rows, followed at a bounded rate: wear and seasons, and no fault that is faster."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edp.storage.reading import Table

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SlowDrift:
    """An offset of each summary that follows its rows.

    After each block an offset goes towards the row by at most `step`, and never further than `most` from zero: a fault
    of more than `most` healthy standard deviations stays visible for ever, and one that comes faster than `step` a
    block is visible for as long as the offset needs to follow it.

    Attributes:
        step: largest change of an offset in a block, in healthy standard deviations.
        most: largest offset, likewise.
    """

    step: float
    most: float

    def run(self, rows: Array, offset: Array) -> tuple[Array, Array]:
        """Subtract the offset before each row; return the rows and the final offset."""
        if self.step == 0.0 or not len(rows):
            return rows - offset, offset
        out = np.empty_like(rows)
        for index, row in enumerate(rows):
            left = row - offset
            out[index] = left
            # A missing row teaches nothing.
            move = np.where(np.isfinite(left), np.clip(left, -self.step, self.step), 0.0)
            offset = np.clip(offset + move, -self.most, self.most)
        return out, offset

    def to_dict(self) -> dict[str, float]:
        """Return the plain values of its file."""
        return {"step": self.step, "most": self.most}

    @staticmethod
    def from_dict(plain: Table) -> SlowDrift:
        """Create the drift from the result of `to_dict`.

        Raises:
            ValueError: values that cannot be.
        """
        step, most = plain["step"], plain["most"]
        for value in (step, most):
            if isinstance(value, bool) or not isinstance(value, int | float) or not 0.0 <= value <= 1e6:
                raise ValueError(f"a number of the drift is {str(value)[:40]}; 0 to 1e6 must hold")
        return SlowDrift(float(step), float(most))
