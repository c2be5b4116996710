"""Layers of a W8A16 network: 8-bit weights, 16-bit values, integers only.

A value is ``q 2^-frac``. A weight is ``q scale`` with a scale for each output; the scale is in the `multiplier` and
`shift` that take an accumulator to its output's format (see `edp.ir.w8a16.arithmetic`), biases are in units of the
accumulator. ``QDense`` is the integer form of `edp.ir.layers.Dense`, and so are the others.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edp.ir.base import Indices, Layer, LayerRun, Number, Slot
from edp.ir.descent import depth_of, find_leaves
from edp.ir.layers import Function, flat, split
from edp.ir.w8a16 import arithmetic as fixed
from edp.ir.w8a16.arithmetic import GATE_FRAC, GATE_LIMIT, LARGEST, UNIT_FRAC, Fixed, round_shift, saturated, scaled

Bytes = NDArray[np.int8]
Halves = NDArray[np.int16]
Words = NDArray[np.int32]
Shifts = NDArray[np.uint8]


@dataclass(frozen=True, eq=False, kw_only=True)
class FixedLayer(Layer):
    """A layer whose value is integers.

    Attributes:
        frac: fractional bits of its value.
    """

    frac: int

    @property
    def kind(self) -> str:
        # Hashes of exported networks are taken over this word, and a state that a controller saved bears the hash.
        return re.sub("^Q(?=[A-Z])", "W", super().kind)

    @property
    def number(self) -> Number:
        return Number.INT16


@dataclass(frozen=True, eq=False, kw_only=True)
class _Sized(FixedLayer):
    """Layer with `size` output elements."""

    size: int

    @property
    def width(self) -> int:
        return self.size


@dataclass(frozen=True, eq=False, kw_only=True)
class _Weighted(FixedLayer):
    """Layer with a matrix, and for each output a bias and the conversion from the sum to the value's format."""

    weight: Bytes
    bias: Words
    multiplier: Words
    shift: Shifts

    @property
    def macs(self) -> int:
        return self.weight.size


@dataclass(frozen=True, eq=False, kw_only=True)
class Quantise(_Sized):
    """Floats to integers, rounded half away from zero; those beyond the range are clipped and counted."""

    def over_time(self, run: LayerRun, x: NDArray[np.float32]) -> Fixed:
        wide = x * np.float32(2.0**self.frac)
        top = np.float32(LARGEST)
        beyond = int((~((wide >= -top) & (wide <= top))).sum())
        run.memory["clipped"] = run.memory.get("clipped", 0) + beyond
        # NaN fails the comparison and takes the lower limit: it is counted as clipped and cannot spread.
        limited = np.where(wide >= -top, np.minimum(wide, top), -top)
        # Half away from zero, as C truncates after adding half with the sign.
        return np.trunc(np.where(limited >= 0, limited + np.float32(0.5), limited - np.float32(0.5))).astype(np.int64)


@dataclass(frozen=True, eq=False, kw_only=True)
class Dequantise(Layer):
    """Integers of `frac` fractional bits to floats, exactly."""

    frac: int
    size: int

    @property
    def width(self) -> int:
        return self.size

    def over_time(self, run: LayerRun, x: Fixed) -> NDArray[np.float32]:
        return np.asarray(x.astype(np.float32) * np.float32(2.0**-self.frac))


@dataclass(frozen=True, eq=False, kw_only=True)
class QGather(FixedLayer):
    """Selected elements of the concatenated inputs; elements of input i are shifted right by `shifts[i]` bits."""

    columns: tuple[int, ...]
    shifts: tuple[int, ...]

    @property
    def width(self) -> int:
        return len(self.columns)

    def over_time(self, run: LayerRun, *parts: Fixed) -> Fixed:
        return np.concatenate(list(map(round_shift, parts, self.shifts)), axis=-1)[..., list(self.columns)]


@dataclass(frozen=True, eq=False, kw_only=True)
class QSum(_Sized):
    """``a + b`` or ``a - b`` of `size` elements, shifted left by `lefts`; the sum is shifted right by `right`."""

    lefts: tuple[int, int]
    right: int
    minus: bool

    def over_time(self, run: LayerRun, a: Fixed, b: Fixed) -> Fixed:
        a, b = a << self.lefts[0], b << self.lefts[1]
        return saturated(round_shift(a - b if self.minus else a + b, self.right))


@dataclass(frozen=True, eq=False, kw_only=True)
class QMultiply(_Sized):
    """``a b`` of `size` elements, shifted right by `right`."""

    right: int

    def over_time(self, run: LayerRun, a: Fixed, b: Fixed) -> Fixed:
        return saturated(round_shift(a * b, self.right))


@dataclass(frozen=True, eq=False, kw_only=True)
class QScaleShift(FixedLayer):
    """``gain x + offset``, shifted right by `right`; `gain` 16-bit, `offset` 32-bit."""

    gain: Halves
    offset: Words
    right: int

    @property
    def width(self) -> int:
        return len(self.gain)

    def over_time(self, run: LayerRun, x: Fixed) -> Fixed:
        return saturated(round_shift(x * self.gain + self.offset, self.right))


@dataclass(frozen=True, eq=False, kw_only=True)
class QActivate(_Sized):
    """A function of each number, which has `input_frac` fractional bits."""

    function: Function
    input_frac: int

    def over_time(self, run: LayerRun, x: Fixed) -> Fixed:
        gate = _to_gate(x, self.input_frac)
        if self.function is Function.RELU:
            return np.maximum(x, 0)
        if self.function is Function.SIGMOID:
            return fixed.sigmoid(gate)
        if self.function is Function.TANH:
            return fixed.tanh(gate, GATE_FRAC)
        if self.function is Function.GELU:
            return saturated(round_shift(x * fixed.normal(gate), 16))
        return saturated(round_shift(fixed.softplus(gate), GATE_FRAC - self.frac))


@dataclass(frozen=True, eq=False, kw_only=True)
class QGlu(FixedLayer):
    """Each row's first half times the sigmoid of its second; the value has the input's format."""

    rows: int
    size: int

    @property
    def width(self) -> int:
        return self.rows * self.size // 2

    def over_time(self, run: LayerRun, x: Fixed) -> Fixed:
        halves = x.reshape(*x.shape[:-1], self.rows, 2, -1)
        gate = fixed.sigmoid(_to_gate(halves[..., 1, :], self.frac))
        return np.asarray(flat(round_shift(halves[..., 0, :] * gate, UNIT_FRAC)))


@dataclass(frozen=True, eq=False, kw_only=True)
class QDense(_Weighted):
    """``W x + b`` on each row; `weight` ``(out, in)``, the others ``(out,)``."""

    rows: int = 1

    @property
    def width(self) -> int:
        return self.rows * len(self.bias)

    @property
    def macs(self) -> int:
        return self.rows * self.weight.size

    def over_time(self, run: LayerRun, x: Fixed) -> Fixed:
        sums = _product(split(x, self.rows), self.weight) + self.bias
        return np.asarray(flat(saturated(scaled(sums, self.multiplier, self.shift))))

    @property
    def scratch(self) -> int:
        return len(self.bias)


@dataclass(frozen=True, eq=False, kw_only=True)
class QGroupedDense(_Weighted):
    """``W_i x_i + b_i``; `weight` ``(rows, out, in)``, the others ``(rows, out)``."""

    @property
    def width(self) -> int:
        return self.bias.size

    def over_time(self, run: LayerRun, x: Fixed) -> Fixed:
        rows = split(x, len(self.bias))
        sums = np.einsum("roi,tbri->tbro", self.weight.astype(np.int64), rows) + self.bias
        return np.asarray(flat(saturated(scaled(sums, self.multiplier, self.shift))))

    @property
    def scratch(self) -> int:
        return int(self.bias.shape[1])


@dataclass(frozen=True, eq=False, kw_only=True)
class QTreeSums(FixedLayer):
    """Sums of trees: `feature` and `threshold` ``(output, tree, node)``, `leaf` ``(output, tree, leaf)``.

    Thresholds have the format of the input, rounded down, so ``q > threshold`` equals the comparison of ``q 2^-frac``
    with the real threshold. The sum of the leaves is shifted right by `right`.
    """

    feature: Indices
    threshold: Halves
    leaf: Halves
    right: int

    @property
    def width(self) -> int:
        return len(self.leaf)

    @property
    def depth(self) -> int:
        """Comparisons from the root to a leaf."""
        return depth_of(self.leaf.shape[2])

    def over_time(self, run: LayerRun, x: Fixed) -> Fixed:
        leaves = find_leaves(self.feature, self.threshold, self.leaf, x)
        return saturated(round_shift(leaves.sum(axis=-1, dtype=np.int64), self.right))


@dataclass(frozen=True, eq=False, kw_only=True)
class QConvolution(_Weighted):
    """Causal convolution; `weight` ``(out, tap, in)``, the last tap is the present. Slot: ring of past inputs."""

    counted = True

    dilation: int = 1

    @property
    def width(self) -> int:
        return len(self.bias)

    @property
    def slots(self) -> tuple[Slot, ...]:
        _, taps, into = self.weight.shape
        shape = ((taps - 1) * self.dilation, into)
        return (Slot("ring", shape, number=Number.INT16),) if taps > 1 else ()

    def over_time(self, run: LayerRun, x: Fixed) -> Fixed:
        m = run.memory
        _, taps, into = self.weight.shape
        history = np.concatenate([m["ring"], x]) if taps > 1 else x
        if taps > 1:
            m["ring"] = history[-len(m["ring"]) :]
        seen = [history[tap * self.dilation :][: len(x)] for tap in range(taps)]
        sums = _product(np.concatenate(seen, axis=-1), self.weight.reshape(-1, taps * into)) + self.bias
        return saturated(scaled(sums, self.multiplier, self.shift))

    @property
    def scratch(self) -> int:
        return len(self.bias)


@dataclass(frozen=True, eq=False, kw_only=True)
class _QRecurrent(FixedLayer):
    """Two matrices into gates of `GATE_FRAC` fractional bits; multipliers and shifts as for `QDense`."""

    weight_x: Bytes
    multiplier_x: Words
    shift_x: Shifts
    weight_h: Bytes
    multiplier_h: Words
    shift_h: Shifts

    @property
    def width(self) -> int:
        return int(self.weight_h.shape[1])

    @property
    def macs(self) -> int:
        return self.weight_x.size + self.weight_h.size


@dataclass(frozen=True, eq=False, kw_only=True)
class QLstm(_QRecurrent):
    """LSTM; `bias` in gates, ``(4 units,)``; `share` in 2^-15, 32768 without zoneout. Slots: h in 2^-15, c in 2^-20."""

    bias: Words
    share: int

    @property
    def slots(self) -> tuple[Slot, ...]:
        shape = (self.width,)
        return Slot("h", shape, number=Number.INT16), Slot("c", shape, number=Number.INT32)

    def over_time(self, run: LayerRun, x: Fixed) -> Fixed:
        m = run.memory
        driven = _gates(x, self.weight_x, self.multiplier_x, self.shift_x) + self.bias
        h, c = m["h"], m["c"]
        out = np.empty((*x.shape[:-1], self.width), dtype=np.int64)
        for tick, ahead in enumerate(driven):
            gates = split(ahead + _gates(h, self.weight_h, self.multiplier_h, self.shift_h), 4)
            i, f, o = np.moveaxis(fixed.sigmoid(gates[..., [0, 1, 3], :]), -2, 0)
            # Both terms in the format of the product, so that one rounding remains.
            product = f * c + ((i * fixed.tanh(gates[..., 2, :], GATE_FRAC)) << (fixed.CELL_FRAC - UNIT_FRAC))
            fresh = saturated(round_shift(product, UNIT_FRAC), fixed.CELL_LIMIT)
            shown = round_shift(o * fixed.tanh(fresh, fixed.CELL_FRAC), UNIT_FRAC)
            c = c + round_shift(self.share * (fresh - c), UNIT_FRAC)
            h = h + round_shift(self.share * (shown - h), UNIT_FRAC)
            out[tick] = h
        m["h"], m["c"] = h, c
        return out

    @property
    def scratch(self) -> int:
        return 8 * self.width


@dataclass(frozen=True, eq=False, kw_only=True)
class QGru(_QRecurrent):
    """GRU; `bias_x`, `bias_h` in gates, ``(3 units,)``. Slot: h in 2^-15."""

    bias_x: Words
    bias_h: Words

    @property
    def slots(self) -> tuple[Slot, ...]:
        return (Slot("h", (self.width,), number=Number.INT16),)

    def over_time(self, run: LayerRun, x: Fixed) -> Fixed:
        m = run.memory
        driven = _gates(x, self.weight_x, self.multiplier_x, self.shift_x) + self.bias_x
        h = m["h"]
        out = np.empty((*x.shape[:-1], self.width), dtype=np.int64)
        for tick, ahead in enumerate(split(driven, 3)):
            back = split(_gates(h, self.weight_h, self.multiplier_h, self.shift_h) + self.bias_h, 3)
            r, z = np.moveaxis(fixed.sigmoid(ahead[..., :2, :] + back[..., :2, :]), -2, 0)
            n = fixed.tanh(ahead[..., 2, :] + round_shift(r * back[..., 2, :], UNIT_FRAC), GATE_FRAC)
            h = n + round_shift(z * (h - n), UNIT_FRAC)
            out[tick] = h
        m["h"] = h
        return out

    @property
    def scratch(self) -> int:
        return 6 * self.width


@dataclass(frozen=True, eq=False, kw_only=True)
class QMinGru(FixedLayer):
    """``h = h + z (c - h)`` of an input ``[z' ; c]``. Slot: h with `EXTRA` more bits than the input."""

    units: int

    # 14 more bits keep the state, and its difference to the input, within 32 bits.
    EXTRA = 14

    @property
    def width(self) -> int:
        return self.units

    @property
    def slots(self) -> tuple[Slot, ...]:
        return (Slot("h", (self.units,), number=Number.INT32),)

    def over_time(self, run: LayerRun, x: Fixed) -> Fixed:
        m = run.memory
        z = fixed.sigmoid(_to_gate(x[..., : self.units], self.frac))
        fresh, h = x[..., self.units :] << self.EXTRA, m["h"]
        out = np.empty_like(fresh)
        for tick in range(len(x)):
            h = h + round_shift(z[tick] * (fresh[tick] - h), UNIT_FRAC)
            out[tick] = h
        m["h"] = h
        return saturated(round_shift(out, self.EXTRA))


@dataclass(frozen=True, eq=False, kw_only=True)
class QRotation(FixedLayer):
    """Complex ``h = factor h + x``; `factor` in 2^-30. Slot: h, `left` more bits than x, `right` more than y."""

    factor: Words
    left: int
    right: int

    @property
    def width(self) -> int:
        return self.factor.size

    @property
    def slots(self) -> tuple[Slot, ...]:
        return (Slot("h", (len(self.factor), 2), number=Number.INT32),)

    def over_time(self, run: LayerRun, x: Fixed) -> Fixed:
        m = run.memory
        a, b = self.factor.astype(np.int64).T
        driven = split(x << self.left, len(a))
        re, im = m["h"][..., 0], m["h"][..., 1]
        out = np.empty_like(driven)
        for tick, add in enumerate(driven):
            turned = round_shift(a * re - b * im, 30), round_shift(a * im + b * re, 30)
            re, im = (saturated(turned[i] + add[..., i], fixed.CELL_LIMIT) for i in (0, 1))
            out[tick, ..., 0], out[tick, ..., 1] = re, im
        m["h"] = np.stack([re, im], axis=-1)
        return saturated(round_shift(out.reshape(x.shape), self.right))


@dataclass(frozen=True, eq=False, kw_only=True)
class QDifference(FixedLayer):
    """``factor (x - before)``, shifted right by `right`. Slots: `before`, and whether there was a tick."""

    counted = True

    factor: Halves
    from_zero: bool
    right: int

    @property
    def width(self) -> int:
        return len(self.factor)

    @property
    def slots(self) -> tuple[Slot, ...]:
        return Slot("before", (self.width,), number=Number.INT16), Slot("age", (1,))

    def over_time(self, run: LayerRun, x: Fixed) -> Fixed:
        m = run.memory
        before = m["before"] if self.from_zero or m["age"][0] > 0 else x[0]
        change = x - np.concatenate([before[None], x[:-1]])
        m["before"], m["age"] = x[-1], np.ones_like(m["age"])
        return saturated(round_shift(self.factor * change, self.right))


@dataclass(frozen=True, eq=False, kw_only=True)
class QTrailingMean(_Sized):
    """Mean of the last `window` inputs. Slots: ring, and ticks seen up to `window`."""

    counted = True

    window: int

    @property
    def slots(self) -> tuple[Slot, ...]:
        return Slot("ring", (self.window - 1, self.size), number=Number.INT16), Slot("age", (1,))

    def over_time(self, run: LayerRun, x: Fixed) -> Fixed:
        m = run.memory
        age = int(m["age"][0])
        history = np.concatenate([m["ring"], x])
        total = np.concatenate([np.zeros_like(history[:1]), history.cumsum(axis=0)])
        sums = total[self.window :] - total[: -self.window]
        count = np.minimum(age + 1 + np.arange(len(x)), self.window)[:, None, None]
        m["ring"], m["age"] = history[len(x) :], np.full_like(m["age"], min(age + len(x), self.window))
        # Division of a negative integer rounds down in NumPy and to zero in C; magnitudes agree in both.
        return np.asarray(np.sign(sums) * ((np.abs(sums) + count // 2) // count))


@dataclass(frozen=True, eq=False, kw_only=True)
class QAttentionPool(FixedLayer):
    """Softmax-weighted mean of the last `window` inputs, without the bias of the scores, which has no effect.

    Slots: rings of inputs and of scores, and ticks seen.
    """

    counted = True

    score: Bytes
    multiplier: Words
    shift: Shifts
    window: int

    @property
    def width(self) -> int:
        return self.score.size

    @property
    def slots(self) -> tuple[Slot, ...]:
        ring = Slot("ring", (self.window - 1, self.width), number=Number.INT16)
        return ring, Slot("scores", (self.window - 1,), number=Number.INT32), Slot("age", (1,))

    @property
    def macs(self) -> int:
        return (self.window + 1) * self.width

    def over_time(self, run: LayerRun, x: Fixed) -> Fixed:
        m = run.memory
        own = _gates(x, self.score[None], self.multiplier, self.shift)[..., 0]
        age, window = int(m["age"][0]), self.window
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

    @property
    def scratch(self) -> int:
        return self.window


def _product(x: Fixed, weight: NDArray[np.int8]) -> Fixed:
    """Return ``x W'`` of integers: double precision holds the sums exactly, and is fast."""
    # Sums of 16 by 8-bit products stay far below 2^53.
    return np.asarray(x.astype(np.float64) @ weight.T.astype(np.float64)).astype(np.int64)


def _gates(x: Fixed, weight: NDArray[np.int8], multiplier: Any, shift: Any) -> Fixed:
    return saturated(scaled(_product(x, weight), multiplier, shift), GATE_LIMIT)


def _to_gate(x: Fixed, frac: int) -> Fixed:
    return saturated(round_shift(x, frac - GATE_FRAC), GATE_LIMIT)
