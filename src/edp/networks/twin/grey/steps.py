"""Time stepping of a grey box: one sample of one run, with exact tangents by parameters or by the previous state."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from edp.networks.twin.grey import layout as at
from edp.networks.twin.grey.jit import inner
from edp.networks.twin.grey.linkage import freeze_linkage
from edp.networks.twin.grey.motion import basis, bristle_slopes, freeze_load, friction
from edp.networks.twin.grey.stage import TOLERANCE, assemble, content, factorise, newton, solve
from edp.networks.twin.grey.valve import advance_valves, displace, own_places

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
GAMMA = 1.0 - 1.0 / math.sqrt(2.0)
"""Of the SDIRK method: the value at which it is L-stable with the smaller error constant."""
AHEAD = (1.0 - GAMMA) / GAMMA
"""The base of the second stage lies on the line through the start and the first stage, this far beyond the latter."""


@inner
def _tangents_of_stage(
    solved: Array,
    base: Array,
    bristle: tuple[Array, Array],
    tangents: tuple[Array, ...],
    now: tuple[Array, Array, float],
    stroke: tuple[Array, Array, float],
    q: Array,
    form: tuple[IntArray, ...],
    load: tuple[Array, ...],
    out: tuple[Array, ...],
    circuit: int,
    frozen: Array,
    columns_by: int,
) -> None:
    """Tangents of y after a stage: ``R_y y' = -(R_q + R_x x' + ...)``, by one factorisation for all columns.

    Args:
        solved: written ``(unknown, column)``: a column is a number, or a state before the tick.
        base: tangents of the base of y.
        bristle: deflections of its base, and their tangents.
        tangents: of the state at the start of the step.
        now: y, base, step.
        stroke: of `stage.motion_rows`.
        q: numbers.
        form: of the model.
        load: inertia, and slopes of its forces by strokes, velocities and numbers.
        out: derivatives of the stage.
        circuit: place of the circuit's numbers.
        frozen: tangents of the frozen strokes.
        columns_by: by what, see `layout.BY_NUMBERS`.
    """
    y, _, step = now
    _, by_y, by_x, by_s, by_d, by_q = out
    t_y, t_s, _, t_d, t_valves = tangents
    n = len(frozen)
    nodes = len(y) - n
    own = np.empty(at.OWN, np.int64)
    columns, numbered = solved.shape[1], columns_by == at.BY_NUMBERS
    for row in range(len(y)):
        for k in range(columns):
            solved[row, k] = -by_q[row, k] if numbered else 0.0
        for i in range(n):
            slope = by_s[row, i] + (step * load[1][row - nodes, i] if row >= nodes else 0.0)
            if slope != 0.0:
                for k in range(columns):
                    solved[row, k] -= slope * frozen[i, k]
        for j in range(by_x.shape[1] if numbered else 0):
            slope = by_x[row, j]
            if slope != 0.0:
                own_places(j, form[0], circuit + at.PLAY, own)
                for k in range(at.OWN):
                    solved[row, own[k]] -= slope * t_valves[j, at.SPOOL, k]
        if row < nodes:
            for m in range(by_d.shape[1]):
                if by_d[row, m] != 0.0:
                    for k in range(columns):
                        solved[row, k] -= by_d[row, m] * t_d[m, k]
            for k in range(columns):
                solved[row, k] += base[row, k]
            continue
        i = row - nodes
        a = form[3][i]
        by_before = step * friction(y[row], bristle[0][i], step, a, q)[3]
        reached = stroke[0][i] + stroke[2] * (stroke[1][i] + y[row])
        inside = q[a + at.STOP_LOW] <= reached <= q[a + at.STOP_HIGH]
        touched = 0.0 if inside else step * q[a + at.STOP_STIFFNESS]
        for k in range(columns):
            solved[row, k] -= (step * load[3][i, k] if numbered else 0.0) + by_before * bristle[1][i, k]
            solved[row, k] -= touched * (t_s[i, k] + stroke[2] * t_y[row, k])
        for m in range(n):
            mass, slope = load[0][i, m], step * load[2][i, m]
            for k in range(columns):
                solved[row, k] += mass * base[nodes + m, k] - slope * t_y[nodes + m, k]
    factorise(by_y)
    solve(by_y, solved)


@inner
def bristles(
    y: Array,
    base: Array,
    step: float,
    q: Array,
    actuator_at: IntArray,
    z: Array,
    tangents: tuple[Array, Array, Array],
    columns_by: int,
) -> None:
    """Deflections after a stage into `z`, and their tangents; `tangents`: theirs, of their base, and of y."""
    n = len(z)
    nodes = len(y) - n
    t_z, t_base, t_y = tangents
    for i in range(n):
        a = actuator_at[i]
        z[i], _, _, _, under, _ = friction(y[nodes + i], base[i], step, a, q)
        if columns_by:
            by_v, own = bristle_slopes(y[nodes + i], base[i], step, a, q)
            for k in range(t_z.shape[1]):
                t_z[i, k] = under * t_base[i, k] + by_v * t_y[nodes + i, k]
        if columns_by == at.BY_NUMBERS:
            t_z[i, a + at.COULOMB] += own[0]
            t_z[i, a + at.STATIC] += own[1]
            t_z[i, a + at.STRIBECK] += own[2]
            t_z[i, a + at.BRISTLE] += own[3]


@inner
def fill_contents(
    y: Array, t_y: Array, nodes: int, q: Array, circuit: int, contents: Array, t_contents: Array, columns_by: int
) -> None:
    """Compute the contents for pressures and velocities: oil volumes and the velocities themselves, with tangents."""
    contents[nodes:] = y[nodes:]
    if columns_by:
        t_contents[nodes:] = t_y[nodes:]
    for k in range(nodes):
        contents[k], by_p, by_bulk, by_air = content(y[k], q[circuit + at.BULK], q[circuit + at.AIR])
        if columns_by:
            for m in range(t_y.shape[1]):
                t_contents[k, m] = by_p * t_y[k, m]
        if columns_by == at.BY_NUMBERS:
            t_contents[k, circuit + at.BULK] += by_bulk
            t_contents[k, circuit + at.AIR] += by_air


@inner
def tick(
    lane: tuple[Array, ...],
    tangents: tuple[Array, ...],
    history: Array,
    model: tuple[Array, ...],
    form: tuple[IntArray, ...],
    places: tuple[int, int, int, int],
    exponents: IntArray,
    time: tuple[float, int],
    work: tuple[tuple[Array, ...], ...],
    columns_by: int,
) -> int:
    """Advance one run by one sample.

    Args:
        lane: y, strokes, bristles, displacements and valves; moved.
        tangents: of these ``(..., column)``; of valves by their own numbers; moved, if `columns_by`.
        history: demands ``(tick, valve)``, newest first.
        model: numbers, knots, middle of the strokes, scale from stroke to z, and a known linkage.
        form: places of valves and elements.
        places: of the load's coefficients and of the circuit.
        exponents: of the load's monomials.
        time: length of the tick (s), and steps in it.
        work: arrays that are written.
        columns_by: by what tangents are carried along: `layout.NONE`, `BY_NUMBERS` or `BY_STATE`.

    Returns:
        Iterations of all stages together.
    """
    y, s, z, d, valves = lane
    t_y, t_s, t_z, t_d, t_valves = tangents
    q, knots, _, scale, _ = model
    sums, out, loads, terms, vectors, matrices = work
    frozen_s, zs, before_v, base, base_z, start, _, reached = vectors
    t_frozen, t_base, t_base_z, t_first, t_start_z, t_reached = matrices
    n, nodes, circuit = len(s), len(y) - len(s), places[3]
    step = time[0] / time[1]
    spent = 0
    at_start, s_start = y[nodes:].copy(), s.copy()
    t_speed, t_stroke = t_y[nodes:].copy(), t_s.copy()
    for _ in range(time[1]):
        before_v[:] = y[nodes:]
        freeze(s, (t_y, t_s), model, places, exponents, step, work, columns_by)
        load = (loads[8], loads[3], loads[4], loads[5])
        small = (loads[0], loads[1], loads[8], loads[9], terms[0], loads[10], loads[11])
        start[:], zs[:], base_z[:] = y, z, z
        fill_contents(y, t_y, nodes, q, circuit, base, t_base, columns_by)
        if columns_by:
            t_first[:], t_start_z[:], t_base_z[:] = t_y, t_z, t_z
        h = GAMMA * step
        for which in range(2):
            advance_valves(
                valves, t_valves, history, h if which == 0 else step - h, time[0], q, form[0], circuit + at.PLAY
            )
            if which == 0:
                lines = (start[2 * n : nodes], t_first[2 * n : nodes])
                displace(d, t_d, valves, t_valves, lines, step, q, form, circuit, columns_by)
            stroke = (s, before_v, 0.5 * (h if which == 0 else step))
            now = (y, base, h)
            x = valves[:, at.SPOOL].copy()
            spent += newton(now, x, d, frozen_s, stroke, base_z, q, form, small, places, knots, sums, out, TOLERANCE)
            if columns_by:
                assemble(now, x, d, frozen_s, stroke, base_z, q, form, small, places, knots, sums, out, True)
                state, bases = (t_first, t_s, t_z, t_d, t_valves), (base_z, t_base_z)
                _tangents_of_stage(
                    t_y, t_base, bases, state, now, stroke, q, form, load, out, circuit, t_frozen, columns_by
                )
            bristles(y, base_z, h, q, form[3], z, (t_z, t_base_z, t_y), columns_by)
            if which == 0:
                fill_contents(y, t_y, nodes, q, circuit, reached, t_reached, columns_by)
                base[:] += AHEAD * (reached - base)
                base_z[:] = zs + AHEAD * (z - zs)
                if columns_by:
                    t_base[:] += AHEAD * (t_reached - t_base)
                    t_base_z[:] = t_start_z + AHEAD * (t_z - t_start_z)
        move(s, t_s, s, t_s, (before_v, t_first[nodes:]), (y[nodes:], t_y[nodes:]), 0.5 * step, scale, columns_by)
    # What a twin promises: a stroke is the trapezoidal integral of the velocities that it answers, one a tick.
    move(s, t_s, s_start, t_stroke, (at_start, t_speed), (y[nodes:], t_y[nodes:]), 0.5 * time[0], scale, columns_by)
    return spent


@inner
def move(
    s: Array,
    t_s: Array,
    start: Array,
    t_start: Array,
    before: tuple[Array, Array],
    after: tuple[Array, Array],
    half: float,
    scale: Array,
    columns_by: int,
) -> None:
    """Strokes and their tangents by the trapezoidal rule, from velocities and their tangents before and after."""
    for i in range(len(s)):
        # A stroke that is not measured has no scale, and nothing depends on it: it stays where it is.
        weight = half if scale[i] > 0.0 else 0.0
        s[i] = start[i] + weight * (before[0][i] + after[0][i])
        if columns_by:
            for k in range(t_s.shape[1]):
                t_s[i, k] = t_start[i, k] + weight * (before[1][i, k] + after[1][i, k])


@inner
def freeze(
    s: Array,
    tangents: tuple[Array, Array],
    model: tuple[Array, ...],
    places: tuple[int, int, int, int],
    exponents: IntArray,
    step: float,
    work: tuple[tuple[Array, ...], ...],
    columns_by: int,
) -> None:
    """Compute the strokes at the middle of the step and the load there; `tangents`: those of y and of the strokes."""
    q, _, middle, scale, linkage = model
    _, _, loads, terms, vectors, matrices = work
    t_y, t_s = tangents
    frozen_s, before_v, z = vectors[0], vectors[2], vectors[6]
    nodes = len(t_y) - len(s)
    for i in range(len(s)):
        half = 0.5 * step if scale[i] > 0.0 else 0.0
        frozen_s[i] = s[i] + half * before_v[i]
        z[i] = (frozen_s[i] - middle[i]) * scale[i]
        if columns_by:
            for k in range(t_s.shape[1]):
                matrices[0][i, k] = t_s[i, k] + half * t_y[nodes + i, k]
    full = columns_by != at.NONE
    force = (loads[0], loads[3], loads[4], loads[5])
    if len(linkage) > 0:
        bodies = (*force, loads[8], loads[9], loads[10], loads[11])
        freeze_linkage(q, places[0], frozen_s, before_v, linkage, bodies, full)
        return
    every = (terms[0], terms[1], loads[7])
    basis(z, exponents, scale, loads[6], every)
    root = (loads[1], loads[2], loads[8], loads[9])
    freeze_load(q, (places[0], places[1], places[2]), before_v, every, root, force, full)
