"""The C calls of each kind of layer."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from edp.errors import ExportError
from edp.export.c.plan import MemoryPlan, scratch_number
from edp.export.c.text import bool_literal, call, identifier, number, struct, unsigned_literals
from edp.export.escape import Code, c_comment
from edp.ir import Graph, Layer, layers, memory
from edp.ir.base import INPUT, Number
from edp.ir.hydraulics import HydraulicTick
from edp.ir.layers import runs as neighbours
from edp.ir.w8a16.layers import QGather

WORK = {Number.FLOAT: "work", Number.INT16: "work16", Number.INT32: "work32"}
"""Names of the work memories by number format."""
MAX_COPIES = 8
"""Maximum number of contiguous column ranges for which copies are written. For more ranges a column table is used."""


class Calls:
    """Writes the calls of a graph's layers.

    Args:
        graph: the layers.
        plan: positions of the values in memory.
    """

    def __init__(self, graph: Graph, plan: MemoryPlan) -> None:
        self.graph, self.plan = graph, plan

    def value(self, name: str, offset: int = 0) -> str:
        """Return a C expression for the location of a value."""
        if name == INPUT:
            base, at = "in", offset
        else:
            base, at = WORK[self.graph.layer(name).number], self.plan.values[name] + offset
        return f"{base} + {at}" if at else base

    def scratch(self, layer: Layer, offset: int = 0) -> str:
        """Return a C expression for the location of a layer's scratch memory."""
        base, at = WORK[scratch_number(layer)], self.plan.scratch[layer.name] + offset
        return f"{base} + {at}" if at else base

    def translate(self, layer: Layer) -> list[str]:
        """Return the statements that compute a layer.

        Raises:
            ExportError: this kind of layer has no C function.
        """
        write = CALLS.get(type(layer))
        if write is None:
            raise ExportError(
                f"layer '{layer.name}' is a {type(layer).__name__}, which has no C function; "
                f"these have: {', '.join(kind.__name__ for kind in CALLS)}"
            )
        return write(self, layer)

    def simple(self, layer: Layer, function: str, *sizes: object) -> list[str]:
        """Return ``function(inputs, constants, sizes, y)``: the order of arguments of most functions."""
        constants = [constant(layer, name) for name in layer.tensors()]
        inputs = [self.value(name) for name in layer.inputs]
        return [call(function, *inputs, *constants, *sizes, self.value(layer.name))]


Write = Callable[[Calls, Any], list[str]]


def constant(layer: Layer, name: str) -> str:
    """Return the C array of a layer's constant."""
    return f"{identifier(layer.name)}_{name}"


def slot(layer: Layer | str, name: str) -> str:
    """Return the C array of a layer's state."""
    return f"s->{identifier(layer if isinstance(layer, str) else layer.name)}_{name}"


def ring(layer: Layer) -> str:
    """Return the address of a layer's ring or counter."""
    return f"&s->{identifier(layer.name)}_ring_at"


def runs(calls: Calls, layer: layers.Gather | QGather) -> list[tuple[str, int, int]]:
    """Return runs of neighbouring columns: source value, first column in it, number of columns."""
    widths = [calls.graph.width_of(name) for name in layer.inputs]
    return [(layer.inputs[which], first, length) for which, first, length in neighbours(layer.columns, widths)]


def needs_columns(calls: Calls, layer: Layer) -> bool:
    """Return whether a layer's columns are written as a table."""
    if not isinstance(layer, layers.Gather | QGather):
        return False
    # Columns of several inputs have no common address, so a table cannot reach them.
    return len(layer.inputs) == 1 and len(runs(calls, layer)) > MAX_COPIES


def _gather(calls: Calls, layer: layers.Gather) -> list[str]:
    if needs_columns(calls, layer):
        source, columns = calls.value(layer.inputs[0]), constant(layer, "columns")
        return [call("edp_gather", source, columns, layer.width, calls.value(layer.name))]
    lines, at = [], 0
    for name, first, length in runs(calls, layer):
        lines.append(call("edp_copy", calls.value(name, first), length, calls.value(layer.name, at)))
        at += length
    return lines


def _difference(calls: Calls, layer: memory.Difference) -> list[str]:
    states = (slot(layer, "before"), ring(layer))
    return calls.simple(layer, "edp_difference", layer.width, bool_literal(layer.from_zero), *states)


def _convolution(calls: Calls, layer: memory.Convolution) -> list[str]:
    out, taps, into = layer.weight.shape
    # A kernel of one tap is a dense layer, and needs neither ring nor counter.
    if taps == 1:
        return calls.simple(layer, "edp_dense", 1, out, into)
    sizes = (out, taps, into, layer.dilation)
    return calls.simple(layer, "edp_convolution", *sizes, slot(layer, "ring"), ring(layer))


def _lstm(calls: Calls, layer: memory.Lstm | memory.LayerNormLstm) -> list[str]:
    name = identifier(layer.name)
    normed = isinstance(layer, memory.LayerNormLstm)
    into, units = layer.weight_x.shape[1], layer.width
    states = (slot(layer, "h"), slot(layer, "c"), calls.scratch(layer), calls.value(layer.name))
    weights = (f"&{name}_weights", f"&{name}_norms") if normed else (f"&{name}_weights",)
    function = "edp_layer_norm_lstm" if normed else "edp_lstm"
    return [call(function, calls.value(layer.inputs[0]), *weights, into, units, *states)]


def _gru(calls: Calls, layer: memory.Gru) -> list[str]:
    source, into = calls.value(layer.inputs[0]), layer.weight_x.shape[1]
    rest = (slot(layer, "h"), calls.scratch(layer), calls.value(layer.name))
    return [call("edp_gru", source, f"&{identifier(layer.name)}_weights", into, layer.width, *rest)]


def _pool(calls: Calls, layer: memory.AttentionPool) -> list[str]:
    score, bias = constant(layer, "score"), f"{constant(layer, 'bias')}[0]"
    state = (slot(layer, "ring"), slot(layer, "scores"), ring(layer), calls.scratch(layer))
    sizes = (layer.width, layer.window)
    source = calls.value(layer.inputs[0])
    return [call("edp_attention_pool", source, score, bias, *sizes, *state, calls.value(layer.name))]


def _window(calls: Calls, layer: memory.WindowAttention) -> list[str]:
    state = (slot(layer, "keys"), slot(layer, "values"), ring(layer), calls.scratch(layer))
    return calls.simple(layer, "edp_window_attention", layer.size, layer.heads, layer.window, *state)


def _prefix(calls: Calls, layer: memory.PrefixCorrection) -> list[str]:
    hidden, seen = layer.first_weight.shape
    correction = calls.scratch(layer, seen + hidden)
    state = (slot(layer, "total"), ring(layer), calls.scratch(layer), correction)
    weights = f"&{identifier(layer.name)}_weights"
    asked = call("edp_prefix", calls.value(layer.inputs[0]), weights, seen // 2, *state).removesuffix(";")
    sizes = {(name, part.name): part.size for name, part in calls.graph.slots()}
    lines, at = [f"if ({asked}) {{"], seen + hidden
    for name, part in layer.corrects:
        old = slot(name, part)
        lines.append("    " + call("edp_add", old, calls.scratch(layer, at), sizes[name, part], old))
        at += sizes[name, part]
    return [*lines, "}"]


def _norm(calls: Calls, layer: layers.LayerNorm) -> list[str]:
    return calls.simple(layer, "edp_layer_norm", number(layer.epsilon), layer.rows, len(layer.gain))


def _dense(calls: Calls, layer: layers.Dense) -> list[str]:
    return calls.simple(layer, "edp_dense", layer.rows, *layer.weight.shape)


def _mean(calls: Calls, layer: memory.TrailingMean) -> list[str]:
    return calls.simple(layer, "edp_trailing_mean", layer.size, layer.window, slot(layer, "ring"), ring(layer))


def _clip(calls: Calls, layer: layers.Clip) -> list[str]:
    y, low, high = calls.value(layer.name), constant(layer, "low"), constant(layer, "high")
    upper = call("edp_minimum", calls.value(layer.inputs[0]), high, layer.width, y)
    return [upper, call("edp_maximum", y, low, layer.width, y)]


def _feed(calls: Calls, layer: memory.Feed) -> list[str]:
    source = layer.inputs[0]
    return [call("edp_copy", calls.value(source), calls.graph.width_of(source), slot(layer.into, "last"))]


def _hydraulics(calls: Calls, layer: HydraulicTick) -> list[str]:
    commands, fed = (calls.value(name) for name in layer.inputs)
    past = ", ".join(slot(layer, part.name) for part in layer.slots)
    machine = f"&{identifier(layer.name)}_machine"
    tick = call("edp_hydraulic_tick", commands, fed, machine, "&past", "room", calls.value(layer.name))
    # Stiff equations need double precision; their room is on the stack, as nothing in it is kept.
    return [
        "{",
        f"    double room[{layer.room}];",
        f"    const edp_hydraulic_state past = {{{past}}};",
        f"    {tick}",
        "}",
    ]


CALLS: dict[type[Layer], Write] = {
    layers.Gather: _gather,
    layers.Standardise: lambda c, x: c.simple(x, "edp_standardise", x.width),
    layers.ScaleShift: lambda c, x: c.simple(x, "edp_scale_shift", x.width),
    layers.Clip: _clip,
    layers.Elementwise: lambda c, x: c.simple(x, f"edp_{x.operation}", x.size),
    layers.Activate: lambda c, x: c.simple(x, f"edp_map_{x.function}", x.size),
    layers.Glu: lambda c, x: c.simple(x, "edp_glu", x.rows, x.size // 2),
    layers.Accumulate: lambda c, x: c.simple(x, "edp_accumulate", x.rows, x.size),
    layers.Dense: _dense,
    layers.GroupedDense: lambda c, x: c.simple(x, "edp_grouped_dense", *x.weight.shape),
    layers.TreeSums: lambda c, x: c.simple(x, "edp_trees", *x.leaf.shape[:2], x.depth),
    layers.LayerNorm: _norm,
    layers.RowAttention: lambda c, x: c.simple(x, "edp_row_attention", x.rows, x.size, c.scratch(x)),
    HydraulicTick: _hydraulics,
    memory.Difference: _difference,
    # The correction is added behind a condition, since the runtime says when the prefix has ended.
    memory.Starting: lambda c, x: c.simple(x, "edp_starting", len(x.mean), x.ticks, ring(x)),
    memory.Convolution: _convolution,
    memory.Lstm: _lstm,
    memory.LayerNormLstm: _lstm,
    memory.Gru: _gru,
    memory.MinGru: lambda c, x: c.simple(x, "edp_min_gru", x.units, slot(x, "h")),
    memory.Rotation: lambda c, x: c.simple(x, "edp_rotation", len(x.factor), slot(x, "h")),
    memory.TrailingMean: _mean,
    memory.AttentionPool: _pool,
    memory.WindowAttention: _window,
    memory.Feedback: lambda c, x: [call("edp_copy", slot(x, "last"), x.size, c.value(x.name))],
    memory.Feed: _feed,
    memory.PrefixCorrection: _prefix,
}
"""Writer functions by layer class."""


def structs(layer: Layer) -> list[Code]:
    """Return the constant structs that a layer's function reads, one a line."""
    name = identifier(layer.name)
    at = {key: constant(layer, key) for key in layer.tensors()}
    if isinstance(layer, memory.Lstm | memory.LayerNormLstm):
        members = [at[key] for key in ("weight_x", "weight_h", "bias")]
        declarations = [struct("edp_lstm_weights", f"{name}_weights", [*members, number(layer.share)])]
        if isinstance(layer, memory.LayerNormLstm):
            norms = [at[key] for key in ("gain_x", "gain_h", "gain_c", "shift_c")]
            declarations.append(struct("edp_lstm_norms", f"{name}_norms", [*norms, number(layer.epsilon)]))
        return declarations
    if isinstance(layer, memory.Gru):
        members = [at[key] for key in ("weight_x", "weight_h", "bias_x", "bias_h")]
        return [struct("edp_gru_weights", f"{name}_weights", members)]
    if isinstance(layer, memory.PrefixCorrection):
        members = [at[key] for key in ("first_weight", "first_bias", "second_weight", "second_bias")]
        sizes = unsigned_literals((len(layer.first_bias), len(layer.second_bias), layer.ticks))
        return [struct("edp_prefix_weights", f"{name}_weights", [*members, *sizes])]
    if isinstance(layer, HydraulicTick):
        counts = (
            *(*layer.sizes, len(layer.ports), len(layer.knots), len(layer.exponents), layer.powers),
            *(layer.remembered, layer.steps, *layer.load, layer.circuit, int(layer.linked)),
        )
        members = [*at.values(), *unsigned_literals(counts), number(layer.tick_s)]
        return [struct("edp_hydraulics", f"{name}_machine", members)]
    return []


def describe(layer: Layer) -> str:
    """Return a comment that describes a layer: name, kind and shapes."""
    shapes = [f"{name} {' x '.join(map(str, values.shape))}" for name, values in layer.tensors().items()]
    size = f"{layer.width} numbers" if layer.width else "no value"
    return f"/* {c_comment(layer.name)}: {layer.kind}, {'; '.join([size, *shapes])} */"
