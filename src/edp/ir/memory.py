"""Layers with state: differences, convolutions, recurrences, trailing windows.

In the equations `before` is the value of the layer at the previous sample.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from edp.ir.base import Array, Layer, LayerRun, Slot, Values
from edp.ir.layers import Function, flat, split

# Finite on purpose: minus infinity would give NaN where all scores of a row are hidden.
UNSEEN = -1e30
"""Attention score of a sample before the reset. The score is so low that the softmax ignores the sample."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Difference(Layer):
    """``factor (x - before)``, `factor` ``(width,)``.

    At the first tick after a reset `before` is 0 where `from_zero` holds, else x, which gives 0. Slots: `before`, and
    `age`, 0 until there was a tick.
    """

    bit_exact = True
    counted = True

    factor: Array
    from_zero: bool

    @property
    def width(self) -> int:
        return len(self.factor)

    @property
    def slots(self) -> tuple[Slot, ...]:
        return Slot("before", (self.width,)), Slot("age", (1,))

    def over_time(self, run: LayerRun, x: Values) -> Values:
        m = run.memory
        # At the first tick there is no past: the change is zero, not a jump from zero.
        before = m["before"] if self.from_zero or m["age"][0] > 0 else x[0]
        past = np.concatenate([before[None], x[:-1]])
        m["before"], m["age"] = x[-1], np.ones_like(m["age"])
        return np.asarray(run.constants["factor"] * (x - past))


@dataclass(frozen=True, eq=False, kw_only=True)
class Starting(Layer):
    """``[x ; 1]`` in the first `ticks` samples after a reset, ``[mean ; 0]`` afterwards.

    Slot: sample count up to `ticks`.
    """

    bit_exact = True
    counted = True

    mean: Array
    ticks: int

    @property
    def width(self) -> int:
        return len(self.mean) + 1

    @property
    def slots(self) -> tuple[Slot, ...]:
        return (Slot("age", (1,)),)

    def over_time(self, run: LayerRun, x: Values) -> Values:
        age = int(run.memory["age"][0])
        read = age + np.arange(len(x)) < self.ticks
        run.memory["age"] = np.full_like(run.memory["age"], min(age + len(x), self.ticks))
        flag = np.broadcast_to(read[:, None, None], (*x.shape[:-1], 1))
        return np.concatenate([np.where(flag, x, run.constants["mean"]), flag.astype(x.dtype)], axis=-1)


@dataclass(frozen=True, eq=False, kw_only=True)
class Convolution(Layer):
    """``b + sum_k W[:, k] x[t - (taps - 1 - k) dilation]``; the last tap is the present.

    `weight` ``(out, tap, in)``, `bias` ``(out,)``. Slot: the last ``(taps - 1) dilation`` inputs.
    """

    matrices = ("weight",)
    counted = True

    weight: Array
    bias: Array
    dilation: int = 1

    @property
    def width(self) -> int:
        return len(self.bias)

    @property
    def slots(self) -> tuple[Slot, ...]:
        _, taps, into = self.weight.shape
        # A kernel of one tap has no past; an empty array has no form in C.
        return (Slot("ring", ((taps - 1) * self.dilation, into)),) if taps > 1 else ()

    @property
    def macs(self) -> int:
        return self.weight.size

    def over_time(self, run: LayerRun, x: Values) -> Values:
        taps = self.weight.shape[1]
        history = np.concatenate([run.memory["ring"], x]) if taps > 1 else x
        if taps > 1:
            run.memory["ring"] = history[len(x) :]
        seen = np.stack([history[tap * self.dilation :][: len(x)] for tap in range(taps)], axis=-2)
        return np.asarray(np.einsum("oki,...ki->...o", run.constants["weight"], seen) + run.constants["bias"])

    def products(self, x: Values, y: Values) -> dict[str, Values]:
        _, taps, into = self.weight.shape
        history = np.concatenate([np.zeros(((taps - 1) * self.dilation, into)), x])
        seen = [history[tap * self.dilation :][: len(x)] for tap in range(taps)]
        return {self.name: np.concatenate(seen, axis=1)[:, None]}


@dataclass(frozen=True, eq=False, kw_only=True)
class _Gated(Layer):
    """Common part of both kinds of LSTM, which are distinguished by their class."""

    matrices = ("weight_x", "weight_h")

    weight_x: Array
    weight_h: Array
    bias: Array
    share: float = 1.0

    @property
    def width(self) -> int:
        return int(self.weight_h.shape[1])

    @property
    def slots(self) -> tuple[Slot, ...]:
        return Slot("h", (self.width,)), Slot("c", (self.width,))

    @property
    def macs(self) -> int:
        return self.weight_x.size + self.weight_h.size

    @property
    def scratch(self) -> int:
        return 4 * self.width

    @property
    def tangent_scratch(self) -> int:
        # The old state is kept in addition: the cell's tangent reads what the layer overwrites.
        return self.scratch + self.width

    def over_time(self, run: LayerRun, x: Values) -> Values:
        m, apply, share = run.memory, run.arithmetic.apply, x.dtype.type(self.share)
        shown = []
        for tick in x:
            i, f, g, o = _parts(self._gates(run, tick), 4)
            driven = apply(Function.SIGMOID, i) * apply(Function.TANH, g)
            fresh = apply(Function.SIGMOID, f) * m["c"] + driven
            out = apply(Function.SIGMOID, o) * apply(Function.TANH, self._squashed(run, fresh))
            # Old value plus a share of the change, in the order of the C code.
            m["h"], m["c"] = m["h"] + share * (out - m["h"]), m["c"] + share * (fresh - m["c"])
            shown.append(m["h"])
        return np.stack(shown)

    def _gates(self, run: LayerRun, x: Values) -> Values:
        w = run.constants
        return np.asarray(_times(w["weight_x"], x) + _times(w["weight_h"], run.memory["h"]) + w["bias"])

    def _squashed(self, run: LayerRun, cell: Values) -> Values:
        return cell


@dataclass(frozen=True, eq=False, kw_only=True)
class Lstm(_Gated):
    """LSTM, gates in the order i, f, g, o: ``c~ = f c + i g``, ``h~ = o tanh(c~)``.

    ``h = h_before + share (h~ - h_before)`` and c likewise; `share` is 1 without zoneout. `weight_x` ``(4 units, in)``,
    `weight_h` ``(4 units, units)``, `bias` ``(4 units,)``.
    """

    def products(self, x: Values, y: Values) -> dict[str, Values]:
        return _recurrent_products(self.name, x, y)


@dataclass(frozen=True, eq=False, kw_only=True)
class LayerNormLstm(_Gated):
    """LSTM whose gates see ``norm(W x) gain_x + norm(U h) gain_h + bias`` and whose output has ``tanh`` of a norm of c.

    Each norm is over all its numbers, ``h~ = o tanh(norm(c~) gain_c + shift_c)``; otherwise as `Lstm`.
    """

    without: ClassVar[Mapping[str, str]] = {"integers": "train with the cell 'lstm', or export in float32"}

    gain_x: Array
    gain_h: Array
    gain_c: Array
    shift_c: Array
    epsilon: float

    @property
    def scratch(self) -> int:
        # The sums of both sides are kept apart for their norms.
        return 8 * self.width

    def _gates(self, run: LayerRun, x: Values) -> Values:
        w, normed = run.constants, run.arithmetic.normed
        driven = normed(_times(w["weight_x"], x), self.epsilon) * w["gain_x"]
        back = normed(_times(w["weight_h"], run.memory["h"]), self.epsilon) * w["gain_h"]
        return np.asarray(driven + back + w["bias"])

    def _squashed(self, run: LayerRun, cell: Values) -> Values:
        normed = run.arithmetic.normed(cell, self.epsilon)
        return np.asarray(normed * run.constants["gain_c"] + run.constants["shift_c"])


@dataclass(frozen=True, eq=False, kw_only=True)
class Gru(Layer):
    """GRU, gates in the order r, z, n: ``n = tanh(W x + b + r (U h + b'))``, ``h = n + z (h_before - n)``."""

    matrices = ("weight_x", "weight_h")

    weight_x: Array
    weight_h: Array
    bias_x: Array
    bias_h: Array

    @property
    def width(self) -> int:
        return int(self.weight_h.shape[1])

    @property
    def slots(self) -> tuple[Slot, ...]:
        return (Slot("h", (self.width,)),)

    @property
    def macs(self) -> int:
        return self.weight_x.size + self.weight_h.size

    @property
    def scratch(self) -> int:
        # The sums of both products are kept apart.
        return 6 * self.width

    @property
    def tangent_scratch(self) -> int:
        return self.scratch + self.width

    def over_time(self, run: LayerRun, x: Values) -> Values:
        m, w, apply = run.memory, run.constants, run.arithmetic.apply
        shown = []
        for tick in x:
            into = _parts(_times(w["weight_x"], tick) + w["bias_x"], 3)
            back = _parts(_times(w["weight_h"], m["h"]) + w["bias_h"], 3)
            r, z = apply(Function.SIGMOID, into[0] + back[0]), apply(Function.SIGMOID, into[1] + back[1])
            n = apply(Function.TANH, into[2] + r * back[2])
            # One product less than z h + (1 - z) n.
            m["h"] = n + z * (m["h"] - n)
            shown.append(m["h"])
        return np.stack(shown)

    def products(self, x: Values, y: Values) -> dict[str, Values]:
        return _recurrent_products(self.name, x, y)


@dataclass(frozen=True, eq=False, kw_only=True)
class MinGru(Layer):
    """``h = (1 - z) h_before + z c`` with ``[z' ; c] = x`` of ``2 units`` elements and ``z = sigmoid(z')``."""

    units: int

    @property
    def width(self) -> int:
        return self.units

    @property
    def slots(self) -> tuple[Slot, ...]:
        return (Slot("h", (self.units,)),)

    def over_time(self, run: LayerRun, x: Values) -> Values:
        m, shown = run.memory, []
        for tick in x:
            z = run.arithmetic.apply(Function.SIGMOID, tick[..., : self.units])
            m["h"] = (1 - z) * m["h"] + z * tick[..., self.units :]
            shown.append(m["h"])
        return np.stack(shown)


@dataclass(frozen=True, eq=False, kw_only=True)
class Rotation(Layer):
    """Complex ``h = factor h_before + x``; all as pairs of real and imaginary part, `factor` ``(states, 2)``."""

    factor: Array

    @property
    def width(self) -> int:
        return self.factor.size

    @property
    def slots(self) -> tuple[Slot, ...]:
        return (Slot("h", (len(self.factor), 2)),)

    def over_time(self, run: LayerRun, x: Values) -> Values:
        m, (a, b), shown = run.memory, run.constants["factor"].T, []
        for tick in x:
            re, im = m["h"][..., 0], m["h"][..., 1]
            m["h"] = np.stack([a * re - b * im, a * im + b * re], axis=-1) + split(tick, len(a))
            shown.append(flat(m["h"]))
        return np.stack(shown)


@dataclass(frozen=True, eq=False, kw_only=True)
class TrailingMean(Layer):
    """Mean of the last `window` inputs, or of all inputs until now. Slots: ring, and sample count up to `window`."""

    bit_exact = True
    counted = True

    size: int
    window: int

    @property
    def width(self) -> int:
        return self.size

    @property
    def slots(self) -> tuple[Slot, ...]:
        return Slot("ring", (self.window - 1, self.size)), Slot("age", (1,))

    def over_time(self, run: LayerRun, x: Values) -> Values:
        # In the memory order of the ring of the C code, since the order of a sum affects its last bit.
        m, shape = run.memory, (self.window - 1, *x.shape[1:])
        ring = np.array(np.broadcast_to(m["ring"].reshape(len(m["ring"]), -1, self.size), shape))
        at, seen, out = m.get("at", 0), int(m["age"][0]), np.empty_like(x)
        for tick in range(len(x)):
            seen = min(seen + 1, self.window)
            out[tick] = run.arithmetic.total(np.concatenate([x[tick][None], ring]), axis=0) / x.dtype.type(seen)
            if self.window > 1:
                ring[at] = x[tick]
                at = (at + 1) % (self.window - 1)
        m["ring"], m["at"], m["age"] = ring, at, np.full_like(m["age"], seen)
        return out


@dataclass(frozen=True, eq=False, kw_only=True)
class AttentionPool(Layer):
    """Softmax-weighted mean of the last `window` inputs, with scores ``score x + bias``. Slots: rings of both."""

    counted = True

    score: Array
    bias: Array
    window: int

    @property
    def width(self) -> int:
        return len(self.score)

    @property
    def slots(self) -> tuple[Slot, ...]:
        return Slot("ring", (self.window - 1, self.width)), Slot("scores", (self.window - 1,), UNSEEN)

    @property
    def macs(self) -> int:
        return (self.window + 1) * self.width

    @property
    def scratch(self) -> int:
        return self.window

    def over_time(self, run: LayerRun, x: Values) -> Values:
        m, out = run.memory, np.empty_like(x)
        for tick in range(len(x)):
            score = (x[tick] @ run.constants["score"] + run.constants["bias"])[None]
            ring, scores = np.concatenate([m["ring"], x[tick][None]]), np.concatenate([m["scores"], score])
            m["ring"], m["scores"] = ring[1:], scores[1:]
            out[tick] = np.einsum("st,tsn->sn", run.arithmetic.softmax(scores.T), ring)
        return out

    def products(self, x: Values, y: Values) -> dict[str, Values]:
        return {self.name: x[:, None]}


@dataclass(frozen=True, eq=False, kw_only=True)
class WindowAttention(Layer):
    """The query attends to the keys and values (the three inputs) of the last `window` ticks, each of `heads` heads.

    Weights are a softmax of ``q k / sqrt(size / heads)``. Slots: rings of keys and values, and ticks seen.
    """

    bit_exact = True
    counted = True
    stays_float = True

    size: int
    heads: int
    window: int

    @property
    def width(self) -> int:
        return self.size

    @property
    def slots(self) -> tuple[Slot, ...]:
        ring = (self.window - 1, self.size)
        return Slot("keys", ring), Slot("values", ring), Slot("age", (1,))

    @property
    def macs(self) -> int:
        return 2 * self.window * self.size

    @property
    def scratch(self) -> int:
        return self.window

    def over_time(self, run: LayerRun, q: Values, k: Values, v: Values) -> Values:
        # In the memory order of the ring of the C code, since the order of a sum affects its last bit. Only ticks since
        # the reset take part.
        m, total, out = run.memory, run.arithmetic.total, np.empty_like(q)
        root = np.sqrt(q.dtype.type(self.size // self.heads))
        for tick in range(len(q)):
            at, seen = m.setdefault("at", 0), int(m["age"][0])
            keys = split(np.concatenate([m["keys"][:seen], k[tick][None]]), self.heads)
            values = split(np.concatenate([v[tick][None], m["values"][:seen]]), self.heads)
            scores = total(split(q[tick], self.heads) * keys) / root
            weights = run.arithmetic.softmax(np.moveaxis(scores, 0, -1))
            order = np.moveaxis(np.concatenate([weights[..., -1:], weights[..., :-1]], axis=-1), -1, 0)
            out[tick] = flat(total(order[..., None] * values, axis=0))
            if self.window > 1:
                m["keys"][at], m["values"][at] = k[tick], v[tick]
                m["at"] = (at + 1) % (self.window - 1)
            m["age"] = np.full_like(m["age"], min(seen + 1, self.window - 1))
        return out


@dataclass(frozen=True, eq=False, kw_only=True)
class Feedback(Layer):
    """Value of `Feed` at the previous sample, `size` elements; stored in the slot `last`."""

    bit_exact = True
    stays_float = True

    size: int

    @property
    def width(self) -> int:
        return self.size

    @property
    def slots(self) -> tuple[Slot, ...]:
        return (Slot("last", (self.size,)),)

    def over_time(self, run: LayerRun, *inputs: Values) -> Values:
        return np.asarray(run.memory["last"][None])


@dataclass(frozen=True, eq=False, kw_only=True)
class Feed(Layer):
    """Feedback edge of a plant model: its input is the value of the layer `into`, a `Feedback`, at the next sample.

    It has no value and comes after all readers of that layer.
    """

    stays_float = True
    tick_by_tick = True

    into: str

    @property
    def width(self) -> int:
        return 0

    def over_time(self, run: LayerRun, x: Values) -> Values:
        run.others[self.into]["last"] = x[-1]
        return x[..., :0]


@dataclass(frozen=True, eq=False, kw_only=True)
class PrefixCorrection(Layer):
    """Adds ``W_2 tanh(W_1 [mean ; x] + b_1) + b_2`` to the memory of other layers once, `ticks` samples after a reset.

    The mean is over these samples. The layer has no value and comes after the layers that it corrects.

    Attributes:
        corrects: layers and slots, in the order of the correction's numbers.
    """

    matrices = ("first_weight", "second_weight")
    counted = True
    tick_by_tick = True
    without: ClassVar[Mapping[str, str]] = {
        "integers": "train with the initial state 'zero' or 'learned', or export in float32"
    }

    first_weight: Array
    first_bias: Array
    second_weight: Array
    second_bias: Array
    ticks: int
    corrects: tuple[tuple[str, str], ...]

    @property
    def width(self) -> int:
        return 0

    @property
    def slots(self) -> tuple[Slot, ...]:
        return Slot("total", (self.first_weight.shape[1] // 2,)), Slot("age", (1,))

    @property
    def macs(self) -> int:
        return self.first_weight.size + self.second_weight.size

    @property
    def scratch(self) -> int:
        hidden, seen = self.first_weight.shape
        return int(seen + hidden + len(self.second_bias))

    def over_time(self, run: LayerRun, x: Values) -> Values:
        m, w, ticks = run.memory, run.constants, x.dtype.type(self.ticks)
        if m["age"][0] < self.ticks:
            m["total"], m["age"] = m["total"] + x[0], m["age"] + 1
            if m["age"][0] == self.ticks:
                seen = np.concatenate([m["total"] / ticks, x[0]], axis=-1)
                hidden = run.arithmetic.apply(Function.TANH, _times(w["first_weight"], seen) + w["first_bias"])
                numbers, at = _times(w["second_weight"], hidden) + w["second_bias"], 0
                for name, slot in self.corrects:
                    old = run.others[name][slot]
                    size = old[0].size
                    run.others[name][slot] = old + numbers[:, at : at + size].reshape(old.shape)
                    at += size
        return x[..., :0]


def _parts(x: Values, count: int) -> list[Values]:
    """Divide the last dimension into equal parts."""
    size = x.shape[-1] // count
    return [x[..., at * size : (at + 1) * size] for at in range(count)]


def _times(weight: Values, x: Values) -> Values:
    """Return ``W x`` for each row of `x`, shape (..., in)."""
    return np.asarray(np.matmul(weight, x[..., None])[..., 0])


def _recurrent_products(name: str, x: Values, y: Values) -> dict[str, Values]:
    """Return the inputs of both matrix products of a recurrent layer; see `Layer.products`."""
    before = np.concatenate([np.zeros_like(y[:1]), y[:-1]])
    return {f"{name}/x": x[:, None], f"{name}/h": before[:, None]}
