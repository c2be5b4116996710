"""One machine with the equations of a grey box, and linearised neighbouring runs, for the plan at each sample.

The first run is the grey box itself. The others differ from it by commands: their spools, pilots and displacements are
run as they are, dead bands and play among them; pressures, velocities and strokes follow by the tangent of each
implicit stage, whose matrix the first run has already factorised. What changes of the strokes do to volumes, cushions,
inertia and gravity is left out: within a plan they are a few per cent of what drives the machine.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from edp.networks.twin.grey import layout as at
from edp.networks.twin.grey.near_jit import compiled, inner
from edp.networks.twin.grey.near_tangents import bristles_of_others, contents_of_others, hold_others, stage_of_others
from edp.networks.twin.grey.near_valves import displace_by, spool_ways
from edp.networks.twin.grey.run import feed, hold_bounds, work_arrays
from edp.networks.twin.grey.stage import newton
from edp.networks.twin.grey.steps import AHEAD, GAMMA, bristles, fill_contents, freeze, move

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
TOLERANCE = 1e-5
"""Of the last change of Newton's method, in MPa and m/s: what is left then is about its square."""
BETWEEN = GAMMA / (1.0 - GAMMA)
"""Where the first stage of a step over two ticks lies between the two stages of the first of them."""


@inner
def _step(
    state: tuple[Array, Array, Array],
    others: tuple[Array, Array, Array],
    displacements: Array,
    valves: tuple[Array, Array, NDArray[np.bool_]],
    resistance: Array,
    model: tuple[Array, ...],
    form: tuple[IntArray, ...],
    places: tuple[int, int, int, int],
    exponents: IntArray,
    time: tuple[float, int],
    scratch: tuple[tuple[Array, ...], ...],
) -> None:
    """Advance all runs by one implicit step; the first run's step equals that of `steps.tick`.

    Args:
        state: y, strokes and bristles of the first run; moved.
        others: differences of the others, shape (..., column); moved.
        displacements: shape (run, pump); moved.
        valves: spools at both stages, shape (run, stage, valve), pilots, shape (run, valve), and which differ.
        resistance: as in `run_near`; so are the following.
        model: numbers and linkage.
        form: places of valves and elements.
        places: of coefficients and circuit.
        exponents: of the load.
        time: tick (s) and steps in it.
        scratch: of `run.work_arrays`.
    """
    y, s, z = state
    d_y, d_s, d_z = others
    q, knots, _, scale, _ = model
    sums, out, loads, terms, vectors, _ = scratch
    frozen, before_v, base, base_z = vectors[0], vectors[2], vectors[3], vectors[4]
    start, reached = vectors[5], vectors[7]
    n, circuit, columns = len(s), places[3], d_y.shape[1]
    nodes, step, none = len(y) - n, time[0] / time[1], np.zeros((len(y), 0))
    no_z = np.zeros((n, 0))
    before_v[:] = y[nodes:]
    freeze(s, (none, none), model, places, exponents, step, scratch, at.NONE)
    for i in range(n):
        loads[0][i] += resistance[i]
    small = (loads[0], loads[1], loads[8], loads[9], terms[0], loads[10], loads[11])
    start[:], start_z = y, z.copy()
    base_z[:] = z
    fill_contents(y, none, nodes, q, circuit, base, none, at.NONE)
    d_base, d_reached, d_base_z = np.empty_like(d_y), np.empty_like(d_y), d_z.copy()
    contents_of_others(d_y, y, nodes, q, circuit, d_base)
    d_v, d_start_z = d_y[nodes:].copy(), d_z.copy()
    lines = np.empty(nodes - 2 * n)
    for run in range(len(displacements)):
        for m in range(len(lines)):
            lines[m] = start[2 * n + m] + (d_y[2 * n + m, run - 1] if run > 0 else 0.0)
        displace_by(displacements[run], valves[1][run], lines, step, q, form, circuit)
    flows = np.empty((len(lines), columns))
    for m in range(len(lines)):
        for k in range(columns):
            flows[m, k] = q[form[4][m] + at.FLOW] * (displacements[k + 1, m] - displacements[0, m])
    for which in range(2):
        h = GAMMA * step
        half = 0.5 * (h if which == 0 else step)
        now, x = (y, base, h), valves[0][0, which].copy()
        stroke = (s, before_v, half)
        newton(now, x, displacements[0], frozen, stroke, base_z, q, form, small, places, knots, sums, out, TOLERANCE)
        if columns > 0:
            bases, spools = (d_base, d_base_z, d_s, d_v), (valves[0][:, which], valves[2])
            stage_of_others(
                d_y, bases, spools, flows, (y, base_z, h, half), (frozen, s, before_v), q, form, knots, circuit, sums,
                (loads[8], out[1]),
            )  # fmt: skip
            bristles_of_others(d_z, d_base_z, d_y, y, base_z, h, q, form[3])
        bristles(y, base_z, h, q, form[3], z, (no_z, no_z, none), at.NONE)
        if which == 0:
            fill_contents(y, none, nodes, q, circuit, reached, none, at.NONE)
            contents_of_others(d_y, y, nodes, q, circuit, d_reached)
            base[:] += AHEAD * (reached - base)
            base_z[:] = start_z + AHEAD * (z - start_z)
            d_base[:] += AHEAD * (d_reached - d_base)
            d_base_z[:] = d_start_z + AHEAD * (d_z - d_start_z)
    ends = ((before_v, d_v), (y[nodes:], d_y[nodes:]))
    move(s, d_s, s, d_s, ends[0], ends[1], 0.5 * step, scale, at.BY_STATE)


@inner
def _write(t: int, ports: IntArray, units: Array, y: Array, s: Array, d_y: Array, d_s: Array, answers: Array) -> None:
    """Answers of all runs after tick t, in SI units."""
    nodes = len(y) - len(s)
    for c in range(len(ports)):
        kind, which = ports[c, 0], ports[c, 1]
        index = which + (0 if kind == 2 else nodes)
        value = s[which] if kind == 1 else y[index]
        answers[0, t, c] = value * units[c]
        for k in range(d_y.shape[1]):
            apart = d_s[which, k] if kind == 1 else d_y[index, k]
            answers[k + 1, t, c] = (value + apart) * units[c]


@inner
def _write_between(t: int, ports: IntArray, half: float, answers: Array) -> None:
    """Interpolate outputs of all runs at sample t between the solved samples before and after it.

    Args:
        t: the tick, of which there is one before.
        ports: kind and number of the state behind each answer ``(answer, 2)``.
        half: half a tick, s.
        answers: read and written ``(run, tick, answer)``.
    """
    for run in range(len(answers)):
        for c in range(len(ports)):
            before, after = answers[run, t - 1, c], answers[run, t + 1, c]
            answers[run, t, c] = 0.5 * (before + after)
        for c in range(len(ports)):
            if ports[c, 0] != 1:
                continue
            for v in range(len(ports)):
                if ports[v, 0] == 0 and ports[v, 1] == ports[c, 1]:
                    moved = half * (answers[run, t - 1, v] + answers[run, t, v])
                    answers[run, t, c] = answers[run, t - 1, c] + moved


@compiled
def run_near(
    demands: Array,
    measured: Array,
    first: IntArray,
    state: tuple[Array, ...],
    resistance: Array,
    limits: tuple[Array, Array, Array],
    model: tuple[Array, ...],
    form: tuple[IntArray, ...],
    ports: IntArray,
    places: tuple[int, int, int, int],
    exponents: IntArray,
    time: tuple[float, int],
    single: int,
    answers: Array,
) -> None:
    """Simulate one machine in free run from the measured state, and neighbouring runs to first order.

    From tick `single` on, a step may go over two ticks: what is answered between them lies on their velocities' line.

    Args:
        demands: of the valves ``(run, tick, valve)``; those of a run the first one's before it branches off.
        measured: what the ports read at the first tick, in units of the grey box ``(answer,)``, NaN where one is free.
        first: tick at which each run branches off the first one ``(run,)``, its own zero.
        state: of the machine: y, strokes, bristles, displacements, valves and history; moved by the first run.
        resistance: forces against each actuator that the load does not know of, MN ``(actuator,)``.
        limits: as in `run.run_lanes`; so are the following.
        model: numbers and linkage.
        form: places of valves and elements.
        ports: kind and number of the state behind each answer ``(answer, 2)``.
        places: of coefficients and circuit.
        exponents: of the load.
        time: tick (s) and steps in it.
        single: number of ticks each of which has steps of its own.
        answers: written, SI units ``(run, tick, answer)``.
    """
    y, s, z, d, valves, history = state
    runs, ticks, count = demands.shape
    n, unknown, circuit, pumps = len(s), len(y), places[3], len(d)
    nodes, columns = unknown - n, runs - 1
    work = work_arrays(n, nodes, pumps, count, 0, 0, len(exponents), exponents.max())
    scratch = (work[0], work[1], work[2], work[3], work[4], work[5])
    differs, spools = np.zeros((runs, count), np.bool_), np.empty((runs, ticks, 2 * time[1], count))
    pilots = np.empty((runs, ticks, time[1], count))
    numbers = (model[0], form[0], model[0][circuit + at.PLAY])
    spool_ways(demands, history, first, time, numbers, valves, differs, spools, pilots)
    d_y, d_s, d_z = np.zeros((unknown, columns)), np.zeros((n, columns)), np.zeros((n, columns))
    d_all = np.empty((runs, pumps))
    d_all[:] = d
    others = (d_y, d_s, d_z)
    feed(measured, measured, False, ports, (y, s), (d_y, d_s), False)
    before_s, before_v = np.empty(n), np.empty(n)
    d_before_s, d_before_v = np.empty((n, columns)), np.empty((n, columns))
    at_stages, asked = np.empty((runs, 2, count)), np.empty((runs, count))
    now, t = (at_stages, asked, differs), 0
    while t < ticks:
        before_s[:], before_v[:], d_before_s[:], d_before_v[:] = s, y[nodes:], d_s, d_y[nodes:]
        double = t >= single and t + 1 < ticks
        if double:
            at_stages[:, 0] = (1.0 - BETWEEN) * spools[:, t, 0] + BETWEEN * spools[:, t, 1]
            at_stages[:, 1] = spools[:, t + 1, 1]
            asked[:] = (1.0 - GAMMA) * pilots[:, t, 0] + GAMMA * pilots[:, t + 1, 0]
        for step in range(1 if double else time[1]):
            if not double:
                at_stages[:], asked[:] = spools[:, t, 2 * step : 2 * step + 2], pilots[:, t, step]
            length = (2.0 * time[0], 1) if double else time
            _step((y, s, z), others, d_all, now, resistance, model, form, places, exponents, length, scratch)
        whole = 2.0 * time[0] if double else time[0]
        # What a twin promises: a stroke is the trapezoidal integral of the velocities that it answers, one a tick.
        ends = ((before_v, d_before_v), (y[nodes:], d_y[nodes:]))
        move(s, d_s, before_s, d_before_s, ends[0], ends[1], 0.5 * whole, model[3], at.BY_STATE)
        hold_bounds(y, s, (before_s, before_v), ports, limits, whole)
        if columns > 0:
            hold_others(ports, limits, y, s, d_y, d_s)
        t += 2 if double else 1
        _write(t - 1, ports, limits[2], y, s, d_y, d_s, answers)
        if double:
            _write_between(t - 2, ports, 0.25 * whole, answers)
    d[:] = d_all[0]
    for k in range(len(history) - 1, -1, -1):
        history[k] = demands[0, ticks - 1 - k] if k < ticks else history[k - ticks]
