"""Requirements on a machine before simulation; every message names file, key, value and bound."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields, is_dataclass
from typing import Any

import numpy as np

from edp.errors import ConfigError
from edp.settings.bounds import MIN_POSITIVE
from edp.settings.tree import SettingsTree
from edp.sim.machine import layout as at
from edp.sim.machine import option_checks
from edp.sim.machine.machine import Machine, Rating, Ratings, Triple
from edp.sim.machine.option_checks import CYLINDERS as CYLINDERS
from edp.sim.machine.parameters import FLOW_SHARING, pack
from edp.sim.physics import linkage
from edp.wording import setting_text, typed

MACHINE_FILE = SettingsTree(what="machine file", positions={Triple: CYLINDERS, Ratings: CYLINDERS})
BEYOND_STOPS = math.radians(4.0)
"""Angle beyond its stops at which a joint must still have a lever arm, rad, since impacts can push the joint there."""
MIN_LEVER = 0.08
"""Minimum lever arm |dx/dpsi| (m/rad) as a fraction of the stroke (m). With a smaller arm, an impact can turn the
linkage over."""


LARGEST = 1e15
"""Maximum magnitude of a machine parameter. Bristle stiffness and bulk modulus are of the order of 1e9."""


@dataclass(frozen=True)
class ParameterBound:
    """Limits of a parameter; `above` makes the lower limit strict and refuses values below `MIN_POSITIVE`."""

    low: float = -LARGEST
    high: float = LARGEST
    above: bool = False
    integer: bool = False

    def holds(self, value: float) -> bool:
        """Return whether the value is within the bound."""
        fits = (value > self.low if self.above else value >= self.low) and value <= self.high
        if self.above and self.low == 0.0 and value < MIN_POSITIVE:
            return False
        return fits and (not self.integer or value == int(value))

    def __str__(self) -> str:
        text = "an integer " if self.integer else ""
        if self.high == LARGEST:
            return f"{text}{'above' if self.above else 'at least'} {typed(self.low)} and at most {typed(self.high)}"
        low = f"above {typed(self.low)} and at most" if self.above else f"from {typed(self.low)} to"
        return f"{text}{low} {typed(self.high)}"


ANY = ParameterBound()
POSITIVE, NOT_NEGATIVE = ParameterBound(0.0, above=True), ParameterBound(0.0)
SHARE, SOME_SHARE, DEAD = ParameterBound(0.0, 1.0), ParameterBound(0.0, 1.0, above=True), ParameterBound(0.0, 0.9)
PUMP = ParameterBound(1.0, 2.0, integer=True)
LENGTH, SMALL = ParameterBound(0.0, 30.0, above=True), ParameterBound(0.0, 1.0, above=True)
FREQUENCY = ParameterBound(0.0, 500.0, above=True)
SECTIONS_OF_MOTORS = ("swing", "travel")
_MOTOR: Mapping[str, ParameterBound] = {
    "pump": PUMP,
    "displacement": SMALL,
    "inertia": POSITIVE,
    "volume": ParameterBound(1e-5, 0.1),
    "leakage": NOT_NEGATIVE,
    "drain_leakage": NOT_NEGATIVE,
    "coulomb": NOT_NEGATIVE,
    "viscous": NOT_NEGATIVE,
    "brake": NOT_NEGATIVE,
    "brake_delay": ParameterBound(0.0, 60.0),
    "relief": POSITIVE,
    "relief_slope": POSITIVE,
    "pilot_frequency": FREQUENCY,
    "spool_frequency": FREQUENCY,
    "dead_time": ParameterBound(0.0, 2.0),
    "dead_band": DEAD,
    "pump_demand": SHARE,
    "boom_foot_ahead": ParameterBound(-5.0, 5.0),
}
BOUNDS: Mapping[str, ParameterBound] = {
    "gravity": POSITIVE,
    "bodies.length": LENGTH,
    "bodies.mass": POSITIVE,
    "bodies.inertia": POSITIVE,
    "boom_cylinder.base_radius": LENGTH,
    "boom_cylinder.rod_radius": LENGTH,
    "boom_cylinder.offset_deg": ParameterBound(-360.0, 360.0),
    "boom_cylinder.closed_length": LENGTH,
    "arm_cylinder.base_radius": LENGTH,
    "arm_cylinder.rod_radius": LENGTH,
    "arm_cylinder.offset_deg": ParameterBound(-360.0, 360.0),
    "arm_cylinder.closed_length": LENGTH,
    "bucket_linkage.pivot_to_pin": LENGTH,
    "bucket_linkage.rocker": LENGTH,
    "bucket_linkage.link": LENGTH,
    "bucket_linkage.lug": LENGTH,
    "bucket_linkage.lug_angle": ParameterBound(-2 * math.pi, 2 * math.pi),
    "bucket_linkage.closed_length": LENGTH,
    "cylinders.count": ParameterBound(1.0, 4.0, integer=True),
    "cylinders.bore": SMALL,
    "cylinders.rod": SMALL,
    "cylinders.stroke": LENGTH,
    "cylinders.hose_volume": ParameterBound(0.0, 0.1),
    "cylinders.dead_length": SMALL,
    "cylinders.cushion_length": SMALL,
    "cylinders.cushion_area": SOME_SHARE,
    "cylinders.stop_stiffness": POSITIVE,
    "cylinders.stop_damping": NOT_NEGATIVE,
    "cylinders.piston_leakage": NOT_NEGATIVE,
    "cylinders.spool_leakage": NOT_NEGATIVE,
    "cylinders.line_bore": ParameterBound(0.0, 0.2),
    "cylinders.line_modulus": NOT_NEGATIVE,
    "friction.coulomb_fraction": SOME_SHARE,
    "friction.static_fraction": SOME_SHARE,
    "friction.viscous": NOT_NEGATIVE,
    "friction.stribeck_velocity": POSITIVE,
    "friction.bristle_stiffness": POSITIVE,
    "friction.bristle_damping": NOT_NEGATIVE,
    "oil.bulk_modulus": POSITIVE,
    "oil.air_fraction": ParameterBound(0.0, 0.2),
    "oil.viscosity": SMALL,
    "oil.temperature": ParameterBound(-40.0, 120.0),
    "oil.tank_pressure": NOT_NEGATIVE,
    "oil.heat_capacity": POSITIVE,
    "oil.cooling": NOT_NEGATIVE,
    "oil.ambient": ParameterBound(-60.0, 80.0),
    "pumps.max_flow": SMALL,
    "pumps.volumetric_efficiency": SOME_SHARE,
    "pumps.power_limit": POSITIVE,
    "pumps.min_displacement": SHARE,
    "pumps.time_constant": POSITIVE,
    "pumps.line_volume": SMALL,
    "pumps.relief": POSITIVE,
    "pumps.relief_slope": POSITIVE,
    "pumps.bypass_closed_at": SOME_SHARE,
    "pumps.engine_droop": ParameterBound(0.0, 0.5),
    "pumps.engine_power": NOT_NEGATIVE,
    "pumps.engine_inertia": ParameterBound(0.0, 1e4),
    "pumps.engine_speed_rpm": ParameterBound(0.0, 1e4),
    "pumps.load_margin": ParameterBound(0.0, 1e7),
    "valves.pilot_pressure": POSITIVE,
    "valves.pilot_frequency": FREQUENCY,
    "valves.spool_frequency": FREQUENCY,
    "valves.conflux_spool_frequency": FREQUENCY,
    "valves.dead_time": ParameterBound(0.0, 2.0),
    "valves.conflux_extra_dead_time": ParameterBound(0.0, 2.0),
    "valves.dead_band_extend": DEAD,
    "valves.dead_band_retract": DEAD,
    "valves.conflux_dead_band_extend": DEAD,
    "valves.conflux_dead_band_retract": DEAD,
    "valves.hysteresis": ParameterBound(0.0, 0.5),
    "valves.lever_dead_zone": DEAD,
    "valves.conflux_start": DEAD,
    "valves.conflux_extend": SHARE,
    "valves.conflux_retract": SHARE,
    "valves.pump_demand_extend": SHARE,
    "valves.pump_demand_retract": SHARE,
    "valves.primary_pump": PUMP,
    "valves.conflux_pump": PUMP,
    "valves.check_leakage": SHARE,
    "valves.port_relief_head": POSITIVE,
    "valves.port_relief_rod": POSITIVE,
    "valves.port_relief_slope": POSITIVE,
    "valves.compensator_drop": ParameterBound(0.0, 1e7),
    "bucket.width": LENGTH,
    "bucket.capacity": ParameterBound(0.0, 100.0, above=True),
    "bucket.floor_angle_deg": ParameterBound(-180.0, 180.0),
    "bucket.floor_length": LENGTH,
    "bucket.edge_area": SMALL,
    "chassis.boom_foot_height": ParameterBound(-5.0, 30.0),
    "chassis.pitch_inertia": POSITIVE,
    "chassis.pitch_frequency": FREQUENCY,
    "chassis.pitch_damping": ParameterBound(0.0, 2.0),
    "chassis.lift_moment": POSITIVE,
    "sensors.velocity": NOT_NEGATIVE,
    "sensors.pressure": NOT_NEGATIVE,
    "sensors.acceleration_bandwidth": POSITIVE,
    "sensors.joint_rate_deg": NOT_NEGATIVE,
    "sensors.joint_bias_walk_deg": NOT_NEGATIVE,
    "sensors.angle_quantum_deg": NOT_NEGATIVE,
    "sensors.pin_backlash": ParameterBound(0.0, 0.1),
    "sensors.pressure_range": NOT_NEGATIVE,
    "sensors.pressure_offset": SHARE,
    "sensors.pressure_bits": ParameterBound(0.0, 32.0, integer=True),
    "sensors.pressure_lag": ParameterBound(0.0, 10.0),
    "sensors.pressure_drift": SHARE,
    "sensors.can_period": ParameterBound(0.0, 10.0),
    "sensors.can_latency": ParameterBound(0.0, 10.0),
    "sensors.can_jitter": ParameterBound(0.0, 10.0),
    "sensors.can_loss": SHARE,
    "sensors.instance_seed": ParameterBound(0.0, 2.0**63, integer=True),
    **{f"{section}.{key}": bound for section in SECTIONS_OF_MOTORS for key, bound in _MOTOR.items()},
}
"""Bounds of machine parameters by ``section.key``. A parameter without an entry must be finite."""
WORDS: Mapping[str, tuple[str, ...]] = {"flow_sharing": FLOW_SHARING, "pressure_at": ("cylinder", "valve")}
"""Accepted words by key, for machine keys with a word as value."""
FLOWING = ("meter_in_extend", "meter_in_retract", "meter_out_extend", "meter_out_retract", "meter_in", "meter_out")
"""Rated flows that must be positive, because a cylinder or a motor could not move without them."""


def check_machine(machine: Machine, where: str) -> None:
    """Refuse a machine that cannot be simulated.

    Raises:
        ConfigError: a value is out of bounds, or the linkage is impossible.
    """
    for section, key, kind, value in _leaves(machine):
        where_key = f"machine file {where}{f' [{section}]' if section else ''}: {key}"
        if kind in ("Rating", "Ratings"):
            _check_ratings(value, key, where_key)
        elif kind == "str":
            if value not in WORDS.get(key, (value,)):
                raise ConfigError(f"{where_key} = {value!r} must be one of {', '.join(WORDS[key])}")
        else:
            _check_numbers(value, BOUNDS.get(f"{section}.{key}" if section else key, ANY), where_key)
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_-]*", machine.name):
        raise ConfigError(
            f"machine file {where}: name = {machine.name!r} must be letters, digits, - and _: recordings carry it"
        )
    _check_pairs(machine, where)
    axes, plant = pack(machine)
    for axis in range(2):
        _check_triangle(axis, axes, plant, where)
    _check_bucket(axes, plant, where)


def _leaves(machine: Machine) -> Iterator[tuple[str, str, str, Any]]:
    for field in fields(machine):
        value = getattr(machine, field.name)
        if is_dataclass(value):
            for inner in fields(value):
                yield field.name, inner.name, str(inner.type), getattr(value, inner.name)
        elif value is not None:
            yield "", field.name, str(field.type), value


def _check_numbers(value: float | tuple[float, ...], bound: ParameterBound, where_key: str) -> None:
    """Check a number, or every number of a list."""
    if isinstance(value, tuple):
        labels = CYLINDERS if len(value) == len(CYLINDERS) else range(len(value))
        for label, entry in zip(labels, value, strict=True):
            _check_number(entry, bound, f"{where_key}[{label}]")
    else:
        _check_number(value, bound, where_key)


def _check_number(value: float, bound: ParameterBound, where_key: str) -> None:
    if not math.isfinite(value) or not bound.holds(value):
        raise ConfigError(
            f"{where_key} = {value!r} must be {bound if math.isfinite(value) or bound is not ANY else 'finite'}"
        )


def _check_ratings(value: Rating | Ratings, key: str, where_key: str) -> None:
    """Check one rating, or one per cylinder."""
    if isinstance(value[0], tuple):
        for name, rating in zip(CYLINDERS, value, strict=True):
            _check_ratings(rating, key, f"{where_key}[{name}]")
        return
    flow, pressure = value
    _check_number(flow, POSITIVE if key in FLOWING else NOT_NEGATIVE, f"{where_key}, flow in L/min,")
    _check_number(pressure, POSITIVE, f"{where_key}, pressure in bar,")


def _check_pairs(machine: Machine, where: str) -> None:
    """Check bounds that depend on another value."""
    cylinders, friction = machine.cylinders, machine.friction
    for i, name in enumerate(CYLINDERS):
        if cylinders.rod[i] >= cylinders.bore[i]:
            raise ConfigError(
                f"machine file {where} [cylinders]: rod[{name}] = {cylinders.rod[i]!r} m must be below "
                f"bore[{name}] = {cylinders.bore[i]!r} m"
            )
        if 2.0 * cylinders.cushion_length[i] > cylinders.stroke[i]:
            raise ConfigError(
                f"machine file {where} [cylinders]: cushion_length[{name}] = {cylinders.cushion_length[i]!r} m must be "
                f"at most half of stroke[{name}] = {cylinders.stroke[i]!r} m"
            )
    option_checks.check_engine(machine, where)
    option_checks.check_load_sensing(machine, where)
    option_checks.check_lines(machine, where)
    option_checks.check_motors(machine, where)
    for key, (low, high) in (
        ("pressure_offset", machine.sensors.pressure_offset),
        ("can_latency", machine.sensors.can_latency),
    ):
        if low > high:
            raise ConfigError(
                f"machine file {where} [sensors]: {key} = [{low!r}, {high!r}] must list the smaller first"
            )
    if friction.static_fraction < friction.coulomb_fraction:
        raise ConfigError(
            f"machine file {where} [friction]: static_fraction = {friction.static_fraction!r} must be at least "
            f"coulomb_fraction = {friction.coulomb_fraction!r}"
        )


def _check_triangle(axis: int, axes: Any, plant: Any, where: str) -> None:
    name = CYLINDERS[axis]
    base, rod = ((at.BOOM_BASE, at.BOOM_ROD), (at.ARM_BASE, at.ARM_ROD))[axis]
    closed, stroke = float(axes[axis, at.CLOSED]), float(axes[axis, at.STROKE])
    least, most = abs(plant[base] - plant[rod]), plant[base] + plant[rod]
    # Pins in one line give no lever arm, so equality is refused.
    if closed <= least:
        raise ConfigError(
            f"machine file {where} [{name}_cylinder]: closed_length = {setting_text(closed)} m must be above "
            f"|base_radius - rod_radius| = {typed(least)} m, or the pins cannot come that close"
        )
    if closed + stroke >= most:
        raise ConfigError(
            f"machine file {where} [cylinders]: stroke[{name}] = {setting_text(stroke)} m with closed_length = "
            f"{setting_text(closed)} m needs "
            f"pins {typed(closed + stroke)} m apart; must be below base_radius + rod_radius = {typed(most)} m"
        )
    ends = [linkage.angle_at_stroke(axis, s, axes, plant) for s in (0.0, stroke)]
    _check_levers(axis, min(ends), max(ends), axes, plant, where)


def _check_bucket(axes: Any, plant: Any, where: str) -> None:
    closed, stroke = float(axes[2, at.CLOSED]), float(axes[2, at.STROKE])
    where_table = f"machine file {where} [bucket_linkage]"
    psi, length = linkage.bucket_branch(closed, closed + stroke, plant)
    if not len(psi):
        raise ConfigError(
            f"{where_table}: rocker = {setting_text(plant[at.ROCKER])} m and link = {setting_text(plant[at.LINK])} m "
            "cannot close the "
            "loop between "
            f"rocker pivot and lug = {setting_text(plant[at.LUG])} m at any bucket angle; rocker + link must be "
            "longer than the "
            "pins are apart, |rocker - link| shorter"
        )
    if length[0] < closed + stroke or length[-1] > closed:
        low, high = np.degrees((psi[0], psi[-1]))
        raise ConfigError(
            f"{where_table}: closed_length = {setting_text(closed)} m with stroke[bucket] = {setting_text(stroke)} m "
            "needs pins from "
            f"{typed(closed)} to "
            f"{typed(closed + stroke)} m apart; this linkage gives {typed(length[-1])} to {typed(length[0])} m "
            "(bucket angles "
            f"{low:.0f} to {high:.0f} deg) before it cannot close or turns over; change closed_length, stroke, rocker "
            "or link"
        )
    ends = [linkage.angle_at_stroke(2, s, axes, plant) for s in (0.0, stroke)]
    _check_levers(2, min(ends), max(ends), axes, plant, where)


def _check_levers(axis: int, low: float, high: float, axes: Any, plant: Any, where: str) -> None:
    """Check that the lever arm keeps its sign and a least size some degrees beyond the stops."""
    name = CYLINDERS[axis]
    table = "bucket_linkage" if axis == 2 else f"{name}_cylinder"
    psi = np.linspace(low - BEYOND_STOPS, high + BEYOND_STOPS, 241)
    closes = linkage.bucket_closes(psi, plant) if axis == 2 else np.full(len(psi), True)
    # By convention extension raises the boom angle and lowers those of arm and bucket.
    sign = 1.0 if axis == 0 else -1.0
    # Without a closed loop there is no lever arm, which is reported before a short lever arm.
    levers = [sign * linkage.cylinder(axis, p, plant)[1] if ok else -math.inf for p, ok in zip(psi, closes)]
    worst = int(np.argmin(levers))
    least = MIN_LEVER * float(axes[axis, at.STROKE])
    # Negated, so that NaN is refused as well.
    if not levers[worst] >= least:
        lever_text = f"{levers[worst]:.3f} m/rad" if math.isfinite(levers[worst]) else "none, the loop cannot close"
        raise ConfigError(
            f"machine file {where} [{table}]: the lever arm of the {name} cylinder at joint angle "
            f"{math.degrees(psi[worst]):.0f} deg is {lever_text}; from 4 deg below to 4 deg above the working range "
            f"({math.degrees(low):.0f} to {math.degrees(high):.0f} deg) it must keep its sign and be at least "
            f"{least:.3f} m/rad ({typed(MIN_LEVER)} of the stroke); change the pins, closed_length or stroke"
        )
