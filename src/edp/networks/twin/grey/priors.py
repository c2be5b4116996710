"""Parameters of each element of a grey box: meaning, unit and typical initial value."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from edp.networks.twin.grey import parameter_index as at
from edp.networks.twin.grey.elements import Actuator, MotorElement
from edp.networks.twin.parameters import Parameter
from edp.wording import typed

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
COARSE = np.array([0.0, 0.1, 0.25, 0.45, 0.7, 1.0])
"""Knots of an opening curve with five segments, as fractions of the spool travel after the dead band. Knots are closer
at small openings, where levers are more sensitive."""
STRETCHES = (5, 10, 20)
"""Numbers of segments of an opening curve. Each number halves the segments of the previous one, so a finer curve can
reproduce a coarser one."""
MEGA, LITRE = 1e6, 1e3
PLAUSIBLE_AREAS = (0.015, 0.008)
"""Prior areas of the head side and the rod side of a cylinder with unknown bore, m^2."""
PLAUSIBLE_FLOW = 0.005
"""Prior flow at the highest speed of a motor with unknown displacement, m^3/s (300 l/min). The prior displacement
follows from this flow."""
NO_STOP = 1e9
"""Stop position of a motor without stops, rad: the lower stop is at this angle and the upper stop at its negative. The
chambers then have no volume beyond their dead volume, and the cushions and stops have no effect. A motor can therefore
use the equations of a cylinder."""
ACTING_LIMIT = 0.2
"""Initial limit of the total pump power, as a fraction of the power of all pumps at full flow and maximum pressure. The
value is low, so that the limit is active in many samples; a limit that is never active has no derivative and cannot be
fitted."""
START_CURVE = (0.25, 0.75)
"""Linear and quadratic fraction of the initial opening curve: fine control near the closed position, as in usual
spools."""


def opening_knots(stretches: int) -> Array:
    """Return the knots of an opening curve from 0 to 1, one more than its segments."""
    parts = stretches // STRETCHES[0]
    places = np.arange(stretches + 1) / parts
    return np.asarray(np.interp(places, np.arange(len(COARSE)), COARSE))


@dataclass(frozen=True)
class Travel:
    """Measured range of one actuator: stroke from `low` to `high` (m or rad), largest speed, largest pressures."""

    low: float
    high: float
    fastest: float
    highest: tuple[float, float]


def plausible_areas(actuator: Actuator, travel: Travel) -> tuple[float, float]:
    """Return typical areas of both sides of an actuator with unknown areas."""
    if isinstance(actuator, MotorElement):
        return (PLAUSIBLE_FLOW / max(travel.fastest, 1e-3),) * 2
    return PLAUSIBLE_AREAS


def load_size(actuator: Actuator, area: float) -> float:
    """Return the scale of the root of an actuator's inertia relative to a typical cylinder.

    A motor scales with its displacement.

    Inertia by the square of the area (or oil a radian) is what the oil carries, so that the root goes with the area.
    """
    return area / PLAUSIBLE_AREAS[0] if isinstance(actuator, MotorElement) else 1.0


def cylinder_numbers(name: str, travel: Travel, areas: tuple[float, float], declared: bool) -> list[Parameter]:
    """Return the parameters of a cylinder in the order of `parameter_index`; `declared`: its areas are given."""
    head, rod = areas
    length = travel.high - travel.low
    hard = 30.0 * head  # MN at the pressure of a main relief
    trust = 0.01 if declared else 0.5
    play = 0.01 * length
    rows = [
        ("head_area", "m^2", 1.0, head, trust),
        ("rod_area", "m^2", 1.0, rod, trust),
        ("head_dead_volume", "m^3", 1.0, 0.15 * head * length, 1.0),
        ("rod_dead_volume", "m^3", 1.0, 0.15 * head * length, 1.0),
        ("piston_leakage", "m^3/s/Pa", 1e-6, 1e-8, 2.0),
        ("spool_leakage", "m^3/s/Pa", 1e-6, 4e-9, 2.0),
        ("head_relief", "Pa", MEGA, max(travel.highest[0], 5.0), 0.2),
        ("rod_relief", "Pa", MEGA, max(travel.highest[1], 5.0), 0.2),
        ("cushion_length", "m", 1.0, 0.05 * length, 0.5),
        ("cushion_least", "1", 1.0, 0.1, 1.0),
        ("coulomb", "N", MEGA, 0.012 * hard, 1.0),
        ("static_less_coulomb", "N", MEGA, 0.006 * hard, 1.0),
        ("stribeck", "m/s", 1.0, 0.01, 1.0),
        ("viscous", "N s/m", MEGA, 0.03 * hard / max(travel.fastest, 0.01), 1.5),
        ("bristle_stiffness", "N/m", MEGA, 15.0 * head / 0.015, 1.0),
        ("bristle_damping", "N s/m", MEGA, 0.1 * head / 0.015, 1.0),
    ]
    numbers = [Parameter(name, label, unit, factor, start, width) for label, unit, factor, start, width in rows]
    numbers.append(Parameter(name, "stop_closed", "m", 1.0, travel.low + 0.4 * play, play, False))
    numbers.append(Parameter(name, "stop_open", "m", 1.0, travel.high - 0.4 * play, play, False))
    numbers.append(Parameter(name, "stop_stiffness", "N/m", MEGA, 100.0 * head / 0.015, 0.7))
    numbers.append(Parameter(name, "friction_asymmetry", "N", MEGA, 0.0, 0.005 * hard, False))
    return numbers


def motor_numbers(name: str, travel: Travel, areas: tuple[float, float], declared: bool) -> list[Parameter]:
    """Return the parameters of a motor in the order of a cylinder's.

    Speed-dependent where a cylinder's depend on stroke.
    """
    each, fastest = areas[0], max(travel.fastest, 1e-3)
    hard, flow = 30.0 * each, each * fastest  # MN m at the pressure of a main relief; m^3/s
    # Half a turn of its own oil, and a tenth of a second of its flow in the lines.
    volume = np.pi * each + 0.1 * flow
    rows = [
        ("displacement", "m^3/rad", 1.0, each, 0.01 if declared else 0.5),
        ("displacement_b", "m^3/rad", 1.0, each, 0.0),
        ("volume_a", "m^3", 1.0, volume, 1.0),
        ("volume_b", "m^3", 1.0, volume, 1.0),
        ("internal_leakage", "m^3/s/Pa", 1e-6, 1e-3 * flow, 2.0),
        ("external_leakage", "m^3/s/Pa", 1e-6, 5e-4 * flow, 2.0),
        ("relief_a", "Pa", MEGA, max(travel.highest[0], 5.0), 0.2),
        ("relief_b", "Pa", MEGA, max(travel.highest[1], 5.0), 0.2),
        ("cushion_length", "rad", 1.0, 1.0, 0.0),
        ("cushion_least", "1", 1.0, 1.0, 0.0),
        ("coulomb", "N m", MEGA, 0.012 * hard, 1.0),
        ("static_less_coulomb", "N m", MEGA, 0.006 * hard, 1.0),
        ("stribeck", "rad/s", 1.0, 0.02 * fastest, 1.0),
        ("viscous", "N m s/rad", MEGA, 0.03 * hard / fastest, 1.5),
        ("bristle_stiffness", "N m/rad", MEGA, 500.0 * each / fastest, 1.0),
        ("bristle_damping", "N m s/rad", MEGA, 3.0 * each / fastest, 1.0),
        ("stop_low", "rad", 1.0, NO_STOP, 0.0),
        ("stop_high", "rad", 1.0, -NO_STOP, 0.0),
        ("stop_stiffness", "N m/rad", MEGA, 0.0, 0.0),
    ]
    numbers = [
        Parameter(name, label, unit, factor, start, width, width > 0.0) for label, unit, factor, start, width in rows
    ]
    numbers[at.ROD_AREA] = replace(numbers[at.ROD_AREA], leader=at.ROD_AREA - at.HEAD_AREA)
    numbers.append(Parameter(name, "friction_asymmetry", "N m", MEGA, 0.0, 0.005 * hard, False))
    return numbers


def pump_numbers(name: str, flow: float, highest: float) -> list[Parameter]:
    """Return the parameters of a pump, from a plausible flow (m^3/s) and the highest pressure of its line (MPa)."""
    rows = [
        ("full_flow", "m^3/s", 1.0, flow, 0.5),
        ("least_displacement", "1", 1.0, 0.15, 0.7),
        ("lag", "s", 1.0, 0.07, 0.7),
        ("line_volume", "m^3", 1.0, 4e-3, 1.0),
        ("open_centre", "m^3/s/Pa^0.5", 1e-3, 1.2 * flow, 1.0),
        ("open_centre_closed_at", "1", 1.0, 0.35, 0.4),
        ("relief", "Pa", MEGA, max(highest / 1.1 * 0.96, 1.0), 0.1),
    ]
    return [Parameter(name, label, unit, factor, start, width) for label, unit, factor, start, width in rows]


def circuit_numbers(highest: float, flow: float) -> list[Parameter]:
    """Return the parameters common to all elements, from the highest pressure (MPa) and total pump flow (m^3/s)."""
    rows = [
        ("bulk_modulus", "Pa", MEGA, 1400.0, 0.3),
        ("air", "1", 1.0, 0.005, 0.7),
        ("tank", "Pa", MEGA, 0.2, 0.7),
        ("supply", "Pa", MEGA, max(highest, 1.0), 0.5),
        ("make_up", "m^3/s/Pa^0.5", 1e-3, 2.0 * flow, 1.0),
        ("port_relief_slope", "m^3/s/Pa", 1e-6, 1e-2, 1.0),
        ("relief_slope", "m^3/s/Pa", 1e-6, 2e-3, 1.0),
        ("power_limit", "W", MEGA, ACTING_LIMIT * flow * highest, 0.5),
        ("play", "1", 1.0, 0.01, 0.7),
        ("demand_start", "1", 1.0, 0.1, 0.3),
        ("demand_span", "1", 1.0, 0.75, 0.2),
    ]
    return [Parameter("circuit", label, unit, factor, start, width) for label, unit, factor, start, width in rows]


def valve_numbers(
    name: str,
    has: tuple[bool, bool],
    areas: tuple[float, float],
    travel: Travel,
    places: IntArray,
    first: int,
    knots: Array,
) -> list[Parameter]:
    """Return the parameters of a spool with opening curves between `knots`, and write their positions to `places`."""
    rows = [("dead_time", "s", 0.04, 0.5), ("pilot_lag", "s", 0.025, 0.5), ("spool_lag", "s", 0.02, 0.5)]
    numbers = [Parameter(name, label, unit, 1.0, start, width) for label, unit, start, width in rows]
    places[at.DELAY : at.BAND] = first + np.arange(3)
    linear, square = START_CURVE
    curve = np.diff(knots * (linear + square * knots))
    meter_out, regeneration = has
    for d, way in enumerate(("extend", "retract")):
        into, out = (areas[0], areas[1]) if d == 0 else (areas[1], areas[0])
        places[at.BAND + d], places[at.GAIN + d] = first + len(numbers), first + len(numbers) + 1
        numbers.append(Parameter(name, f"dead_band_{way}", "1", 1.0, 0.12, 0.4))
        numbers.append(Parameter(name, f"pump_demand_{way}", "1", 1.0, 0.9, 0.5))
        fed = [("into", at.INTO, into * travel.fastest / np.sqrt(2.0))]
        if meter_out:
            fed.append(("out_of", at.OUT_OF, out * travel.fastest / np.sqrt(1.5)))
        for label, column, area in fed:
            places[column + d] = first + len(numbers)
            numbers += [
                Parameter(name, f"{label}_{way}_{typed(100 * knots[k + 1], 6)}", "m^3/s/Pa^0.5", 1e-3, area * step, 1.0)
                for k, step in enumerate(curve)
            ]
        if meter_out and regeneration:
            places[at.REGENERATION + d] = first + len(numbers)
            numbers.append(Parameter(name, f"regeneration_{way}", "1", 1.0, 0.1, 2.0))
    return numbers
