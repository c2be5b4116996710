"""The C calls of integer layers, and the runtime's tables."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from edp.export.c.calls import CALLS, Calls, Write, constant, needs_columns, ring, runs, slot
from edp.export.c.text import array, bool_literal, call, identifier, initialiser, number, struct, unsigned_literals
from edp.export.escape import Code
from edp.ir import Layer
from edp.ir.layers import Function
from edp.ir.w8a16 import arithmetic as fixed
from edp.ir.w8a16 import layers as quantised

FILES = ("edp_integer.h", "edp_integer.c", "edp_integer_memory.c")
"""Runtime files of integer networks. The tables of `tables_header` are added to them."""


def _quantise(calls: Calls, x: quantised.Quantise) -> list[str]:
    source, scale = calls.value(x.inputs[0]), number(2.0**x.frac)
    made_call = call("edp_q_from_float", source, x.size, scale, calls.value(x.name))
    return [f"s->clipped += {made_call}"]


def _gather(calls: Calls, x: quantised.QGather) -> list[str]:
    if needs_columns(calls, x):
        source = calls.value(x.inputs[0])
        return [call("edp_q_gather", source, constant(x, "columns"), x.width, x.shifts[0], calls.value(x.name))]
    right = dict(zip(x.inputs, x.shifts, strict=True))
    lines, at = [], 0
    for name, first, length in runs(calls, x):
        lines.append(call("edp_q_move", calls.value(name, first), length, right[name], calls.value(x.name, at)))
        at += length
    return lines


def _sum(calls: Calls, x: quantised.QSum) -> list[str]:
    a, b = (calls.value(name) for name in x.inputs)
    # A difference is a sum with a negative factor: one function less in the runtime.
    factors = (str(2 ** x.lefts[0]), str((-1 if x.minus else 1) * 2 ** x.lefts[1]))
    return [call("edp_q_sum", a, b, x.size, *factors, x.right, calls.value(x.name))]


def _activate(calls: Calls, x: quantised.QActivate) -> list[str]:
    sizes: list[object] = [x.size]
    if x.function is not Function.RELU:
        sizes.append(str(x.input_frac))
    if x.function is Function.SOFTPLUS:
        sizes.append(str(x.frac))
    return [call(f"edp_q_map_{x.function}", calls.value(x.inputs[0]), *sizes, calls.value(x.name))]


def _linear(calls: Calls, x: Any, function: str, *sizes: int) -> list[str]:
    source, matrix = calls.value(x.inputs[0]), f"&{identifier(x.name)}_matrix"
    rest = (calls.scratch(x), calls.value(x.name))
    return [call(function, source, matrix, constant(x, "bias"), *sizes, *rest)]


def _convolution(calls: Calls, x: quantised.QConvolution) -> list[str]:
    out, taps, into = x.weight.shape
    if taps == 1:
        return _linear(calls, x, "edp_q_dense", 1, out, into)
    source, matrix = calls.value(x.inputs[0]), f"&{identifier(x.name)}_matrix"
    state = (slot(x, "ring"), ring(x), calls.scratch(x), calls.value(x.name))
    return [call("edp_q_convolution", source, matrix, constant(x, "bias"), out, taps, into, x.dilation, *state)]


def _recurrent(calls: Calls, x: quantised.QLstm | quantised.QGru) -> list[str]:
    lstm = isinstance(x, quantised.QLstm)
    states = (slot(x, "h"), slot(x, "c")) if lstm else (slot(x, "h"),)
    sizes = (x.weight_x.shape[1], x.width)
    weights = f"&{identifier(x.name)}_weights"
    function = "edp_q_lstm" if lstm else "edp_q_gru"
    rest = (calls.scratch(x), calls.value(x.name))
    return [call(function, calls.value(x.inputs[0]), weights, *sizes, *states, *rest)]


def _difference(calls: Calls, x: quantised.QDifference) -> list[str]:
    return calls.simple(x, "edp_q_difference", x.width, bool_literal(x.from_zero), x.right, slot(x, "before"), ring(x))


def _pool(calls: Calls, x: quantised.QAttentionPool) -> list[str]:
    source, matrix = calls.value(x.inputs[0]), f"&{identifier(x.name)}_matrix"
    state = (slot(x, "ring"), slot(x, "scores"), ring(x), calls.scratch(x), calls.value(x.name))
    return [call("edp_q_attention_pool", source, matrix, x.width, x.window, *state)]


def _mean(calls: Calls, x: quantised.QTrailingMean) -> list[str]:
    return calls.simple(x, "edp_q_trailing_mean", x.size, x.window, slot(x, "ring"), ring(x))


def _dequantise(calls: Calls, x: quantised.Dequantise) -> list[str]:
    return calls.simple(x, "edp_q_to_float", x.size, number(2.0**-x.frac))


INTEGER_CALLS: dict[type[Layer], Write] = {
    quantised.Quantise: _quantise,
    quantised.Dequantise: _dequantise,
    quantised.QGather: _gather,
    quantised.QSum: _sum,
    quantised.QMultiply: lambda c, x: c.simple(x, "edp_q_multiply", x.size, x.right),
    quantised.QScaleShift: lambda c, x: c.simple(x, "edp_q_scale_shift", x.width, x.right),
    quantised.QActivate: _activate,
    quantised.QGlu: lambda c, x: c.simple(x, "edp_q_glu", x.rows, x.size // 2, str(x.frac)),
    quantised.QDense: lambda c, x: _linear(c, x, "edp_q_dense", x.rows, *x.weight.shape),
    quantised.QGroupedDense: lambda c, x: _linear(c, x, "edp_q_grouped_dense", *x.weight.shape),
    quantised.QTreeSums: lambda c, x: c.simple(x, "edp_q_trees", *x.leaf.shape[:2], x.depth, x.right),
    quantised.QConvolution: _convolution,
    quantised.QLstm: _recurrent,
    quantised.QGru: _recurrent,
    quantised.QMinGru: lambda c, x: c.simple(x, "edp_q_min_gru", x.units, str(x.frac), slot(x, "h")),
    quantised.QRotation: lambda c, x: c.simple(x, "edp_q_rotation", len(x.factor), x.left, x.right, slot(x, "h")),
    quantised.QDifference: _difference,
    quantised.QTrailingMean: _mean,
    quantised.QAttentionPool: _pool,
}
"""Writer functions by class of integer layer."""
CALLS |= INTEGER_CALLS


def structs(layer: Layer) -> list[Code]:
    """Return the constant structs that an integer layer's function reads, one a line."""
    name = identifier(layer.name)

    def matrix(suffix: str, weight: str = "weight") -> list[str]:
        parts = (f"{weight}{suffix}", f"multiplier{suffix}", f"shift{suffix}")
        return [constant(layer, part) for part in parts]

    def recurrent(biases: tuple[str, str], share: int) -> list[Code]:
        members = [initialiser(matrix("_x")), initialiser(matrix("_h")), *(constant(layer, bias) for bias in biases)]
        return [struct("edp_q_recurrent", f"{name}_weights", [*members, str(share)])]

    if isinstance(layer, quantised.QDense | quantised.QGroupedDense | quantised.QConvolution):
        return [struct("edp_q_matrix", f"{name}_matrix", matrix(""))]
    if isinstance(layer, quantised.QAttentionPool):
        return [struct("edp_q_matrix", f"{name}_matrix", matrix("", "score"))]
    if isinstance(layer, quantised.QLstm):
        return recurrent(("bias", "bias"), layer.share)
    if isinstance(layer, quantised.QGru):
        # A GRU has no zoneout; 32768 is 1 in 2^-15.
        return recurrent(("bias_x", "bias_h"), 32768)
    return []


def lay_out(layer: Layer, values: NDArray[Any]) -> NDArray[Any]:
    """Return a constant in the order in which the runtime reads it: see ``edp_q_products``."""
    if values.dtype != np.int8 or values.ndim < 2:
        return values
    if isinstance(layer, quantised.QConvolution):
        # Taps first: the runtime multiplies one tick of the ring after the other.
        values = values.transpose(1, 0, 2)
    matrices = values.reshape(-1, *values.shape[-2:])
    return np.concatenate([_reorder_weights(matrix) for matrix in matrices])


def _reorder_weights(matrix: NDArray[Any]) -> NDArray[Any]:
    out, into = matrix.shape
    rows, columns = out - out % 4, into - into % 4
    # Pairs of products: the order in which the Cortex-M4's SIMD instruction reads bytes after widening
    # (docs/journal).
    groups = matrix[:rows, :columns].reshape(rows // 4, 4, columns // 4, 4)[..., [0, 2, 1, 3]]
    parts = []
    for block, group in enumerate(groups):
        parts.append(group.transpose(1, 0, 2).ravel())
        # Columns left over follow their block, so that a block stays one stretch of memory.
        parts.append(matrix[4 * block : 4 * block + 4, columns:].T.ravel())
    return np.concatenate([*parts, matrix[rows:].ravel()])


def tables_header() -> str:
    """Return the header file with the tables of the runtime."""
    parts = ["/* Functions at even distances, in 2^-16; see edp_integer.h. */", "#ifndef EDP_TABLES_H"]
    parts += ["#define EDP_TABLES_H", "", "#include <stdint.h>", "", f"#define EDP_TABLE {fixed.TABLE}u", ""]
    for name, values, note in (
        ("tanh", fixed.TANH, "tanh on [0, 8]"),
        ("exp", fixed.EXP, "exp(-x) on [0, 16]"),
        ("log1p_exp", fixed.LOG1P_EXP, "log(1 + exp(-x)) on [0, 16]"),
        ("normal", fixed.NORMAL, "cumulated normal distribution on [0, 8]"),
    ):
        parts.append(array("uint16_t", f"edp_table_{name}", unsigned_literals(values), note))
    return "\n".join([*parts, "", "#endif", ""])
