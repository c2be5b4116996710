"""The constants of an exported controller as C, and their checksum."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import ArrayLike

from edp.export.c.tables import ConstantTables
from edp.export.c.text import bool_literal, initialiser, number, struct, table
from edp.export.controller.parts import AXES, ControllerParts, PlanParts, Side

SIDES = ("out", "back")
ROUNDED = 2.0**-23
"""Unit in the last place of a lever command in single precision."""


def constants_of_controller(parts: ControllerParts, near: bool = False) -> ConstantTables:
    """Return everything that is not the model's; `near`: a plan is on a grey box, whose load is estimated."""
    tables = ConstantTables("controller")
    tables.floats("input_low", parts.limits_low)
    tables.floats("input_high", parts.limits_high)
    tables.rows("front_angles", parts.angles)
    lengths = [initialiser(map(number, values)) for values in (parts.full_m, parts.lengths_m)]
    tables.text(struct("edp_front", "front", [f"{len(parts.angles)}u", "front_angles", *lengths]))
    # A rounding below: levers are sums in single precision, and a limit is one.
    slew = np.maximum(np.asarray(parts.slew) - ROUNDED, 0.5 * np.asarray(parts.slew))
    limits = (parts.lever_low, parts.lever_high, slew)
    tables.text(struct("edp_lever_limits", "limits", (initialiser(map(number, values)) for values in limits)))
    if parts.plan is None or parts.plan.fallback:
        _set_sides(tables, "loop", parts.sides)
        gains = map(number, (*parts.gains, parts.rate_hz))
        tables.text(struct("edp_pi_gains", "gains", [*gains, f"{parts.lead}u"]))
    if parts.plan is not None:
        _set_plan(tables, parts, parts.plan, near)
    return tables


def _set_plan(tables: ConstantTables, parts: ControllerParts, plan: PlanParts, near: bool) -> None:
    _set_sides(tables, "plan", plan.sides)
    tables.floats("slowest", plan.slowest)
    tables.floats("fastest", plan.fastest)
    tables.places("blocks", plan.blocks)
    tables.places("ports", plan.ports)
    tables.places("stroke_reads", parts.stroke_inputs)
    tables.places("stroke_answers", plan.strokes)
    if near:
        tables.places("velocity_reads", [plan.ports.index(answer) for answer in plan.velocities])
        tables.places("velocity_answers", plan.velocities)
    if plan.pressures:
        tables.places("pressure_answers", plan.pressures)
    tables.text(struct("edp_lever_shape", "lever_shape", map(number, plan.lever_shape)))
    pilots = [(f"{p.axis}u", bool_literal(p.second), bool_literal(p.extend), number(p.share)) for p in plan.pilots]
    tables.text(table("edp_pilot", f"pilots[{len(pilots)}]", pilots))
    names = ("along", "attitude", "change", "feedforward", "trust", "smoothing")
    scalars = dict(zip(names, plan.weights, strict=True)) | {"STEP": plan.step_m_s, "margin": plan.margin}
    scalars |= {"load": plan.load} if near else {}
    scalars |= {"most_pressure": plan.pressure_pa} if plan.pressures else {}
    for name, value in scalars.items():
        tables.text(f"static const float {name} = {number(value)};")


def _set_sides(tables: ConstantTables, name: str, sides: Iterable[tuple[Side, Side]]) -> None:
    """Write the lever-by-speed polygons of each axis, extending and retracting."""
    rows = []
    for axis, pair in enumerate(sides):
        entries = []
        for label, (speeds, levers) in zip(SIDES, pair, strict=True):
            own = f"{name}_{label}_{axis}"
            tables.floats(f"{own}_speeds", _rising(speeds))
            tables.floats(f"{own}_levers", levers)
            entries.append(initialiser([f"{len(speeds)}u", f"{own}_speeds", f"{own}_levers"]))
        rows.append(entries)
    tables.text(table("edp_valve_side", f"{name}_sides[{AXES}][2]", rows))


def _rising(speeds: ArrayLike) -> np.ndarray:
    """Return strictly rising single-precision nodes, since differences of nodes are divisors."""
    nodes = np.asarray(speeds, dtype=np.float32).copy()
    for i in range(1, len(nodes)):
        nodes[i] = max(nodes[i], np.nextafter(nodes[i - 1], np.float32(np.inf)))
    return nodes
