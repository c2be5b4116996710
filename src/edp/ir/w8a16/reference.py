"""What a W8A16 network computes, bit for bit, over many ticks at once: the definition that exported code must meet."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edp.ir.base import INPUT, Graph, Layer, Number
from edp.ir.layers import Function
from edp.ir.w8a16 import arithmetic as whole
from edp.ir.w8a16 import layers as made
from edp.ir.w8a16.arithmetic import GATE_FRAC, GATE_LIMIT, LARGEST, UNIT_FRAC, Whole, rounded_shift, saturated, scaled
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
        values: dict[str, Any] = {INPUT: np.asarray(inputs, dtype=np.float32)}
        for layer in self.graph.layers:
            layer_inputs = [values[name] for name in layer.inputs]
            if isinstance(layer, made.Quantise):
                values[layer.name] = self._quantised(layer, layer_inputs[0])
                continue
            kind = type(layer)
            run = WHOLE[kind] if kind in WHOLE else OVER_TIME[kind]
            values[layer.name] = run(layer, self.memory[layer.name], *layer_inputs)
        return values

    def _quantised(self, layer: made.Quantise, x: NDArray[np.float32]) -> Whole:
        wide = x * np.float32(2.0**layer.frac)
        top = np.float32(LARGEST)
        self.clipped += int((~((wide >= -top) & (wide <= top))).sum())
        # NaN fails the comparison and takes the lower limit: it is counted as clipped and cannot spread.
        limited = np.where(wide >= -top, np.minimum(wide, top), -top)
        # Half away from zero, as C truncates after adding half with the sign.
        return np.trunc(np.where(limited >= 0, limited + np.float32(0.5), limited - np.float32(0.5))).astype(np.int64)


def matrix(x: Whole, weight: NDArray[np.int8]) -> Whole:
    """``x W'`` of integers: double precision holds the sums exactly, and is fast."""
    # Sums of 16 by 8-bit products stay far below 2^53.
    return np.asarray(x.astype(np.float64) @ weight.T.astype(np.float64)).astype(np.int64)


def _gates(x: Whole, weight: NDArray[np.int8], multiplier: Any, shift: Any) -> Whole:
    return saturated(scaled(matrix(x, weight), multiplier, shift), GATE_LIMIT)


def _to_gate(x: Whole, frac: int) -> Whole:
    return saturated(rounded_shift(x, frac - GATE_FRAC), GATE_LIMIT)


def _dequantise(layer: made.Dequantise, m: Memory, x: Whole) -> NDArray[np.float32]:
    return np.asarray(x.astype(np.float32) * np.float32(2.0**-layer.frac))


def _gather(layer: made.WGather, m: Memory, *parts: Whole) -> Whole:
    return np.asarray(gather(layer, m, *map(rounded_shift, parts, layer.shifts)))


def _sum(layer: made.WSum, m: Memory, a: Whole, b: Whole) -> Whole:
    a, b = a << layer.lefts[0], b << layer.lefts[1]
    return saturated(rounded_shift(a - b if layer.minus else a + b, layer.right))


def _activate(layer: made.WActivate, m: Memory, x: Whole) -> Whole:
    gate = _to_gate(x, layer.input_frac)
    if layer.function is Function.RELU:
        return np.maximum(x, 0)
    if layer.function is Function.SIGMOID:
        return whole.sigmoid(gate)
    if layer.function is Function.TANH:
        return whole.tanh(gate, GATE_FRAC)
    if layer.function is Function.GELU:
        return saturated(rounded_shift(x * whole.normal(gate), 16))
    return saturated(rounded_shift(whole.softplus(gate), GATE_FRAC - layer.frac))


def _glu(layer: made.WGlu, m: Memory, x: Whole) -> Whole:
    halves = x.reshape(*x.shape[:-1], layer.rows, 2, -1)
    gate = whole.sigmoid(_to_gate(halves[..., 1, :], layer.frac))
    return np.asarray(flat(rounded_shift(halves[..., 0, :] * gate, UNIT_FRAC)))


def _dense(layer: made.WDense, m: Memory, x: Whole) -> Whole:
    sums = matrix(split(x, layer.rows), layer.weight) + layer.bias
    return np.asarray(flat(saturated(scaled(sums, layer.multiplier, layer.shift))))


def _grouped(layer: made.WGroupedDense, m: Memory, x: Whole) -> Whole:
    rows = split(x, len(layer.bias))
    sums = np.einsum("roi,tbri->tbro", layer.weight.astype(np.int64), rows) + layer.bias
    return np.asarray(flat(saturated(scaled(sums, layer.multiplier, layer.shift))))


def _convolution(layer: made.WConvolution, m: Memory, x: Whole) -> Whole:
    _, taps, into = layer.weight.shape
    history = np.concatenate([m["ring"], x]) if taps > 1 else x
    if taps > 1:
        m["ring"] = history[-len(m["ring"]) :]
    seen = [history[tap * layer.dilation :][: len(x)] for tap in range(taps)]
    sums = matrix(np.concatenate(seen, axis=-1), layer.weight.reshape(-1, taps * into)) + layer.bias
    return saturated(scaled(sums, layer.multiplier, layer.shift))


def _lstm(layer: made.WLstm, m: Memory, x: Whole) -> Whole:
    driven = _gates(x, layer.weight_x, layer.multiplier_x, layer.shift_x) + layer.bias
    h, c = m["h"], m["c"]
    out = np.empty((*x.shape[:-1], layer.width), dtype=np.int64)
    for tick, ahead in enumerate(driven):
        gates = split(ahead + _gates(h, layer.weight_h, layer.multiplier_h, layer.shift_h), 4)
        i, f, o = np.moveaxis(whole.sigmoid(gates[..., [0, 1, 3], :]), -2, 0)
        # Both terms in the format of the product, so that one rounding remains.
        product = f * c + ((i * whole.tanh(gates[..., 2, :], GATE_FRAC)) << (whole.CELL_FRAC - UNIT_FRAC))
        fresh = saturated(rounded_shift(product, UNIT_FRAC), whole.CELL_LIMIT)
        shown = rounded_shift(o * whole.tanh(fresh, whole.CELL_FRAC), UNIT_FRAC)
        c = c + rounded_shift(layer.share * (fresh - c), UNIT_FRAC)
        h = h + rounded_shift(layer.share * (shown - h), UNIT_FRAC)
        out[tick] = h
    m["h"], m["c"] = h, c
    return out


def _gru(layer: made.WGru, m: Memory, x: Whole) -> Whole:
    driven = _gates(x, layer.weight_x, layer.multiplier_x, layer.shift_x) + layer.bias_x
    h = m["h"]
    out = np.empty((*x.shape[:-1], layer.width), dtype=np.int64)
    for tick, ahead in enumerate(split(driven, 3)):
        back = split(_gates(h, layer.weight_h, layer.multiplier_h, layer.shift_h) + layer.bias_h, 3)
        r, z = np.moveaxis(whole.sigmoid(ahead[..., :2, :] + back[..., :2, :]), -2, 0)
        n = whole.tanh(ahead[..., 2, :] + rounded_shift(r * back[..., 2, :], UNIT_FRAC), GATE_FRAC)
        h = n + rounded_shift(z * (h - n), UNIT_FRAC)
        out[tick] = h
    m["h"] = h
    return out


def _min_gru(layer: made.WMinGru, m: Memory, x: Whole) -> Whole:
    z = whole.sigmoid(_to_gate(x[..., : layer.units], layer.frac))
    fresh, h = x[..., layer.units :] << layer.EXTRA, m["h"]
    out = np.empty_like(fresh)
    for tick in range(len(x)):
        h = h + rounded_shift(z[tick] * (fresh[tick] - h), UNIT_FRAC)
        out[tick] = h
    m["h"] = h
    return saturated(rounded_shift(out, layer.EXTRA))


def _rotation(layer: made.WRotation, m: Memory, x: Whole) -> Whole:
    a, b = layer.factor.astype(np.int64).T
    driven = split(x << layer.left, len(a))
    re, im = m["h"][..., 0], m["h"][..., 1]
    out = np.empty_like(driven)
    for tick, add in enumerate(driven):
        turned = rounded_shift(a * re - b * im, 30), rounded_shift(a * im + b * re, 30)
        re, im = (saturated(turned[i] + add[..., i], whole.CELL_LIMIT) for i in (0, 1))
        out[tick, ..., 0], out[tick, ..., 1] = re, im
    m["h"] = np.stack([re, im], axis=-1)
    return saturated(rounded_shift(out.reshape(x.shape), layer.right))


def _difference(layer: made.WDifference, m: Memory, x: Whole) -> Whole:
    before = m["before"] if layer.from_zero or m["age"][0] > 0 else x[0]
    change = x - np.concatenate([before[None], x[:-1]])
    m["before"], m["age"] = x[-1], np.ones_like(m["age"])
    return saturated(rounded_shift(layer.factor * change, layer.right))


def _mean(layer: made.WTrailingMean, m: Memory, x: Whole) -> Whole:
    age = int(m["age"][0])
    history = np.concatenate([m["ring"], x])
    total = np.concatenate([np.zeros_like(history[:1]), history.cumsum(axis=0)])
    sums = total[layer.window :] - total[: -layer.window]
    count = np.minimum(age + 1 + np.arange(len(x)), layer.window)[:, None, None]
    m["ring"], m["age"] = history[len(x) :], np.full_like(m["age"], min(age + len(x), layer.window))
    # Division of a negative integer rounds down in NumPy and to zero in C; magnitudes agree in both.
    return np.asarray(np.sign(sums) * ((np.abs(sums) + count // 2) // count))


def _pool(layer: made.WAttentionPool, m: Memory, x: Whole) -> Whole:
    own = _gates(x, layer.score[None], layer.multiplier, layer.shift)[..., 0]
    age, window = int(m["age"][0]), layer.window
    ring, scores = np.concatenate([m["ring"], x]), np.concatenate([m["scores"], own])
    out = np.empty_like(x)
    for tick in range(len(x)):
        # Only ticks since the reset: hidden scores have no integer value.
        first, stop = tick + window - min(age + tick + 1, window), tick + window
        weights = whole.softmax(scores[first:stop].T).astype(np.float64)
        sums = np.einsum("bs,sbn->bn", weights, ring[first:stop].astype(np.float64))
        out[tick] = rounded_shift(sums.astype(np.int64), UNIT_FRAC)
    m["ring"], m["scores"] = ring[len(x) :], scores[len(x) :]
    m["age"] = np.full_like(m["age"], min(age + len(x), window))
    return saturated(out)


WHOLE: dict[type[Layer], Callable[..., Any]] = {
    made.Dequantise: _dequantise,
    made.WGather: _gather,
    made.WSum: _sum,
    made.WMultiply: lambda layer, m, a, b: saturated(rounded_shift(a * b, layer.right)),
    made.WScaleShift: lambda layer, m, x: saturated(rounded_shift(x * layer.gain + layer.offset, layer.right)),
    made.WActivate: _activate,
    made.WGlu: _glu,
    made.WDense: _dense,
    made.WGroupedDense: _grouped,
    made.WConvolution: _convolution,
    made.WLstm: _lstm,
    made.WGru: _gru,
    made.WMinGru: _min_gru,
    made.WRotation: _rotation,
    made.WDifference: _difference,
    made.WTrailingMean: _mean,
    made.WAttentionPool: _pool,
}
"""Many ticks of a kind of integer layer."""
