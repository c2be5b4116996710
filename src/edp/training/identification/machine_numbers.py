"""Machine file parameters that logs can identify: position, unit, and prior standard deviation from a guess."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edp.sim.machine.machine import Machine
from edp.sim.machine.machine_checks import CYLINDERS
from edp.storage.reading import Table

Doubles = NDArray[np.float64]
STATIC = ("friction", "static_fraction")
"""Fitted by what it exceeds the Coulomb fraction, so that it never falls below it."""
MIN_REGENERATION = 0.1
"""Of the conductance of meter-out: where a fit begins that must find whether oil returns at all."""


@dataclass(frozen=True)
class MachineNumber:
    """One number of a machine file, fitted by its logarithm.

    Attributes:
        section: table of the file.
        key: key in the machine file.
        cylinder: index of the cylinder; None for a parameter of the whole machine.
        group: name of the group of parameters that are evaluated together.
        width: plausible deviation of its logarithm from the guess.
        unit: unit of the value.
    """

    section: str
    key: str
    cylinder: int | None
    group: str
    width: float
    unit: str

    @property
    def path(self) -> str:
        """Section and key."""
        return f"{self.section}.{self.key}"

    @property
    def label(self) -> str:
        """Name in messages and comments."""
        return self.path + ("" if self.cylinder is None else f"[{CYLINDERS[self.cylinder]}]")

    def read(self, machine: Machine) -> float:
        """Return its value: the flow of a rating, the excess over Coulomb friction for static friction."""
        value = getattr(getattr(machine, self.section), self.key)
        value = value if self.cylinder is None else value[self.cylinder]
        value = value[0] if isinstance(value, tuple) else value
        excess = machine.friction.coulomb_fraction if (self.section, self.key) == STATIC else 0.0
        return float(value) - excess


_EACH = (
    ("cylinders", "stroke", "end stops", 0.01, "m"),
    ("cylinders", "hose_volume", "volumes", 1.0, "m^3"),
    ("cylinders", "cushion_length", "cushions", 0.5, "m"),
    ("cylinders", "cushion_area", "cushions", 1.0, "1"),
    ("cylinders", "piston_leakage", "leakage", 2.0, "m^3/s/Pa"),
    ("cylinders", "spool_leakage", "leakage", 2.0, "m^3/s/Pa"),
    ("friction", "viscous", "friction", 1.5, "N s/m"),
    ("friction", "bristle_stiffness", "bristles", 1.0, "N/m"),
    ("friction", "bristle_damping", "bristles", 1.0, "N s/m"),
    ("valves", "pilot_frequency", "time constants", 0.5, "Hz"),
    ("valves", "spool_frequency", "time constants", 0.5, "Hz"),
    ("valves", "conflux_spool_frequency", "time constants", 0.5, "Hz"),
    ("valves", "dead_time", "time constants", 0.5, "s"),
    ("valves", "dead_band_extend", "dead bands", 0.4, "1"),
    ("valves", "dead_band_retract", "dead bands", 0.4, "1"),
    ("valves", "conflux_dead_band_extend", "dead bands", 0.4, "1"),
    ("valves", "conflux_dead_band_retract", "dead bands", 0.4, "1"),
    ("valves", "pump_demand_extend", "pump demand", 0.5, "1"),
    ("valves", "pump_demand_retract", "pump demand", 0.5, "1"),
    ("valves", "meter_in_extend", "valve curves", 1.0, "L/min"),
    ("valves", "meter_in_retract", "valve curves", 1.0, "L/min"),
    ("valves", "conflux_in_extend", "valve curves", 1.0, "L/min"),
    ("valves", "conflux_in_retract", "valve curves", 1.0, "L/min"),
    ("valves", "meter_out_extend", "valve curves", 1.0, "L/min"),
    ("valves", "meter_out_retract", "valve curves", 1.0, "L/min"),
    ("valves", "regeneration_extend", "regeneration", 2.0, "L/min"),
    ("valves", "regeneration_retract", "regeneration", 2.0, "L/min"),
    ("valves", "port_relief_head", "reliefs", 0.2, "Pa"),
    ("valves", "port_relief_rod", "reliefs", 0.2, "Pa"),
)
_WHOLE = (
    ("cylinders", "stop_stiffness", "end stops", 0.7, "N/m"),
    ("friction", "coulomb_fraction", "friction", 1.0, "1"),
    ("friction", "static_fraction", "friction", 1.0, "1"),
    ("friction", "stribeck_velocity", "friction", 1.0, "m/s"),
    ("oil", "bulk_modulus", "oil", 0.3, "Pa"),
    ("oil", "air_fraction", "oil", 0.7, "1"),
    ("oil", "tank_pressure", "oil", 0.7, "Pa"),
    ("pumps", "max_flow", "pumps", 0.7, "m^3/s"),
    ("pumps", "power_limit", "pumps", 0.7, "W"),
    ("pumps", "min_displacement", "pumps", 0.7, "1"),
    ("pumps", "time_constant", "pumps", 0.7, "s"),
    ("pumps", "line_volume", "volumes", 1.0, "m^3"),
    ("pumps", "relief", "reliefs", 0.2, "Pa"),
    ("pumps", "relief_slope", "reliefs", 1.0, "m^3/s/Pa"),
    ("pumps", "bypass", "open centre", 1.0, "L/min"),
    ("pumps", "bypass_closed_at", "open centre", 0.4, "1"),
    ("valves", "conflux_extra_dead_time", "time constants", 0.7, "s"),
    ("valves", "hysteresis", "dead bands", 0.7, "1"),
    ("valves", "port_relief_slope", "reliefs", 1.0, "m^3/s/Pa"),
    ("valves", "anti_cavitation", "reliefs", 1.0, "L/min"),
)
MACHINE_NUMBERS: tuple[MachineNumber, ...] = (
    *(MachineNumber(s, k, i, group, width, unit) for s, k, group, width, unit in _EACH for i in range(len(CYLINDERS))),
    *(MachineNumber(s, k, None, group, width, unit) for s, k, group, width, unit in _WHOLE),
)
"""All of them; the others of a machine file are geometry, or what no log of free motion tells."""
_LEAST = {"conflux_extra_dead_time": 5e-3, "spool_leakage": 1e-16, "piston_leakage": 1e-16, "air_fraction": 1e-4}
"""Where a fit begins that must find a number which the machine file has as zero."""


def guesses(machine: Machine) -> Doubles:
    """Return the values of a machine from which a fit begins ``(number,)``; never zero."""
    values = np.array([number.read(machine) for number in MACHINE_NUMBERS])
    for k, number in enumerate(MACHINE_NUMBERS):
        if values[k] > 0.0:
            continue
        values[k] = _regeneration(machine, number) if "regeneration" in number.key else _LEAST.get(number.key, 1e-3)
    return values


def _regeneration(machine: Machine, number: MachineNumber) -> float:
    """Return the flow of a small regeneration, L/min at the rated pressure difference of the file."""
    out = number.key.replace("regeneration", "meter_out")
    (flow, bar), (_, own_bar) = (getattr(machine.valves, key)[number.cylinder] for key in (out, number.key))
    return float(MIN_REGENERATION * flow * np.sqrt(own_bar / bar))


def set_values(machine: Machine, values: Sequence[float] | Doubles) -> Machine:
    """Return a machine with other parameters.

    Args:
        machine: the one whose other numbers stay.
        values: values of `MACHINE_NUMBERS` in the form of `MachineNumber.of`.
    """
    sections: dict[str, Table] = {}
    for number, value in zip(MACHINE_NUMBERS, values, strict=True):
        changed = sections.setdefault(number.section, {})
        old = changed.get(number.key, getattr(getattr(machine, number.section), number.key))
        if number.cylinder is None:
            changed[number.key] = _read_rating(old, float(value))
        else:
            each = list(old)
            each[number.cylinder] = _read_rating(each[number.cylinder], float(value))
            changed[number.key] = tuple(each)
    friction = sections["friction"]
    friction["static_fraction"] += friction["coulomb_fraction"]
    return replace(machine, **{name: replace(getattr(machine, name), **changed) for name, changed in sections.items()})


def _read_rating(old: Any, value: float) -> Any:
    """Return a number, or a rating with unchanged pressure."""
    return (value, old[1]) if isinstance(old, tuple) else value
