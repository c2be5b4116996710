"""The C calls that bring the tangent of each kind of layer on: before and after the call of the layer itself."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from edp.errors import ExportError
from edp.export.c.calls import Calls, constant, needs_columns, ring, runs, slot
from edp.export.c.plan import MemoryPlan
from edp.export.c.text import call, identifier, number
from edp.ir import Graph, Layer, layers, memory
from edp.ir.base import INPUT
from edp.ir.layers import BinaryOperation

FILES = ("edp_tangent.h", "edp_tangent.c", "edp_tangent_memory.c")
"""Runtime files for derivatives."""


class Tangents:
    """Writes the calls of a graph's layers with their tangents.

    Args:
        graph: the layers.
        plan: positions of the values in memory.
        changes: positions of the tangents in memory.
    """

    def __init__(self, graph: Graph, plan: MemoryPlan, changes: MemoryPlan) -> None:
        self.graph, self.calls, self.plan = graph, Calls(graph, plan), changes

    def change(self, name: str, offset: int = 0) -> str:
        """Return the location of the change of a value."""
        if name == INPUT:
            return f"t->last + {offset}" if offset else "t->last"
        return f"t->work + {self.plan.values[name] + offset}"

    def scratch(self, layer: Layer, offset: int = 0) -> str:
        """Return the location of a tangent's scratch memory."""
        return f"t->work + {self.plan.scratch[layer.name] + offset}"

    def translate(self, layer: Layer) -> list[str]:
        """Return the statements that compute a layer and propagate its tangent.

        Raises:
            ExportError: this kind of layer has no tangent.
        """
        write = TANGENTS.get(type(layer))
        if write is None:
            raise ExportError(
                f"layer '{layer.name}' is a {type(layer).__name__}, which has no tangent in C; "
                f"these have: {', '.join(kind.__name__ for kind in TANGENTS)}"
            )
        return write(self, layer)

    def changes(self, layer: Layer) -> list[str]:
        """Return the locations of the changes of a layer's inputs."""
        return [self.change(name) for name in layer.inputs]

    def values(self, layer: Layer) -> list[str]:
        """Return the locations of a layer's inputs."""
        return [self.calls.value(name) for name in layer.inputs]

    def before(self, layer: Layer, function: str, *arguments: object) -> list[str]:
        """Return a tangent call followed by the layer.

        The directions and the change of its value are the last arguments.
        """
        # Tangents come first: they read states that the layer itself brings on.
        return [call(function, *arguments, "d", self.change(layer.name)), *self.calls.translate(layer)]


Write = Callable[[Tangents, Any], list[str]]


def changed(layer: Layer | str, name: str) -> str:
    """Return the C array of the change of a layer's state."""
    return slot(layer, name).replace("s->", "t->")


def _pointers(places: list[str]) -> str:
    return f"(const float *const[]){{{', '.join(places)}}}"


def _linear(function: str, *constants: str) -> Write:
    """Return the writer for a layer whose result depends linearly on its inputs only."""

    def write(t: Tangents, layer: Layer) -> list[str]:
        constants_of_layer = [constant(layer, name) for name in constants]
        return t.before(layer, function, *t.changes(layer), *constants_of_layer, layer.width)

    return write


def _elementwise(t: Tangents, layer: layers.Elementwise) -> list[str]:
    # Sums change with their inputs alone, at whatever values these are.
    linear = layer.operation in (BinaryOperation.ADD, BinaryOperation.SUBTRACT)
    values = () if linear else t.values(layer)
    return t.before(layer, f"edp_{layer.operation}_tangent", *values, *t.changes(layer), layer.width)


def _gather(t: Tangents, layer: layers.Gather) -> list[str]:
    if needs_columns(t.calls, layer):
        return t.before(layer, "edp_gather_tangent", *t.changes(layer), constant(layer, "columns"), layer.width)
    lines, at = [], 0
    for name, first, length in runs(t.calls, layer):
        lines.append(call("edp_copy_tangent", t.change(name, first), length, "d", t.change(layer.name, at)))
        at += length
    return [*lines, *t.calls.translate(layer)]


def _clip(t: Tangents, layer: layers.Clip) -> list[str]:
    ends = (constant(layer, "low"), constant(layer, "high"))
    return t.before(layer, "edp_clip_tangent", *t.values(layer), *t.changes(layer), *ends, layer.width)


def _activate(t: Tangents, layer: layers.Activate) -> list[str]:
    slope = t.scratch(layer)
    first = call(f"edp_slope_{layer.function}", *t.values(layer), layer.size, slope)
    return [first, *t.before(layer, "edp_scale_tangent", *t.changes(layer), slope, layer.size)]


def _glu(t: Tangents, layer: layers.Glu) -> list[str]:
    return t.before(layer, "edp_glu_tangent", *t.values(layer), *t.changes(layer), layer.rows, layer.size // 2)


def _dense(t: Tangents, layer: layers.Dense) -> list[str]:
    sizes = (layer.rows, *layer.weight.shape)
    return t.before(layer, "edp_dense_tangent", *t.changes(layer), constant(layer, "weight"), *sizes)


def _write_grouped(t: Tangents, layer: layers.GroupedDense) -> list[str]:
    weight = constant(layer, "weight")
    return t.before(layer, "edp_grouped_dense_tangent", *t.changes(layer), weight, *layer.weight.shape)


def _norm(t: Tangents, layer: layers.LayerNorm) -> list[str]:
    parameters = (constant(layer, "gain"), number(layer.epsilon), layer.rows, len(layer.gain))
    return t.before(layer, "edp_layer_norm_tangent", *t.values(layer), *t.changes(layer), *parameters)


def _rows(t: Tangents, layer: layers.RowAttention) -> list[str]:
    six = (_pointers(t.values(layer)), _pointers(t.changes(layer)))
    scratch = (t.calls.scratch(layer), t.scratch(layer))
    return t.before(layer, "edp_row_attention_tangent", *six, layer.rows, layer.size, *scratch)


def _difference(t: Tangents, layer: memory.Difference) -> list[str]:
    kind = "true" if layer.from_zero else "false"
    parameters = (constant(layer, "factor"), layer.width, kind, ring(layer), changed(layer, "before"))
    return t.before(layer, "edp_difference_tangent", *t.changes(layer), *parameters)


def _starting(t: Tangents, layer: memory.Starting) -> list[str]:
    parameters = (len(layer.mean), layer.ticks, ring(layer))
    return t.before(layer, "edp_starting_tangent", *t.changes(layer), *parameters)


def _convolution(t: Tangents, layer: memory.Convolution) -> list[str]:
    out, taps, into = layer.weight.shape
    inputs = (*t.changes(layer), constant(layer, "weight"))
    if taps == 1:
        return t.before(layer, "edp_dense_tangent", *inputs, 1, out, into)
    parameters = (out, taps, into, layer.dilation, ring(layer), changed(layer, "ring"))
    return t.before(layer, "edp_convolution_tangent", *inputs, *parameters)


def _lstm(t: Tangents, layer: memory.Lstm | memory.LayerNormLstm) -> list[str]:
    name, units, into = identifier(layer.name), layer.width, layer.weight_x.shape[1]
    normed = isinstance(layer, memory.LayerNormLstm)
    weights, norms = f"&{name}_weights", f"&{name}_norms" if normed else "NULL"
    gates, dgates, old = t.calls.scratch(layer), t.scratch(layer), t.scratch(layer, layer.scratch)
    states = changed(layer, "h"), changed(layer, "c")
    if normed:
        inputs = (*t.values(layer), *t.changes(layer), slot(layer, "h"), states[0], weights, norms, into, units, gates)
        first = call("edp_layer_norm_gates_tangent", *inputs, "d", dgates)
    else:
        inputs = (*t.changes(layer), states[0], weights, into, units)
        first = call("edp_lstm_gates_tangent", *inputs, "d", dgates)
    # The LSTM overwrites its cell, whose old value the tangent still needs.
    copied_state = call("edp_copy", slot(layer, "c"), units, old)
    rest = (gates, units, number(layer.share), norms, old, dgates, *states)
    return [
        first,
        copied_state,
        *t.calls.translate(layer),
        call("edp_lstm_cell_tangent", *rest, "d", t.change(layer.name)),
    ]


def _gru(t: Tangents, layer: memory.Gru) -> list[str]:
    name, units, into = identifier(layer.name), layer.width, layer.weight_x.shape[1]
    old = t.scratch(layer, layer.scratch)
    memory_arguments = (t.calls.scratch(layer), old, t.scratch(layer), changed(layer, "h"))
    copied_state = call("edp_copy", slot(layer, "h"), units, old)
    own = call(
        "edp_gru_tangent",
        *t.changes(layer),
        f"&{name}_weights",
        into,
        units,
        *memory_arguments,
        "d",
        t.change(layer.name),
    )
    return [copied_state, *t.calls.translate(layer), own]


def _min_gru(t: Tangents, layer: memory.MinGru) -> list[str]:
    states = (slot(layer, "h"), changed(layer, "h"))
    return t.before(layer, "edp_min_gru_tangent", *t.values(layer), *t.changes(layer), layer.units, *states)


def _rotation(t: Tangents, layer: memory.Rotation) -> list[str]:
    parameters = (constant(layer, "factor"), len(layer.factor), changed(layer, "h"))
    return t.before(layer, "edp_rotation_tangent", *t.changes(layer), *parameters)


def _mean(t: Tangents, layer: memory.TrailingMean) -> list[str]:
    parameters = (layer.size, layer.window, ring(layer), changed(layer, "ring"))
    return t.before(layer, "edp_trailing_mean_tangent", *t.changes(layer), *parameters)


def _write_attention(t: Tangents, layer: memory.AttentionPool | memory.WindowAttention, *slots: str) -> str:
    past, moved = (", ".join(of(layer, name) for name in slots) for of in (slot, changed))
    struct = f"{{{past}}}, {{{moved}}}, {ring(layer)}, {layer.window}u"
    return f"&(const edp_attended){{{struct}, {t.calls.scratch(layer)}, {t.scratch(layer)}}}"


def _pool(t: Tangents, layer: memory.AttentionPool) -> list[str]:
    score = (constant(layer, "score"), f"{constant(layer, 'bias')}[0]", layer.width)
    attended = _write_attention(t, layer, "ring", "scores")
    return t.before(layer, "edp_attention_pool_tangent", *t.values(layer), *t.changes(layer), *score, attended)


def _window(t: Tangents, layer: memory.WindowAttention) -> list[str]:
    attended = _write_attention(t, layer, "keys", "values")
    six = (_pointers(t.values(layer)), _pointers(t.changes(layer)))
    return t.before(layer, "edp_window_attention_tangent", *six, layer.size, layer.heads, attended)


def _prefix(t: Tangents, layer: memory.PrefixCorrection) -> list[str]:
    hidden, seen = layer.first_weight.shape
    states = (slot(layer, "total"), changed(layer, "total"), ring(layer))
    work = (t.calls.scratch(layer), t.scratch(layer), "d")
    inputs = (*t.values(layer), *t.changes(layer), f"&{identifier(layer.name)}_weights", seen // 2)
    asked = call("edp_prefix_tangent", *inputs, *states, *work).removesuffix(";")
    lines = [f"if ({asked}) {{"]
    sizes, at = {(name, part.name): part.size for name, part in t.graph.slots()}, seen + hidden
    for name, part in layer.corrects:
        old = changed(name, part)
        lines.append("    " + call("edp_add_tangent", old, t.scratch(layer, at), sizes[name, part], "d", old))
        at += sizes[name, part]
    return [*lines, "}", *t.calls.translate(layer)]


def _feedback(t: Tangents, layer: memory.Feedback) -> list[str]:
    return t.before(layer, "edp_copy_tangent", changed(layer, "last"), layer.size)


def _feed(t: Tangents, layer: memory.Feed) -> list[str]:
    source = layer.inputs[0]
    size, into = t.graph.width_of(source), changed(layer.into, "last")
    return [call("edp_copy_tangent", t.change(source), size, "d", into), *t.calls.translate(layer)]


TANGENTS: dict[type[Layer], Write] = {
    layers.Gather: _gather,
    layers.Standardise: _linear("edp_standardise_tangent", "scale"),
    layers.ScaleShift: _linear("edp_scale_tangent", "gain"),
    layers.Clip: _clip,
    layers.Elementwise: _elementwise,
    layers.Activate: _activate,
    layers.Glu: _glu,
    layers.Accumulate: lambda t, x: t.before(x, "edp_accumulate_tangent", *t.changes(x), x.rows, x.size),
    layers.Dense: _dense,
    layers.GroupedDense: _write_grouped,
    # Between thresholds a sum of trees is constant.
    layers.TreeSums: lambda t, x: t.before(x, "edp_fill_tangent", x.width),
    layers.LayerNorm: _norm,
    layers.RowAttention: _rows,
    memory.Difference: _difference,
    memory.Starting: _starting,
    memory.Convolution: _convolution,
    memory.Lstm: _lstm,
    memory.LayerNormLstm: _lstm,
    memory.Gru: _gru,
    memory.MinGru: _min_gru,
    memory.Rotation: _rotation,
    memory.TrailingMean: _mean,
    memory.AttentionPool: _pool,
    memory.WindowAttention: _window,
    memory.Feedback: _feedback,
    memory.Feed: _feed,
    memory.PrefixCorrection: _prefix,
}
"""Writer functions of the derivatives by layer class."""


def differentiable(graph: Graph) -> bool:
    """Return whether every layer has a tangent."""
    return all(type(layer) in TANGENTS for layer in graph.layers)
