"""ONNX nodes of the layers without memory: matrices ``(tick, number)`` in, one out, each row by itself."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from edp.export.onnx.nodes import Nodes
from edp.ir import Layer, layers
from edp.ir.layers import BinaryOperation, Function, runs

MAX_PIECES = 12
"""Maximum number of contiguous column ranges that are selected by Split and Concat. For more ranges a 0/1 matrix is
used.
"""

Plain = Callable[[Nodes, Any, int, Sequence[str], Sequence[int]], str]
"""Function (nodes, layer, ticks, values, widths of the values) that returns the layer's value."""


def activate(nodes: Nodes, function: Function, x: str) -> str:
    """Apply a function to each element."""
    if function is Function.GELU:
        # GELU is an operator only from opset 20 on; here it is written out by the error function.
        half = nodes.plus(nodes.add("Erf", nodes.times(x, np.float32(1 / math.sqrt(2)))), np.float32(1.0))
        return nodes.add("Mul", nodes.times(x, np.float32(0.5)), half)
    if function is Function.POSITIVE:
        # Sign gives -1, 0 and 1; ReLU makes 0 of the negative ones. Comparisons would give booleans.
        return nodes.add("Relu", nodes.add("Sign", x))
    if function is Function.LOG:
        x = nodes.add("Max", x, nodes.constant(np.float32(layers.LEAST)))
    return nodes.add(OPERATORS[function], x)


OPERATORS = {
    Function.RELU: "Relu",
    Function.SIGMOID: "Sigmoid",
    Function.TANH: "Tanh",
    Function.SOFTPLUS: "Softplus",
    Function.EXP: "Exp",
    Function.SQRT: "Sqrt",
    Function.SINE: "Sin",
    Function.COSINE: "Cos",
    Function.LOG: "Log",
}


def normed(nodes: Nodes, x: str, epsilon: float) -> str:
    """Return each row less its mean, over the root of its variance plus `epsilon`."""
    # Variance by its definition: the difference of squares cancels for large means.
    middle = nodes.less(x, nodes.mean(x, 1))
    spread = nodes.plus(nodes.mean(nodes.add("Mul", middle, middle), 1), np.float32(epsilon))
    return nodes.add("Div", middle, nodes.add("Sqrt", spread))


BINARY_OPERATORS = {
    BinaryOperation.ADD: "Add",
    BinaryOperation.MULTIPLY: "Mul",
    BinaryOperation.DIVIDE: "Div",
    BinaryOperation.MINIMUM: "Min",
    BinaryOperation.MAXIMUM: "Max",
}
"""ONNX operators of binary operations. `Nodes.less` writes a difference."""


def combine(nodes: Nodes, operation: BinaryOperation, a: str, b: str) -> str:
    """Return two values, number by number."""
    return nodes.less(a, b) if operation is BinaryOperation.SUBTRACT else nodes.add(BINARY_OPERATORS[operation], a, b)


def _rows(nodes: Nodes, x: str, ticks: int, rows: int, size: int) -> str:
    return x if rows == 1 else nodes.shaped(x, ticks * rows, size)


def _flat(nodes: Nodes, x: str, ticks: int, rows: int, width: int) -> str:
    return x if rows == 1 else nodes.shaped(x, ticks, width)


def _gather(nodes: Nodes, layer: layers.Gather, ticks: int, values: Sequence[str], widths: Sequence[int]) -> str:
    column_runs = runs(layer.columns, widths)
    if len(column_runs) > MAX_PIECES:
        matrix = np.zeros((len(layer.columns), sum(widths)), np.float32)
        # A 0/1 matrix moves numbers exactly: every sum has a single term.
        matrix[np.arange(len(layer.columns)), list(layer.columns)] = 1.0
        return nodes.linear(nodes.join(list(values), 1), matrix, np.zeros(1, np.float32))
    pieces: dict[int, dict[int, tuple[int, str]]] = {}
    for number, width in enumerate(widths):
        ends = {end for value, first, length in column_runs if value == number for end in (first, first + length)}
        if ends:
            cuts = sorted({0, width} | ends)
            names = nodes.split(values[number], [b - a for a, b in pairwise(cuts)], 1)
            pieces[number] = {a: (b, name) for (a, b), name in zip(pairwise(cuts), names, strict=True)}
    parts = []
    for value, at, length in column_runs:
        stop = at + length
        while at < stop:
            at, name = pieces[value][at]
            parts.append(name)
    return nodes.join(parts, 1)


def _standardise(nodes: Nodes, layer: layers.Standardise, ticks: int, values: Sequence[str], *_: object) -> str:
    # Sub and Div stay apart: with gain and shift pressures of 1e7 Pa would lose digits (decision 25).
    centred = nodes.add("Sub", values[0], nodes.constant(layer.offset, "offset"))
    return nodes.add("Div", centred, nodes.constant(layer.scale, "scale"))


def _scale_shift(nodes: Nodes, layer: layers.ScaleShift, ticks: int, values: Sequence[str], *_: object) -> str:
    return nodes.plus(nodes.times(values[0], layer.gain), layer.shift)


def _clip(nodes: Nodes, layer: layers.Clip, ticks: int, values: Sequence[str], *_: object) -> str:
    # The operator Clip takes one pair of limits for all numbers.
    below = nodes.add("Min", values[0], nodes.constant(layer.high[None], "high"))
    return nodes.add("Max", below, nodes.constant(layer.low[None], "low"))


def _glu(nodes: Nodes, layer: layers.Glu, ticks: int, values: Sequence[str], *_: object) -> str:
    half = layer.size // 2
    value, gate = nodes.split(_rows(nodes, values[0], ticks, layer.rows, layer.size), [half, half], 1)
    return _flat(nodes, nodes.add("Mul", value, nodes.add("Sigmoid", gate)), ticks, layer.rows, layer.width)


def _accumulate(nodes: Nodes, layer: layers.Accumulate, ticks: int, values: Sequence[str], *_: object) -> str:
    rows = nodes.split(values[0], [layer.size] * layer.rows, 1)
    sums = rows[:1]
    # CumSum comes with opset 11, and opset 9 is written too.
    for row in rows[1:]:
        sums.append(nodes.add("Add", sums[-1], row))
    return nodes.join(sums, 1)


def _dense(nodes: Nodes, layer: layers.Dense, ticks: int, values: Sequence[str], *_: object) -> str:
    rows = _rows(nodes, values[0], ticks, layer.rows, layer.weight.shape[1])
    return _flat(nodes, nodes.linear(rows, layer.weight, layer.bias), ticks, layer.rows, layer.width)


def _grouped_dense(nodes: Nodes, layer: layers.GroupedDense, ticks: int, values: Sequence[str], *_: object) -> str:
    count, _, into = layer.weight.shape
    rows = nodes.split(values[0], [into] * count, 1)
    parts = [nodes.linear(x, w, b) for x, w, b in zip(rows, layer.weight, layer.bias, strict=True)]
    return nodes.join(parts, 1)


def _trees(nodes: Nodes, layer: layers.TreeSums, ticks: int, values: Sequence[str], *_: object) -> str:
    """Return every node compares at once, and from the leaves up each one hands on the number of its side."""
    outputs, trees = layer.leaf.shape[:2]
    levels = [[0]]
    for _level in range(layer.depth):
        # All left children, then all right ones: a side is one run of columns.
        levels.append([2 * at + side for side in (1, 2) for at in levels[-1]])
    order = np.concatenate(levels[:-1])
    feature, threshold = (table[..., order].transpose(2, 0, 1).ravel() for table in (layer.feature, layer.threshold))
    over = nodes.add("Sub", nodes.columns(values[0], feature), nodes.constant(threshold, "threshold"))
    # 1 where a number is above its threshold, else 0; single precision never rounds a difference to nought.
    right = nodes.split(
        activate(nodes, Function.POSITIVE, over), [outputs * trees * len(level) for level in levels[:-1]], 1
    )
    leaf = layer.leaf[..., np.array(levels[-1]) - (len(order))].transpose(2, 0, 1).reshape(2, -1)
    y = nodes.plus(nodes.times(right[-1], leaf[1] - leaf[0]), leaf[0])
    for side in reversed(right[:-1]):
        size = outputs * trees * 2 ** right.index(side)
        low, high = nodes.split(y, [size, size], 1)
        y = nodes.add("Add", low, nodes.add("Mul", side, nodes.less(high, low)))
    sums = [
        nodes.linear(part, np.ones((1, trees), np.float32), np.zeros(1, np.float32))
        for part in nodes.split(y, [trees] * outputs, 1)
    ]
    return nodes.join(sums, 1)


def _norm(nodes: Nodes, layer: layers.LayerNorm, ticks: int, values: Sequence[str], *_: object) -> str:
    rows = _rows(nodes, values[0], ticks, layer.rows, len(layer.gain))
    scaled = nodes.plus(nodes.times(normed(nodes, rows, layer.epsilon), layer.gain), layer.shift)
    return _flat(nodes, scaled, ticks, layer.rows, layer.width)


def _row_attention(nodes: Nodes, layer: layers.RowAttention, ticks: int, values: Sequence[str], *_: object) -> str:
    # Ticks are split, since a product of more than two dimensions is no Gemm.
    split = [nodes.split(x, [1] * ticks, 0) for x in values]
    seen = []
    for tick in zip(*split, strict=True):
        q, k, v = (nodes.shaped(x, layer.rows, layer.size) for x in tick)
        weights = nodes.softmax(nodes.product(q, k, scale=1 / math.sqrt(layer.size), turn=True))
        seen.append(nodes.shaped(nodes.product(weights, v), 1, layer.width))
    return nodes.join(seen, 0)


PLAIN: dict[type[Layer], Plain] = {
    layers.Gather: _gather,
    layers.Standardise: _standardise,
    layers.ScaleShift: _scale_shift,
    layers.Clip: _clip,
    layers.Elementwise: lambda nodes, layer, ticks, values, widths: combine(nodes, layer.operation, *values),
    layers.Activate: lambda nodes, layer, ticks, values, widths: activate(nodes, layer.function, values[0]),
    layers.Glu: _glu,
    layers.Accumulate: _accumulate,
    layers.Dense: _dense,
    layers.GroupedDense: _grouped_dense,
    layers.TreeSums: _trees,
    layers.LayerNorm: _norm,
    layers.RowAttention: _row_attention,
}
"""Writer functions by layer class, for layers without memory."""
