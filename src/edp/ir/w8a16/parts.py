"""Choice of the float layers that are computed in integers; the others stay in single precision."""

from __future__ import annotations

from edp.ir import layers, memory
from edp.ir.base import INPUT, Graph
from edp.ir.layers import Function


def integer_part(graph: Graph) -> set[str]:
    """Return layers that are computed in integer arithmetic: after the scaling of the inputs, up to the last weights.

    Functions and selections of integers behind the last weights belong to it too.
    """
    scaled: set[str] = set()
    before: set[str] = set()
    for layer in graph.layers:
        if isinstance(layer, layers.Standardise) or scaled & set(layer.inputs):
            scaled.add(layer.name)
    # Go backwards: layers whose values are not read by weights are cheap and stay in single precision.
    for layer in reversed(graph.layers):
        if layer.macs or layer.name in before:
            before |= set(layer.inputs) | {layer.name}
    inside: set[str] = set()
    for layer in graph.layers:
        # Norms and attentions need sums of squares and quotients that 16-bit formats would spoil.
        if layer.name not in scaled or isinstance(layer, layers.Standardise) or layer.stays_float:
            continue
        # The exponential leaves 16 bits quickly; it stays in single precision.
        exponential = isinstance(layer, layers.Activate) and layer.function is Function.EXP
        light = isinstance(layer, layers.Activate | layers.Gather) and set(layer.inputs) <= inside
        if not exponential and (layer.name in before or light):
            inside.add(layer.name)
    return inside - {INPUT} - _ports(graph)


def _ports(graph: Graph) -> set[str]:
    """Return the layers between a feedback edge and the first weights: ports hand on sums that 16 bits would spoil."""
    ports: set[str] = set()
    for layer in graph.layers:
        plain = not layer.macs and not isinstance(layer, layers.Gather)
        if isinstance(layer, memory.Feedback) or (plain and ports & set(layer.inputs)):
            ports.add(layer.name)
    # What a port selects from as well: a measured value must not be rounded before it is fed to a sum.
    for layer in reversed(graph.layers):
        if layer.name in ports and not layer.macs:
            ports |= set(layer.inputs)
    return ports
