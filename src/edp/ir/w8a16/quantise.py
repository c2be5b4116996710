"""Conversion of a float layer graph to integer layers, given the range of each value.

What lies between the standardised inputs and the last weights is computed in integer arithmetic; scaling of the
inputs, the way back to SI units and the few kinds with `Layer.stays_float` stay in single precision.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edp.errors import ExportError
from edp.ir import layers, memory
from edp.ir.base import INPUT, Graph, Layer, Number
from edp.ir.layers import BinaryOperation, Function
from edp.ir.w8a16 import arithmetic as fixed
from edp.ir.w8a16 import layers as quantised
from edp.ir.w8a16.balance import balanced
from edp.ir.w8a16.parts import integer_part
from edp.ir.w8a16.rounding import WeightRounding
from edp.ir.w8a16.rows import halves, rows, to_gates

Ranges = Mapping[str, float]
"""Largest magnitude of each value, and of each memory slot as ``layer/slot``."""
ADVICE = "export in float32"
"""Advice in the error message for a layer without an integer form and without its own advice."""


@dataclass(frozen=True)
class Formats:
    """Fractional bits of values, chosen on data.

    Attributes:
        fracs: fractional bits by value of the float graph; slots with their own format are named ``layer/slot``.
        weights: 8-bit weights by matrix; missing matrices are rounded to the nearest.
    """

    fracs: Mapping[str, int]
    weights: Mapping[str, NDArray[np.int8]] = field(default_factory=dict)


# A quarter more than calibration has seen; one more bit would cost half of the resolution.
def formats(ranges: Ranges, margin: float = 1.25) -> Formats:
    """Return the finest format of each value that holds `margin` times its largest magnitude."""
    fracs = {name: fixed.frac_for(margin * size) for name, size in ranges.items() if "/" not in name}
    # The state of a rotation is 32-bit, and half of what it may grow to is kept free.
    wide = {name: fixed.frac_for(2.0 * margin * size, 29) for name, size in ranges.items() if "/" in name}
    return Formats(fracs | wide)


@dataclass
class _Work:
    """A graph in the making."""

    graph: Graph
    fracs: Mapping[str, int]
    rounding: WeightRounding
    integer_fracs: dict[str, int]
    """Number of fractional bits of each value that is already an integer."""
    out: list[Layer]
    slots: dict[tuple[str, str], int]
    """Number of fractional bits of each memory slot."""

    def rows(self, layer: Any, input_frac: int) -> dict[str, Any]:
        """Return the integer weights and biases of a layer."""
        return rows(layer.name, layer.weight, layer.bias, (input_frac, self.frac(layer.name)), self.rounding)

    def gates(self, layer: Any, input_frac: int) -> dict[str, Any]:
        """Return the integer matrices of a recurrent layer."""
        gate_constants: dict[str, object] = {}
        for side, frac in (("x", input_frac), ("h", fixed.UNIT_FRAC)):
            made_of = to_gates(f"{layer.name}/{side}", getattr(layer, f"weight_{side}"), frac, self.rounding)
            gate_constants |= {f"{key}_{side}": values for key, values in made_of.items()}
        return gate_constants

    def convert_to_fixed(self, value: str) -> str:
        """Return the name of a value as integers."""
        if value in self.integer_fracs:
            return value
        name = f"{value}.whole"
        if name not in self.integer_fracs:
            size = self.graph.width_of(value)
            self.out.append(quantised.Quantise(name=name, inputs=(value,), frac=self.frac(value), size=size))
            self.integer_fracs[name] = self.frac(value)
        return name

    def to_float(self, value: str) -> str:
        """Return the name of a value as floats."""
        if value not in self.integer_fracs:
            return value
        name = f"{value}.real"
        if not any(layer.name == name for layer in self.out):
            size, frac = self.graph.width_of(value), self.integer_fracs[value]
            self.out.append(quantised.Dequantise(name=name, inputs=(value,), frac=frac, size=size))
        return name

    def frac(self, value: str) -> int:
        """Return the format chosen for a value."""
        if value not in self.fracs:
            raise ExportError(f"value '{value}' has no format; the formats are those of another network")
        return self.fracs[value]


def quantise(graph: Graph, chosen: Formats, moments: Mapping[str, NDArray[np.floating]] | None = None) -> Graph:
    """Convert the network to W8A16.

    Args:
        graph: the float network.
        chosen: formats of its values, and known weights.
        moments: moments of the inputs of each matrix (see `WeightRounding`), for weights without given values.

    Raises:
        ExportError: a kind of layer that has no integer form, sums that would not fit in 32 bits, or formats of
            another graph.
    """
    if not any(layer.macs for layer in graph.layers):
        raise ExportError(
            "the list of layers has no matrix of weights, and its equations would lose digits in 16 bits; 8-bit "
            "weights save nothing here: export in float32"
        )
    graph = balanced(graph)
    inside = integer_part(graph)
    work = _Work(graph, chosen.fracs, WeightRounding(chosen.weights, moments or {}), {}, [], {})
    for layer in graph.layers:
        kind = type(layer)
        if "integers" in layer.without or (layer.name in inside and kind not in LOWER):
            advice = layer.without.get("integers", ADVICE)
            raise ExportError(
                f"layer '{layer.name}' is a {kind.__name__}, which has no form in integer arithmetic; {advice}"
            )
        if layer.name not in inside:
            if isinstance(layer, layers.Dense):
                raise ExportError(
                    f"layer '{layer.name}' multiplies what a feedback edge hands on; 8-bit weights would move its "
                    "poles, so it has no form in integer arithmetic: export in float32"
                )
            work.out.append(replace(layer, inputs=tuple(work.to_float(name) for name in layer.inputs)))
            continue
        inputs = tuple(work.convert_to_fixed(name) for name in layer.inputs)
        # Inputs are brought into integers first, since a layer's own format depends on theirs.
        done = LOWER[kind](work, layer, [work.integer_fracs[name] for name in inputs])
        work.out.append(replace(done, inputs=inputs))
        work.integer_fracs[layer.name] = done.frac
    results = {meaning: work.to_float(value) for meaning, value in graph.results.items()}
    finished = Graph(graph.inputs, tuple(work.out), results, {}, graph.window)
    return replace(finished, initial=_initial(graph, finished, work))


def outline(graph: Graph) -> Graph:
    """Return the structure of the W8A16 network: every constant has its shape and type, filled with zeros.

    The resources on a controller do not depend on the weights, so neither training nor recordings are needed.

    Raises:
        ExportError: a kind of layer that has no integer form.
    """
    hollow = []
    for layer in graph.layers:
        empty: dict[str, Any] = {name: np.zeros_like(values) for name, values in layer.tensors().items()}
        hollow.append(replace(layer, **empty))
    names = [INPUT, *(layer.name for layer in graph.layers)]
    names += [f"{layer}/{slot.name}" for layer, slot in graph.slots()]
    # Formats of zero bits do for counting: sizes do not depend on numbers.
    return quantise(replace(graph, layers=tuple(hollow)), Formats(dict.fromkeys(names, 0)))


def _initial(graph: Graph, finished: Graph, work: _Work) -> dict[tuple[str, str], Any]:
    """Return the initial values of slots in their formats."""
    numbers = {(name, slot.name): slot.number for name, slot in finished.slots()}
    start: dict[tuple[str, str], Any] = {}
    for key, values in graph.initial.items():
        if numbers[key] is Number.FLOAT:
            start[key] = values
        else:
            small = numbers[key] is Number.INT16
            largest = fixed.LARGEST if small else fixed.CELL_LIMIT
            fixed_values = fixed.to_fixed(values, work.slots[key], largest)
            start[key] = fixed_values.astype(np.int16 if small else np.int32)
    return start


def _limit_format(frac: int, finest: int) -> int:
    """Return a format that a right shift of 0 to 31 bits reaches from `finest`."""
    return min(max(frac, finest - 31), finest)


Lower = Callable[[_Work, Any, list[int]], quantised.FixedLayer]


def _gather(work: _Work, x: layers.Gather, input_fracs: list[int]) -> quantised.FixedLayer:
    # The coarsest format of the inputs: a shift left could overflow, a shift right only loses bits.
    frac = min(input_fracs)
    shifts = tuple(own - frac for own in input_fracs)
    return quantised.QGather(name=x.name, inputs=(), frac=frac, columns=x.columns, shifts=shifts)


def _elementwise(work: _Work, x: layers.Elementwise, input_fracs: list[int]) -> quantised.FixedLayer:
    if x.operation in (BinaryOperation.ADD, BinaryOperation.SUBTRACT):
        return _sum(work, x, input_fracs)
    if x.operation is BinaryOperation.MULTIPLY:
        return _multiply(work, x, input_fracs)
    raise ExportError(f"layer '{x.name}' is a {x.kind}, which has no form in integer arithmetic; export in float32")


def _sum(work: _Work, x: layers.Elementwise, input_fracs: list[int]) -> quantised.FixedLayer:
    """Convert a sum; the finer of two formats is the common one, limited to 32 bits."""
    frac, (a, b) = work.frac(x.name), input_fracs
    # 14 bits of difference: 16-bit values shifted by more would leave 32 bits.
    common = min(max(a, b), min(a, b) + 14)
    lefts, minus = (common - a, common - b), x.operation is BinaryOperation.SUBTRACT
    frac = _limit_format(frac, common)
    return quantised.QSum(name=x.name, inputs=(), frac=frac, size=x.size, lefts=lefts, right=common - frac, minus=minus)


def _multiply(work: _Work, x: layers.Elementwise, input_fracs: list[int]) -> quantised.FixedLayer:
    frac = _limit_format(work.frac(x.name), sum(input_fracs))
    return quantised.QMultiply(name=x.name, inputs=(), frac=frac, size=x.size, right=sum(input_fracs) - frac)


def _scale_shift(work: _Work, x: layers.ScaleShift, input_fracs: list[int]) -> quantised.FixedLayer:
    # The offset is in the format of the product, 32-bit.
    # Product and offset share the accumulator; 30 bits leave one for their sum.
    most = fixed.frac_for(float(np.abs(x.shift).max()), 30) - input_fracs[0]
    gain, bits = halves(x.gain, most)
    frac = _limit_format(work.frac(x.name), input_fracs[0] + bits)
    offset = fixed.to_fixed(x.shift, input_fracs[0] + bits, 2**30 - 1).astype(np.int32)
    right = input_fracs[0] + bits - frac
    return quantised.QScaleShift(name=x.name, inputs=(), frac=frac, gain=gain, offset=offset, right=right)


def _activate(work: _Work, x: layers.Activate, input_fracs: list[int]) -> quantised.FixedLayer:
    frac = input_fracs[0]
    # Results of tanh and sigmoid lie between -1 and 1: their format needs no calibration.
    if x.function in (Function.SIGMOID, Function.TANH):
        frac = fixed.UNIT_FRAC
    elif x.function is Function.SOFTPLUS:
        # Finer than its table of 2^-16 a softplus cannot be.
        frac = min(work.frac(x.name), fixed.GATE_FRAC)
    return quantised.QActivate(
        name=x.name, inputs=(), frac=frac, function=x.function, size=x.size, input_frac=input_fracs[0]
    )


def _glu(work: _Work, x: layers.Glu, input_fracs: list[int]) -> quantised.FixedLayer:
    return quantised.QGlu(name=x.name, inputs=(), frac=input_fracs[0], rows=x.rows, size=x.size)


def _dense(work: _Work, x: layers.Dense, input_fracs: list[int]) -> quantised.FixedLayer:
    return quantised.QDense(name=x.name, inputs=(), frac=work.frac(x.name), rows=x.rows, **work.rows(x, input_fracs[0]))


def _quantise_grouped(work: _Work, x: layers.GroupedDense, input_fracs: list[int]) -> quantised.FixedLayer:
    return quantised.QGroupedDense(name=x.name, inputs=(), frac=work.frac(x.name), **work.rows(x, input_fracs[0]))


def _trees(work: _Work, x: layers.TreeSums, input_fracs: list[int]) -> quantised.FixedLayer:
    # In double precision: times a power of two, thresholds that are never exceeded leave single precision. Values lie
    # from -32767 to 32767, so that the ends of 16 bits are exceeded always and never.
    floor = np.floor(np.ldexp(x.threshold.astype(np.float64), input_fracs[0]))
    threshold = np.clip(floor, -(2**15), 2**15 - 1).astype(np.int16)
    leaf, bits = halves(x.leaf)
    frac = _limit_format(work.frac(x.name), bits)
    return quantised.QTreeSums(
        name=x.name,
        inputs=(),
        frac=frac,
        right=bits - frac,
        feature=x.feature,
        threshold=threshold,
        leaf=leaf,
    )


def _convolution(work: _Work, x: memory.Convolution, input_fracs: list[int]) -> quantised.FixedLayer:
    frac = work.frac(x.name)
    work.slots[x.name, "ring"] = input_fracs[0]
    return quantised.QConvolution(
        name=x.name, inputs=(), frac=frac, dilation=x.dilation, **work.rows(x, input_fracs[0])
    )


def _lstm(work: _Work, x: memory.Lstm, input_fracs: list[int]) -> quantised.FixedLayer:
    work.slots |= {(x.name, "h"): fixed.UNIT_FRAC, (x.name, "c"): fixed.CELL_FRAC}
    # A share of 1 is 32768, which fits since it is held in 32 bits.
    share = round(x.share * 2**fixed.UNIT_FRAC)
    bias = fixed.to_fixed(x.bias, fixed.GATE_FRAC, fixed.GATE_LIMIT).astype(np.int32)
    matrices = work.gates(x, input_fracs[0])
    return quantised.QLstm(name=x.name, inputs=(), frac=fixed.UNIT_FRAC, bias=bias, share=share, **matrices)


def _gru(work: _Work, x: memory.Gru, input_fracs: list[int]) -> quantised.FixedLayer:
    work.slots[x.name, "h"] = fixed.UNIT_FRAC
    bias_x, bias_h = (
        fixed.to_fixed(values, fixed.GATE_FRAC, fixed.GATE_LIMIT).astype(np.int32) for values in (x.bias_x, x.bias_h)
    )
    matrices = work.gates(x, input_fracs[0])
    return quantised.QGru(name=x.name, inputs=(), frac=fixed.UNIT_FRAC, bias_x=bias_x, bias_h=bias_h, **matrices)


def _min_gru(work: _Work, x: memory.MinGru, input_fracs: list[int]) -> quantised.FixedLayer:
    work.slots[x.name, "h"] = input_fracs[0] + quantised.QMinGru.EXTRA
    return quantised.QMinGru(name=x.name, inputs=(), frac=input_fracs[0], units=x.units)


def _rotation(work: _Work, x: memory.Rotation, input_fracs: list[int]) -> quantised.FixedLayer:
    # The state must not be coarser than its input, which is shifted left to it.
    state_frac = max(work.frac(f"{x.name}/h"), input_fracs[0])
    frac = _limit_format(work.frac(x.name), state_frac)
    work.slots[x.name, "h"] = state_frac
    factor = fixed.to_fixed(x.factor, 30, 2**30).astype(np.int32)
    return quantised.QRotation(
        name=x.name, inputs=(), frac=frac, factor=factor, left=state_frac - input_fracs[0], right=state_frac - frac
    )


def _difference(work: _Work, x: memory.Difference, input_fracs: list[int]) -> quantised.FixedLayer:
    factor, bits = halves(x.factor)
    frac = _limit_format(work.frac(x.name), input_fracs[0] + bits)
    work.slots[x.name, "before"] = input_fracs[0]
    right = input_fracs[0] + bits - frac
    return quantised.QDifference(name=x.name, inputs=(), frac=frac, factor=factor, from_zero=x.from_zero, right=right)


def _mean(work: _Work, x: memory.TrailingMean, input_fracs: list[int]) -> quantised.FixedLayer:
    work.slots[x.name, "ring"] = input_fracs[0]
    return quantised.QTrailingMean(name=x.name, inputs=(), frac=input_fracs[0], size=x.size, window=x.window)


def _pool(work: _Work, x: memory.AttentionPool, input_fracs: list[int]) -> quantised.FixedLayer:
    work.slots |= {(x.name, "ring"): input_fracs[0], (x.name, "scores"): fixed.GATE_FRAC}
    numbers = to_gates(x.name, x.score[None], input_fracs[0], work.rounding)
    return quantised.QAttentionPool(
        name=x.name,
        inputs=(),
        frac=input_fracs[0],
        window=x.window,
        score=numbers["weight"][0],
        multiplier=numbers["multiplier"],
        shift=numbers["shift"],
    )


def weights_of(graph: Graph) -> dict[str, NDArray[np.int8]]:
    """Return 8-bit weights of an integer graph, by matrix."""
    weights: dict[str, NDArray[np.int8]] = {}
    for layer, name, values in graph.tensors():
        if values.dtype == np.int8:
            weights[layer + ("/" + name[-1] if name in ("weight_x", "weight_h") else "")] = values
    return weights


LOWER: dict[type[Layer], Lower] = {
    layers.Gather: _gather,
    layers.Elementwise: _elementwise,
    layers.ScaleShift: _scale_shift,
    layers.Activate: _activate,
    layers.Glu: _glu,
    layers.Dense: _dense,
    layers.GroupedDense: _quantise_grouped,
    layers.TreeSums: _trees,
    memory.Convolution: _convolution,
    memory.Lstm: _lstm,
    memory.Gru: _gru,
    memory.MinGru: _min_gru,
    memory.Rotation: _rotation,
    memory.Difference: _difference,
    memory.TrailingMean: _mean,
    memory.AttentionPool: _pool,
}
"""Functions that convert a layer to integer arithmetic, by kind of layer."""
