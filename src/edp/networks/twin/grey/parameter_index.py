"""Positions of the grey-box parameters in the flat arrays of the compiled code.

Units there are m, s, MPa, MN and Gg (10^6 kg), in which pressures, forces and masses are numbers of a like size.

One hydraulic network: nodes are the head chambers of all actuators, their rod chambers, the pump lines, then two of
constant pressure, tank and supply. Every opening is an edge from node to node.
"""

from __future__ import annotations

# numbers of one actuator, from `actuator_at[i]`
(
    HEAD_AREA, ROD_AREA, HEAD_DEAD, ROD_DEAD, PISTON_LEAK, SPOOL_LEAK, HEAD_RELIEF, ROD_RELIEF,
    CUSHION_LENGTH, CUSHION_LEAST, COULOMB, STATIC, STRIBECK, VISCOUS, BRISTLE, BRISTLE_DAMPING,
    STOP_LOW, STOP_HIGH, STOP_STIFFNESS, ASYMMETRY,
) = range(20)  # fmt: skip
ACTUATOR_VALUES = 20

# of one pump, from `pump_at[m]`
FLOW, LEAST, LAG, LINE, BYPASS, BYPASS_CLOSED, RELIEF = range(7)
PUMP_VALUES = 7

# of the circuit, from `circuit_at`
(
    BULK, AIR, TANK, SUPPLY, MAKE_UP, PORT_SLOPE, RELIEF_SLOPE, POWER, PLAY, DEMAND_START, DEMAND_SPAN,
) = range(11)  # fmt: skip
CIRCUIT_VALUES = 11

# valve_at[j, ...]: place of each number of a valve, by direction where there are two; -1: the valve has none
DELAY, PILOT_LAG, SPOOL_LAG, BAND, GAIN, INTO, OUT_OF, REGENERATION = 0, 1, 2, 3, 5, 7, 9, 11
VALVE_PLACES = 13

# linkage: gravity (m/s^2), lengths of the bodies that carry another one (m), then for each body from the first one on:
# its actuator, and at each knot the stroke (m), the joint angle there (rad) and its first and second derivative by the
# stroke; without a linkage the array is empty, and polynomials describe inertia and gravity
BODIES, LINKAGE_KNOTS = 3, 33
GRAVITY, LENGTH, JOINTS = 0, 1, BODIES
ACTUATOR, KNOT = 0, 1
KNOT_VALUES = 4
JOINT_VALUES = KNOT + KNOT_VALUES * LINKAGE_KNOTS
LINKAGE_VALUES = JOINTS + BODIES * JOINT_VALUES

# numbers of one body, from the first one of the load
MASS, CENTRE_X, CENTRE_Y, INERTIA = range(4)
BODY_VALUES = 4
BASE = 3 * BODIES
"""Number of parameters in which inertia and gravity are linear: two first moments and one inertia per body."""

# valves[j, ...]: pilot (two lags), play, spool (two lags), as shares of full, extension positive
PILOT_1, PILOT_2, PLAYED, SPOOL_1, SPOOL = range(5)
VALVE_STATES = 5

# own tangents of a valve: by its delay, lags and the play
BY_DELAY, BY_PILOT_LAG, BY_SPOOL_LAG, BY_PLAY = range(4)
OWN = 4

# tangents that a sample propagates: none, with respect to all parameters, or with respect to the previous state
# (pressures, velocities, strokes, bristles and displacements; the state of valves depends only on the commands)
NONE, BY_PARAMETERS, BY_STATE = range(3)

ATMOSPHERE = 0.1013
"""Atmospheric pressure, MPa. All other pressures are gauge pressures."""
LEAST_ABSOLUTE = 1e-3
"""Minimum absolute pressure of oil, MPa."""
