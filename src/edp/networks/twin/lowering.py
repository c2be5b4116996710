"""A twin as a list of layers with a feedback edge: ports, scales, the trapezoidal rule, end stops and bounds."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from edp.ir import Builder, Graph
from edp.ir.base import INPUT
from edp.ir.layers import Activate, BinaryOperation, Clip, Function, ScaleShift, Standardise
from edp.ir.memory import Feed, Feedback

if TYPE_CHECKING:
    from edp.networks.twin.base import Twin
    from edp.networks.twin.scales import Array

ADD, MULTIPLY = BinaryOperation.ADD, BinaryOperation.MULTIPLY
MEASURED = 0.5
"""Threshold of a port flag. A port reads the measured value if its flag is above the threshold."""


def plant_graph(twin: Twin) -> Graph:
    """Return one sample of a twin as a graph, from SI inputs to SI outputs.

    Inputs are the commands, a measured value for each output, and a flag for each: 1 where the port reads what was
    measured, 0 where it reads the last output. A measured value must be finite even if its port is free. After a reset
    the plant starts in steady state at the means of its training data.

    Raises:
        ExportError: the formulation has no form as layers.
    """
    scales, channels = twin.scales, twin.channels
    commands, answers = len(channels.commands), len(channels.answers)
    build = Builder(commands + 2 * answers)
    logged = build.pick("logged", INPUT, range(commands))
    command = build.add(Standardise, "commands", logged, offset=scales.command_offset, scale=scales.command_width)
    with build.inside("ports"):
        fed, last = _ports(build, twin, commands)
    answer = twin.lower_answers(build, command, fed)
    with build.inside("answers"):
        # A map of the commands alone reads no port, so it needs no feedback edge.
        if any(fed in layer.inputs for layer in build.layers):
            build.add(Feed, "feed", answer, into=last)
        result = build.add(ScaleShift, "decoded", answer, gain=scales.answer_width, shift=scales.answer_offset)
    return build.graph({"prediction": result}, twin.prefix_ticks)


def _ports(build: Builder, twin: Twin, commands: int) -> tuple[str, str]:
    """Add the scaled port readings and the layer that holds the last outputs."""
    scales, size = twin.scales, len(twin.channels.answers)
    one = np.ones(size)
    logged = build.pick("logged", INPUT, range(commands, commands + size))
    measured = build.add(Standardise, "measured", logged, offset=scales.answer_offset, scale=scales.answer_width)
    flags = build.pick("flags", INPUT, range(commands + size, commands + 2 * size))
    # Exactly 0 or 1, whatever is fed: a product with it selects without rounding, in forms that have no condition.
    above = build.add(ScaleShift, "above", flags, gain=one, shift=-MEASURED * one)
    read = build.add(Activate, "read", above, function=Function.POSITIVE, size=size)
    free = build.add(ScaleShift, "free", read, gain=-one, shift=one)
    last = build.add(Feedback, "last", size=size)
    parts = (build.combine("outer", MULTIPLY, read, measured), build.combine("own", MULTIPLY, free, last))
    return build.combine("fed", ADD, *parts), last


def add_bounds(build: Builder, twin: Twin, fed: str, proposed: str) -> str:
    """Add layers that limit scaled outputs to the bounds, as `Twin.bounded` does."""
    scales, channels = twin.scales, twin.channels
    count, strokes = len(channels.velocities), len(channels.strokes)
    low, high = ((end - scales.answer_offset) / scales.answer_width for end in (scales.low, scales.high))
    free = [*range(count), *range(count + strokes, len(low))]
    clipped = build.add(Clip, "bounded", proposed, low=low[free], high=high[free])
    if not strokes:
        return clipped
    velocity = build.pick("velocity", clipped, range(count))
    velocity, stroke = add_stroke_stops(build, twin, fed, velocity, list(range(count)))
    pressures = build.width(clipped) - count
    rest = [build.pick("pressure", clipped, range(count, count + pressures))] if pressures else []
    return build.join("together", velocity, stroke, *rest)


def add_stroke_stops(build: Builder, twin: Twin, fed: str, velocity: str, columns: list[int]) -> tuple[str, str]:
    """Add velocities of these columns without motion into an end stop, and the resulting strokes; all scaled."""
    scales, count = twin.scales, len(twin.channels.velocities)
    low, high = ((end - scales.answer_offset) / scales.answer_width for end in (scales.low, scales.high))
    both = build.combine("both_ends", ADD, build.pick("velocity_before", fed, columns), velocity)
    gain, zero = scales.trapezoid(twin.channels)[columns], np.zeros(len(columns))
    moved = build.add(ScaleShift, "moved", both, gain=gain, shift=zero)
    ends = [count + column for column in columns]
    stroke = build.combine("stroke", ADD, build.pick("stroke_before", fed, ends), moved)
    velocity = _stop_at_ends(build, "open", stroke, velocity, high[ends], high[columns], 1.0)
    velocity = _stop_at_ends(build, "closed", stroke, velocity, low[ends], low[columns], -1.0)
    return velocity, build.add(Clip, "held", stroke, low=low[ends], high=high[ends])


def _stop_at_ends(build: Builder, name: str, stroke: str, velocity: str, stop: Array, most: Array, side: float) -> str:
    """Return the velocities that do not go into an end stop: their bound is zero where a stroke is beyond it."""
    one = np.ones(len(stop))
    past = build.add(ScaleShift, f"past_{name}", stroke, gain=side * one, shift=-side * stop)
    there = build.add(Activate, f"at_{name}", past, function=Function.POSITIVE, size=len(stop))
    bound = build.add(ScaleShift, f"most_{name}", there, gain=-most, shift=most)
    operation = BinaryOperation.MINIMUM if side > 0 else BinaryOperation.MAXIMUM
    return build.combine(f"velocity_{name}", operation, velocity, bound)
