"""Layers with state: differences, convolutions, recurrences, trailing windows.

In the equations `before` is what the layer had at the tick before.
"""

from __future__ import annotations

from dataclasses import dataclass

from edp.ir.base import Array, Layer, Slot

# Finite on purpose: minus infinity would give NaN where all scores of a row are hidden.
UNSEEN = -1e30
"""Score of a tick before the reset: no softmax notices it."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Difference(Layer):
    """``factor (x - before)``, `factor` ``(width,)``.

    At the first tick after a reset `before` is 0 where `from_zero` holds, else x, which gives 0. Slots: `before`, and
    `age`, 0 until there was a tick.
    """

    factor: Array
    from_zero: bool

    @property
    def width(self) -> int:
        return len(self.factor)

    @property
    def slots(self) -> tuple[Slot, ...]:
        return Slot("before", (self.width,)), Slot("age", (1,))


@dataclass(frozen=True, eq=False, kw_only=True)
class Starting(Layer):
    """``[x ; 1]`` in the first `ticks` samples after a reset, ``[mean ; 0]`` afterwards.

    Slot: sample count up to `ticks`.
    """

    mean: Array
    ticks: int

    @property
    def width(self) -> int:
        return len(self.mean) + 1

    @property
    def slots(self) -> tuple[Slot, ...]:
        return (Slot("age", (1,)),)


@dataclass(frozen=True, eq=False, kw_only=True)
class Convolution(Layer):
    """``b + sum_k W[:, k] x[t - (taps - 1 - k) dilation]``; the last tap is the present.

    `weight` ``(out, tap, in)``, `bias` ``(out,)``. Slot: the last ``(taps - 1) dilation`` inputs.
    """

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


@dataclass(frozen=True, eq=False, kw_only=True)
class _Gated(Layer):
    """Common part of both kinds of LSTM, which are distinguished by their class."""

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


@dataclass(frozen=True, eq=False, kw_only=True)
class Lstm(_Gated):
    """LSTM, gates in the order i, f, g, o: ``c~ = f c + i g``, ``h~ = o tanh(c~)``.

    ``h = h_before + share (h~ - h_before)`` and c likewise; `share` is 1 without zoneout. `weight_x` ``(4 units, in)``,
    `weight_h` ``(4 units, units)``, `bias` ``(4 units,)``.
    """


@dataclass(frozen=True, eq=False, kw_only=True)
class LayerNormLstm(_Gated):
    """LSTM whose gates see ``norm(W x) gain_x + norm(U h) gain_h + bias`` and whose output has ``tanh`` of a norm of c.

    Each norm is over all its numbers, ``h~ = o tanh(norm(c~) gain_c + shift_c)``; otherwise as `Lstm`.
    """

    gain_x: Array
    gain_h: Array
    gain_c: Array
    shift_c: Array
    epsilon: float


@dataclass(frozen=True, eq=False, kw_only=True)
class Gru(Layer):
    """GRU, gates in the order r, z, n: ``n = tanh(W x + b + r (U h + b'))``, ``h = n + z (h_before - n)``."""

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


@dataclass(frozen=True, eq=False, kw_only=True)
class TrailingMean(Layer):
    """Mean of the last `window` inputs, or of all inputs so far. Slots: ring, and sample count up to `window`."""

    size: int
    window: int

    @property
    def width(self) -> int:
        return self.size

    @property
    def slots(self) -> tuple[Slot, ...]:
        return Slot("ring", (self.window - 1, self.size)), Slot("age", (1,))


@dataclass(frozen=True, eq=False, kw_only=True)
class AttentionPool(Layer):
    """Softmax-weighted mean of the last `window` inputs, with scores ``score x + bias``. Slots: rings of both."""

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


@dataclass(frozen=True, eq=False, kw_only=True)
class WindowAttention(Layer):
    """The query attends to the keys and values (the three inputs) of the last `window` ticks, each of `heads` heads.

    Weights are a softmax of ``q k / sqrt(size / heads)``. Slots: rings of keys and values, and ticks seen.
    """

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


@dataclass(frozen=True, eq=False, kw_only=True)
class Feedback(Layer):
    """Value of `Feed` at the previous sample, `size` elements; stored in the slot `last`."""

    size: int

    @property
    def width(self) -> int:
        return self.size

    @property
    def slots(self) -> tuple[Slot, ...]:
        return (Slot("last", (self.size,)),)


@dataclass(frozen=True, eq=False, kw_only=True)
class Feed(Layer):
    """Feedback edge of a plant model: its input is the value of the layer `into`, a `Feedback`, at the next sample.

    It gives no value and comes after all readers of that layer.
    """

    into: str

    @property
    def width(self) -> int:
        return 0


@dataclass(frozen=True, eq=False, kw_only=True)
class PrefixCorrection(Layer):
    """Adds ``W_2 tanh(W_1 [mean ; x] + b_1) + b_2`` to what other layers remember, once, `ticks` ticks after a reset.

    The mean is over these ticks. It gives no value and comes after the layers that it corrects.

    Attributes:
        corrects: layers and slots, in the order of the correction's numbers.
    """

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
