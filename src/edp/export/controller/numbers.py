"""The constants of an exported controller as C, and their checksum."""

from __future__ import annotations

import binascii
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from edp.export.c.text import array, filled, number
from edp.export.controller.parts import AXES, ControllerParts, PlanParts, Side
from edp.export.escape import Code
from edp.export.hashes import little_endian

SIDES = ("out", "back")
ROUNDED = 2.0**-23
"""Last place of a lever in single precision."""


@dataclass
class ConstantTables:
    """Definitions of constants, and the entries of the checksum at start-up.

    Attributes:
        lines: of C.
        entries: of the table of arrays.
        crc: CRC-32 of all arrays so far.
        bytes: of them.
    """

    lines: list[str] = field(default_factory=list)
    entries: list[str] = field(default_factory=list)
    crc: int = 0
    bytes: int = 0

    def floats(self, name: str, values: ArrayLike) -> None:
        """Add a float array; two dimensions become an array of rows."""
        numbers = np.asarray(values, dtype=np.float32)
        if numbers.ndim == 2:
            rows = ",\n".join(f"    {{{', '.join(map(number, row))}}}" for row in numbers)
            self.lines.append(f"static const float {name}[{len(numbers)}][{numbers.shape[1]}] = {{\n{rows}\n}};")
        else:
            self.lines.append(array("float", name, map(number, numbers)))
        self._check(name, numbers)

    def small(self, name: str, values: Iterable[int]) -> None:
        """Add an array of 16-bit counts or positions."""
        numbers = np.asarray(list(values), dtype=np.uint16)
        self.lines.append(array("uint16_t", name, (f"{value}u" for value in numbers)))
        self._check(name, numbers)

    def text(self, line: str) -> None:
        """Add a definition that the checksum omits, since it holds pointers or is a struct."""
        self.lines.append(line)

    def _check(self, name: str, values: np.ndarray) -> None:
        self.entries.append(f"{{{name}, {values.size}u, {values.itemsize}u}}")
        self.crc = binascii.crc32(little_endian(values), self.crc)
        self.bytes += values.nbytes

    def finished(self) -> Code:
        """All of it as the text of a header."""
        return Code("\n".join([*self.lines, array("edp_table", "tables", self.entries)]) + "\n")


def constants_of_controller(parts: ControllerParts, near: bool = False) -> ConstantTables:
    """Everything that is not the model's; `near`: a plan is on a grey box, whose load is estimated."""
    tables = ConstantTables()
    tables.floats("input_low", parts.limits_low)
    tables.floats("input_high", parts.limits_high)
    tables.floats("front_angles", parts.angles)
    full, lengths = (_write_initialiser(values) for values in (parts.full_m, parts.lengths_m))
    tables.text(f"static const edp_front front = {{{len(parts.angles)}u, front_angles, {full}, {lengths}}};")
    # A rounding below: levers are sums in single precision, and a limit is one.
    slew = np.maximum(np.asarray(parts.slew) - ROUNDED, 0.5 * np.asarray(parts.slew))
    limits = ", ".join(_write_initialiser(values) for values in (parts.lever_low, parts.lever_high, slew))
    tables.text(f"static const edp_lever_limits limits = {{{limits}}};")
    if parts.plan is None or parts.plan.fallback:
        _set_sides(tables, "loop", parts.sides)
        gains = ", ".join(map(number, (*parts.gains, parts.rate_hz)))
        tables.text(f"static const edp_pi_gains gains = {{{gains}, {parts.lead}u}};")
    if parts.plan is not None:
        _set_plan(tables, parts, parts.plan, near)
    return tables


def _set_plan(tables: ConstantTables, parts: ControllerParts, plan: PlanParts, near: bool) -> None:
    _set_sides(tables, "plan", plan.sides)
    tables.floats("slowest", plan.slowest)
    tables.floats("fastest", plan.fastest)
    tables.small("blocks", plan.blocks)
    tables.small("ports", plan.ports)
    tables.small("stroke_reads", parts.stroke_inputs)
    tables.small("stroke_answers", plan.strokes)
    if near:
        tables.small("velocity_reads", [plan.ports.index(answer) for answer in plan.velocities])
        tables.small("velocity_answers", plan.velocities)
    if plan.pressures:
        tables.small("pressure_answers", plan.pressures)
    tables.text(f"static const edp_lever_shape lever_shape = {_write_initialiser(plan.lever_shape)};")
    pilots = ",\n".join(
        f"    {{{pilot.axis}u, {_truth(pilot.second)}, {_truth(pilot.extend)}, {number(pilot.share)}}}"
        for pilot in plan.pilots
    )
    tables.text(f"static const edp_pilot pilots[{len(plan.pilots)}] = {{\n{pilots}\n}};")
    names = ("along", "attitude", "change", "feedforward", "trust", "smoothing")
    scalars = dict(zip(names, plan.weights, strict=True)) | {"STEP": plan.step_m_s, "margin": plan.margin}
    scalars |= {"load": plan.load} if near else {}
    scalars |= {"most_pressure": plan.pressure_pa} if plan.pressures else {}
    for name, value in scalars.items():
        tables.text(f"static const float {name} = {number(value)};")


def _set_sides(tables: ConstantTables, name: str, sides: Iterable[tuple[Side, Side]]) -> None:
    """Polygons of levers by speed, by axis, extending and retracting."""
    rows = []
    for axis, pair in enumerate(sides):
        entries = []
        for label, (speeds, levers) in zip(SIDES, pair, strict=True):
            own = f"{name}_{label}_{axis}"
            tables.floats(f"{own}_speeds", _rising(speeds))
            tables.floats(f"{own}_levers", levers)
            entries.append(f"{{{len(speeds)}u, {own}_speeds, {own}_levers}}")
        rows.append(f"    {{{', '.join(entries)}}}")
    body = ",\n".join(rows)
    tables.text(f"static const edp_valve_side {name}_sides[{AXES}][2] = {{\n{body}\n}};")


def _rising(speeds: ArrayLike) -> np.ndarray:
    """Return strictly rising single-precision nodes, since differences of nodes are divisors."""
    nodes = np.asarray(speeds, dtype=np.float32).copy()
    for i in range(1, len(nodes)):
        nodes[i] = max(nodes[i], np.nextafter(nodes[i - 1], np.float32(np.inf)))
    return nodes


def _write_initialiser(values: Iterable[float]) -> Code:
    return Code(f"{{{', '.join(map(number, values))}}}")


def _truth(value: bool) -> str:
    return "true" if value else "false"


def golden_rows(name: str, kind: str, rows: ArrayLike) -> Code:
    """Return a two-dimensional array for a self-test."""
    numbers = np.asarray(rows, dtype=np.float32)
    body = ",\n".join("    {\n" + filled(map(number, row), "     ") + "}" for row in numbers)
    return Code(f"static const {kind} {name}[{len(numbers)}][{numbers.shape[1]}] = {{\n{body}\n}};\n")
