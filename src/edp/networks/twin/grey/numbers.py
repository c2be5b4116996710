"""The numbers of a grey box: where each lies, what it means, its unit, and a plausible value to start from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations_with_replacement
from math import comb

import numpy as np
from numpy.typing import NDArray

from edp.errors import ConfigError
from edp.networks.twin.grey import layout as at
from edp.networks.twin.grey.elements import Elements

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
KNOTS = np.array([0.0, 0.1, 0.25, 0.45, 0.7, 1.0])
"""Of the opening curves, as shares of the spool's travel behind the dead band: denser where levers are finer."""
MEGA, LITRE = 1e6, 1e3
MOST_OF_LOAD = 5_000
"""Numbers of a load: a fit holds their matrix, 200 MB of it."""
LEFT_OUT = {
    "power_limit": {"power_limit": 1e6},
    "cushions": {"cushion_length": 1.0, "cushion_least": 1.0},
    "play": {"play": 0.0},
}
"""What can be left out of the equations: its numbers, and where they do nothing (1 TW, whole outflow, no width)."""
START_CURVE = (0.25, 0.75)
"""Linear and quadratic share of the opening that a curve starts from: fine control near closed, as spools are cut."""


@dataclass(frozen=True)
class GreyNumber:
    """One number of a grey box.

    Attributes:
        element: that it belongs to.
        name: what it is.
        unit: SI; of the value times `factor`.
        factor: from the units of the grey box to SI.
        nominal: where a fit starts, in units of the grey box.
        width: plausible deviation: of the logarithm where `positive`, else in units of the grey box; 0: not fitted.
        positive: whether it is fitted by its logarithm.
    """

    element: str
    name: str
    unit: str
    factor: float
    nominal: float
    width: float = 1.0
    positive: bool = True

    @property
    def label(self) -> str:
        """Element and name."""
        return f"{self.element}.{self.name}"


@dataclass(frozen=True)
class Travel:
    """What the data say of one cylinder: stroke from `low` to `high` (m), fastest speed (m/s), highest pressures."""

    low: float
    high: float
    fastest: float
    highest: tuple[float, float]


@dataclass(frozen=True, eq=False)
class NumberTable:
    """All numbers in order, and where those of each element begin."""

    numbers: tuple[GreyNumber, ...]
    valve_at: IntArray
    actuator_at: IntArray
    pump_at: IntArray
    circuit_at: int
    inertia_at: int
    inertia_terms: int
    potential_at: int
    exponents: IntArray

    @property
    def places(self) -> tuple[int, int, int, int]:
        """As compiled code reads them."""
        return self.inertia_at, self.inertia_terms, self.potential_at, self.circuit_at

    @property
    def positive(self) -> NDArray[np.bool_]:
        """Which are fitted by their logarithm."""
        return np.array([number.positive for number in self.numbers])

    @property
    def nominal(self) -> Array:
        """Where a fit starts."""
        return np.array([number.nominal for number in self.numbers])

    @property
    def width(self) -> Array:
        """Plausible deviations."""
        return np.array([number.width for number in self.numbers])

    def values(self, theta: Array) -> Array:
        """Numbers from coordinates of a fit, in which the nominal is 0."""
        grown = self.nominal * np.exp(np.clip(theta, -12.0, 12.0))
        return np.where(self.positive, grown, self.nominal + self.width * theta)

    def slope(self, values: Array) -> Array:
        """Derivative of the numbers by the coordinates."""
        return np.where(self.positive, values, self.width)


def monomials(variables: int, degree: int) -> IntArray:
    """Exponents of all monomials up to a degree, the lower ones first ``(term, variable)``."""
    chosen = [which for total in range(degree + 1) for which in combinations_with_replacement(range(variables), total)]
    return np.array([[which.count(variable) for variable in range(variables)] for which in chosen], dtype=np.int64)


def number_table(
    elements: Elements,
    travels: Sequence[Travel],
    highest_pump: Sequence[float],
    degrees: tuple[int, int],
    left_out: Sequence[str] = (),
) -> NumberTable:
    """Numbers of connected elements, with starting values from what the data show.

    Args:
        elements: connected.
        travels: of each cylinder.
        highest_pump: highest pressure of each pump's line, MPa.
        degrees: of the polynomials of L and of U.
        left_out: keys of `LEFT_OUT`.

    Raises:
        ConfigError: the load would have more numbers than can be fitted.
    """
    _check_load(len(elements.cylinders), degrees)
    numbers: list[GreyNumber] = []
    actuator_at, areas = [], []
    for cylinder, travel in zip(elements.cylinders, travels, strict=True):
        actuator_at.append(len(numbers))
        areas.append(cylinder.areas or (0.015, 0.008))
        numbers += _cylinder(cylinder.name, travel, areas[-1], cylinder.areas is not None)
    flows = [a[0] * t.fastest for a, t in zip(areas, travels, strict=True)]
    pump_at = []
    for pump, highest in zip(elements.pumps, highest_pump, strict=True):
        pump_at.append(len(numbers))
        numbers += _pump(pump.name, 0.6 * float(np.mean(flows)), highest)
    circuit_at = len(numbers)
    numbers += _circuit(max([*highest_pump, *(max(t.highest) for t in travels)]), 0.6 * sum(flows))
    names = [cylinder.name for cylinder in elements.cylinders]
    valve_at = np.full((len(elements.valves), at.VALVE_PLACES), -1, np.int64)
    for j, valve in enumerate(elements.valves):
        i = names.index(valve.actuator)
        numbers += _valve(
            valve.name, (valve.meter_out, valve.regeneration), areas[i], travels[i], valve_at[j], len(numbers)
        )
    n = len(names)
    exponents = monomials(n, max(degrees))
    inertia_terms = int((exponents.sum(axis=1) <= degrees[0]).sum())
    inertia_at = len(numbers)
    for a in range(n):
        for c in range(a + 1):
            for b in range(inertia_terms):
                # 10 t on the diagonal: a start for where nothing is measured.
                start = 0.1 if a == c and b == 0 else 0.0
                label = f"inertia_root_{names[a]}_{names[c]}_{_power(exponents[b])}"
                numbers.append(GreyNumber("load", label, "kg^0.5", 1e3, start, 0.05, False))
    potential_at = len(numbers)
    for b in range(1, len(exponents)):
        numbers.append(GreyNumber("load", f"potential_{_power(exponents[b])}", "J", MEGA, 0.0, 0.03, False))
    neutral = {name: value for part in left_out for name, value in LEFT_OUT[part].items()}
    every = tuple(_fixed(number, neutral[number.name]) if number.name in neutral else number for number in numbers)
    return NumberTable(
        every, valve_at, np.array(actuator_at), np.array(pump_at, dtype=np.int64), circuit_at, inertia_at,
        inertia_terms, potential_at, exponents,
    )  # fmt: skip


def _check_load(actuators: int, degrees: tuple[int, int]) -> None:
    """Refuse a load before its numbers are made: they grow with a power of the actuators."""
    entries = actuators * (actuators + 1) // 2
    count = entries * comb(actuators + degrees[0], actuators) + comb(actuators + max(degrees), actuators)
    if count > MOST_OF_LOAD:
        raise ConfigError(
            f"grey box: the load of {actuators} cylinders with inertia_degree = {degrees[0]} and potential_degree = "
            f"{degrees[1]} has {count:,} numbers; at most {MOST_OF_LOAD:,} must hold: lower the degrees"
        )


def _fixed(number: GreyNumber, value: float) -> GreyNumber:
    """The number at a value that a fit leaves alone."""
    return replace(number, nominal=value, width=0.0, positive=False)


def _power(exponent: IntArray) -> str:
    return "".join(str(int(e)) for e in exponent)


def _cylinder(name: str, travel: Travel, areas: tuple[float, float], declared: bool) -> list[GreyNumber]:
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
    numbers = [GreyNumber(name, label, unit, factor, start, width) for label, unit, factor, start, width in rows]
    numbers.append(GreyNumber(name, "stop_closed", "m", 1.0, travel.low + 0.4 * play, play, False))
    numbers.append(GreyNumber(name, "stop_open", "m", 1.0, travel.high - 0.4 * play, play, False))
    numbers.append(GreyNumber(name, "stop_stiffness", "N/m", MEGA, 100.0 * head / 0.015, 0.7))
    numbers.append(GreyNumber(name, "friction_asymmetry", "N", MEGA, 0.0, 0.005 * hard, False))
    return numbers


def _pump(name: str, flow: float, highest: float) -> list[GreyNumber]:
    rows = [
        ("full_flow", "m^3/s", 1.0, flow, 0.5),
        ("least_displacement", "1", 1.0, 0.15, 0.7),
        ("lag", "s", 1.0, 0.07, 0.7),
        ("line_volume", "m^3", 1.0, 4e-3, 1.0),
        ("open_centre", "m^3/s/Pa^0.5", 1e-3, 1.2 * flow, 1.0),
        ("open_centre_closed_at", "1", 1.0, 0.35, 0.4),
        ("relief", "Pa", MEGA, max(highest / 1.1 * 0.96, 1.0), 0.1),
    ]
    return [GreyNumber(name, label, unit, factor, start, width) for label, unit, factor, start, width in rows]


def _circuit(highest: float, flow: float) -> list[GreyNumber]:
    rows = [
        ("bulk_modulus", "Pa", MEGA, 1400.0, 0.3),
        ("air", "1", 1.0, 0.005, 0.7),
        ("tank", "Pa", MEGA, 0.2, 0.7),
        ("supply", "Pa", MEGA, max(highest, 1.0), 0.5),
        ("make_up", "m^3/s/Pa^0.5", 1e-3, 2.0 * flow, 1.0),
        ("port_relief_slope", "m^3/s/Pa", 1e-6, 1e-2, 1.0),
        ("relief_slope", "m^3/s/Pa", 1e-6, 2e-3, 1.0),
        ("power_limit", "W", MEGA, 0.6 * flow * highest, 0.5),
        ("play", "1", 1.0, 0.01, 0.7),
        ("demand_start", "1", 1.0, 0.1, 0.3),
        ("demand_span", "1", 1.0, 0.75, 0.2),
    ]
    return [GreyNumber("circuit", label, unit, factor, start, width) for label, unit, factor, start, width in rows]


def _valve(
    name: str,
    has: tuple[bool, bool],
    areas: tuple[float, float],
    travel: Travel,
    places: IntArray,
    first: int,
) -> list[GreyNumber]:
    """Numbers of a spool; `places` is filled in."""
    rows = [("dead_time", "s", 0.04, 0.5), ("pilot_lag", "s", 0.025, 0.5), ("spool_lag", "s", 0.02, 0.5)]
    numbers = [GreyNumber(name, label, unit, 1.0, start, width) for label, unit, start, width in rows]
    places[at.DELAY : at.BAND] = first + np.arange(3)
    linear, square = START_CURVE
    curve = np.diff(KNOTS * (linear + square * KNOTS))
    meter_out, regeneration = has
    for d, way in enumerate(("extend", "retract")):
        into, out = (areas[0], areas[1]) if d == 0 else (areas[1], areas[0])
        places[at.BAND + d], places[at.GAIN + d] = first + len(numbers), first + len(numbers) + 1
        numbers.append(GreyNumber(name, f"dead_band_{way}", "1", 1.0, 0.12, 0.4))
        numbers.append(GreyNumber(name, f"pump_demand_{way}", "1", 1.0, 0.9, 0.5))
        fed = [("into", at.INTO, into * travel.fastest / np.sqrt(2.0))]
        if meter_out:
            fed.append(("out_of", at.OUT_OF, out * travel.fastest / np.sqrt(1.5)))
        for label, column, area in fed:
            places[column + d] = first + len(numbers)
            numbers += [
                GreyNumber(name, f"{label}_{way}_{100 * KNOTS[k + 1]:.0f}", "m^3/s/Pa^0.5", 1e-3, area * step, 1.0)
                for k, step in enumerate(curve)
            ]
        if meter_out and regeneration:
            places[at.REGENERATION + d] = first + len(numbers)
            numbers.append(GreyNumber(name, f"regeneration_{way}", "1", 1.0, 0.1, 2.0))
    return numbers
