"""Reference implementation of W8A16 networks, bit for bit, over many samples: the definition for exported code."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edp.ir import memory
from edp.ir.base import INPUT, Graph, Layer, Number
from edp.ir.descent import find_leaves
from edp.ir.layers import Function
from edp.ir.w8a16 import arithmetic as fixed
from edp.ir.w8a16 import layers as quantised
from edp.ir.w8a16.arithmetic import GATE_FRAC, GATE_LIMIT, LARGEST, UNIT_FRAC, Fixed, round_shift, saturated, scaled
from edp.ir.w8a16.single import OVER_TIME, flat, gather, split

Memory = dict[str, Any]


RINGS = ("ring", "scores", "keys", "values")
"""Slots whose first dimension is time."""


class Integers:
    """Streams side by side through a graph of `edp.ir.w8a16.quantise`.

    Args:
        graph: the layers.
        streams: how many.

    Attributes:
        clipped: numbers that were beyond the range of their format since the reset, of all ticks and streams.
    """

    def __init__(self, graph: Graph, streams: int = 1) -> None:
        self.graph, self.streams = graph, streams
        self.reset()

    def reset(self) -> None:
        """Forget all ticks."""
        self.clipped = 0
        self.memory: dict[str, Memory] = {layer.name: {} for layer in self.graph.layers}
        for name, slot in self.graph.slots():
            start = self.graph.start(name, slot).astype(np.float32 if slot.number is Number.FLOAT else np.int64)
            if slot.name != "age":
                start = np.stack([start] * self.streams, axis=int(slot.name in RINGS))
            self.memory[name][slot.name] = start

    def run(self, inputs: NDArray[np.floating]) -> dict[str, NDArray[np.float32]]:
        """Feed ticks ``(time, stream, input)`` in SI units; returns results ``(time, stream, number)`` by meaning."""
        values = self.values(inputs)
        return {meaning: values[name] for meaning, name in self.graph.results.items()}

    def values(self, inputs: NDArray[np.floating]) -> dict[str, Any]:
        """Feed ticks; returns the value of every layer and the input."""
        if not self.graph.fed_back:
            return self._together(inputs)
        # A tick of a plant waits for the answer of the one before.
        ticks = [self._together(inputs[at : at + 1]) for at in range(len(inputs))]
        return {name: np.concatenate([tick[name] for tick in ticks]) for name in (ticks[0] if ticks else ())}

    def _together(self, inputs: NDArray[np.floating]) -> dict[str, object]:
        """All ticks at once, layer by layer."""
        values: dict[str, Any] = {INPUT: np.asarray(inputs, dtype=np.float32)}
        for layer in self.graph.layers:
            layer_inputs = [values[name] for name in layer.inputs]
            run = INTEGER_STEPS.get(type(layer)) or OVER_TIME.get(type(layer))
            # First: asking what a layer is takes as long as the step of a small one.
            if run is not None:
                values[layer.name] = run(layer, self.memory[layer.name], *layer_inputs)
            elif isinstance(layer, quantised.Quantise):
                values[layer.name] = self._quantise(layer, layer_inputs[0])
            elif isinstance(layer, memory.Feed):
                self.memory[layer.into]["last"] = layer_inputs[0][-1]
            else:
                raise KeyError(type(layer))
        return values

    def _quantise(self, layer: quantised.Quantise, x: NDArray[np.float32]) -> Fixed:
        wide = x * np.float32(2.0**layer.frac)
        top = np.float32(LARGEST)
        self.clipped += int((~((wide >= -top) & (wide <= top))).sum())
        # NaN fails the comparison and takes the lower limit: it is counted as clipped and cannot spread.
        limited = np.where(wide >= -top, np.minimum(wide, top), -top)
        # Half away from zero, as C truncates after adding half with the sign.
        return np.trunc(np.where(limited >= 0, limited + np.float32(0.5), limited - np.float32(0.5))).astype(np.int64)


def matrix(x: Fixed, weight: NDArray[np.int8]) -> Fixed:
    """``x W'`` of integers: double precision holds the sums exactly, and is fast."""
    # Sums of 16 by 8-bit products stay far below 2^53.
    return np.asarray(x.astype(np.float64) @ weight.T.astype(np.float64)).astype(np.int64)


def _gates(x: Fixed, weight: NDArray[np.int8], multiplier: Any, shift: Any) -> Fixed:
    return saturated(scaled(matrix(x, weight), multiplier, shift), GATE_LIMIT)


def _to_gate(x: Fixed, frac: int) -> Fixed:
    return saturated(round_shift(x, frac - GATE_FRAC), GATE_LIMIT)


def _dequantise(layer: quantised.Dequantise, m: Memory, x: Fixed) -> NDArray[np.float32]:
    return np.asarray(x.astype(np.float32) * np.float32(2.0**-layer.frac))


def _gather(layer: quantised.QGather, m: Memory, *parts: Fixed) -> Fixed:
    return np.asarray(gather(layer, m, *map(round_shift, parts, layer.shifts)))


def _sum(layer: quantised.QSum, m: Memory, a: Fixed, b: Fixed) -> Fixed:
    a, b = a << layer.lefts[0], b << layer.lefts[1]
    return saturated(round_shift(a - b if layer.minus else a + b, layer.right))


def _activate(layer: quantised.QActivate, m: Memory, x: Fixed) -> Fixed:
    gate = _to_gate(x, layer.input_frac)
    if layer.function is Function.RELU:
        return np.maximum(x, 0)
    if layer.function is Function.SIGMOID:
        return fixed.sigmoid(gate)
    if layer.function is Function.TANH:
        return fixed.tanh(gate, GATE_FRAC)
    if layer.function is Function.GELU:
        return saturated(round_shift(x * fixed.normal(gate), 16))
    return saturated(round_shift(fixed.softplus(gate), GATE_FRAC - layer.frac))


def _glu(layer: quantised.QGlu, m: Memory, x: Fixed) -> Fixed:
    halves = x.reshape(*x.shape[:-1], layer.rows, 2, -1)
    gate = fixed.sigmoid(_to_gate(halves[..., 1, :], layer.frac))
    return np.asarray(flat(round_shift(halves[..., 0, :] * gate, UNIT_FRAC)))


def _dense(layer: quantised.QDense, m: Memory, x: Fixed) -> Fixed:
    sums = matrix(split(x, layer.rows), layer.weight) + layer.bias
    return np.asarray(flat(saturated(scaled(sums, layer.multiplier, layer.shift))))


def _grouped_dense(layer: quantised.QGroupedDense, m: Memory, x: Fixed) -> Fixed:
    rows = split(x, len(layer.bias))
    sums = np.einsum("roi,tbri->tbro", layer.weight.astype(np.int64), rows) + layer.bias
    return np.asarray(flat(saturated(scaled(sums, layer.multiplier, layer.shift))))


def _trees(layer: quantised.QTreeSums, m: Memory, x: Fixed) -> Fixed:
    leaves = find_leaves(layer.feature, layer.threshold, layer.leaf, x)
    return saturated(round_shift(leaves.sum(axis=-1, dtype=np.int64), layer.right))


def _convolution(layer: quantised.QConvolution, m: Memory, x: Fixed) -> Fixed:
    _, taps, into = layer.weight.shape
    history = np.concatenate([m["ring"], x]) if taps > 1 else x
    if taps > 1:
        m["ring"] = history[-len(m["ring"]) :]
    seen = [history[tap * layer.dilation :][: len(x)] for tap in range(taps)]
    sums = matrix(np.concatenate(seen, axis=-1), layer.weight.reshape(-1, taps * into)) + layer.bias
    return saturated(scaled(sums, layer.multiplier, layer.shift))


def _lstm(layer: quantised.QLstm, m: Memory, x: Fixed) -> Fixed:
    driven = _gates(x, layer.weight_x, layer.multiplier_x, layer.shift_x) + layer.bias
    h, c = m["h"], m["c"]
    out = np.empty((*x.shape[:-1], layer.width), dtype=np.int64)
    for tick, ahead in enumerate(driven):
        gates = split(ahead + _gates(h, layer.weight_h, layer.multiplier_h, layer.shift_h), 4)
        i, f, o = np.moveaxis(fixed.sigmoid(gates[..., [0, 1, 3], :]), -2, 0)
        # Both terms in the format of the product, so that one rounding remains.
        product = f * c + ((i * fixed.tanh(gates[..., 2, :], GATE_FRAC)) << (fixed.CELL_FRAC - UNIT_FRAC))
        fresh = saturated(round_shift(product, UNIT_FRAC), fixed.CELL_LIMIT)
        shown = round_shift(o * fixed.tanh(fresh, fixed.CELL_FRAC), UNIT_FRAC)
        c = c + round_shift(layer.share * (fresh - c), UNIT_FRAC)
        h = h + round_shift(layer.share * (shown - h), UNIT_FRAC)
        out[tick] = h
    m["h"], m["c"] = h, c
    return out


def _gru(layer: quantised.QGru, m: Memory, x: Fixed) -> Fixed:
    driven = _gates(x, layer.weight_x, layer.multiplier_x, layer.shift_x) + layer.bias_x
    h = m["h"]
    out = np.empty((*x.shape[:-1], layer.width), dtype=np.int64)
    for tick, ahead in enumerate(split(driven, 3)):
        back = split(_gates(h, layer.weight_h, layer.multiplier_h, layer.shift_h) + layer.bias_h, 3)
        r, z = np.moveaxis(fixed.sigmoid(ahead[..., :2, :] + back[..., :2, :]), -2, 0)
        n = fixed.tanh(ahead[..., 2, :] + round_shift(r * back[..., 2, :], UNIT_FRAC), GATE_FRAC)
        h = n + round_shift(z * (h - n), UNIT_FRAC)
        out[tick] = h
    m["h"] = h
    return out


def _min_gru(layer: quantised.QMinGru, m: Memory, x: Fixed) -> Fixed:
    z = fixed.sigmoid(_to_gate(x[..., : layer.units], layer.frac))
    fresh, h = x[..., layer.units :] << layer.EXTRA, m["h"]
    out = np.empty_like(fresh)
    for tick in range(len(x)):
        h = h + round_shift(z[tick] * (fresh[tick] - h), UNIT_FRAC)
        out[tick] = h
    m["h"] = h
    return saturated(round_shift(out, layer.EXTRA))


def _rotation(layer: quantised.QRotation, m: Memory, x: Fixed) -> Fixed:
    a, b = layer.factor.astype(np.int64).T
    driven = split(x << layer.left, len(a))
    re, im = m["h"][..., 0], m["h"][..., 1]
    out = np.empty_like(driven)
    for tick, add in enumerate(driven):
        turned = round_shift(a * re - b * im, 30), round_shift(a * im + b * re, 30)
        re, im = (saturated(turned[i] + add[..., i], fixed.CELL_LIMIT) for i in (0, 1))
        out[tick, ..., 0], out[tick, ..., 1] = re, im
    m["h"] = np.stack([re, im], axis=-1)
    return saturated(round_shift(out.reshape(x.shape), layer.right))


def _difference(layer: quantised.QDifference, m: Memory, x: Fixed) -> Fixed:
    before = m["before"] if layer.from_zero or m["age"][0] > 0 else x[0]
    change = x - np.concatenate([before[None], x[:-1]])
    m["before"], m["age"] = x[-1], np.ones_like(m["age"])
    return saturated(round_shift(layer.factor * change, layer.right))


def _mean(layer: quantised.QTrailingMean, m: Memory, x: Fixed) -> Fixed:
    age = int(m["age"][0])
    history = np.concatenate([m["ring"], x])
    total = np.concatenate([np.zeros_like(history[:1]), history.cumsum(axis=0)])
    sums = total[layer.window :] - total[: -layer.window]
    count = np.minimum(age + 1 + np.arange(len(x)), layer.window)[:, None, None]
    m["ring"], m["age"] = history[len(x) :], np.full_like(m["age"], min(age + len(x), layer.window))
    # Division of a negative integer rounds down in NumPy and to zero in C; magnitudes agree in both.
    return np.asarray(np.sign(sums) * ((np.abs(sums) + count // 2) // count))


def _pool(layer: quantised.QAttentionPool, m: Memory, x: Fixed) -> Fixed:
    own = _gates(x, layer.score[None], layer.multiplier, layer.shift)[..., 0]
    age, window = int(m["age"][0]), layer.window
    ring, scores = np.concatenate([m["ring"], x]), np.concatenate([m["scores"], own])
    out = np.empty_like(x)
    for tick in range(len(x)):
        # Only ticks since the reset: hidden scores have no integer value.
        first, stop = tick + window - min(age + tick + 1, window), tick + window
        weights = fixed.softmax(scores[first:stop].T).astype(np.float64)
        sums = np.einsum("bs,sbn->bn", weights, ring[first:stop].astype(np.float64))
        out[tick] = round_shift(sums.astype(np.int64), UNIT_FRAC)
    m["ring"], m["scores"] = ring[len(x) :], scores[len(x) :]
    m["age"] = np.full_like(m["age"], min(age + len(x), window))
    return saturated(out)


INTEGER_STEPS: dict[type[Layer], Callable[..., Any]] = {
    quantised.Dequantise: _dequantise,
    quantised.QGather: _gather,
    quantised.QSum: _sum,
    quantised.QMultiply: lambda layer, m, a, b: saturated(round_shift(a * b, layer.right)),
    quantised.QScaleShift: lambda layer, m, x: saturated(round_shift(x * layer.gain + layer.offset, layer.right)),
    quantised.QActivate: _activate,
    quantised.QGlu: _glu,
    quantised.QDense: _dense,
    quantised.QGroupedDense: _grouped_dense,
    quantised.QTreeSums: _trees,
    quantised.QConvolution: _convolution,
    quantised.QLstm: _lstm,
    quantised.QGru: _gru,
    quantised.QMinGru: _min_gru,
    quantised.QRotation: _rotation,
    quantised.QDifference: _difference,
    quantised.QTrailingMean: _mean,
    quantised.QAttentionPool: _pool,
}
"""Many ticks of a kind of integer layer."""
