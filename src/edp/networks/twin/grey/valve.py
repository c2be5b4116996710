"""Command path of a grey box: dead time, two pilot lags, play, two spool lags; and the demand on the pumps.

Nothing here depends on the load, so a valve has tangents of its own: by its dead time, its lags and the play.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from edp.networks.twin.grey import layout as at
from edp.networks.twin.grey.jit import inlined, inner

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
IDLE = 1e-9
"""MW below which pumps take no power: no division by zero."""


@inlined
def delayed(history: Array, j: int, delay: float, step: float) -> tuple[float, float]:
    """Demand of valve `j` a dead time (s) ago, linear between ticks, newest first; and its slope by the dead time."""
    ticks = min(max(delay / step, 0.0), len(history) - 2.0)
    whole = min(int(ticks), len(history) - 2)
    part = ticks - whole
    newer, older = history[whole, j], history[whole + 1, j]
    slope = (older - newer) / step if 0.0 <= delay / step <= len(history) - 2.0 else 0.0
    return newer + part * (older - newer), slope


@inner
def _lag(
    row: Array, which: int, goal: float, keep: float, slopes: Array, by_goal: Array, own: int, by_lag: float
) -> None:
    """One first-order lag, and its tangents."""
    behind = row[which] - goal
    row[which] = goal + behind * keep
    for k in range(at.OWN):
        slopes[which, k] = keep * slopes[which, k] + (1.0 - keep) * by_goal[k]
    slopes[which, own] += behind * keep * by_lag


@inner
def advance_valves(
    valves: Array,
    slopes: Array,
    history: Array,
    step: float,
    tick: float,
    q: Array,
    valve_at: IntArray,
    play_at: int,
) -> None:
    """Move all valves on by `step` seconds; `tick` is the time from one row of the history to the next."""
    by_goal = np.empty(at.OWN)
    play = q[play_at]
    for j in range(len(valves)):
        row, mine = valves[j], slopes[j]
        goal, by_delay = delayed(history, j, q[valve_at[j, at.DELAY]], tick)
        by_goal[:] = 0.0
        by_goal[at.BY_DELAY] = by_delay
        lag = q[valve_at[j, at.PILOT_LAG]]
        keep = math.exp(-step / lag)
        _lag(row, at.PILOT_1, goal, keep, mine, by_goal, at.BY_PILOT_LAG, step / (lag * lag))
        _lag(row, at.PILOT_2, row[at.PILOT_1], keep, mine, mine[at.PILOT_1], at.BY_PILOT_LAG, step / (lag * lag))
        pilot = row[at.PILOT_2]
        if row[at.PLAYED] > pilot + play or row[at.PLAYED] < pilot - play:
            side = 1.0 if row[at.PLAYED] > pilot else -1.0
            row[at.PLAYED] = pilot + side * play
            mine[at.PLAYED] = mine[at.PILOT_2]
            mine[at.PLAYED, at.BY_PLAY] += side
        lag = q[valve_at[j, at.SPOOL_LAG]]
        keep = math.exp(-step / lag)
        _lag(row, at.SPOOL_1, row[at.PLAYED], keep, mine, mine[at.PLAYED], at.BY_SPOOL_LAG, step / (lag * lag))
        _lag(row, at.SPOOL, row[at.SPOOL_1], keep, mine, mine[at.SPOOL_1], at.BY_SPOOL_LAG, step / (lag * lag))


@inner
def own_places(j: int, valve_at: IntArray, play_at: int, places: IntArray) -> None:
    """Write the positions of the parameters in a valve's own tangents."""
    places[at.BY_DELAY] = valve_at[j, at.DELAY]
    places[at.BY_PILOT_LAG] = valve_at[j, at.PILOT_LAG]
    places[at.BY_SPOOL_LAG] = valve_at[j, at.SPOOL_LAG]
    places[at.BY_PLAY] = play_at


@inner
def displace(
    displacement: Array,
    tangents: Array,
    valves: Array,
    slopes: Array,
    pressures: tuple[Array, Array],
    step: float,
    q: Array,
    form: tuple[IntArray, ...],
    circuit: int,
    columns_by: int,
) -> None:
    """Move the displacements of all pumps towards the pilots' demand, under the common power limit.

    Args:
        displacement: shares of full ``(pump,)``, moved; `tangents` theirs ``(pump, column)``.
        tangents: moved as well, if `columns_by`.
        valves: state of the valves; `slopes` their tangents.
        slopes: of the valves.
        pressures: of the pump lines (MPa) and their tangents.
        step: s.
        q: numbers.
        form: of the model.
        circuit: place of the circuit's numbers.
        columns_by: by what tangents are carried along, see `layout.BY_NUMBERS`.
    """
    valve_at, _, valve_pump, _, pump_at = form
    pumps, columns, numbered = len(displacement), tangents.shape[1], columns_by == at.BY_NUMBERS
    start, span = q[circuit + at.DEMAND_START], q[circuit + at.DEMAND_SPAN]
    asked, by_asked = np.empty(pumps), np.zeros((pumps, columns))
    own = np.empty(at.OWN, np.int64)
    power = 0.0
    for m in range(pumps):
        asked[m] = q[pump_at[m] + at.LEAST]
        best, best_r, inside = -1, 0.0, False
        for j in range(len(valves)):
            if valve_pump[j] == m:
                pilot = valves[j, at.PILOT_2]
                r = min(max((abs(pilot) - start) / span, 0.0), 1.0)
                gain = q[valve_at[j, at.GAIN + (0 if pilot >= 0.0 else 1)]]
                if min(gain * r, 1.0) > asked[m]:
                    asked[m], best, best_r, inside = min(gain * r, 1.0), j, r, gain * r < 1.0
        power += q[pump_at[m] + at.FLOW] * asked[m] * max(pressures[0][m], 0.0)
        if not numbered:
            continue
        if best < 0:
            by_asked[m, pump_at[m] + at.LEAST] = 1.0
        elif inside:
            pilot = valves[best, at.PILOT_2]
            gain_at = valve_at[best, at.GAIN + (0 if pilot >= 0.0 else 1)]
            by_asked[m, gain_at] = best_r
            if best_r < 1.0:
                along = q[gain_at] / span
                by_asked[m, circuit + at.DEMAND_START] = -along
                by_asked[m, circuit + at.DEMAND_SPAN] = -along * best_r
                own_places(best, valve_at, circuit + at.PLAY, own)
                for k in range(at.OWN):
                    by_asked[m, own[k]] += along * slopes[best, at.PILOT_2, k] * (1.0 if pilot >= 0.0 else -1.0)
    limit = min(1.0, q[circuit + at.POWER] / max(power, IDLE))
    by_limit = np.zeros(columns)
    if numbered and limit < 1.0:
        by_limit[circuit + at.POWER] = limit / q[circuit + at.POWER]
    if columns_by and limit < 1.0:
        for m in range(pumps):
            p = max(pressures[0][m], 0.0)
            flow = q[pump_at[m] + at.FLOW]
            if numbered:
                by_limit[pump_at[m] + at.FLOW] -= limit / power * asked[m] * p
            for k in range(columns):
                by_limit[k] -= (
                    limit / power * flow * (by_asked[m, k] * p + (asked[m] * pressures[1][m, k] if p > 0.0 else 0.0))
                )
    for m in range(pumps):
        lag = q[pump_at[m] + at.LAG]
        keep, goal = math.exp(-step / lag), asked[m] * limit
        behind = displacement[m] - goal
        displacement[m] = goal + behind * keep
        if columns_by:
            for k in range(columns):
                by_goal = by_asked[m, k] * limit + asked[m] * by_limit[k]
                tangents[m, k] = keep * tangents[m, k] + (1.0 - keep) * by_goal
        if numbered:
            tangents[m, pump_at[m] + at.LAG] += behind * keep * step / (lag * lag)
