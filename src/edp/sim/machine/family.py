"""Machines of other sizes: one parameter set scaled by stated laws, with seeded scatter between machines.

With s the cube root of the ratio of masses (geometric similarity at equal pressures and equal cylinder speeds):

=======================  ======================================================================
lengths, bores, strokes  s
masses, volumes          s^3; so does heat capacity
moments of inertia       s^5
flows, ratings, power    s^2, as areas, since pressures and cylinder speeds stay; so does cooling
viscous friction         s^2; its Coulomb part is a share of area times pressure
leakage                  s, a gap of equal width around a larger diameter
stop stiffness           s
valve frequencies        s^-1/2, spools of greater mass; dead times and pump time constant s^1/2
chassis                  pitch frequency s^-1/2, lifting moment s^4
=======================  ======================================================================

Front proportions, masses, valves, friction, leakage and wear scatter about the laws. A cylinder and its pins have one
scale factor, so that joint ranges and lever arm shapes are unchanged and every linkage closes. ``scatter`` widens all
ranges about their middle, except those of wear and oil, which already span new to worn machines.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from edp.errors import ConfigError
from edp.sim.machine.machine import (
    Bodies,
    BucketLinkage,
    Cylinders,
    Machine,
    PinTriangle,
    Ratings,
    SwingMotor,
    Triple,
    Valves,
)
from edp.wording import typed

BASE_MASS_T = 21.7
"""Operating weight of M22, t."""
GOLDEN = 0.5 * (np.sqrt(5.0) - 1.0)
"""Increment of the golden-ratio sequence modulo 1, which fills a range evenly for any number of members."""
LIGHTEST_T, HEAVIEST_T = 1.0, 200.0
MASSES_T = (10.0, 50.0)
"""Default range of the operating weights in a family, t."""
WIDEST = 2.5
"""Maximum scatter of the parameters. With three times the scatter, the ranges of pump and hoses would reach below zero.
"""


@dataclass(frozen=True)
class Draws:
    """Random factors of one machine.

    Attributes:
        rng: source of the scatter.
        scatter: factor on the width of every range except wear.
    """

    rng: np.random.Generator
    scatter: float = 1.0

    def uniform(self, low: float, high: float, size: int | None = None) -> Any:
        """Draw uniformly from a widened range around a scaling law."""
        more = 0.5 * (self.scatter - 1.0) * (high - low)
        return self.rng.uniform(low - more, high + more, size)

    def wear(self, low: float, high: float) -> float:
        """Draw uniformly between new and worn."""
        return float(self.rng.uniform(low, high))


def member_name(seed: int, index: int, masses_t: tuple[float, float] = MASSES_T, scatter: float = 1.0) -> str:
    """Return ``family-<seed>-<index>``, with ``-<low>-<high>`` (t) and ``-x<scatter>`` unless they are the defaults.

    Such as ``family-0-3-10-12p5`` and ``family-0-3-x1p5``.
    """
    name = f"family-{seed}-{index}"
    if tuple(masses_t) != MASSES_T:
        name += "".join(f"-{_format_value(mass)}" for mass in masses_t)
    return name if scatter == 1.0 else f"{name}-x{_format_value(scatter)}"


def _format_value(value: float) -> str:
    return f"{value:.3f}".rstrip("0").rstrip(".").replace(".", "p")


def member_mass(seed: int, index: int, low_t: float = MASSES_T[0], high_t: float = MASSES_T[1]) -> float:
    """Return the mass (t) of one machine of a family: evenly spread on a logarithmic scale, however many there are.

    Raises:
        ConfigError: the range is empty or beyond 1 to 200 t.
    """
    if not LIGHTEST_T <= low_t <= high_t <= HEAVIEST_T:
        raise ConfigError(
            f"family of machines from {low_t} to {high_t} t; the lower must not exceed the upper, "
            f"both within {typed(LIGHTEST_T)} to {typed(HEAVIEST_T)} t"
        )
    # Stream 0 is the masses'; machine i draws from stream 1 + i, so members do not depend on how many there are.
    first = np.random.default_rng([seed, 0]).random()
    share = (first + index * GOLDEN) % 1.0
    return float(low_t * (high_t / low_t) ** share)


def scale_machine(
    base: Machine, mass_t: float, draws: Draws, name: str = "", base_mass_t: float = BASE_MASS_T
) -> Machine:
    """Scale a machine to another mass by the laws above.

    Args:
        base: the parameter set to scale.
        mass_t: operating weight of the new machine, t.
        draws: the scatter.
        name: name of the new machine; empty to derive it from base and mass.
        base_mass_t: operating weight of `base`, t.

    Raises:
        ConfigError: the mass is out of range.
    """
    if not LIGHTEST_T <= mass_t <= HEAVIEST_T:
        raise ConfigError(f"machine of {mass_t} t; choose from {typed(LIGHTEST_T)} to {typed(HEAVIEST_T)} t")
    s = (mass_t / base_mass_t) ** (1.0 / 3.0)
    front = s * draws.uniform(0.94, 1.06, 3)  # boom, arm, bucket
    linkage = s * draws.uniform(0.95, 1.05, 3)  # pins and stroke of each cylinder
    bodies = _bodies(base.bodies, s, front, draws)
    return replace(
        base,
        name=name or f"{base.name}-{mass_t:.0f}t",
        description=f"{base.name} scaled to {mass_t:.1f} t, with scatter; class-equivalent, not a replica",
        bodies=bodies,
        boom_cylinder=_triangle(base.boom_cylinder, linkage[0]),
        arm_cylinder=_triangle(base.arm_cylinder, linkage[1]),
        bucket_linkage=_bucket_linkage(base.bucket_linkage, linkage[2], base.bodies.length[1], bodies.length[1]),
        cylinders=_cylinders(base.cylinders, s, linkage, draws),
        friction=_friction(base, s, draws),
        oil=replace(
            base.oil,
            air_fraction=base.oil.air_fraction * draws.wear(0.8, 2.0),
            heat_capacity=base.oil.heat_capacity * s**3,
            cooling=base.oil.cooling * s**2,
        ),
        pumps=_pumps(base, s, draws),
        valves=_valves(base.valves, s, draws),
        bucket=replace(
            base.bucket,
            width=base.bucket.width * s,
            capacity=base.bucket.capacity * s**3,
            floor_length=base.bucket.floor_length * front[2],
            edge_area=base.bucket.edge_area * s**2,
            load_x=base.bucket.load_x * front[2],
            load_y=base.bucket.load_y * front[2],
        ),
        chassis=replace(
            base.chassis,
            boom_foot_height=base.chassis.boom_foot_height * s,
            pitch_inertia=base.chassis.pitch_inertia * s**5,
            pitch_frequency=base.chassis.pitch_frequency / np.sqrt(s),
            lift_moment=base.chassis.lift_moment * s**4,
        ),
        swing=None if base.swing is None else _swing(base.swing, s),
        travel=None if base.travel is None else _motor(base.travel, s, 2.0, 3.0),
    )


def _motor(motor: Any, s: float, sweep: float, weight: float) -> Any:
    """Scale a motor by its exponents of displacement and inertia; pressures stay, forces scale with displacement."""
    forces = ("displacement", "coulomb", "viscous", "brake")
    changed = {key: getattr(motor, key) * s**sweep for key in forces}
    flows = {key: (getattr(motor, key)[0] * s**2, getattr(motor, key)[1]) for key in ("meter_in", "meter_out")}
    leaks = {key: getattr(motor, key) * s for key in ("leakage", "drain_leakage")}
    leaks["relief_slope"] = motor.relief_slope * s**2
    slower = {key: float(getattr(motor, key) / np.sqrt(s)) for key in ("pilot_frequency", "spool_frequency")}
    return replace(
        motor,
        inertia=motor.inertia * s**weight,
        volume=motor.volume * s**3,
        dead_time=float(motor.dead_time * np.sqrt(s)),
        **{**changed, **flows, **leaks, **slower},
    )


def _swing(swing: SwingMotor, s: float) -> SwingMotor:
    """Return the speeds of the swing fall with the root of the length."""
    scaled: SwingMotor = replace(_motor(swing, s, 2.5, 5.0), boom_foot_ahead=swing.boom_foot_ahead * s)
    return scaled


def _times(values: Triple, factor: Any) -> Triple:
    first, second, third = (float(v) for v in np.asarray(values) * factor)
    return first, second, third


def _bodies(bodies: Bodies, s: float, front: Any, draws: Draws) -> Bodies:
    stretch = front / s
    heavier = s**3 * stretch * draws.uniform(0.95, 1.05, 3)  # a longer boom of the same section weighs more
    return Bodies(
        length=_times(bodies.length, front),
        mass=_times(bodies.mass, heavier),
        com_x=_times(bodies.com_x, front),
        com_y=_times(bodies.com_y, s),
        inertia=_times(bodies.inertia, heavier * front**2),
    )


def _triangle(pins: PinTriangle, size: float) -> PinTriangle:
    return replace(
        pins,
        base_radius=pins.base_radius * size,
        rod_radius=pins.rod_radius * size,
        closed_length=pins.closed_length * size,
    )


def _bucket_linkage(pins: BucketLinkage, size: float, old_arm: float, new_arm: float) -> BucketLinkage:
    """Return the scaled about the bucket pin, which ends the arm."""
    x, y = pins.cylinder_pin
    return replace(
        pins,
        pivot_to_pin=pins.pivot_to_pin * size,
        pivot_offset=pins.pivot_offset * size,
        rocker=pins.rocker * size,
        link=pins.link * size,
        lug=pins.lug * size,
        cylinder_pin=(new_arm - size * (old_arm - x), size * y),
        closed_length=pins.closed_length * size,
    )


def _cylinders(cylinders: Cylinders, s: float, linkage: Any, draws: Draws) -> Cylinders:
    # Evenly in the logarithm: leakage is a matter of factors.
    wear = np.exp(draws.wear(np.log(0.7), np.log(4.0)))
    width = s * draws.uniform(0.96, 1.04, 3)
    return replace(
        cylinders,
        bore=_times(cylinders.bore, width),
        rod=_times(cylinders.rod, width),
        stroke=_times(cylinders.stroke, linkage),
        hose_volume=_times(cylinders.hose_volume, s**3 * draws.uniform(0.8, 1.25, 3)),
        line_bore=_times(cylinders.line_bore, s * np.ones(3)),
        dead_length=cylinders.dead_length * s,
        cushion_length=_times(cylinders.cushion_length, linkage),
        stop_stiffness=cylinders.stop_stiffness * s,
        piston_leakage=_times(cylinders.piston_leakage, s * wear * draws.uniform(0.7, 1.4, 3)),
        spool_leakage=_times(cylinders.spool_leakage, s * wear * draws.uniform(0.7, 1.4, 3)),
    )


def _friction(base: Machine, s: float, draws: Draws) -> Any:
    friction, wear = base.friction, draws.wear(0.8, 1.6)
    return replace(
        friction,
        coulomb_fraction=friction.coulomb_fraction * wear,
        static_fraction=friction.static_fraction * wear,
        viscous=_times(friction.viscous, s**2 * wear * draws.uniform(0.85, 1.15, 3)),
        bristle_stiffness=_times(friction.bristle_stiffness, s**2),
        bristle_damping=_times(friction.bristle_damping, s**2),
    )


def _pumps(base: Machine, s: float, draws: Draws) -> Any:
    pumps = base.pumps
    scaled = replace(
        pumps,
        max_flow=pumps.max_flow * s**2 * draws.uniform(0.93, 1.07),
        volumetric_efficiency=draws.wear(0.90, 0.98),
        power_limit=pumps.power_limit * s**2 * draws.uniform(0.93, 1.07),
        time_constant=pumps.time_constant * np.sqrt(s) * draws.uniform(0.8, 1.3),
        line_volume=pumps.line_volume * s**3,
        relief_slope=pumps.relief_slope * s**2,
        bypass=(pumps.bypass[0] * s**2, pumps.bypass[1]),
    )
    # The ratio of engine power to pump power, and the flywheel energy per watt, stay constant.
    share = scaled.power_limit / pumps.power_limit
    return replace(scaled, engine_power=pumps.engine_power * share, engine_inertia=pumps.engine_inertia * share)


def _ratings(ratings: Ratings, factor: Any) -> Ratings:
    boom, arm, bucket = ((flow * float(f), bar) for (flow, bar), f in zip(ratings, factor, strict=True))
    return boom, arm, bucket


def _valves(valves: Valves, s: float, draws: Draws) -> Valves:
    quicker = draws.uniform(0.88, 1.12) / np.sqrt(s)
    later = np.sqrt(s) * draws.uniform(0.9, 1.15)
    wear = draws.wear(-0.01, 0.035)
    changed: dict[str, Any] = {}
    for key in ("pilot_frequency", "spool_frequency", "conflux_spool_frequency"):
        changed[key] = _times(getattr(valves, key), quicker)
    for key in ("dead_band_extend", "dead_band_retract", "conflux_dead_band_extend", "conflux_dead_band_retract"):
        band = np.asarray(getattr(valves, key)) + wear + draws.uniform(-0.01, 0.01, 3)
        # After wear and scatter a dead band is required, and most of the spool's travel after it.
        changed[key] = _times((1.0, 1.0, 1.0), np.clip(band, 0.04, 0.35))
    for key in (
        *("meter_in_extend", "meter_in_retract", "conflux_in_extend", "conflux_in_retract"),
        *("meter_out_extend", "meter_out_retract", "regeneration_extend", "regeneration_retract"),
    ):
        changed[key] = _ratings(getattr(valves, key), s**2 * draws.uniform(0.9, 1.1, 3))
    return replace(
        valves,
        **changed,
        dead_time=_times(valves.dead_time, later),
        conflux_extra_dead_time=float(valves.conflux_extra_dead_time * later),
        hysteresis=float(valves.hysteresis * draws.uniform(0.8, 1.6)),
        port_relief_slope=valves.port_relief_slope * s**2,
        anti_cavitation=(valves.anti_cavitation[0] * s**2, valves.anti_cavitation[1]),
    )
