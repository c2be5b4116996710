"""The graph ``step``: the inputs of one tick and all states in, predictions and the next states out."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from edp.errors import ExportError
from edp.export.description import shape_of_result
from edp.export.onnx.memory import STEPS, Held, shape_of, step_correction
from edp.export.onnx.nodes import DEFAULT_OPSET, Nodes
from edp.export.onnx.plain import PLAIN
from edp.ir import Array, Graph, Layer, memory
from edp.ir.base import INPUT

INPUTS = "inputs"
"""Name of the graph's input with raw values in SI units."""
SPOILT = "spoilt"
"""Name of the state that is 0 until an input is not finite, and NaN afterwards."""
LAST = "_next"
"""Suffix of a state's output name."""
KINDS: frozenset[type[Layer]] = frozenset({*PLAIN, *STEPS, memory.Feed, memory.PrefixCorrection})
"""Layer classes that ONNX export supports. The last two depend on other layers."""


@dataclass(frozen=True, eq=False)
class State:
    """A state of the step graph.

    Attributes:
        name: name of the graph's input; the output has the suffix `LAST`.
        layer: layer and slot of the state; empty for `SPOILT`.
        start: values after a reset, a matrix.
    """

    name: str
    layer: tuple[str, str]
    start: Array

    @property
    def next(self) -> str:
        """The name of the output."""
        return self.name + LAST


def plain_name(name: str) -> str:
    """Return the name of a layer as part of a name in the graph."""
    return name.replace(".", "_")


def states_of(graph: Graph) -> list[State]:
    """Return the states of the step graph in the order of its inputs."""
    states: list[State] = []
    used_names = {INPUTS, SPOILT, *graph.results}
    for layer, slot in graph.slots():
        if slot.size:
            first = f"{plain_name(layer)}_{slot.name}"
            name = next(c for n in range(len(states) + 9) if (c := f"{first}_{n}" if n else first) not in used_names)
            used_names |= {name, name + LAST}
            states.append(State(name, (layer, slot.name), graph.start(layer, slot).reshape(shape_of(slot))))
    return [*states, State(SPOILT, ("", ""), np.zeros((1, 1), np.float32))]


def refuse(layer: Layer) -> ExportError:
    """Return the error for an unsupported kind of layer."""
    supported_kinds = sorted(kind.__name__ for kind in KINDS)
    return ExportError(
        f"layer '{layer.name}' is a {type(layer).__name__}, which has no form in ONNX; these have: "
        f"{', '.join(supported_kinds)}"
    )


def spoil(nodes: Nodes, inputs: str, ends: Iterable[str]) -> str:
    """Return 0 ``(tick, 1)`` where all inputs of a tick are finite, else NaN: ReLU and clipping may swallow a NaN.

    Values that nothing reads are read here. ONNX Runtime up to 1.18 puts them, from the second run on, over values that
    are still needed.
    """
    # Zero times NaN or infinity is NaN, zero times anything else is zero.
    zero = nodes.mean(nodes.times(inputs, np.float32(0)), 1)
    # Unread outputs are read here with weight zero: old runtimes overwrite what they share memory with.
    for value in nodes.unread(ends):
        nothing = nodes.times(nodes.shaped(nodes.add("ReduceMean", value, keepdims=1), 1, 1), np.float32(0))
        zero = nodes.add("Add", zero, nothing)
    return zero


def step_model(graph: Graph, targets: int, name: str, notes: Mapping[str, str], opset: int = DEFAULT_OPSET) -> bytes:
    """Return the file of the step graph.

    Args:
        graph: the layers.
        targets: numbers of each horizon.
        name: name of the ONNX graph.
        notes: kept in the file.
        opset: one of `OPSETS`.

    Raises:
        ExportError: a layer has no form in ONNX, or the opset is not written.
    """
    nodes, states = Nodes(opset), states_of(graph)
    nodes.reserve(INPUTS, *graph.results, *(name for s in states for name in (s.name, s.next)))
    layer_states: dict[str, dict[str, str]] = {layer.name: {} for layer in graph.layers}
    for state in states[:-1]:
        layer_states[state.layer[0]][state.layer[1]] = state.name
    values = {INPUT: INPUTS}
    fresh: dict[str, Held] = {}
    for layer in graph.layers:
        with nodes.inside(plain_name(layer.name)):
            _add_layer(nodes, graph, layer, values, layer_states, fresh)
    with nodes.inside("end"):
        ends = [
            *(values[name] for name in graph.results.values()),
            *(v for new_states in fresh.values() for v in new_states.values()),
        ]
        # The state adds up: once spoilt, always spoilt, as the recurrent states are.
        spoilt = nodes.add("Add", SPOILT, spoil(nodes, INPUTS, ends))
        outputs = add_results(nodes, graph, values, spoilt, targets)
    for state in states[:-1]:
        outputs[state.next] = (fresh[state.layer[0]][state.layer[1]], state.start.shape)
    outputs[SPOILT + LAST] = (spoilt, (1, 1))
    inputs = {INPUTS: (1, graph.inputs)} | {state.name: state.start.shape for state in states}
    return nodes.model(name, inputs, outputs, notes)


def _add_layer(
    nodes: Nodes,
    graph: Graph,
    layer: Layer,
    values: dict[str, str],
    layer_states: Mapping[str, Held],
    fresh: dict[str, Held],
) -> None:
    input_names = [values[name] for name in layer.inputs]
    if isinstance(layer, memory.PrefixCorrection):
        numbers, fresh[layer.name] = step_correction(nodes, layer, layer_states[layer.name], input_names[0])
        for (owner, slot), part in corrections(nodes, graph, layer, numbers).items():
            fresh[owner] = dict(fresh[owner]) | {slot: nodes.add("Add", fresh[owner][slot], part)}
    elif isinstance(layer, memory.Feed):
        fresh[layer.into] = {"last": input_names[0]}
    elif type(layer) in STEPS:
        values[layer.name], fresh[layer.name] = STEPS[type(layer)](nodes, layer, layer_states[layer.name], *input_names)
    elif type(layer) in PLAIN:
        widths = [graph.width_of(name) for name in layer.inputs]
        values[layer.name] = PLAIN[type(layer)](nodes, layer, 1, input_names, widths)
    else:
        raise refuse(layer)


def corrections(nodes: Nodes, graph: Graph, layer: memory.PrefixCorrection, numbers: str) -> dict[tuple[str, str], str]:
    """Return the part of a correction for each state, in the shape of the state."""
    slots = {(name, slot.name): slot for name, slot in graph.slots()}
    parts = nodes.split(numbers, [slots[owner].size for owner in layer.corrects], 1)
    shaped = {}
    for owner, part in zip(layer.corrects, parts, strict=True):
        shape = shape_of(slots[owner])
        shaped[owner] = part if shape[0] == 1 else nodes.shaped(part, *shape)
    return shaped


def add_results(
    nodes: Nodes, graph: Graph, values: Mapping[str, str], spoilt: str, targets: int
) -> dict[str, tuple[str, tuple[int, ...]]]:
    """Add the results as graph outputs, NaN where an input was not finite."""
    outputs: dict[str, tuple[str, tuple[int, ...]]] = {}
    for meaning, value in graph.results.items():
        shape = shape_of_result(graph, value, targets)
        marked = nodes.add("Add", values[value], spoilt)
        outputs[meaning] = (marked if shape[0] == 1 else nodes.shaped(marked, *shape), shape)
    return outputs
