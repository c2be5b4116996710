"""Weights as integers, with a scale for each output."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from edp.errors import ExportError
from edp.ir.w8a16 import arithmetic as fixed
from edp.ir.w8a16.rounding import WeightRounding, nearest
from edp.wording import typed

Array = NDArray[np.floating]
COARSER = 1.02
"""Safety factor of the scale at which a row's sum fits the accumulator. Weights of least error have a slightly larger
sum than rounded weights."""
MAX_COARSE = 4.0
"""Maximum factor by which the scale of a row may grow, a loss of two bits of its weights. A network that needs more is
rejected."""


def rows(
    matrix: str, weight: Array, bias: Array, formats: tuple[int, int], rounding: WeightRounding
) -> dict[str, object]:
    """Return the weights ``(..., out, terms ...)``, biases ``(..., out)``, and the way from accumulators to `frac`.

    Args:
        matrix: name of the matrix.
        weight: first dimensions as `bias`, the others are summed over.
        bias: one for each output.
        formats: fractional bits of the input and of the output.
        rounding: rounding of the weights.

    Raises:
        ExportError: a sum that might not fit in 32 bits.
    """
    input_frac, frac = formats
    scale = _scale(weight, bias, input_frac)
    rounded = rounding.round(matrix, weight, scale)
    offset = np.floor(bias / scale * 2.0**input_frac + 0.5)
    _check(matrix, rounded, offset)
    multiplier, shift = fixed.factor(scale * 2.0 ** (frac - input_frac))
    return {"weight": rounded, "bias": offset.astype(np.int32), "multiplier": multiplier, "shift": shift}


def _scale(weight: Array, bias: Array, input_frac: int) -> Array:
    """Return the value of one step of an integer weight, for each output."""
    terms = tuple(range(bias.ndim, weight.ndim))
    # A bias far larger than its weights takes part in the choice of the scale, else it would not fit.
    scale = np.maximum(np.abs(weight).max(axis=terms) / fixed.WEIGHT, np.abs(bias) * 2.0 ** (input_frac - 30))
    # A row of zeros has no scale; any positive one gives zeros again.
    scale = np.maximum(scale.astype(np.float64), 1e-30)
    offset = np.abs(bias) * 2.0**input_frac
    worst = np.abs(nearest(weight, scale).astype(np.int64)).sum(axis=terms) * fixed.LARGEST + offset / scale
    # Where a row of very many weights could leave 32 bits, coarser weights keep it within; half a step of each is
    # what rounding may add. All other rows keep their scale, and so what was quantised before keeps its numbers.
    count = float(np.prod([weight.shape[axis] for axis in terms]))
    room = max(1.0, fixed.ACCUMULATOR - fixed.LARGEST * (0.5 * count + 1.0))
    coarser = COARSER * (np.abs(weight).sum(axis=terms, dtype=np.float64) * fixed.LARGEST + offset) / room
    saved = (worst > fixed.ACCUMULATOR) & (coarser <= MAX_COARSE * scale)
    return np.asarray(np.where(saved, np.maximum(scale, coarser), scale))


def to_gates(matrix: str, weight: Array, input_frac: int, rounding: WeightRounding) -> dict[str, Any]:
    """Return the constants of a matrix ``(out, in)`` that computes gates or scores; see `rows`."""
    constants = rows(matrix, weight, np.zeros(len(weight)), (input_frac, fixed.GATE_FRAC), rounding)
    return {key: constants[key] for key in ("weight", "multiplier", "shift")}


def halves(gain: Array, most: int = 30) -> tuple[NDArray[np.int16], int]:
    """Return gains as 16-bit values and their number of fractional bits, at most `most`."""
    bits = min(fixed.frac_for(float(np.abs(gain).max())), most)
    return fixed.to_fixed(gain, bits).astype(np.int16), bits


def _check(name: str, weight: NDArray[np.int8], bias: Array) -> None:
    terms = tuple(range(bias.ndim, weight.ndim))
    # Use the worst case over all inputs, since an overflow of the sum is not detected on the controller.
    sums = np.abs(weight.astype(np.int64)).sum(axis=terms) * fixed.LARGEST + np.abs(bias)
    worst = float(sums.max())
    if worst > fixed.ACCUMULATOR:
        count = int(np.prod([weight.shape[axis] for axis in terms]))
        raise ExportError(
            f"layer '{name}': a sum of {count} products may reach {typed(worst, 3)}, and 32 bits end at "
            f"{typed(fixed.ACCUMULATOR, 3)}; {int(count * fixed.ACCUMULATOR / worst)} inputs of this size would fit: "
            "make "
            "the layer before it narrower (edp.workflows.compression.prune, student), or export in float32"
        )
