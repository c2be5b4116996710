"""Weights as integers, with a scale for each output."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from edp.errors import ExportError
from edp.ir.w8a16 import arithmetic as fixed
from edp.ir.w8a16.rounding import WeightRounding

Array = NDArray[np.floating]


def rows(matrix: str, weight: Array, bias: Array, formats: tuple[int, int], rounding: WeightRounding) -> dict[str, Any]:
    """Weights ``(..., out, terms ...)``, biases ``(..., out)``, and the way from accumulators to `frac`.

    Args:
        matrix: its name.
        weight: first dimensions as `bias`, the others are summed over.
        bias: one for each output.
        formats: fractional bits of the input and of the output.
        rounding: of the weights.

    Raises:
        ExportError: a sum that might not fit in 32 bits.
    """
    input_frac, frac = formats
    terms = tuple(range(bias.ndim, weight.ndim))
    # A bias far larger than its weights takes part in the choice of the scale, else it would not fit.
    scale = np.maximum(np.abs(weight).max(axis=terms) / fixed.WEIGHT, np.abs(bias) * 2.0 ** (input_frac - 30))
    # A row of zeros has no scale; any positive one gives zeros again.
    scale = np.maximum(scale.astype(np.float64), 1e-30)
    rounded = rounding.of(matrix, weight, scale)
    offset = np.floor(bias / scale * 2.0**input_frac + 0.5)
    _check(matrix, rounded, offset)
    multiplier, shift = fixed.factor(scale * 2.0 ** (frac - input_frac))
    return {"weight": rounded, "bias": offset.astype(np.int32), "multiplier": multiplier, "shift": shift}


def to_gates(matrix: str, weight: Array, input_frac: int, rounding: WeightRounding) -> dict[str, Any]:
    """A matrix ``(out, in)`` into gates or scores; see `rows`."""
    constants = rows(matrix, weight, np.zeros(len(weight)), (input_frac, fixed.GATE_FRAC), rounding)
    return {key: constants[key] for key in ("weight", "multiplier", "shift")}


def halves(gain: Array, most: int = 30) -> tuple[NDArray[np.int16], int]:
    """Gains as 16-bit numbers with the most fractional bits, up to `most`, and how many these are."""
    bits = min(fixed.frac_for(float(np.abs(gain).max())), most)
    return fixed.to_fixed(gain, bits).astype(np.int16), bits


def _check(name: str, weight: NDArray[np.int8], bias: Array) -> None:
    terms = tuple(range(bias.ndim, weight.ndim))
    # The worst case over all inputs, since a sum that wraps around would be silent on the controller.
    sums = np.abs(weight.astype(np.int64)).sum(axis=terms) * fixed.LARGEST + np.abs(bias)
    worst = float(sums.max())
    if worst > fixed.ACCUMULATOR:
        count = int(np.prod([weight.shape[axis] for axis in terms]))
        raise ExportError(
            f"layer '{name}': a sum of {count} products may reach {worst:.3g}, and 32 bits end at "
            f"{fixed.ACCUMULATOR:.3g}; {int(count * fixed.ACCUMULATOR / worst)} inputs of this size would fit: make "
            "the layer before it narrower (edp.workflows.compression.prune, student), or export in float32"
        )
