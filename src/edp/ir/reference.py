"""Reference implementation of layer graphs in NumPy, sample by sample. Slow; used by tests and quantisation."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edp.ir import layers as plain
from edp.ir import memory
from edp.ir.base import INPUT, Graph, Layer
from edp.ir.descent import find_leaves, summed

Values = NDArray[np.floating]
Memory = dict[str, Values]
"""What one layer remembers, by slot."""


class Reference:
    """A stream through a graph.

    Args:
        graph: the layers.
        dtype: float64 shows what the graph means, float32 what single precision makes of it.
    """

    # Double precision by default: the reference judges single-precision forms, so its own rounding must not show.
    def __init__(self, graph: Graph, dtype: type[np.floating] = np.float64) -> None:
        self.graph, self.dtype = graph, dtype
        self._constants = {
            layer.name: {name: values.astype(dtype) for name, values in layer.tensors().items()}
            for layer in graph.layers
        }
        self._plan = [(layer, STEPS.get(type(layer)), self._constants[layer.name]) for layer in graph.layers]
        self.reset()

    def reset(self) -> None:
        """Forget all ticks."""
        self.memory: dict[str, Memory] = {layer.name: {} for layer in self.graph.layers}
        for name, slot in self.graph.slots():
            self.memory[name][slot.name] = self.graph.start(name, slot).astype(self.dtype)

    def step(self, inputs: Values) -> dict[str, Values]:
        """Feed one tick ``(input,)`` in SI units; returns the value of every layer and the input."""
        values: dict[str, Values] = {INPUT: np.asarray(inputs, dtype=self.dtype)}
        for layer, run, constants in self._plan:
            layer_inputs = [values[name] for name in layer.inputs]
            # First: layers are of an abstract class, and asking what they are takes as long as the step of a small one.
            if run is not None:
                values[layer.name] = run(layer, constants, self.memory[layer.name], *layer_inputs)
            elif isinstance(layer, memory.PrefixCorrection):
                self._correct(layer, layer_inputs[0])
            elif isinstance(layer, memory.Feed):
                self.memory[layer.into]["last"] = layer_inputs[0]
            else:
                raise KeyError(type(layer))
        return values

    def results(self, inputs: Values) -> dict[str, Values]:
        """Process one sample and return the results of the graph by meaning."""
        values = self.step(inputs)
        return {meaning: values[name] for meaning, name in self.graph.results.items()}

    def _correct(self, layer: memory.PrefixCorrection, x: Values) -> None:
        state, weights = self.memory[layer.name], self._constants[layer.name]
        if state["age"][0] >= layer.ticks:
            return
        state["total"] = state["total"] + x
        state["age"] = state["age"] + 1
        if state["age"][0] < layer.ticks:
            return
        seen = np.concatenate([state["total"] / self.dtype(layer.ticks), x])
        hidden = np.tanh(weights["first_weight"] @ seen + weights["first_bias"])
        numbers, at = weights["second_weight"] @ hidden + weights["second_bias"], 0
        for name, slot in layer.corrects:
            old = self.memory[name][slot]
            self.memory[name][slot] = old + numbers[at : at + old.size].reshape(old.shape)
            at += old.size


Step = Callable[..., Values]
Weights = Mapping[str, Values]
STEPS: dict[type[Layer], Step] = {}
"""One tick of each kind of layer: (layer, constants, memory, inputs ...) to its value; the memory is brought on."""


def _step(kind: type[Layer]) -> Callable[[Step], Step]:
    def enter(step: Step) -> Step:
        STEPS[kind] = step
        return step

    return enter


def sigmoid(x: Values) -> Values:
    """``1 / (1 + exp(-x))`` without overflow."""
    # exp of a negative number cannot overflow; the two branches are the same function.
    small = np.exp(-np.abs(x))
    return np.where(x >= 0, 1 / (1 + small), small / (1 + small))


def softmax(x: Values) -> Values:
    """Weights that sum to 1 over the last axis."""
    # Subtracting the largest score keeps exp below one; the weights do not change.
    raised = np.exp(x - x.max(axis=-1, keepdims=True))
    return np.asarray(raised / raised.sum(axis=-1, keepdims=True))


def _gelu(x: Values) -> Values:
    # NumPy has no error function; `math.erf` is exact to double precision.
    erf = np.array([math.erf(float(v) / math.sqrt(2)) for v in x], dtype=x.dtype)
    return np.asarray(x * (1 + erf) / 2)


FUNCTIONS: Mapping[plain.Function, Callable[[Values], Values]] = {
    plain.Function.RELU: lambda x: np.maximum(x, 0),
    plain.Function.SIGMOID: sigmoid,
    plain.Function.TANH: np.tanh,
    plain.Function.GELU: _gelu,
    # `logaddexp` neither overflows for large x nor loses digits for small ones.
    plain.Function.SOFTPLUS: lambda x: np.logaddexp(x, np.zeros_like(x)),
    plain.Function.EXP: np.exp,
    plain.Function.SQRT: np.sqrt,
    plain.Function.SINE: np.sin,
    plain.Function.COSINE: np.cos,
    plain.Function.LOG: lambda x: np.log(np.maximum(x, x.dtype.type(plain.LEAST))),
    plain.Function.POSITIVE: lambda x: np.asarray(x > 0, dtype=x.dtype),
}


OPERATIONS: Mapping[plain.BinaryOperation, Callable[[Values, Values], Values]] = {
    plain.BinaryOperation.ADD: np.add,
    plain.BinaryOperation.SUBTRACT: np.subtract,
    plain.BinaryOperation.MULTIPLY: np.multiply,
    plain.BinaryOperation.DIVIDE: np.divide,
    plain.BinaryOperation.MINIMUM: np.minimum,
    plain.BinaryOperation.MAXIMUM: np.maximum,
}


@_step(plain.Gather)
def _gather(layer: plain.Gather, w: Weights, m: Memory, *parts: Values) -> Values:
    return np.concatenate(parts)[list(layer.columns)]


@_step(plain.Standardise)
def _standardise(layer: Any, w: Weights, m: Memory, x: Values) -> Values:
    return np.asarray((x - w["offset"]) / w["scale"])


@_step(plain.ScaleShift)
def _scale_shift(layer: Any, w: Weights, m: Memory, x: Values) -> Values:
    return np.asarray(w["gain"] * x + w["shift"])


@_step(plain.Clip)
def _clip(layer: Any, w: Weights, m: Memory, x: Values) -> Values:
    return np.asarray(np.maximum(np.minimum(x, w["high"]), w["low"]))


@_step(plain.Elementwise)
def _elementwise(layer: plain.Elementwise, w: Weights, m: Memory, a: Values, b: Values) -> Values:
    return np.asarray(OPERATIONS[layer.operation](a, b))


@_step(plain.Activate)
def _activate(layer: plain.Activate, w: Weights, m: Memory, x: Values) -> Values:
    return FUNCTIONS[layer.function](x)


@_step(plain.Glu)
def _glu(layer: plain.Glu, w: Weights, m: Memory, x: Values) -> Values:
    halves = x.reshape(layer.rows, 2, -1)
    return (halves[:, 0] * sigmoid(halves[:, 1])).ravel()


@_step(plain.Accumulate)
def _accumulate(layer: plain.Accumulate, w: Weights, m: Memory, x: Values) -> Values:
    return np.asarray(x.reshape(layer.rows, -1).cumsum(axis=0).ravel())


@_step(plain.Dense)
def _dense(layer: plain.Dense, w: Weights, m: Memory, x: Values) -> Values:
    return np.asarray((x.reshape(layer.rows, -1) @ w["weight"].T + w["bias"]).ravel())


@_step(plain.GroupedDense)
def _grouped_dense(layer: Any, w: Weights, m: Memory, x: Values) -> Values:
    rows = x.reshape(len(w["bias"]), -1)
    return np.asarray((np.einsum("roi,ri->ro", w["weight"], rows) + w["bias"]).ravel())


@_step(plain.TreeSums)
def _trees(layer: plain.TreeSums, w: Weights, m: Memory, x: Values) -> Values:
    return summed(find_leaves(layer.feature, w["threshold"], w["leaf"], x))


def _normalise(x: Values, epsilon: float) -> Values:
    middle = x - x.mean(axis=-1, keepdims=True)
    spread = (middle * middle).mean(axis=-1, keepdims=True)
    return np.asarray(middle / np.sqrt(spread + x.dtype.type(epsilon)))


@_step(plain.LayerNorm)
def _layer_norm(layer: plain.LayerNorm, w: Weights, m: Memory, x: Values) -> Values:
    rows = _normalise(x.reshape(layer.rows, -1), layer.epsilon)
    return np.asarray((rows * w["gain"] + w["shift"]).ravel())


@_step(plain.RowAttention)
def _rows(layer: plain.RowAttention, w: Weights, m: Memory, *qkv: Values) -> Values:
    q, k, v = (x.reshape(layer.rows, -1) for x in qkv)
    return np.asarray((softmax(q @ k.T / q.dtype.type(math.sqrt(layer.size))) @ v).ravel())


@_step(memory.Difference)
def _difference(layer: memory.Difference, w: Weights, m: Memory, x: Values) -> Values:
    # At the first tick there is no past: the change is zero, not a jump from zero.
    before = m["before"] if layer.from_zero or m["age"][0] > 0 else x
    m["before"], m["age"] = x, np.ones_like(m["age"])
    return np.asarray(w["factor"] * (x - before))


@_step(memory.Starting)
def _starting(layer: memory.Starting, w: Weights, m: Memory, x: Values) -> Values:
    read = m["age"][0] < layer.ticks
    m["age"] = np.minimum(m["age"] + 1, layer.ticks)
    flag = np.full(1, 1.0 if read else 0.0, dtype=x.dtype)
    return np.concatenate([x if read else w["mean"], flag])


@_step(memory.Feedback)
def _feedback(layer: memory.Feedback, w: Weights, m: Memory) -> Values:
    return m["last"]


@_step(memory.Convolution)
def _convolution(layer: memory.Convolution, w: Weights, m: Memory, x: Values) -> Values:
    ring = m.get("ring", np.zeros((0, len(x)), dtype=x.dtype))
    history = np.concatenate([ring, x[None]])
    if "ring" in m:
        m["ring"] = history[1:]
    return np.asarray(np.einsum("oki,ki->o", w["weight"], history[:: layer.dilation]) + w["bias"])


def _lstm_states(gates: Values, m: Memory, share: float, squash: Callable[[Values], Values]) -> Values:
    i, f, g, o = np.split(gates, 4)
    fresh = sigmoid(f) * m["c"] + sigmoid(i) * np.tanh(g)
    out = sigmoid(o) * np.tanh(squash(fresh))
    dtype_share = gates.dtype.type(share)
    # Old value plus a share of the change, in the order of the C code.
    m["h"], m["c"] = m["h"] + dtype_share * (out - m["h"]), m["c"] + dtype_share * (fresh - m["c"])
    return m["h"]


@_step(memory.Lstm)
def _lstm(layer: memory.Lstm, w: Weights, m: Memory, x: Values) -> Values:
    gates = w["weight_x"] @ x + w["weight_h"] @ m["h"] + w["bias"]
    return _lstm_states(gates, m, layer.share, lambda c: c)


@_step(memory.LayerNormLstm)
def _layer_norm_lstm(layer: memory.LayerNormLstm, w: Weights, m: Memory, x: Values) -> Values:
    driven = _normalise(w["weight_x"] @ x, layer.epsilon) * w["gain_x"]
    gates = driven + _normalise(w["weight_h"] @ m["h"], layer.epsilon) * w["gain_h"] + w["bias"]
    return _lstm_states(gates, m, layer.share, lambda c: _normalise(c, layer.epsilon) * w["gain_c"] + w["shift_c"])


@_step(memory.Gru)
def _gru(layer: memory.Gru, w: Weights, m: Memory, x: Values) -> Values:
    into = np.split(w["weight_x"] @ x + w["bias_x"], 3)
    back = np.split(w["weight_h"] @ m["h"] + w["bias_h"], 3)
    r, z = sigmoid(into[0] + back[0]), sigmoid(into[1] + back[1])
    n = np.tanh(into[2] + r * back[2])
    # One product less than z h + (1 - z) n.
    m["h"] = n + z * (m["h"] - n)
    return m["h"]


@_step(memory.MinGru)
def _min_gru(layer: memory.MinGru, w: Weights, m: Memory, x: Values) -> Values:
    z = sigmoid(x[: layer.units])
    m["h"] = (1 - z) * m["h"] + z * x[layer.units :]
    return m["h"]


@_step(memory.Rotation)
def _rotation(layer: memory.Rotation, w: Weights, m: Memory, x: Values) -> Values:
    (a, b), (re, im) = w["factor"].T, m["h"].T
    m["h"] = np.stack([a * re - b * im, a * im + b * re], axis=1) + x.reshape(-1, 2)
    return np.asarray(m["h"].ravel())


@_step(memory.TrailingMean)
def _trailing_mean(layer: memory.TrailingMean, w: Weights, m: Memory, x: Values) -> Values:
    history = np.concatenate([m["ring"], x[None]])
    m["ring"], m["age"] = history[1:], np.minimum(m["age"] + 1, layer.window)
    return np.asarray(history.sum(axis=0) / m["age"][0])


@_step(memory.AttentionPool)
def _attention_pool(layer: memory.AttentionPool, w: Weights, m: Memory, x: Values) -> Values:
    ring = np.concatenate([m["ring"], x[None]])
    scores = np.concatenate([m["scores"], w["score"] @ x[:, None] + w["bias"]])
    m["ring"], m["scores"] = ring[1:], scores[1:]
    return np.asarray(softmax(scores) @ ring)


@_step(memory.WindowAttention)
def _window_attention(layer: memory.WindowAttention, w: Weights, m: Memory, *qkv: Values) -> Values:
    q, k, v = qkv
    keys, values = np.concatenate([m["keys"], k[None]]), np.concatenate([m["values"], v[None]])
    m["keys"], m["values"], m["age"] = keys[1:], values[1:], np.minimum(m["age"] + 1, layer.window)
    # Only ticks since the reset take part; the rest of the ring holds zeros.
    seen, heads = int(m["age"][0]), layer.heads
    ks, vs = (x[-seen:].reshape(seen, heads, -1) for x in (keys, values))
    scores = np.einsum("hd,shd->hs", q.reshape(heads, -1), ks) / q.dtype.type(math.sqrt(layer.size / heads))
    return np.asarray(np.einsum("hs,shd->hd", softmax(scores), vs).ravel())
