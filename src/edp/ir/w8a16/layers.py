"""Layers of a W8A16 network: 8-bit weights, 16-bit values, integers only.

A value is ``q 2^-frac``. A weight is ``q scale`` with a scale for each output; the scale is in the `multiplier` and
`shift` that take an accumulator to its output's format (see `edp.ir.w8a16.arithmetic`), biases are in units of the
accumulator. ``QDense`` is the integer form of `edp.ir.layers.Dense`, and so are the others.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edp.ir.base import Indices, Layer, Number, Slot
from edp.ir.layers import Function, depth_of

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


@dataclass(frozen=True, eq=False, kw_only=True)
class Dequantise(Layer):
    """Integers of `frac` fractional bits to floats, exactly."""

    frac: int
    size: int

    @property
    def width(self) -> int:
        return self.size


@dataclass(frozen=True, eq=False, kw_only=True)
class QGather(FixedLayer):
    """Selected elements of the concatenated inputs; elements of input i are shifted right by `shifts[i]` bits."""

    columns: tuple[int, ...]
    shifts: tuple[int, ...]

    @property
    def width(self) -> int:
        return len(self.columns)


@dataclass(frozen=True, eq=False, kw_only=True)
class QSum(_Sized):
    """``a + b`` or ``a - b`` of `size` elements, shifted left by `lefts`; the sum is shifted right by `right`."""

    lefts: tuple[int, int]
    right: int
    minus: bool


@dataclass(frozen=True, eq=False, kw_only=True)
class QMultiply(_Sized):
    """``a b`` of `size` elements, shifted right by `right`."""

    right: int


@dataclass(frozen=True, eq=False, kw_only=True)
class QScaleShift(FixedLayer):
    """``gain x + offset``, shifted right by `right`; `gain` 16-bit, `offset` 32-bit."""

    gain: Halves
    offset: Words
    right: int

    @property
    def width(self) -> int:
        return len(self.gain)


@dataclass(frozen=True, eq=False, kw_only=True)
class QActivate(_Sized):
    """A function of each number, which has `input_frac` fractional bits."""

    function: Function
    input_frac: int


@dataclass(frozen=True, eq=False, kw_only=True)
class QGlu(FixedLayer):
    """Each row's first half times the sigmoid of its second; the value has the input's format."""

    rows: int
    size: int

    @property
    def width(self) -> int:
        return self.rows * self.size // 2


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


@dataclass(frozen=True, eq=False, kw_only=True)
class QGroupedDense(_Weighted):
    """``W_i x_i + b_i``; `weight` ``(rows, out, in)``, the others ``(rows, out)``."""

    @property
    def width(self) -> int:
        return self.bias.size


@dataclass(frozen=True, eq=False, kw_only=True)
class QTreeSums(FixedLayer):
    """Sums of trees: `feature` and `threshold` ``(output, tree, node)``, `leaf` ``(output, tree, leaf)``.

    Thresholds have the format of the input, rounded down: ``q > threshold`` is what ``q 2^-frac`` says of the real one.
    The sum of the leaves is shifted right by `right`.
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


@dataclass(frozen=True, eq=False, kw_only=True)
class QConvolution(_Weighted):
    """Causal convolution; `weight` ``(out, tap, in)``, the last tap is the present. Slot: ring of past inputs."""

    dilation: int = 1

    @property
    def width(self) -> int:
        return len(self.bias)

    @property
    def slots(self) -> tuple[Slot, ...]:
        _, taps, into = self.weight.shape
        shape = ((taps - 1) * self.dilation, into)
        return (Slot("ring", shape, number=Number.INT16),) if taps > 1 else ()


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


@dataclass(frozen=True, eq=False, kw_only=True)
class QGru(_QRecurrent):
    """GRU; `bias_x`, `bias_h` in gates, ``(3 units,)``. Slot: h in 2^-15."""

    bias_x: Words
    bias_h: Words

    @property
    def slots(self) -> tuple[Slot, ...]:
        return (Slot("h", (self.width,), number=Number.INT16),)


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


@dataclass(frozen=True, eq=False, kw_only=True)
class QDifference(FixedLayer):
    """``factor (x - before)``, shifted right by `right`. Slots: `before`, and whether there was a tick."""

    factor: Halves
    from_zero: bool
    right: int

    @property
    def width(self) -> int:
        return len(self.factor)

    @property
    def slots(self) -> tuple[Slot, ...]:
        return Slot("before", (self.width,), number=Number.INT16), Slot("age", (1,))


@dataclass(frozen=True, eq=False, kw_only=True)
class QTrailingMean(_Sized):
    """Mean of the last `window` inputs. Slots: ring, and ticks seen up to `window`."""

    window: int

    @property
    def slots(self) -> tuple[Slot, ...]:
        return Slot("ring", (self.window - 1, self.size), number=Number.INT16), Slot("age", (1,))


@dataclass(frozen=True, eq=False, kw_only=True)
class QAttentionPool(FixedLayer):
    """Softmax-weighted mean of the last `window` inputs, without the bias of the scores, which has no effect.

    Slots: rings of inputs and of scores, and ticks seen.
    """

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
