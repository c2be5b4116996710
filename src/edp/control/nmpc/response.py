"""Response time of a machine to its levers, by its twin: the lower limit of a plan's length."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from edp.control.geometry import AXES
from edp.control.nmpc.model import TwinModel
from edp.control.nmpc.moves import Moves, SpeedToLever
from edp.control.plant import STROKES

Array = NDArray[np.float64]
SPEED_M_S = 0.1
"""Requested speed of the step response, m/s: outside the dead bands and far below the pump limits."""
SETTLED_S, MEAN_S = 1.0, 0.2
"""Time after which a speed counts as reached, and length of the averaging window before it, s."""
MIN_OF_ASKED = 0.2
"""Minimum fraction of the requested speed that the twin must reach. Otherwise its response time cannot be measured."""


def response(model: TwinModel, measured: Array, valves: SpeedToLever, slew: Array) -> Array | None:
    """Return the speed of each cylinder after a lever step for `SPEED_M_S`, relative to its final speed.

    Each cylinder moves away from its nearer end, alone, at the slew limit of its lever.

    Args:
        model: model whose memory is the steady state at this row.
        measured: row of its `reads`.
        valves: inverse valve map.
        slew: most that a lever moves in a tick, shape (3,).

    Returns:
        Shape (tick, 3), for the ticks of `SETTLED_S`; None where a cylinder does not come to a speed.
    """
    plant = model.plant
    ticks = max(2, round(SETTLED_S * plant.rate_hz))
    strokes = measured[[model.reads.index(name) for name in STROKES]]
    ways = np.where(strokes > 0.5 * plant.geometry.full_m, -1.0, 1.0)
    levers = Moves((ticks,)).levers(valves.levers(SPEED_M_S * np.diag(ways)[:, None]), np.zeros(AXES), slew)
    # One by one: beside a run at rest, a grey box would follow tangents at levers inside their dead bands.
    moved = np.stack(
        [model.predicted(levers[axis][None], measured, np.zeros(1, np.int64))[0][0, :, axis] for axis in range(AXES)], 1
    )
    speeds = ways * np.diff(moved, axis=0, prepend=strokes[None]) * plant.rate_hz
    reached = speeds[-max(1, round(MEAN_S * plant.rate_hz)) :].mean(axis=0)
    if not np.isfinite(speeds).all() or reached.min() < MIN_OF_ASKED * SPEED_M_S:
        return None
    return np.asarray(speeds / reached)
