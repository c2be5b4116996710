"""Layers that stay in single precision, over many ticks at once, with the operations of the C runtime in their order.

So both give the same bits. Sums are taken one after the other; the functions are the runtime's own. Values are
``(time, stream, number)``: several streams side by side, all of the same age.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edp.ir import layers, memory
from edp.ir.base import Layer
from edp.ir.descent import find_leaves, summed
from edp.ir.layers import BinaryOperation, Function

Rows = NDArray[np.float32]
Memory = dict[str, Any]
ONE = np.float32(1.0)


def _small_expm1(r: Rows) -> Rows:
    f = np.float32
    # Taylor's series to the seventh power: enough for float32 up to ln 2 / 2, and for the 0.34 of tanh.
    tail = f(1 / 6) + r * (f(1 / 24) + r * (f(1 / 120) + r * (f(1 / 720) + r * f(1 / 5040))))
    return np.asarray(r + r * r * (f(0.5) + r * tail))


def exp(x: Rows) -> Rows:
    """``edp_exp`` of the runtime."""
    f = np.float32
    # Limits of float32: beyond them exp is 0 or infinite, and the shift below would leave the exponent's bits.
    limited = np.clip(x, f(-87.0), f(88.0))
    turns = limited * f(1.44269504)
    n = np.trunc(np.where(turns >= 0, turns + f(0.5), turns - f(0.5))).astype(np.int32)
    # ln 2 in two parts (Cody and Waite): n times the first part is exact, so the rest keeps its digits.
    r = (limited - n.astype(f) * f(0.693359375)) - n.astype(f) * f(-2.12194440e-4)
    # 2^n is written into the exponent's bits: exact, and cheaper than a power.
    power = ((n + 127).astype(np.uint32) << np.uint32(23)).view(np.float32)
    return np.asarray((ONE + _small_expm1(r)) * power)


def tanh(x: Rows) -> Rows:
    """``edp_tanh`` of the runtime."""
    f = np.float32
    size = np.abs(x)
    # Near zero 1 - 2/(e+1) would cancel; the quotient of expm1 keeps relative accuracy.
    e = _small_expm1(f(2.0) * np.minimum(size, f(0.17)))
    near = e / (e + f(2.0))
    far = ONE - f(2.0) / (exp(f(2.0) * np.minimum(size, f(10.0))) + ONE)
    y = np.where(size < f(0.17), near, np.where(size < f(10.0), far, ONE))
    return np.asarray(np.where(x < 0, -y, y))


def sigmoid(x: Rows) -> Rows:
    """``edp_sigmoid`` of the runtime."""
    small = exp(-np.abs(x))
    return np.asarray(np.where(x >= 0, ONE, small) / (ONE + small))


def log1p(x: Rows) -> Rows:
    """log(1 + x) as the runtime has it, for x in [0, 1]."""
    f = np.float32
    s = x / (f(2.0) + x)
    # The series of artanh: log(1+x) = 2 artanh(x / (2 + x)), whose argument stays below 1/3.
    q = s * s
    tail = f(1 / 11) + q * (f(1 / 13) + q * f(1 / 15))
    tail = f(1 / 3) + q * (f(1 / 5) + q * (f(1 / 7) + q * (f(1 / 9) + q * tail)))
    return np.asarray(f(2.0) * (s + s * q * tail))


def _log(x: Rows) -> Rows:
    """``natural_log`` of the runtime."""
    f = np.float32
    half, power = np.frexp(np.clip(x, f(layers.LEAST), np.finfo(f).max))
    # Between 0.71 and 1.41 the logarithm of a number near 1 keeps its digits.
    above = half > f(0.707106769)
    mantissa, n = np.where(above, half, f(2.0) * half), (power - 1 + above).astype(f)
    y = n * f(0.693359375) + (n * f(-2.12194440e-4) + log1p(mantissa - ONE))
    return np.asarray(np.where(np.isnan(x), x, y))


def _softplus(x: Rows) -> Rows:
    return np.asarray(np.where(x > 0, x, np.float32(0)) + log1p(exp(-np.abs(x))))


def _gelu(x: Rows) -> Rows:
    erf = np.vectorize(math.erf, otypes=[np.float32])(x * np.float32(0.707106781))
    return np.asarray(np.float32(0.5) * x * (ONE + erf))


def _sine_of_quadrant(x: Rows, quarters: int) -> Rows:
    """Return the runtime's sine of x plus a number of quarter turns."""
    f = np.float32
    # 8,192 rad: up to there n times the parts of pi/2 below stays exact.
    limited = np.clip(x, f(-8192.0), f(8192.0))
    turns = limited * f(0.636619772)
    n = np.trunc(np.where(turns >= 0, turns + f(0.5), turns - f(0.5))).astype(np.int32)
    whole = n.astype(f)
    # pi/2 in three parts (Cody and Waite), for the digits of large angles.
    r = ((limited - whole * f(1.5703125)) - whole * f(4.83751297e-4)) - whole * f(7.54978995e-8)
    q = r * r
    sine = r + r * q * (f(-1 / 6) + q * (f(1 / 120) + q * (f(-1 / 5040) + q * f(1 / 362880))))
    tail = f(1 / 24) + q * (f(-1 / 720) + q * (f(1 / 40320) + q * f(-1 / 3628800)))
    cosine = ONE + q * (f(-0.5) + q * tail)
    quarter = (n + quarters) & 3
    y = np.where(quarter & 1, cosine, sine)
    return np.asarray(np.where(quarter >= 2, -y, y))


FUNCTIONS: dict[Function, Callable[[Rows], Rows]] = {
    Function.RELU: lambda x: np.where(x > 0, x, np.float32(0)),
    Function.SIGMOID: sigmoid,
    Function.TANH: tanh,
    Function.GELU: _gelu,
    Function.SOFTPLUS: _softplus,
    Function.EXP: exp,
    Function.SQRT: np.sqrt,
    Function.SINE: lambda x: _sine_of_quadrant(x, 0),
    Function.COSINE: lambda x: _sine_of_quadrant(x, 1),
    Function.LOG: _log,
    Function.POSITIVE: lambda x: (x > 0).astype(np.float32),
}


OPERATIONS: dict[BinaryOperation, Callable[[Rows, Rows], Rows]] = {
    BinaryOperation.ADD: np.add,
    BinaryOperation.SUBTRACT: np.subtract,
    BinaryOperation.MULTIPLY: np.multiply,
    BinaryOperation.DIVIDE: np.divide,
    # As in C, where a comparison with NaN is false: the first number stays.
    BinaryOperation.MINIMUM: lambda a, b: np.where(a > b, b, a),
    BinaryOperation.MAXIMUM: lambda a, b: np.where(a < b, b, a),
}


def _sum(x: Rows, axis: int = -1) -> Rows:
    """Sum one after the other, as a loop does; NumPy's own sum adds in pairs."""
    return np.asarray(np.take(np.add.accumulate(x, axis=axis, dtype=np.float32), -1, axis=axis))


def softmax(scores: Rows) -> Rows:
    """Weights over the last axis."""
    raised = exp(scores - scores.max(axis=-1, keepdims=True))
    return np.asarray(raised / _sum(raised)[..., None])


def split(x: Any, rows: int) -> Any:
    """Split the last dimension into the given number of rows."""
    return x.reshape(*x.shape[:-1], rows, -1)


def flat(x: Any) -> Any:
    """Merge the last two dimensions."""
    return x.reshape(*x.shape[:-2], -1)


def gather(layer: Any, m: Memory, *parts: Any) -> Any:
    """Chosen columns."""
    return np.concatenate(parts, axis=-1)[..., list(layer.columns)]


def _difference(layer: memory.Difference, m: Memory, x: Rows) -> Rows:
    before = m["before"] if layer.from_zero or m["age"][0] > 0 else x[0]
    past = np.concatenate([before[None], x[:-1]])
    m["before"], m["age"] = x[-1], np.ones_like(m["age"])
    return np.asarray(layer.factor * (x - past))


def _starting(layer: memory.Starting, m: Memory, x: Rows) -> Rows:
    age = int(m["age"][0])
    read = age + np.arange(len(x)) < layer.ticks
    m["age"] = np.full_like(m["age"], min(age + len(x), layer.ticks))
    flag = np.broadcast_to(read[:, None, None], (*x.shape[:-1], 1))
    return np.concatenate([np.where(flag, x, layer.mean), flag.astype(np.float32)], axis=-1)


def _layer_norm(layer: layers.LayerNorm, m: Memory, x: Rows) -> Rows:
    n = np.float32(len(layer.gain))
    rows = split(x, layer.rows)
    middle = rows - (_sum(rows) / n)[..., None]
    scale = ONE / np.sqrt(_sum(middle * middle) / n + np.float32(layer.epsilon))
    return np.asarray(middle * scale[..., None] * layer.gain + layer.shift).reshape(x.shape)


def _rows(layer: layers.RowAttention, m: Memory, *qkv: Rows) -> Rows:
    q, k, v = (split(x, layer.rows) for x in qkv)
    root = np.sqrt(np.float32(layer.size))
    weights = softmax(_sum(q[..., :, None, :] * k[..., None, :, :]) / root)
    return _sum(weights[..., None] * v[..., None, :, :], axis=3).reshape(qkv[0].shape)


def _window(layer: memory.WindowAttention, m: Memory, q: Rows, k: Rows, v: Rows) -> Rows:
    """Compute window attention in the memory order of the ring, since the order of a sum affects its last bit."""
    root = np.sqrt(np.float32(layer.size // layer.heads))
    out = np.empty_like(q)
    for tick in range(len(q)):
        at, seen = m.setdefault("at", 0), int(m["age"][0])
        keys = split(np.concatenate([m["keys"][:seen], k[tick][None]]), layer.heads)
        values = split(np.concatenate([v[tick][None], m["values"][:seen]]), layer.heads)
        scores = _sum(split(q[tick], layer.heads) * keys) / root
        weights = softmax(np.moveaxis(scores, 0, -1))
        order = np.moveaxis(np.concatenate([weights[..., -1:], weights[..., :-1]], axis=-1), -1, 0)
        out[tick] = _sum(order[..., None] * values, axis=0).reshape(out[tick].shape)
        if layer.window > 1:
            m["keys"][at], m["values"][at] = k[tick], v[tick]
            m["at"] = (at + 1) % (layer.window - 1)
        m["age"] = np.full_like(m["age"], min(seen + 1, layer.window - 1))
    return out


def _trailing_mean(layer: memory.TrailingMean, m: Memory, x: Rows) -> Rows:
    """Compute the trailing mean in the memory order of the ring, as in `_window`; rows not yet seen are zero."""
    shape = (layer.window - 1, *x.shape[1:])
    ring = np.array(np.broadcast_to(m["ring"].reshape(len(m["ring"]), -1, layer.size), shape))
    at, seen, out = m.get("at", 0), int(m["age"][0]), np.empty_like(x)
    for tick in range(len(x)):
        seen = min(seen + 1, layer.window)
        out[tick] = _sum(np.concatenate([x[tick][None], ring]), axis=0) / np.float32(seen)
        if layer.window > 1:
            ring[at] = x[tick]
            at = (at + 1) % (layer.window - 1)
    m["ring"], m["at"], m["age"] = ring, at, np.full_like(m["age"], seen)
    return out


def _accumulate(layer: layers.Accumulate, m: Memory, x: Rows) -> Rows:
    return np.add.accumulate(split(x, layer.rows), axis=2).reshape(x.shape)


def _glu(layer: layers.Glu, m: Memory, x: Rows) -> Rows:
    halves = x.reshape(*x.shape[:-1], layer.rows, 2, -1)
    result: Rows = flat(halves[..., 0, :] * sigmoid(halves[..., 1, :]))
    return result


def _trees(layer: layers.TreeSums, m: Memory, x: Rows) -> Rows:
    return summed(find_leaves(layer.feature, layer.threshold, layer.leaf, x))


def _clip(layer: layers.Clip, m: Memory, x: Rows) -> Rows:
    below = np.where(x > layer.high, layer.high, x)
    return np.asarray(np.where(below < layer.low, layer.low, below))


Run = Callable[..., Any]
OVER_TIME: dict[type[Layer], Run] = {
    layers.Gather: gather,
    layers.Standardise: lambda layer, m, x: (x - layer.offset) / layer.scale,
    layers.ScaleShift: lambda layer, m, x: x * layer.gain + layer.shift,
    layers.Clip: _clip,
    layers.Elementwise: lambda layer, m, a, b: OPERATIONS[layer.operation](a, b),
    layers.Activate: lambda layer, m, x: FUNCTIONS[layer.function](x),
    layers.Glu: _glu,
    layers.Accumulate: _accumulate,
    layers.TreeSums: _trees,
    layers.LayerNorm: _layer_norm,
    layers.RowAttention: _rows,
    memory.Difference: _difference,
    memory.Starting: _starting,
    memory.TrailingMean: _trailing_mean,
    memory.WindowAttention: _window,
    memory.Feedback: lambda layer, m: m["last"][None],
}
"""Many ticks of a kind of layer: (layer, memory, inputs ...) to its value; the memory is brought on."""
