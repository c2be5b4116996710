"""Machine faults: each is a function that changes plant parameters, and a row of `FAULTS`."""

from __future__ import annotations

import math

from edp.settings.bounds import span
from edp.sim.faults.base import (
    AXES,
    CHAMBERS,
    FACTOR,
    FAULTS,
    FLOW,
    MASS,
    PRESSURE,
    SHARE,
    SPOOLS,
    TIME,
    MachineFault,
    MachineNumbers,
)
from edp.sim.machine import layout as at
from edp.sim.physics import terramechanics, valve

LEAK_PRESSURE = 200e5
"""Pressure difference at which the size of a leak is defined, at 40 degC, Pa."""


def _add_attachment_mass(numbers: MachineNumbers, site: str, size: float) -> None:
    """Increase mass and inertia of the bucket in proportion; its centre of mass stays."""
    axes, soil = numbers.axes, numbers.soil
    factor = 1.0 + size / numbers.machine.bodies.mass[2]
    axes[2, at.MASS] *= factor
    axes[2, at.INERTIA] *= factor
    # In soil, mass and inertia follow at each tick from those of the empty bucket and of its load.
    soil[terramechanics.BUCKET_MASS] *= factor
    soil[terramechanics.BUCKET_INERTIA] *= factor


FAULTS.register("attachment_mass")(MachineFault(
    text="the attachment is heavier than it is known to be",
    part="attachment",
    words="the attachment is {size} heavier than it is known to be",
    sites=(),
    units=MASS,
    ladder=(100.0, 300.0, 900.0),
    bound=span(0.0, 5000.0),
    change=_add_attachment_mass,
))  # fmt: skip


def _open_checks(numbers: MachineNumbers, site: str, size: float) -> None:
    """Increase the backward opening of the load checks of one axis, in all sections."""
    i = AXES.index(site)
    numbers.axes[i, at.CHECK] = min(numbers.axes[i, at.CHECK] + size, 1.0)


FAULTS.register("check_leak")(MachineFault(
    text="load checks of an axis let oil back; the size is the share of the opening that stays",
    part="{axis} valve",
    words="the load checks of the {axis} let oil back: {size} of the opening stay",
    grave=True,
    units=SHARE,
    ladder=(2.0, 5.0, 10.0, 15.0),
    bound=span(0.0, 100.0),
    change=_open_checks,
))  # fmt: skip


def _reduce_cooling(numbers: MachineNumbers, site: str, size: float) -> None:
    """Reduce the heat flow from oil to air, so that the oil warms up over minutes."""
    numbers.plant[at.COOLING] *= 1.0 - size


FAULTS.register("cooler")(MachineFault(
    text="the oil cooler takes away less heat; the size is the share that is lost",
    part="oil cooler",
    words="the oil cooler takes away {size} less heat",
    sites=(),
    units=SHARE,
    ladder=(50.0, 80.0, 100.0),
    bound=span(0.0, 100.0),
    change=_reduce_cooling,
))  # fmt: skip


def _widen_dead_band(numbers: MachineNumbers, site: str, size: float) -> None:
    """Widen the dead band of one spool to both sides, to 95 % of the travel at most."""
    i, conflux = SPOOLS.index(site) % len(AXES), SPOOLS.index(site) >= len(AXES)
    first = at.CONFLUX_DEAD_BAND_EXTEND if conflux else at.DEAD_BAND_EXTEND
    # Some travel after the dead band is required, because the opening divides by it.
    for column in (first, first + 1):
        numbers.axes[i, column] = min(numbers.axes[i, column] + size, 0.95)


FAULTS.register("dead_band")(MachineFault(
    text="a spool opens too late; the size is added to its dead band, in shares of travel",
    part="{axis} valve",
    words="the {site} spool opens late: {size} of its travel are added to the dead band",
    sites=SPOOLS,
    units=SHARE,
    ladder=(2.0, 4.0, 8.0, 16.0),
    bound=span(0.0, 80.0),
    change=_widen_dead_band,
))  # fmt: skip


def _leak_outward(numbers: MachineNumbers, site: str, size: float) -> None:
    """Add a laminar leak from one chamber to the tank; its flow is proportional to 1 / viscosity."""
    axis, side = site.split("_")
    column = at.HEAD_LEAK if side == "head" else at.ROD_LEAK
    numbers.axes[AXES.index(axis), column] += size / LEAK_PRESSURE


FAULTS.register("external_leak")(MachineFault(
    text="oil leaves a chamber or its hose",
    part="{axis} cylinder",
    words="the {site} of the cylinder or its hose leaks outward: {size} at 200 bar",
    grave=True,
    sites=CHAMBERS,
    units=FLOW,
    ladder=(0.3, 1.0, 3.0, 10.0),
    bound=span(0.0, 100.0),
    change=_leak_outward,
))  # fmt: skip


def _add_air(numbers: MachineNumbers, site: str, size: float) -> None:
    """Increase the fraction of free air, which makes the oil softer."""
    numbers.plant[at.AIR] += size


FAULTS.register("free_air")(MachineFault(
    text="there is more free air in the oil",
    part="oil",
    words="there is {size} more free air in the oil",
    sites=(),
    units=SHARE,
    ladder=(1.0, 3.0, 6.0, 12.0),
    bound=span(0.0, 50.0),
    change=_add_air,
))  # fmt: skip


def _multiply_friction(numbers: MachineNumbers, site: str, size: float) -> None:
    """Multiply Coulomb, static and viscous friction of one cylinder."""
    for column in (at.COULOMB, at.STATIC, at.VISCOUS):
        numbers.axes[AXES.index(site), column] *= size


FAULTS.register("friction")(MachineFault(
    text="an axis rubs more, by a factor",
    part="{axis} cylinder",
    words="the {axis} rubs more: by a factor of {size}",
    units=FACTOR,
    ladder=(1.3, 2.0, 4.0),
    bound=span(1.0, 20.0),
    neutral=1.0,
    change=_multiply_friction,
))  # fmt: skip


def _leak_across_piston(numbers: MachineNumbers, site: str, size: float) -> None:
    """Add a laminar leak across the piston: flow proportional to pressure difference and to 1 / viscosity."""
    numbers.axes[AXES.index(site), at.PISTON_LEAK] += size / LEAK_PRESSURE


FAULTS.register("internal_leak")(MachineFault(
    text="oil passes the seals of the piston",
    part="{axis} cylinder",
    words="the {axis} cylinder leaks inside: {size} at 200 bar",
    grave=True,
    units=FLOW,
    ladder=(0.3, 1.0, 3.0, 10.0),
    bound=span(0.0, 100.0),
    change=_leak_across_piston,
))  # fmt: skip


def _lower_main_relief(numbers: MachineNumbers, site: str, size: float) -> None:
    """Lower the pressure setting, at least to the tank pressure."""
    plant = numbers.plant
    plant[at.PUMP_RELIEF] = max(plant[at.PUMP_RELIEF] - size, plant[at.TANK])


FAULTS.register("main_relief")(MachineFault(
    text="the main relief valve opens too early; the size is the fall of its setting",
    part="main relief valve",
    words="the main relief valve opens {size} too early",
    sites=(),
    units=PRESSURE,
    ladder=(20.0, 50.0, 100.0, 150.0),
    bound=span(0.0, 300.0),
    change=_lower_main_relief,
))  # fmt: skip


def _lower_port_relief(numbers: MachineNumbers, site: str, size: float) -> None:
    """Lower the pressure setting, at least to the tank pressure."""
    axis, side = site.split("_")
    i, column = AXES.index(axis), at.RELIEF_HEAD if side == "head" else at.RELIEF_ROD
    numbers.axes[i, column] = max(numbers.axes[i, column] - size, numbers.plant[at.TANK])


FAULTS.register("port_relief")(MachineFault(
    text="a port relief valve opens too early; the size is the fall of its setting",
    part="{axis} valve",
    words="the port relief valve of {site} opens {size} too early",
    grave=True,
    sites=CHAMBERS,
    units=PRESSURE,
    ladder=(100.0, 150.0, 200.0, 250.0),
    bound=span(0.0, 350.0),
    change=_lower_port_relief,
))  # fmt: skip


def _reduce_power(numbers: MachineNumbers, site: str, size: float) -> None:
    """Reduce the common power limit of the pumps by a fraction."""
    numbers.plant[at.POWER_LIMIT] *= 1.0 - size


FAULTS.register("power_limit")(MachineFault(
    text="the power limit of the pumps is too low; the size is the share that is lost",
    part="pump control",
    words="the power limit of the pumps is {size} too low",
    sites=(),
    units=SHARE,
    ladder=(5.0, 10.0, 20.0, 40.0),
    bound=span(0.0, 95.0),
    change=_reduce_power,
))  # fmt: skip


def _reduce_pump_flow(numbers: MachineNumbers, site: str, size: float) -> None:
    """Reduce the volumetric efficiency by a fraction."""
    if site != "pump_2":
        numbers.plant[at.EFFICIENCY] *= 1.0 - size
    if site != "pump_1":
        numbers.plant[at.EFFICIENCY_2] *= 1.0 - size


FAULTS.register("pump_efficiency")(MachineFault(
    text="a pump delivers less; the size is the share that is lost",
    part="{site}",
    words="the flow of {site} is {size} too low",
    sites=("pump_1", "pump_2", "both"),
    units=SHARE,
    ladder=(3.0, 6.0, 12.0, 25.0),
    bound=span(0.0, 90.0),
    change=_reduce_pump_flow,
))  # fmt: skip


def _raise_tank_pressure(numbers: MachineNumbers, site: str, size: float) -> None:
    """Raise the pressure of the return gallery, independent of the flow."""
    numbers.plant[at.TANK] += size


FAULTS.register("return_line")(MachineFault(
    text="the pressure of the return line is too high",
    part="return line",
    words="the pressure of the return line is {size} too high",
    sites=(),
    units=PRESSURE,
    ladder=(2.0, 5.0, 10.0),
    bound=span(0.0, 50.0),
    change=_raise_tank_pressure,
))  # fmt: skip


def _slow_spool(numbers: MachineNumbers, site: str, size: float) -> None:
    """Divide the natural frequency of one spool by a factor; its pilot stays."""
    if size == 1.0:
        # Computing the parameters of a healthy spool again might change them by rounding.
        return
    j, valves = SPOOLS.index(site), numbers.machine.valves
    frequency = (*valves.spool_frequency, *valves.conflux_spool_frequency)[j] / size
    for filters, step_s in zip((numbers.coarse, numbers.fine), numbers.half_steps_s, strict=True):
        filters[j, 1] = valve.oscillator(frequency, valve.SPOOL_DAMPING, step_s)


FAULTS.register("slow_spool")(MachineFault(
    text="a spool moves more slowly, by a factor",
    part="{axis} valve",
    words="the {site} spool moves slowly: by a factor of {size}",
    sites=SPOOLS,
    units=FACTOR,
    ladder=(1.25, 1.5, 2.0, 3.0),
    bound=span(1.0, 20.0),
    neutral=1.0,
    change=_slow_spool,
))  # fmt: skip


def _add_play(numbers: MachineNumbers, site: str, size: float) -> None:
    """Increase the half width of the play between pilot and spool."""
    i, conflux = SPOOLS.index(site) % len(AXES), SPOOLS.index(site) >= len(AXES)
    numbers.axes[i, at.CONFLUX_HYSTERESIS if conflux else at.HYSTERESIS] += size


FAULTS.register("spool_play")(MachineFault(
    text="a spool follows its pilot with play; the size is added to the half width, in shares of travel",
    part="{axis} valve",
    words="the {site} spool follows its pilot with play: {size} of its travel",
    sites=SPOOLS,
    units=SHARE,
    ladder=(1.0, 2.0, 4.0, 8.0),
    bound=span(0.0, 50.0),
    change=_add_play,
))  # fmt: skip


def _limit_travel(numbers: MachineNumbers, site: str, size: float) -> None:
    """Limit the travel of one spool beyond its dead band, so that part of its opening is never reached."""
    if size == 0.0:
        return
    i, conflux = SPOOLS.index(site) % len(AXES), SPOOLS.index(site) >= len(AXES)
    # Solve opening = r (0.25 + 0.75 r) for the travel r at the remaining opening.
    numbers.axes[i, at.CONFLUX_WIDEST if conflux else at.WIDEST] = (math.sqrt(0.0625 + 3.0 * (1.0 - size)) - 0.25) / 1.5


FAULTS.register("stuck_spool")(MachineFault(
    text="a spool sticks before it is open; the size is the share of the opening that is lost",
    part="{axis} valve",
    words="the {site} spool sticks: {size} of its opening are lost",
    grave=True,
    sites=SPOOLS,
    units=SHARE,
    ladder=(10.0, 25.0, 50.0, 80.0),
    bound=span(0.0, 100.0),
    change=_limit_travel,
))  # fmt: skip


def _add_dead_time(numbers: MachineNumbers, site: str, size: float) -> None:
    """Increase the dead time of one spool."""
    numbers.delays[SPOOLS.index(site)] += size * numbers.rate_hz


FAULTS.register("valve_delay")(MachineFault(
    text="the command of a spool arrives late",
    part="{axis} valve",
    words="the command of the {site} spool arrives {size} late",
    sites=SPOOLS,
    units=TIME,
    ladder=(10.0, 20.0, 50.0, 100.0),
    bound=span(0.0, 500.0),
    change=_add_dead_time,
    delays_commands=True,
))  # fmt: skip


def _widen_outlets(numbers: MachineNumbers, site: str, size: float) -> None:
    """Multiply the openings from both chambers to the tank, so that a load falls faster."""
    i = AXES.index(site)
    numbers.axes[i, at.OUT_EXTEND] *= size
    numbers.axes[i, at.OUT_RETRACT] *= size


FAULTS.register("worn_edges")(MachineFault(
    text="the meter-out edges of a spool are worn, and let out more by a factor",
    part="{axis} valve",
    words="the meter-out edges of the {axis} spool let out more: by a factor of {size}",
    units=FACTOR,
    ladder=(1.1, 1.2, 1.4, 1.6),
    bound=span(1.0, 5.0),
    neutral=1.0,
    change=_widen_outlets,
))  # fmt: skip
