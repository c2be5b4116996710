"""Parameters of a grey box: position, meaning, unit and typical initial value."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations_with_replacement
from math import comb

import numpy as np
from numpy.typing import NDArray

from edp.errors import ConfigError
from edp.networks.twin.grey import parameter_index as at
from edp.networks.twin.grey.elements import Actuator, Elements, MotorElement
from edp.networks.twin.grey.known_linkage import KnownLinkage
from edp.networks.twin.grey.priors import (
    MEGA,
    STRETCHES,
    Travel,
    circuit_numbers,
    cylinder_numbers,
    load_size,
    motor_numbers,
    opening_knots,
    plausible_areas,
    pump_numbers,
    valve_numbers,
)
from edp.networks.twin.parameters import Parameter, Priors

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
MAX_ACTUATORS, MAX_VALVES = 12, 48
"""Maximum number of actuators and of valves. The equations are compiled, which takes seconds and a gigabyte of memory
at these sizes."""
MAX_OF_LOAD = 5_000
"""Maximum number of load parameters. The matrix of a fit needs 200 MB at this number."""
LEFT_OUT = {
    "power_limit": {"power_limit": 1e6},
    "cushions": {"cushion_length": 1.0, "cushion_least": 1.0},
    "play": {"play": 0.0},
}
"""Optional parts of the equations, each with the parameter values that disable the part (1 TW, full outflow, zero
width)."""


@dataclass(frozen=True, eq=False)
class ParameterTable:
    """All parameters in order, and the position of each element's first one.

    With a known linkage `inertia_at` is the place of the first body's, and the load has no terms.
    """

    numbers: tuple[Parameter, ...]
    valve_at: IntArray
    actuator_at: IntArray
    pump_at: IntArray
    circuit_at: int
    inertia_at: int
    inertia_terms: int
    potential_at: int
    exponents: IntArray
    front: KnownLinkage | None = None
    stretches: int = STRETCHES[0]

    @cached_property
    def knots(self) -> Array:
        """Knots of all opening curves ``(stretches + 1,)``."""
        return opening_knots(self.stretches)

    @property
    def is_in_curves(self) -> NDArray[np.bool_]:
        """Mask of the parameters that are increments of an opening curve."""
        inside = np.zeros(len(self.numbers), np.bool_)
        for first in self.valve_at[:, at.INTO : at.REGENERATION].ravel():
            if first >= 0:
                inside[first : first + self.stretches] = True
        return inside

    @property
    def linkage(self) -> Array:
        """Linkage values in the order of `parameter_index`; empty if the load is a polynomial of the strokes."""
        return np.zeros(0) if self.front is None else self.front.values

    @property
    def places(self) -> tuple[int, int, int, int]:
        """Positions as read by compiled code."""
        return self.inertia_at, self.inertia_terms, self.potential_at, self.circuit_at

    @cached_property
    def priors(self) -> Priors:
        """Priors about the nominal values, cached, since a fit reads them thousands of times."""
        return Priors.from_parameters(self.numbers)

    @cached_property
    def factor(self) -> Array:
        """Value of one unit of each parameter in SI units."""
        return np.array([number.factor for number in self.numbers])

    @property
    def positive(self) -> NDArray[np.bool_]:
        """Mask of the parameters fitted by their logarithm."""
        return self.priors.positive

    @property
    def nominal(self) -> Array:
        """Initial values of a fit, a copy."""
        return self.priors.origin.copy()

    @property
    def width(self) -> Array:
        """Prior standard deviations."""
        return self.priors.width


def monomials(variables: int, degree: int) -> IntArray:
    """Return the exponents of all monomials up to a degree, the lower ones first ``(term, variable)``."""
    chosen = [which for total in range(degree + 1) for which in combinations_with_replacement(range(variables), total)]
    return np.array([[which.count(variable) for variable in range(variables)] for which in chosen], dtype=np.int64)


def number_table(
    elements: Elements,
    travels: Sequence[Travel],
    highest_pump: Sequence[float],
    degrees: tuple[int, int],
    left_out: Sequence[str] = (),
    front: KnownLinkage | None = None,
    stretches: int = STRETCHES[0],
) -> ParameterTable:
    """Return the parameters of connected elements, with initial values from the data.

    Args:
        elements: connected elements.
        travels: travel of each cylinder.
        highest_pump: highest pressure of each pump's line, MPa.
        degrees: degrees of the load polynomials L and U.
        left_out: keys of `LEFT_OUT`.
        front: linkage whose bodies are the load; None: polynomials.
        stretches: number of segments of each opening curve, one of `STRETCHES`.

    Raises:
        ConfigError: the load would have more numbers than can be fitted.
    """
    degrees = degrees if front is None else (0, 0)
    _check_size(elements, degrees)
    numbers: list[Parameter] = []
    actuator_at, areas = [], []
    for actuator, travel in zip(elements.actuators, travels, strict=True):
        actuator_at.append(len(numbers))
        areas.append(actuator.areas or plausible_areas(actuator, travel))
        of_kind = motor_numbers if isinstance(actuator, MotorElement) else cylinder_numbers
        numbers += of_kind(actuator.name, travel, areas[-1], actuator.areas is not None)
    flows = [a[0] * t.fastest for a, t in zip(areas, travels, strict=True)]
    pump_at = []
    for pump, highest in zip(elements.pumps, highest_pump, strict=True):
        pump_at.append(len(numbers))
        numbers += pump_numbers(pump.name, 0.6 * float(np.mean(flows)), highest)
    circuit_at = len(numbers)
    numbers += circuit_numbers(max([*highest_pump, *(max(t.highest) for t in travels)]), 0.6 * sum(flows))
    names, knots = [actuator.name for actuator in elements.actuators], opening_knots(stretches)
    valve_at = np.full((len(elements.valves), at.VALVE_PLACES), -1, np.int64)
    for j, valve in enumerate(elements.valves):
        i = names.index(valve.actuator)
        numbers += valve_numbers(
            valve.name, (valve.meter_out, valve.regeneration), areas[i], travels[i], valve_at[j], len(numbers), knots
        )
    inertia_at = len(numbers)
    exponents = _load_exponents(elements, max(degrees))
    inertia_terms = int((exponents.sum(axis=1) <= degrees[0]).sum()) if front is None else 0
    sizes = [area[0] for area in areas]
    numbers += _inertia(elements.actuators, sizes, exponents[:inertia_terms]) if front is None else front.numbers()
    potential_at = len(numbers)
    numbers += _potential(elements.actuators, sizes, travels, exponents)
    neutral = {name: value for part in left_out for name, value in LEFT_OUT[part].items()}
    every = tuple(
        _fix_parameter(number, neutral[number.name]) if number.name in neutral else number for number in numbers
    )
    return ParameterTable(
        every, valve_at, np.array(actuator_at), np.array(pump_at, dtype=np.int64), circuit_at, inertia_at,
        inertia_terms, potential_at, exponents, front, stretches,
    )  # fmt: skip


def finer_values(coarse: ParameterTable, values: Array, fine: ParameterTable) -> Array:
    """Return the parameters of the same machine with subdivided opening curves of unchanged shape."""
    parts = fine.stretches // coarse.stretches
    divided, result = coarse.is_in_curves, np.empty(len(fine.numbers))
    # Curves, and what is no curve, have the same order in both tables.
    result[fine.is_in_curves] = np.repeat(values[divided] / parts, parts)
    result[~fine.is_in_curves] = values[~divided]
    return result


def coarse_by_fine(coarse: ParameterTable, fine: ParameterTable) -> Array:
    """Return derivatives of coarse coordinates by fine ones with equal curves ``(coarse, fine)``.

    Subdivided increments grow together.
    """
    parts = fine.stretches // coarse.stretches
    slopes, divided = np.zeros((len(coarse.numbers), len(fine.numbers))), coarse.is_in_curves
    slopes[np.repeat(np.flatnonzero(divided), parts), np.flatnonzero(fine.is_in_curves)] = 1.0 / parts
    slopes[np.flatnonzero(~divided), np.flatnonzero(~fine.is_in_curves)] = 1.0
    return slopes


def _check_size(elements: Elements, degrees: tuple[int, int]) -> None:
    """Raise ConfigError if the elements or the parameters of the polynomial load model are too many."""
    actuators, variables = len(elements.actuators), len(elements.load_variables)
    if actuators > MAX_ACTUATORS or len(elements.valves) > MAX_VALVES:
        raise ConfigError(
            f"grey box: got {actuators:,} cylinders and motors and {len(elements.valves):,} valves, expected at most "
            f"{MAX_ACTUATORS} and {MAX_VALVES}; leave channels out of [channels], or choose another twin.kind"
        )
    entries = actuators * (actuators + 1) // 2
    count = entries * comb(variables + degrees[0], variables) + comb(variables + max(degrees), variables)
    if count > MAX_OF_LOAD:
        motors = f" and {len(elements.motors)} motors" if elements.motors else ""
        raise ConfigError(
            f"grey box: the load of {len(elements.cylinders)} cylinders{motors} with inertia_degree = {degrees[0]} and "
            f"potential_degree = {degrees[1]} has {count:,} numbers; at most {MAX_OF_LOAD:,} must hold: lower the "
            "degrees"
        )


def _load_exponents(elements: Elements, degree: int) -> IntArray:
    """Return the exponents of the load's monomials ``(term, actuator)``: zero for motors not affecting the load."""
    variables = elements.load_variables
    own = monomials(len(variables), degree)
    exponents = np.zeros((len(own), len(elements.actuators)), np.int64)
    exponents[:, list(variables)] = own
    return exponents


def _inertia(actuators: Sequence[Actuator], areas: Sequence[float], exponents: IntArray) -> list[Parameter]:
    """Return the coefficients of the root of the inertia, row by row."""
    numbers = []
    for a, actuator in enumerate(actuators):
        size = load_size(actuator, areas[a])
        unit = "kg^0.5 m" if isinstance(actuator, MotorElement) else "kg^0.5"
        for c in range(a + 1):
            for b, exponent in enumerate(exponents):
                # Start with 10 t on the diagonal of a cylinder if there is no measurement.
                start = 0.1 * size if a == c and b == 0 else 0.0
                label = f"inertia_root_{actuator.name}_{actuators[c].name}_{_power(exponent)}"
                numbers.append(Parameter("load", label, unit, 1e3, start, 0.05 * size, False))
    return numbers


def _potential(
    actuators: Sequence[Actuator], areas: Sequence[float], travels: Sequence[Travel], exponents: IntArray
) -> list[Parameter]:
    """Return the coefficients of the potential without the constant one."""
    # Work of a motor's oil over half of its angle, where a cylinder has 30 kJ.
    sizes = [
        load_size(one, area) * (0.5 * (travel.high - travel.low) if isinstance(one, MotorElement) else 1.0)
        for one, area, travel in zip(actuators, areas, travels, strict=True)
    ]
    return [
        Parameter(
            "load", f"potential_{_power(exponent)}", "J", MEGA, 0.0,
            0.03 * max(size for size, power in zip(sizes, exponent, strict=True) if power), False,
        )
        for exponent in exponents[1:]
    ]  # fmt: skip


def _fix_parameter(number: Parameter, value: float) -> Parameter:
    """Return the parameter fixed at a value."""
    return replace(number, nominal=value, width=0.0, positive=False)


def _power(exponent: IntArray) -> str:
    return "".join(str(int(e)) for e in exponent)
