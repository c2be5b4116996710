"""Command path of neighbouring runs: exact spools, pilots and displacements of each run."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from edp.networks.twin.grey import layout as at
from edp.networks.twin.grey.near_jit import inner
from edp.networks.twin.grey.steps import GAMMA
from edp.networks.twin.grey.valve import IDLE

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]


@inner
def _demand(demands: Array, past: Array, t: int, j: int, delay: float) -> float:
    """Return the demand of valve `j` one dead time (in samples) before sample t, interpolated.

    From `past` before the run.
    """
    ticks = min(max(delay, 0.0), len(past) - 2.0)
    whole = min(int(ticks), len(past) - 2)
    part = ticks - whole
    newer = demands[t - whole, j] if whole <= t else past[whole - t - 1, j]
    older = demands[t - whole - 1, j] if whole < t else past[whole - t, j]
    return float(newer + part * (older - newer))


@inner
def _spool_way(
    demands: Array,
    past: Array,
    j: int,
    ticks: tuple[int, int],
    time: tuple[float, int],
    numbers: tuple[Array, IntArray, float],
    valves: Array,
    spools: Array,
    pilots: Array,
) -> None:
    """Advance a valve of one run from its state `valves[t]`, like `valve.advance_valves`.

    Args:
        demands: shape (tick, valve).
        past: those before, newest first, shape (row, valve).
        j: the valve.
        ticks: the first one, and the end.
        time: length of a tick (s), and steps in it.
        numbers: of the grey box, places of those of the valves, and the play.
        valves: state before each tick, and after the last one; written, shape (tick + 1, valve, state).
        spools: written: at each stage, shape (tick, 2 * step, valve).
        pilots: written: in the middle of each step, shape (tick, step, valve).
    """
    q, valve_at, play = numbers
    step = time[0] / time[1]
    delay = q[valve_at[j, at.DELAY]] / time[0]
    pilot_lag, spool_lag = q[valve_at[j, at.PILOT_LAG]], q[valve_at[j, at.SPOOL_LAG]]
    keep_pilot, keep_spool = np.empty(2), np.empty(2)
    for stage in range(2):
        h = GAMMA * step if stage == 0 else (1.0 - GAMMA) * step
        keep_pilot[stage], keep_spool[stage] = math.exp(-h / pilot_lag), math.exp(-h / spool_lag)
    for t in range(ticks[0], ticks[1]):
        row = valves[t + 1, j]
        row[:] = valves[t, j]
        goal = _demand(demands, past, t, j, delay)
        for stage in range(2 * time[1]):
            keep, slow = keep_pilot[stage % 2], keep_spool[stage % 2]
            row[at.PILOT_1] = goal + (row[at.PILOT_1] - goal) * keep
            row[at.PILOT_2] = row[at.PILOT_1] + (row[at.PILOT_2] - row[at.PILOT_1]) * keep
            pilot = row[at.PILOT_2]
            row[at.PLAYED] = min(max(row[at.PLAYED], pilot - play), pilot + play)
            row[at.SPOOL_1] = row[at.PLAYED] + (row[at.SPOOL_1] - row[at.PLAYED]) * slow
            row[at.SPOOL] = row[at.SPOOL_1] + (row[at.SPOOL] - row[at.SPOOL_1]) * slow
            spools[t, stage, j] = row[at.SPOOL]
            if stage % 2 == 0:
                pilots[t, stage // 2, j] = pilot


@inner
def spool_ways(
    demands: Array,
    past: Array,
    first: IntArray,
    time: tuple[float, int],
    numbers: tuple[Array, IntArray, float],
    valves: Array,
    differs: NDArray[np.bool_],
    spools: Array,
    pilots: Array,
) -> None:
    """Compute spools and pilots of all runs; `differs` is set for valves that differ from the first run.

    Args:
        demands: shape (run, tick, valve).
        past: as in `_spool_way`.
        first: tick at which each run branches off, shape (run,).
        time: as in `_spool_way`; so are `numbers`.
        numbers: as in `_spool_way`.
        valves: before tick 0, shape (valve, state); moved to behind the first run.
        differs: shape (run, valve).
        spools: written, shape (run, tick, 2 * step, valve).
        pilots: written, shape (run, tick, step, valve).
    """
    runs, ticks, count = demands.shape
    base, own = np.empty((ticks + 1, count, at.VALVE_STATES)), np.empty((ticks + 1, count, at.VALVE_STATES))
    base[0] = valves
    for run in range(runs):
        if run > 0:
            spools[run], pilots[run] = spools[0], pilots[0]
        for j in range(count):
            apart = run == 0
            for t in range(first[run], ticks):
                apart = apart or demands[run, t, j] != demands[0, t, j]
            differs[run, j] = apart
            if not apart:
                continue
            if run > 0:
                own[first[run], j] = base[first[run], j]
            states = base if run == 0 else own
            _spool_way(
                demands[run], past, j, (first[run], ticks), time, numbers, states, spools[run], pilots[run]
            )  # fmt: skip
    valves[:] = base[ticks]


@inner
def displace_by(
    displacement: Array,
    pilots: Array,
    lines: Array,
    step: float,
    q: Array,
    form: tuple[IntArray, ...],
    circuit: int,
) -> None:
    """Displacements after a step, as `valve.displace` moves them, from pilots ``(valve,)`` and line pressures."""
    valve_at, _, valve_pump, _, pump_at = form
    start, per_span = q[circuit + at.DEMAND_START], 1.0 / q[circuit + at.DEMAND_SPAN]
    asked, power = np.empty(len(displacement)), 0.0
    for m in range(len(displacement)):
        asked[m] = q[pump_at[m] + at.LEAST]
        for j in range(len(pilots)):
            if valve_pump[j] == m:
                r = min(max((abs(pilots[j]) - start) * per_span, 0.0), 1.0)
                gain = q[valve_at[j, at.GAIN + (0 if pilots[j] >= 0.0 else 1)]]
                asked[m] = max(asked[m], min(gain * r, 1.0))
        power += q[pump_at[m] + at.FLOW] * asked[m] * max(lines[m], 0.0)
    limit = min(1.0, q[circuit + at.POWER] / max(power, IDLE))
    for m in range(len(displacement)):
        goal = asked[m] * limit
        displacement[m] = goal + (displacement[m] - goal) * math.exp(-step / q[pump_at[m] + at.LAG])


@inner
def centre(x: Array, m: int, q: Array, valve_pump: IntArray, pump: int) -> float:
    """Return the open-centre area of pump `m`, whose parameters begin at `pump`, with spools at `x` ``(valve,)``."""
    closed, area = 1.0 / q[pump + at.BYPASS_CLOSED], q[pump + at.BYPASS]
    for j in range(len(x)):
        if valve_pump[j] == m:
            left = max(1.0 - abs(x[j]) * closed, 0.0)
            area *= left * left
    return float(area)
