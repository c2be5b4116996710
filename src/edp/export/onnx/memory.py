"""ONNX nodes of one tick of the layers that remember: states come in as values and go out as values.

A state of one axis is a row ``(1, n)``; rings are ``(tick, n)``, the oldest tick first.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from edp.export.onnx.nodes import Nodes
from edp.export.onnx.plain import normed
from edp.ir import Layer, Slot, memory
from edp.ir.memory import UNSEEN

Held = Mapping[str, str]
"""Names of the state values of a layer, by slot."""
Step = Callable[..., tuple[str, dict[str, str]]]
"""Function (nodes, layer, state, inputs ...) that returns the layer's value and its next state."""


def shape_of(slot: Slot) -> tuple[int, ...]:
    """Return the shape of a state in the graph, always a matrix."""
    # A row and not a vector: Gemm takes matrices only.
    return (1, *slot.shape) if len(slot.shape) == 1 else slot.shape


def push(nodes: Nodes, ring: str, rows: int, x: str, axis: int = 0) -> tuple[str, str]:
    """Return the ring with a sample appended, and the ring without its oldest sample."""
    if rows == 1:
        return nodes.join([ring, x], axis), x
    oldest, rest = nodes.split(ring, [1, rows - 1], axis)
    newest = nodes.join([rest, x], axis)
    return nodes.join([oldest, newest], axis), newest


def _difference(nodes: Nodes, layer: memory.Difference, state: Held, x: str) -> tuple[str, dict[str, str]]:
    change = nodes.times(nodes.less(x, state["before"]), layer.factor)
    # At the first tick `age` is 0, which takes the change out; a condition has no place in the graph.
    if not layer.from_zero:
        change = nodes.add("Mul", change, state["age"])
    return change, {"before": x, "age": nodes.clip(nodes.plus(state["age"], np.float32(1)), 0, 1)}


def _starting(nodes: Nodes, layer: memory.Starting, state: Held, x: str) -> tuple[str, dict[str, str]]:
    # Clipping a count gives 1 and 0 without comparison, which importers lack or type differently.
    left = nodes.plus(nodes.times(state["age"], np.float32(-1)), np.float32(layer.ticks))
    read = nodes.clip(left, 0, 1)
    # mean + read (x - mean) would lose the digits of a large x.
    later = nodes.times(nodes.plus(nodes.times(read, np.float32(-1)), np.float32(1)), layer.mean)
    value = nodes.add("Add", nodes.add("Mul", x, read), later)
    age = nodes.clip(nodes.plus(state["age"], np.float32(1)), 0, layer.ticks)
    return nodes.join([value, read], 1), {"age": age}


def _convolution(nodes: Nodes, layer: memory.Convolution, state: Held, x: str) -> tuple[str, dict[str, str]]:
    out, taps, into = layer.weight.shape
    weight = layer.weight.reshape(out, taps * into)
    if taps == 1:
        return nodes.linear(x, weight, layer.bias), {}
    # A tap, and the ticks up to the next one, which only wait.  # no output of a split may stay unread
    sizes = [1, layer.dilation - 1] * (taps - 1) if layer.dilation > 1 else [1] * (taps - 1)
    pieces = nodes.split(state["ring"], sizes, 0)
    read = pieces[:: 2 if layer.dilation > 1 else 1]
    value = nodes.linear(nodes.join([*read, x], 1), weight, layer.bias)
    return value, {"ring": nodes.join([*pieces[1:], x], 0)}


def _mix_states(nodes: Nodes, old: str, new: str, share: float) -> str:
    if share == 1.0:
        # Without zoneout the mix would be two products by 1 and 0.
        return new
    return nodes.add("Add", nodes.times(old, np.float32(1 - share)), nodes.times(new, np.float32(share)))


def _add_gates(nodes: Nodes, layer: Any, state: Held, gates: str) -> tuple[str, dict[str, str]]:
    i, f, g, o = nodes.split(gates, [layer.width] * 4, 1)
    decayed = nodes.add("Mul", nodes.add("Sigmoid", f), state["c"])
    cell = nodes.add("Add", decayed, nodes.add("Mul", nodes.add("Sigmoid", i), nodes.add("Tanh", g)))
    squashed = cell
    if isinstance(layer, memory.LayerNormLstm):
        squashed = nodes.plus(nodes.times(normed(nodes, cell, layer.epsilon), layer.gain_c), layer.shift_c)
    out = nodes.add("Mul", nodes.add("Sigmoid", o), nodes.add("Tanh", squashed))
    new = {name: _mix_states(nodes, state[name], fresh, layer.share) for name, fresh in (("h", out), ("c", cell))}
    return new["h"], new


def _lstm(nodes: Nodes, layer: memory.Lstm, state: Held, x: str) -> tuple[str, dict[str, str]]:
    driven = nodes.linear(x, layer.weight_x, layer.bias)
    return _add_gates(nodes, layer, state, nodes.linear(state["h"], layer.weight_h, driven))


def _layer_norm_lstm(nodes: Nodes, layer: memory.LayerNormLstm, state: Held, x: str) -> tuple[str, dict[str, str]]:
    # Gemm's bias is optional only from opset 11 on.
    none = np.zeros(1, np.float32)
    driven = normed(nodes, nodes.linear(x, layer.weight_x, none), layer.epsilon)
    back = normed(nodes, nodes.linear(state["h"], layer.weight_h, none), layer.epsilon)
    both = nodes.add("Add", nodes.times(driven, layer.gain_x), nodes.times(back, layer.gain_h))
    return _add_gates(nodes, layer, state, nodes.plus(both, layer.bias))


def _gru(nodes: Nodes, layer: memory.Gru, state: Held, x: str) -> tuple[str, dict[str, str]]:
    into = nodes.split(nodes.linear(x, layer.weight_x, layer.bias_x), [layer.width] * 3, 1)
    back = nodes.split(nodes.linear(state["h"], layer.weight_h, layer.bias_h), [layer.width] * 3, 1)
    r, z = (nodes.add("Sigmoid", nodes.add("Add", a, b)) for a, b in zip(into[:2], back[:2], strict=True))
    n = nodes.add("Tanh", nodes.add("Add", into[2], nodes.add("Mul", r, back[2])))
    h = nodes.add("Add", n, nodes.add("Mul", z, nodes.less(state["h"], n)))
    return h, {"h": h}


def _min_gru(nodes: Nodes, layer: memory.MinGru, state: Held, x: str) -> tuple[str, dict[str, str]]:
    z, c = nodes.split(x, [layer.units] * 2, 1)
    h = nodes.add("Add", state["h"], nodes.add("Mul", nodes.add("Sigmoid", z), nodes.less(c, state["h"])))
    return h, {"h": h}


def _rotation(nodes: Nodes, layer: memory.Rotation, state: Held, x: str) -> tuple[str, dict[str, str]]:
    states = len(layer.factor)
    real, imaginary = nodes.split(state["h"], [1, 1], 1)
    a, b = layer.factor[:, :1], layer.factor[:, 1:]
    turned = [
        nodes.add("Add", nodes.times(real, a), nodes.times(imaginary, -b)),
        # Real and imaginary part as columns; complex numbers have no operators in common use.
        nodes.add("Add", nodes.times(imaginary, a), nodes.times(real, b)),
    ]
    h = nodes.add("Add", nodes.join(turned, 1), nodes.shaped(x, states, 2))
    return nodes.shaped(h, 1, 2 * states), {"h": h}


def _trailing_mean(nodes: Nodes, layer: memory.TrailingMean, state: Held, x: str) -> tuple[str, dict[str, str]]:
    age = nodes.clip(nodes.plus(state["age"], np.float32(1)), 0, layer.window)
    if layer.window == 1:
        return x, {"age": age}
    full, ring = push(nodes, state["ring"], layer.window - 1, x)
    # The mean over the whole ring times its length: a sum operator is one more that importers need.
    total = nodes.times(nodes.mean(full, 0), np.float32(layer.window))
    return nodes.add("Div", total, age), {"ring": ring, "age": age}


def _attention_pool(nodes: Nodes, layer: memory.AttentionPool, state: Held, x: str) -> tuple[str, dict[str, str]]:
    if layer.window == 1:
        return x, {}
    score = nodes.linear(x, layer.score[None], layer.bias)
    scores, new_scores = push(nodes, state["scores"], layer.window - 1, score, axis=1)
    full, ring = push(nodes, state["ring"], layer.window - 1, x)
    return nodes.product(nodes.softmax(scores), full), {"ring": ring, "scores": new_scores}


def attend(nodes: Nodes, layer: memory.WindowAttention, qkv: tuple[str, str, str], hidden: str | None) -> str:
    """Return every row of the queries over all rows of keys and values, head by head.

    `hidden` is added to the scores.
    """
    wide = layer.size // layer.heads
    parts = [nodes.split(x, [wide] * layer.heads, 1) for x in qkv]
    seen = []
    for q, k, v in zip(*parts, strict=True):
        scores = nodes.product(q, k, hidden, 1 / math.sqrt(wide), turn=True)
        seen.append(nodes.product(nodes.softmax(scores), v))
    return nodes.join(seen, 1)


def _window_attention(
    nodes: Nodes, layer: memory.WindowAttention, state: Held, q: str, k: str, v: str
) -> tuple[str, dict[str, str]]:
    age = nodes.clip(nodes.plus(state["age"], np.float32(1)), 0, layer.window)
    if layer.window == 1:
        return v, {"age": age}
    keys, new_keys = push(nodes, state["keys"], layer.window - 1, k)
    values, also = push(nodes, state["values"], layer.window - 1, v)
    # Row j of the window was seen if at most window - 1 - j ticks are missing.
    places = np.arange(layer.window, 0, -1, dtype=np.float32)[None]
    unseen = nodes.clip(nodes.plus(nodes.times(age, np.float32(-1)), places), 0, 1)
    # A finite offset, as in the network: minus infinity times zero would be NaN.
    value = attend(nodes, layer, (q, keys, values), nodes.times(unseen, np.float32(UNSEEN)))
    return value, {"keys": new_keys, "values": also, "age": age}


def correct(nodes: Nodes, layer: memory.PrefixCorrection, seen: str) -> str:
    """Return the change of the states, concatenated, from the mean and the last value of the initial samples."""
    hidden = nodes.add("Tanh", nodes.linear(seen, layer.first_weight, layer.first_bias))
    return nodes.linear(hidden, layer.second_weight, layer.second_bias)


def step_correction(nodes: Nodes, layer: memory.PrefixCorrection, state: Held, x: str) -> tuple[str, dict[str, str]]:
    """Return the correction, zero except at sample `ticks`, and the next states of the layer."""
    ticks, age = layer.ticks, state["age"]
    counting = nodes.clip(nodes.plus(nodes.times(age, np.float32(-1)), np.float32(ticks)), 0, 1)
    # Only while the prefix lasts; later ticks must leave the total as it is.
    total = nodes.add("Add", state["total"], nodes.add("Mul", x, counting))
    numbers = correct(nodes, layer, nodes.join([nodes.times(total, np.float32(1 / ticks)), x], 1))
    # One at the last tick of the prefix and after; with `counting` it is that tick alone.
    reached = nodes.clip(nodes.plus(age, np.float32(2 - ticks)), 0, 1)
    now = nodes.add("Mul", reached, counting)
    return nodes.add("Mul", numbers, now), {
        "total": total,
        "age": nodes.clip(nodes.plus(age, np.float32(1)), 0, ticks),
    }


def _feedback(nodes: Nodes, layer: memory.Feedback, state: Held) -> tuple[str, dict[str, str]]:
    return state["last"], {}


STEPS: dict[type[Layer], Step] = {
    memory.Difference: _difference,
    memory.Starting: _starting,
    memory.Convolution: _convolution,
    memory.Lstm: _lstm,
    memory.LayerNormLstm: _layer_norm_lstm,
    memory.Gru: _gru,
    memory.MinGru: _min_gru,
    memory.Rotation: _rotation,
    memory.TrailingMean: _trailing_mean,
    memory.AttentionPool: _attention_pool,
    memory.WindowAttention: _window_attention,
    memory.Feedback: _feedback,
}
"""Step functions by layer class. Prefix correction and feedback depend on other layers and are handled separately."""
