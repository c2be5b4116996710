"""Conversion of a `Machine` to the flat arrays of the compiled code, with derived parameters."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from edp.errors import ConfigError
from edp.sim.machine import layout as at
from edp.sim.machine.machine import Machine, Rating
from edp.sim.physics import lines, thermal

Array = NDArray[np.float64]
REFERENCE_PRESSURE = 343e5
"""Pressure of the main relief valve, Pa. Friction is specified as a fraction of head area times this pressure."""


FLOW_SHARING = ("parallel", "compensated", "pre_compensated")
"""Methods of flow sharing: parallel orifices; compensators after the orifices that transmit the highest load pressure;
compensators before the orifices, each with its own pressure drop."""
UNBOUNDED = 1e12
"""Pressure drop across a section without a limit, Pa."""


def conductance(rating: Rating) -> float:
    """Return k of Q = k sqrt(dp), m^3/s/sqrt(Pa), from L/min at bar."""
    flow, pressure = rating
    # 6e4 L/min are 1 m^3/s.
    return flow / 6e4 / math.sqrt(pressure * 1e5)


def pack(machine: Machine) -> tuple[Array, Array]:
    """Return `axes`, shape (3, AXIS_VALUES), and `plant`, shape (PLANT_VALUES,); see `edp.sim.machine.layout`."""
    axes = np.zeros((at.AXES, at.AXIS_VALUES))
    _pack_bodies(machine, axes)
    _pack_cylinders(machine, axes)
    _pack_friction(machine, axes)
    _pack_valves(machine, axes)
    plant = np.zeros(at.PLANT_VALUES)
    _pack_linkage(machine, plant)
    _pack_supply(machine, plant)
    return axes, plant


def _pack_bodies(machine: Machine, axes: Array) -> None:
    bodies = machine.bodies
    axes[:, at.LENGTH] = bodies.length
    axes[:, at.MASS] = bodies.mass
    axes[:, at.COM_X] = bodies.com_x
    axes[:, at.COM_Y] = bodies.com_y
    axes[:, at.INERTIA] = bodies.inertia


def _pack_cylinders(machine: Machine, axes: Array) -> None:
    cylinders, valves = machine.cylinders, machine.valves
    count, bore, rod = (np.array(v) for v in (cylinders.count, cylinders.bore, cylinders.rod))
    axes[:, at.HEAD_AREA] = count * np.pi / 4 * bore**2
    axes[:, at.ROD_AREA] = count * np.pi / 4 * (bore**2 - rod**2)
    axes[:, at.STROKE] = cylinders.stroke
    closed = (machine.boom_cylinder, machine.arm_cylinder, machine.bucket_linkage)
    axes[:, at.CLOSED] = [part.closed_length for part in closed]
    hoses = np.array(cylinders.hose_volume)
    if lines.modelled(cylinders):
        lines.pack_lines(machine, axes)
        hoses -= axes[:, at.PORT_VOLUME]
    axes[:, at.HEAD_DEAD] = cylinders.dead_length * axes[:, at.HEAD_AREA] + hoses
    axes[:, at.ROD_DEAD] = cylinders.dead_length * axes[:, at.ROD_AREA] + hoses
    axes[:, at.CUSHION_LENGTH] = cylinders.cushion_length
    axes[:, at.CUSHION_AREA] = cylinders.cushion_area
    axes[:, at.STOP_STIFFNESS] = cylinders.stop_stiffness
    axes[:, at.STOP_DAMPING] = cylinders.stop_damping
    axes[:, at.PISTON_LEAK] = cylinders.piston_leakage
    axes[:, at.HEAD_LEAK] = axes[:, at.ROD_LEAK] = cylinders.spool_leakage
    axes[:, at.CHECK] = valves.check_leakage
    axes[:, at.RELIEF_HEAD] = valves.port_relief_head
    axes[:, at.RELIEF_ROD] = valves.port_relief_rod


def _pack_friction(machine: Machine, axes: Array) -> None:
    friction = machine.friction
    reference = axes[:, at.HEAD_AREA] * REFERENCE_PRESSURE
    axes[:, at.COULOMB] = friction.coulomb_fraction * reference
    axes[:, at.STATIC] = friction.static_fraction * reference
    axes[:, at.STRIBECK] = friction.stribeck_velocity
    axes[:, at.VISCOUS] = friction.viscous
    axes[:, at.SIGMA0] = friction.bristle_stiffness
    axes[:, at.SIGMA1] = friction.bristle_damping


def _pack_valves(machine: Machine, axes: Array) -> None:
    valves = machine.valves
    ratings = {
        at.IN_EXTEND: valves.meter_in_extend,
        at.IN_RETRACT: valves.meter_in_retract,
        at.CONFLUX_EXTEND: valves.conflux_in_extend,
        at.CONFLUX_RETRACT: valves.conflux_in_retract,
        at.OUT_EXTEND: valves.meter_out_extend,
        at.OUT_RETRACT: valves.meter_out_retract,
        at.REGEN_EXTEND: valves.regeneration_extend,
        at.REGEN_RETRACT: valves.regeneration_retract,
    }
    for column, triple in ratings.items():
        axes[:, column] = [conductance(rating) for rating in triple]
    axes[:, at.DEAD_BAND_EXTEND] = valves.dead_band_extend
    axes[:, at.DEAD_BAND_RETRACT] = valves.dead_band_retract
    axes[:, at.CONFLUX_DEAD_BAND_EXTEND] = valves.conflux_dead_band_extend
    axes[:, at.CONFLUX_DEAD_BAND_RETRACT] = valves.conflux_dead_band_retract
    # Files count pumps from 1, arrays from 0.
    axes[:, at.PRIMARY_PUMP] = np.array(valves.primary_pump) - 1
    axes[:, at.CONFLUX_PUMP] = np.array(valves.conflux_pump) - 1
    axes[:, at.DEMAND_EXTEND] = valves.pump_demand_extend
    axes[:, at.DEMAND_RETRACT] = valves.pump_demand_retract
    axes[:, at.CONFLUX_SHARE_EXTEND] = valves.conflux_extend
    axes[:, at.CONFLUX_SHARE_RETRACT] = valves.conflux_retract
    axes[:, at.HYSTERESIS] = axes[:, at.CONFLUX_HYSTERESIS] = valves.hysteresis
    # A sound spool reaches the end of its travel.
    axes[:, at.WIDEST] = axes[:, at.CONFLUX_WIDEST] = 1.0


def _pack_linkage(machine: Machine, plant: Array) -> None:
    boom, arm, bucket = machine.boom_cylinder, machine.arm_cylinder, machine.bucket_linkage
    plant[at.GRAVITY] = machine.gravity
    plant[at.BOOM_BASE], plant[at.BOOM_ROD] = boom.base_radius, boom.rod_radius
    plant[at.ARM_BASE], plant[at.ARM_ROD] = arm.base_radius, arm.rod_radius
    for offset_deg, angle, cosine, sine in (
        (boom.offset_deg, at.BOOM_OFFSET, at.BOOM_COS, at.BOOM_SIN),
        (arm.offset_deg, at.ARM_OFFSET, at.ARM_COS, at.ARM_SIN),
    ):
        plant[angle] = math.radians(offset_deg)
        plant[cosine], plant[sine] = math.cos(plant[angle]), math.sin(plant[angle])
    pin_x = machine.bodies.length[1]
    plant[at.PIN_X] = pin_x
    plant[at.PIVOT_X], plant[at.PIVOT_Y] = pin_x - bucket.pivot_to_pin, bucket.pivot_offset
    plant[at.ROCKER], plant[at.LINK] = bucket.rocker, bucket.link
    plant[at.LUG], plant[at.LUG_ANGLE] = bucket.lug, bucket.lug_angle
    plant[at.LUG_X] = bucket.lug * math.cos(bucket.lug_angle)
    plant[at.LUG_Y] = bucket.lug * math.sin(bucket.lug_angle)
    plant[at.CYLINDER_X], plant[at.CYLINDER_Y] = bucket.cylinder_pin


def _pack_supply(machine: Machine, plant: Array) -> None:
    oil, pumps, valves = machine.oil, machine.pumps, machine.valves
    plant[at.BULK_AT_45] = oil.bulk_modulus
    plant[at.HEAT_CAPACITY], plant[at.COOLING], plant[at.AMBIENT] = oil.heat_capacity, oil.cooling, oil.ambient
    thermal.set_temperature(oil.temperature, plant)
    plant[at.AIR] = oil.air_fraction
    plant[at.TANK] = oil.tank_pressure
    plant[at.REGEN_CHECK] = valves.check_leakage
    plant[at.ANTI_CAVITATION] = conductance(valves.anti_cavitation)
    plant[at.PORT_SLOPE] = valves.port_relief_slope
    plant[at.MAX_FLOW] = plant[at.RATED_FLOW] = pumps.max_flow
    plant[at.ENGINE_SPEED] = 1.0
    plant[at.ENGINE_DROOP], plant[at.ENGINE_POWER] = pumps.engine_droop, pumps.engine_power
    plant[at.ENGINE_ENERGY] = pumps.engine_inertia * (pumps.engine_speed_rpm * math.pi / 30.0) ** 2
    plant[at.EFFICIENCY] = plant[at.EFFICIENCY_2] = pumps.volumetric_efficiency
    plant[at.POWER_LIMIT] = pumps.power_limit
    plant[at.MIN_DISPLACEMENT] = pumps.min_displacement
    plant[at.PUMP_TIME] = pumps.time_constant
    plant[at.LINE_VOLUME] = pumps.line_volume
    plant[at.PUMP_RELIEF] = pumps.relief
    plant[at.RELIEF_SLOPE] = pumps.relief_slope
    plant[at.BYPASS] = conductance(pumps.bypass)
    plant[at.BYPASS_CLOSED] = pumps.bypass_closed_at
    plant[at.LEVER_DEAD_ZONE] = valves.lever_dead_zone
    plant[at.CONFLUX_START] = valves.conflux_start
    if valves.flow_sharing not in FLOW_SHARING:
        raise ConfigError(
            f"machine {machine.name} [valves]: flow_sharing = {valves.flow_sharing!r} must be one of "
            f"{', '.join(FLOW_SHARING)}"
        )
    plant[at.COMPENSATED] = valves.flow_sharing == "compensated"
    plant[at.SECTION_DROP] = valves.compensator_drop if valves.flow_sharing == "pre_compensated" else UNBOUNDED
    plant[at.LOAD_MARGIN] = pumps.load_margin
    plant[at.LINES] = lines.modelled(machine.cylinders)
