"""Grey box as the model of a controller plan in C: an exact first run, and linearised runs near it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from edp.errors import ExportError
from edp.export.c.model import Model, make_model
from edp.export.c.text import filled, identifier, number, unsigned_literals
from edp.export.controller.parts import PlanParts
from edp.export.controller.plants import plant_files, plant_values
from edp.export.escape import Code
from edp.ir.hydraulics import VALVE_STATES, HydraulicTick
from edp.networks.twin import TwinPlant
from edp.networks.twin.grey.runner import SINGLE_TICKS, goes_twice
from edp.networks.twin.greybox import GreyTwin

RUNTIME = ("edp_near.h", "edp_near.c")
WITHIN = "edp_hydraulics.c"
"""File that includes `edp_near.c`, so that the build does not compile `edp_near.c` separately."""


@dataclass(frozen=True, eq=False)
class NearModel:
    """Template values of a grey box with linearised runs.

    Attributes:
        name: C prefix.
        model: layer graph of the model, for its constants.
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

    template = "plan_near"
    fragments = ("fields.h", "public.h", "pressures.c", "recall.c")

    def sizes(self, plan: PlanParts) -> dict[str, int]:
        """Return additional sizes that the controller defines."""
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
        return plant_files("plant_near", self.model, self._values(), RUNTIME)

    @property
    def sources(self) -> tuple[str, ...]:
        """C files that a program with this model compiles."""
        runtime = (*self.model.runtime, *RUNTIME)
        return (f"{self.name}.c", *(name for name in runtime if name.endswith(".c") and name != WITHIN))

    def _values(self) -> dict[str, object]:
        twin, machine = self.twin, self.machine
        actuators, valves, pumps = machine.sizes
        return {
            **plant_values(self.model, self.plant),
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
            "axes": Code(", ".join(unsigned_literals(machine.ports[answer, 1] for answer in self.velocities))),
            "machine": f"{identifier(machine.name)}_machine",
        }


def near_model(name: str, plan: PlanParts) -> NearModel | None:
    """Create a grey box with linearised runs, ready to be written; None for other twins.

    Args:
        name: C prefix of the model.
        plan: plan on the twin.

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
