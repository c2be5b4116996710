"""Grey box as the model of a controller plan in C: an exact first run, and linearised runs near it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from edp import __version__
from edp.errors import ExportError
from edp.export.c.model import Model, crc, make_model
from edp.export.c.text import filled, identifier, number
from edp.export.controller.files import model_files, own_file
from edp.export.controller.parts import PlanParts
from edp.export.escape import Code, c_comment, fill
from edp.export.hashes import model_hash, scale_hash
from edp.ir.hydraulics import VALVE_STATES, HydraulicTick
from edp.networks.twin import TwinPlant
from edp.networks.twin.grey.runner import SINGLE_TICKS, goes_twice
from edp.networks.twin.greybox import GreyTwin

RUNTIME = ("edp_near.h", "edp_near.c")
WITHIN = "edp_hydraulics.c"
"""A file that `edp_near.c` includes, so that no program compiles it by itself."""
PUBLIC = """\
    uint32_t newton; /* iterations of the model's equations since the last tick */
    uint32_t newton_limit; /* of them; may be lowered */
"""
PRIVATE = """\
    {plant}_memory model;
    struct {{
        {plant}_memory memory;
        bool measured;
        float row[{NAME}_CONTROL_INPUTS];
        float demands[{PLANT}_VALVES];
    }} past[{NAME}_CONTROL_WINDOW];
    double resistance[{PLANT}_ACTUATORS]; /* MN that the load does not know of */
    double by_force[EDP_AXES][EDP_AXES];
    double expected[EDP_AXES]; /* m/s */
    bool expects;
    uint32_t age;
    uint32_t newton_left;
    /* Scratch of a tick. */
    edp_near near;
    bool between;
    uint8_t differs[{NAME}_CONTROL_LANES * {PLANT}_VALVES];
    float demands[{NAME}_CONTROL_LANES][{NAME}_CONTROL_SPAN][{PLANT}_VALVES];
    double room[{PLANT}_ROOM +
                EDP_NEAR_ROOM({PLANT}_ACTUATORS, {PLANT}_VALVES, {PLANT}_PUMPS, {NAME}_CONTROL_VARIABLES)];
"""
"""Fields of the state of a controller on a grey box."""
PRESSURE_ROWS = """\
    for (uint32_t i = 0; (i < {count}u) && ends; i++) {{
        const float share = (float)edp_near_answer(&c->near, pressure_answers[i], c->between) / most_pressure;
        add_row(c, share, -1e30f, 1.0f, pressure_answers[i], most_pressure, variables);
    }}
"""
RECALLED = """\
    for (uint32_t i = 0; i < EDP_AXES; i++) {{
        control.resistance[{plant}_axes[i]] = 1e-6 * (double)before[{at}u + i];
    }}
"""


@dataclass(frozen=True, eq=False)
class NearModel:
    """Template values of a grey box with linearised runs.

    Attributes:
        name: C prefix.
        model: its layers, for their constants.
        plant: the twin.
        twin: the grey box.
        machine: its layer.
        velocities: answers that are those of boom, arm and bucket.
    """

    name: str
    model: Model
    plant: TwinPlant
    twin: GreyTwin
    machine: HydraulicTick
    velocities: tuple[int, ...]

    fragment = "plan_near"
    public, private, recalled, pressure_rows = PUBLIC, PRIVATE, RECALLED, PRESSURE_ROWS

    def sizes(self, plan: PlanParts) -> dict[str, int]:
        """Further sizes that the controller defines."""
        ticks = sum(plan.blocks)
        return {"TICKS": ticks, "SPAN": max(ticks, plan.window), "NEWTON": plan.newton}

    def cost(self, plan: PlanParts) -> str:
        """Return the cost of one controller step, for the header."""
        unknown = self.machine.unknown
        lines = (
            f" * COST. A tick solves the model's equations, of {unknown} unknowns, by up to {plan.newton} iterations",
            " * of Newton's method together, in double precision, and one more for each stage where these are spent:",
            f" * then the plan is dropped. DAQP has up to {plan.iterations} iterations (see edp_qp.h). No other loop",
            " * has a length that varies.",
        )
        return "\n".join(lines)

    def files(self) -> dict[str, str]:
        """Model and runtime by file name."""
        return model_files(self.name, self._fill_template, "plant_near", self.model, RUNTIME)

    @property
    def sources(self) -> tuple[str, ...]:
        """C files that a program with this model compiles."""
        runtime = (*self.model.runtime, *RUNTIME)
        return (f"{self.name}.c", *(name for name in runtime if name.endswith(".c") and name != WITHIN))

    def _fill_template(self, template: str) -> Code:
        text = own_file(f"templates/{template}")
        graph, twin, machine = self.model.graph, self.twin, self.machine
        actuators, valves, pumps = machine.sizes
        values = {
            "name": self.name,
            "NAME": self.name.upper(),
            "title": c_comment(self.plant.title),
            "version": __version__,
            "model_hash": model_hash(graph),
            "scale_hash": scale_hash(self.plant),
            "crc": crc(graph),
            "commands": self.plant.sizes[0],
            "answers": self.plant.sizes[1],
            "actuators": actuators,
            "valves": valves,
            "pumps": pumps,
            "unknown": machine.unknown,
            "displacements": max(pumps, 1),
            "valve_states": valves * VALVE_STATES,
            "history": machine.remembered * valves,
            "prefix": max(1, twin.prefix_ticks),
            "single": SINGLE_TICKS,
            "twice": "true" if goes_twice(twin) else "false",
            "room": machine.room,
            "low": filled(map(number, np.asarray(twin.scales.low) / twin.units)),
            "high": filled(map(number, np.asarray(twin.scales.high) / twin.units)),
            "mean": filled(map(number, np.asarray(twin.scales.answer_offset))),
            "axes": Code(", ".join(f"{machine.ports[answer, 1]}u" for answer in self.velocities)),
            "machine": f"{identifier(machine.name)}_machine",
        }
        return fill(text, values)


def near_model(name: str, plan: PlanParts) -> NearModel | None:
    """Create a grey box with linearised runs, ready to be written; None for other twins.

    Args:
        name: C prefix of the model.
        plan: on it.

    Raises:
        ExportError: a part of it has no form as a layer.
    """
    plant = plan.plant.predictor
    if not isinstance(plant, TwinPlant) or type(plant.twin) is not GreyTwin:
        return None
    model = make_model(name, plan.plant)
    machine = next((layer for layer in model.graph.layers if isinstance(layer, HydraulicTick)), None)
    if machine is None:
        raise ExportError("the grey box of the controller has no layer of its equations; fit it again with edp twin")
    return NearModel(name, model, plant, plant.twin, machine, plan.velocities)
