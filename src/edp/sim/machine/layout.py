"""Positions of all parameters in the flat arrays of the compiled code.

Compiled functions take four arrays: `axes` (one row per cylinder), `plant` (one value per name), `state`
(the 19 plant states, and 12 of the lines behind them) and `valves` (one row per spool: boom, arm, bucket, then their
conflux spools).
"""

from __future__ import annotations

from edp.signals import GROUND_POINTS as GROUND_POINTS

AXES = 3
SPOOLS = 6

# state
PSI, RATE, HEAD, ROD, PUMP, BRISTLE, DISPLACEMENT = 0, 3, 6, 9, 12, 14, 17
LOGGED_STATES = 19
# of the lines between valves and cylinders, behind the others: pressures at the valve, and flows towards the cylinder
PORT_HEAD, PORT_ROD, FLOW_HEAD, FLOW_ROD = 19, 22, 25, 28
STATES = 31

# valves[spool, ...]: pilot (value, rate), play output, spool (value, rate), all as a share of full, extension positive
PILOT, PILOT_RATE, PLAY, SPOOL, SPOOL_RATE = range(5)

# axes[cylinder, ...]
(
    LENGTH, MASS, COM_X, COM_Y, INERTIA,
    HEAD_AREA, ROD_AREA, STROKE, CLOSED, HEAD_DEAD, ROD_DEAD,
    CUSHION_LENGTH, CUSHION_AREA, STOP_STIFFNESS, STOP_DAMPING,
    COULOMB, STATIC, STRIBECK, VISCOUS, SIGMA0, SIGMA1,
    PISTON_LEAK, HEAD_LEAK, ROD_LEAK, RELIEF_HEAD, RELIEF_ROD, CHECK,
    IN_EXTEND, IN_RETRACT, CONFLUX_EXTEND, CONFLUX_RETRACT, OUT_EXTEND, OUT_RETRACT, REGEN_EXTEND, REGEN_RETRACT,
    DEAD_BAND_EXTEND, DEAD_BAND_RETRACT, CONFLUX_DEAD_BAND_EXTEND, CONFLUX_DEAD_BAND_RETRACT,
    PRIMARY_PUMP, CONFLUX_PUMP, DEMAND_EXTEND, DEMAND_RETRACT, CONFLUX_SHARE_EXTEND, CONFLUX_SHARE_RETRACT,
    HYSTERESIS, CONFLUX_HYSTERESIS, WIDEST, CONFLUX_WIDEST,
    PORT_VOLUME, LINE_WALL, LINE_INERTANCE, LINE_LAMINAR, LINE_TURBULENT,
) = range(54)  # fmt: skip
AXIS_VALUES = 54

# plant[...]
(
    GRAVITY, BOOM_BASE, BOOM_ROD, BOOM_COS, BOOM_SIN, ARM_BASE, ARM_ROD, ARM_COS, ARM_SIN,
    PIVOT_X, PIVOT_Y, PIN_X, ROCKER, LINK, LUG_X, LUG_Y, CYLINDER_X, CYLINDER_Y,
    BULK_MODULUS, AIR, TANK, REGEN_CHECK, ANTI_CAVITATION, PORT_SLOPE,
    MAX_FLOW, EFFICIENCY, EFFICIENCY_2, POWER_LIMIT, MIN_DISPLACEMENT, PUMP_TIME, LINE_VOLUME, PUMP_RELIEF,
    RELIEF_SLOPE,
    BYPASS, BYPASS_CLOSED, LEVER_DEAD_ZONE, CONFLUX_START, OIL_TEMPERATURE,
    BULK_AT_45, THINNING, VISCOUS_SHARE, HEAT_CAPACITY, COOLING, AMBIENT, COMPENSATED,
    BOOM_OFFSET, ARM_OFFSET, LUG, LUG_ANGLE,
    RATED_FLOW, ENGINE_SPEED, ENGINE_DROOP, ENGINE_POWER, ENGINE_ENERGY,
    LOAD_MARGIN, SECTION_DROP, LINES,
) = range(57)  # fmt: skip
PLANT_VALUES = 57

# conductance[cylinder, ...]: openings of one step, m^3/s/sqrt(Pa)
HEAD_IN_1, HEAD_IN_2, ROD_IN_1, ROD_IN_2, HEAD_OUT, ROD_OUT, HEAD_TO_ROD, ROD_TO_HEAD = range(8)
OPENINGS = 8

# motors: swing, left track, right track; numbers[motor, ...], the boom foot's place of the swing alone
MOTORS = 3
(
    MOTOR_PUMP, SWEPT, MOTOR_INERTIA, MOTOR_VOLUME, MOTOR_LEAK, MOTOR_DRAIN, MOTOR_COULOMB, MOTOR_VISCOUS, BRAKE,
    BRAKE_DELAY, MOTOR_RELIEF, MOTOR_SLOPE, MOTOR_DEAD_BAND, MOTOR_DEMAND, MOTOR_IN, MOTOR_OUT, FOOT_AHEAD,
) = range(17)  # fmt: skip
MOTOR_VALUES = 17
# state[motor, ...]: speed (rad/s, of tracks m/s), pressures of its ports, way (rad, m), time since its spool closed (s)
SPEED, PORT_A, PORT_B, WAY, IDLE = range(5)
MOTOR_STATES = 5

ATMOSPHERE = 1.013e5
LOWEST_PRESSURE = 0.1e5 - ATMOSPHERE
"""Minimum gauge pressure, Pa (0.1 bar absolute). Lower pressures are clamped and counted."""

# columns of one logged sample: the plant state, then
LOG_DEMAND = LOGGED_STATES
LOG_STROKE = LOG_DEMAND + SPOOLS
LOG_VELOCITY = LOG_STROKE + AXES
LOG_SPOOL = LOG_VELOCITY + AXES
LOG_TIP = LOG_SPOOL + SPOOLS  # x, y (m from the boom foot), attitude (rad)
LOG_FORCE = LOG_TIP + 3  # of the ground on the tip: x, y (N)
LOG_PAYLOAD = LOG_FORCE + 2  # kg
LOG_OIL = LOG_PAYLOAD + 1  # degC
LOG_EVENTS = LOG_OIL + 1
RELIEF, CAVITATION, REGENERATION, POWER_LIMITED, SOIL_CONTACT = range(5)
EVENTS = 5
LOG_PORT = LOG_EVENTS + EVENTS  # pressures of heads and rods at the valve (Pa); the chambers' where there are no lines
LOG_COLUMNS = LOG_PORT + 2 * AXES
LOG_GROUND = LOG_COLUMNS
"""Index of the first ground height column. There are `GROUND_POINTS` such columns, only in recordings with ground."""

# columns of the motors in one logged sample, behind all others, only where they move; three of a kind stand together
LOG_MOTOR_SPEED, LOG_MOTOR_A, LOG_MOTOR_B, LOG_MOTOR_DEMAND, LOG_MOTOR_SPOOL, LOG_SWING = 0, 3, 6, 9, 12, 15
MOTOR_COLUMNS = 16

# memory[...]: what the ground remembers; behind it the depth of the rut (m) at each of its points
(
    FORCE_X, FORCE_Y, PAYLOAD, HEAP, DISTANCE, CHIP, SHEAR, HEEL_SET, PITCH, PITCH_RATE, DIGS, IN_SOIL, TOUCHED,
) = range(13)  # fmt: skip
MEMORY = 13
