"""Compiled numerics of the predictive controller outside its model, replacing many small NumPy calls.

All compiled code of the controller is in this file, whose content is the fingerprint of the code that is kept on disk.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from edp.storage.machine_code import Compiler

Array = NDArray[np.float64]
compiler = Compiler("control", lambda: (Path(__file__),))


@compiler.inner
def _interpolate(value: float, xs: Array, ys: Array, count: int) -> float:
    """Return `np.interp` on the first `count` points; the end values beyond them."""
    if value <= xs[0]:
        return float(ys[0])
    for i in range(1, count):
        if value < xs[i]:
            return float(ys[i - 1] + (ys[i] - ys[i - 1]) / (xs[i] - xs[i - 1]) * (value - xs[i - 1]))
    return float(ys[count - 1])


@compiler.compiled
def fill_levers(speeds: Array, xs: Array, ys: Array, counts: NDArray[np.int64], levers: Array) -> None:
    """Compute levers from speeds by the tables of both directions.

    Args:
        speeds: m/s, shape (rows, axis).
        xs: speeds of the tables, rising, shape (axis, 2, points); extending first.
        ys: their levers, the same shape.
        counts: points in use, shape (axis, 2).
        levers: written, shape (rows, axis).
    """
    for row in range(speeds.shape[0]):
        for axis in range(speeds.shape[1]):
            speed = speeds[row, axis]
            side = 0 if speed >= 0.0 else 1
            lever = _interpolate(abs(speed), xs[axis, side], ys[axis, side], counts[axis, side])
            levers[row, axis] = lever if side == 0 else -lever


@compiler.compiled
def fill_ways(targets: Array, before: Array, step: Array, last_ticks: NDArray[np.int64], levers: Array) -> None:
    """Compute the levers on the way to the target of each block, with at most `step` per sample.

    Args:
        targets: shape (run, block, axis).
        before: levers of the tick before, shape (axis,).
        step: shape (axis,).
        last_ticks: last sample of each block, shape (block,).
        levers: written, shape (run, tick, axis).
    """
    runs, ticks, axes = levers.shape
    for run in range(runs):
        for axis in range(axes):
            lever, most, block = before[axis], step[axis], 0
            for tick in range(ticks):
                if tick > last_ticks[block]:
                    block += 1
                lever += min(max(targets[run, block, axis] - lever, -most), most)
                levers[run, tick, axis] = lever


@compiler.compiled
def fill_poses(strokes: Array, angles: Array, full: Array, lengths: Array, tips: Array, jacobians: Array) -> None:
    """Compute tip poses and their derivatives, see `edp.control.nmpc.tip.TipTable`.

    Args:
        strokes: m, shape (rows, axis).
        angles: joint angles at nodes of the strokes, rad, shape (nodes, axis).
        full: m, shape (axis,).
        lengths: lengths of the links, m, shape (axis,).
        tips: written, shape (rows, 3).
        jacobians: written, shape (rows, 3, axis).
    """
    nodes, axes = angles.shape
    for row in range(len(strokes)):
        turned, x, y = 0.0, 0.0, 0.0
        for axis in range(axes):
            node = min(max(strokes[row, axis] / full[axis], 0.0), 1.0) * (nodes - 1)
            low = min(int(node), nodes - 2)
            rise = angles[low + 1, axis] - angles[low, axis]
            turned += angles[low, axis] + (node - low) * rise
            slope = rise * (nodes - 1) / full[axis]
            along, up = lengths[axis] * math.cos(turned), lengths[axis] * math.sin(turned)
            x, y = x + along, y + up
            jacobians[row, 2, axis] = slope
            # A joint turns all links behind it: what this link adds turns with all joints before.
            jacobians[row, 0, axis], jacobians[row, 1, axis] = 0.0, 0.0
            for joint in range(axis + 1):
                jacobians[row, 0, joint] -= up * jacobians[row, 2, joint]
                jacobians[row, 1, joint] += along * jacobians[row, 2, joint]
        tips[row, 0], tips[row, 1], tips[row, 2] = x, y, turned


@compiler.compiled
def fill_normal(
    strokes: Array, steps: Array, tips: Array, jacobians: Array, directions: Array, goals: Array, normal: Array
) -> None:
    """Compute the normal equations of the weighted tip errors over a horizon.

    Args:
        strokes: strokes of all runs, the base first, m, shape (variable + 1, tick, axis).
        steps: step of each variable in its run, shape (variable,).
        tips: tips of the base run, shape (tick, 3).
        jacobians: derivatives of the tips by the strokes, shape (tick, 3, axis).
        directions: rows that weight a tip error, shape (tick, 3, 3).
        goals: tips of the reference, shape (tick, 3).
        normal: written, shape (variable, variable + 1): derivatives' products, then those with the errors.
    """
    ticks, count, axes = len(tips), len(steps), strokes.shape[2]
    # A column a variable, and the errors behind them.
    rows = np.empty((3 * ticks, count + 1))
    error = np.empty(3)
    for t in range(ticks):
        for i in range(3):
            error[i] = tips[t, i] - goals[t, i]
        error[2] = (error[2] + math.pi) % (2.0 * math.pi) - math.pi
        for i in range(3):
            row, weighted = 3 * t + i, 0.0
            for j in range(3):
                weighted += directions[t, i, j] * error[j]
            rows[row, count] = weighted
            for v in range(count):
                rows[row, v] = 0.0
            for axis in range(axes):
                by_stroke = 0.0
                for j in range(3):
                    by_stroke += directions[t, i, j] * jacobians[t, j, axis]
                base = strokes[0, t, axis]
                for v in range(count):
                    rows[row, v] += by_stroke * ((strokes[v + 1, t, axis] - base) / steps[v])
    normal[:] = np.dot(np.ascontiguousarray(rows[:, :count].T), rows)


@compiler.compiled
def fill_limits(
    values: Array,
    steps: Array,
    unit: Array,
    ends: tuple[Array, Array, float],
    room: tuple[Array, Array, Array],
) -> int:
    """Write one row for each value near a limit, and return the number of rows.

    Args:
        values: values of all runs at the ends of the blocks, the base first, shape (variable + 1, block, number).
        steps: step of each variable in its run, shape (variable,).
        unit: divisor of each value, shape (number,).
        ends: least and largest share of the unit, shape (number,) each, and the distance within which one is near.
        room: written: slopes by the variables, shape (block * number, variable), least and largest change.
    """
    least, largest, near = ends
    slopes, low, high = room
    rows = 0
    for block in range(values.shape[1]):
        for i in range(values.shape[2]):
            base = values[0, block, i] / unit[i]
            if base < least[i] + near or base > largest[i] - near:
                for v in range(len(steps)):
                    slopes[rows, v] = (values[v + 1, block, i] - values[0, block, i]) / (steps[v] * unit[i])
                low[rows], high[rows] = least[i] - base, largest[i] - base
                rows += 1
    return rows
