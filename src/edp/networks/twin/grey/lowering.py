"""Grey box as a layer: constants, state after a reset, and reference implementation of one sample."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from edp.ir import Builder
from edp.ir.base import INPUT
from edp.ir.builder import indices
from edp.ir.hydraulics import NONE, SOLVERS, HydraulicTick
from edp.networks.twin.grey.correction import OutputBounds
from edp.networks.twin.grey.equations import GreyForm
from edp.networks.twin.grey.program import program_of
from edp.networks.twin.grey.rollouts import RunBatch, run_batch
from edp.networks.twin.grey.tick import machine_arrays

if TYPE_CHECKING:
    from edp.networks.twin.greybox import GreyTwin

Values = NDArray[np.floating]


def add_layer(build: Builder, twin: GreyTwin, fed: str) -> str:
    """Add the layer of a twin; after a reset it is in steady state at the means of the training data.

    Args:
        build: the layers in the making.
        twin: whose tick it is.
        fed: scaled port readings.
    """
    table, wiring, scales = twin.table, twin.wiring, twin.scales
    tick_s, steps = twin.time
    inertia, per_entry, potential, circuit = (int(first) for first in table.places)
    rest = twin.initial_state(scales.command_offset[None], scales.answer_offset[None])
    commands = build.pick("commands", INPUT, range(len(twin.channels.commands)))
    before = len(build.layers)
    name = build.add(
        HydraulicTick,
        "machine",
        commands,
        fed,
        numbers=twin.numbers,
        full=twin.full,
        knots=table.knots,
        middle=wiring.z_of[0],
        scale=wiring.z_of[1],
        offset=scales.answer_offset / twin.units,
        answer_width=scales.answer_width / twin.units,
        # C has no empty arrays.
        linkage=table.linkage if table.front is not None else np.zeros(1),
        sides=_places(wiring.sides),
        valve_at=_places(table.valve_at),
        valve_actuator=_places(wiring.actuator),
        valve_pump=_places(wiring.pump),
        actuator_at=_places(table.actuator_at),
        pump_at=_places(table.pump_at if len(table.pump_at) else [-1]),
        ports=_places(wiring.ports),
        exponents=_places(table.exponents),
        load=(inertia, per_entry, potential),
        circuit=circuit,
        remembered=rest["history"].shape[1],
        steps=steps,
        tick_s=tick_s,
    )
    slots = build.slots_since(before)
    build.start_from(slots, np.concatenate([_pad(rest[slot.name].ravel(), slot.size) for _, slot in slots]))
    return name


def _pad(values: Values, size: int) -> Values:
    return np.pad(values, (0, size - len(values)))


def _places(values: Any) -> NDArray[np.uint16]:
    """Return a table of positions with `NONE` for missing entries."""
    return indices(np.where(np.asarray(values) < 0, NONE, values))


def _decode_missing(values: NDArray[np.uint16]) -> NDArray[np.int64]:
    whole = values.astype(np.int64)
    return np.where(whole == NONE, -1, whole)


def _tick(
    layer: HydraulicTick, w: Mapping[str, Values], memory: dict[str, Values], commands: Values, fed: Values
) -> Values:
    """Compute one sample of the layer with the machine code of the twin, without output bounds."""
    values = {name: np.asarray(array, np.float64) for name, array in w.items()}
    sides, ports = _decode_missing(layer.sides), _decode_missing(layer.ports)
    demand = commands[sides[:, 0]] - np.where(sides[:, 1] >= 0, commands[sides[:, 1]], 0.0)
    demand = np.clip(np.asarray(demand / values["full"], np.float32), -1.0, 1.0)
    measured = values["offset"] + values["answer_width"] * fed
    state = [np.array(memory[slot.name], np.float64)[None] for slot in layer.slots]
    pumps = layer.sizes[2]
    state[3] = np.ascontiguousarray(state[3][:, :pumps])
    answers, unbounded = np.empty((1, 1, len(ports))), np.full(len(ports), np.inf)
    linkage = values["linkage"] if layer.linked else np.zeros(0)
    strokes, time = (values["middle"], values["scale"]), (layer.tick_s, layer.steps)
    batch = RunBatch(np.array(demand, np.float64)[None, None], measured[None, None], np.zeros((1, len(ports))), *state)
    run_batch(
        program_of(GreyForm.from_arrays(vars(layer), linkage, layer.circuit, layer.load)),
        machine_arrays(values["numbers"], strokes, linkage, ports, time),
        OutputBounds(-unbounded, unbounded, np.ones(len(ports))),
        batch,
        answers,
        None,
        None,
    )
    for slot, value in zip(layer.slots, state, strict=True):
        memory[slot.name] = _pad(value[0], slot.size) if slot.shape != value[0].shape else value[0]
    scaled = (answers[0, 0] - values["offset"]) / values["answer_width"]
    return np.asarray(scaled[ports[:, 0] != 1], commands.dtype)


SOLVERS[:] = [_tick]
