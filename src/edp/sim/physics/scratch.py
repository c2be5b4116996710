"""Arrays of one integrator step: states, commands, and positions of values in scratch arrays."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


class MovingParts(NamedTuple):
    """State of the plant, and pilots, play and spools of its valves."""

    state: NDArray[np.float64]
    valves: NDArray[np.float64]


class SpoolCommands(NamedTuple):
    """Commands of the spools, shape (sample, spool), and scratch with one value per spool."""

    demands: NDArray[np.float64]
    present: NDArray[np.float64]


# frozen[...]: numbers of one step; three of a kind stand together, one per cylinder
LEVERS, GRAVITY_T, PER_HEAD, PER_ROD, SINES, MASS, BYPASS, ANGLES = 0, 3, 6, 9, 12, 15, 21, 23
ANCHOR, ANCHOR_COS, ANCHOR_SIN = 29, 32, 35
FROZEN = 38
# slopes[cylinder, ...]: Jacobian pieces and elimination factors of one cylinder
(
    C_HEAD, C_ROD, HEAD_BY_HEAD, ROD_BY_ROD, ACROSS, HEAD_BY_1, HEAD_BY_2, ROD_BY_1, ROD_BY_2,
    F_BY_Z, F_BY_V, Z_BY_V, Z_BY_Z,
    T_HH, T_HR, T_RH, T_RR, H_BY_W, H_BY_1, H_BY_2, R_BY_W, R_BY_1, R_BY_2, Z_BY_W, Z_LEFT,
    HEAD_K, ROD_K, BRISTLE_K,
    # lines: what the valve sees in place of the chambers, in the order of H_BY_W to R_BY_2 and of HEAD_K, ROD_K; slopes
    # of the drops and of the piston's leakage, stiffness over volume at the valve, and factors of the elimination
    PORT_H_BY_W, PORT_H_BY_1, PORT_H_BY_2, PORT_R_BY_W, PORT_R_BY_1, PORT_R_BY_2, PORT_HEAD_K, PORT_ROD_K,
    DROP_HEAD, DROP_ROD, PISTON, C_PORT_HEAD, C_PORT_ROD,
    KEPT_HEAD, KEPT_ROD, PUSHED_HEAD, PUSHED_ROD, P_HH, P_HR, P_RH, P_RR,
) = range(49)  # fmt: skip
SLOPES = 49
# slopes[PUMP_ROW, ...]: slope of the flow lost from each pump line, then stiffness over volume
PUMP_ROW, LOST_1, C_PUMP_1 = 3, 0, 2
# work: numbers of the step, strokes, openings, LU factors, slopes, contact with the soil, vectors of one state each
FROZEN_W, STROKES_W, OPENED, LU, SLOPE, CONTACT, RATES, RHS, K1, K2, STAGE = range(11)
