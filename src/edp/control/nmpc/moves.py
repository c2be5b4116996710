"""Moves over a horizon: requested speeds, a few per lever, and the levers derived by the valve map."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from edp.control.geometry import AXES
from edp.control.limits import LoopLimits
from edp.control.nmpc.compiled import fill_levers, fill_ways
from edp.control.valve_map import SIDES, ValveMap

Array = NDArray[np.float64]
REST_M_S = 0.004
"""Speed below which the lever crosses the dead band on a straight line, m/s. A jump would cause chatter."""


class SpeedToLever:
    """The inverse valve map for arrays, continuous through zero.

    The dead band is thereby in front of the model, not in it: what is solved for acts everywhere.

    Args:
        valves: the map.
        limits: limits of the levers.

    Attributes:
        slowest: least speed (m/s) that each lever's range gives, shape (3,), negative.
        fastest: largest speed (m/s), shape (3,).
    """

    def __init__(self, valves: ValveMap, limits: LoopLimits) -> None:
        self._tables: list[list[tuple[Array, Array]]] = []
        ends = np.zeros((len(SIDES), AXES))
        for axis in range(AXES):
            sides = []
            for side, end in enumerate((limits.lever_high[axis], limits.lever_low[axis])):
                speeds, levers = valves.speeds[axis, side], valves.levers[axis, side]
                knee = float(np.interp(REST_M_S, speeds, levers))
                beyond = speeds > REST_M_S
                table = np.concatenate(([0.0, REST_M_S], speeds[beyond])), np.concatenate(([0.0, knee], levers[beyond]))
                sides.append(table)
                ends[side, axis] = SIDES[side] * float(np.interp(abs(end), table[1], table[0]))
            self._tables.append(sides)
        self._packed = _packed(self._tables)
        self.fastest, self.slowest = ends

    @property
    def tables(self) -> list[list[tuple[Array, Array]]]:
        """Speeds (m/s) and levers of each polygon: by axis, then extending and retracting."""
        return self._tables

    def levers(self, speeds: Array) -> Array:
        """Return the levers for speeds (m/s), shape (..., 3) both."""
        levers = np.empty(speeds.shape)
        rows = np.ascontiguousarray(speeds).reshape(-1, AXES)
        fill_levers(rows, *self._packed, levers.reshape(-1, AXES))
        return levers


def _packed(tables: list[list[tuple[Array, Array]]]) -> tuple[Array, Array, NDArray[np.int64]]:
    """Return the speeds, levers ``(axis, side, point)``, and the points in use, of tables of different lengths."""
    counts = np.array([[len(speeds) for speeds, _ in sides] for sides in tables], np.int64)
    arrays = np.zeros((2, *counts.shape, counts.max()))
    for axis, sides in enumerate(tables):
        for side, table in enumerate(sides):
            arrays[:, axis, side, : counts[axis, side]] = table
    return arrays[0], arrays[1], counts


class Moves:
    """Horizon in blocks of samples with constant requested speeds.

    Args:
        blocks: length of each block in samples.

    Attributes:
        ticks: length of the horizon.
        count: variables: an axis and block each, block by block.
        first: tick at which a run branches off whose variable alone differs, the base first, shape (count + 1,).
    """

    def __init__(self, blocks: tuple[int, ...]) -> None:
        self.blocks, self.ticks = len(blocks), sum(blocks)
        self.count = AXES * self.blocks
        starts = np.cumsum(blocks) - blocks
        self.first = np.concatenate(([0], np.repeat(starts, AXES))).astype(np.int64)
        self.last_ticks = np.cumsum(blocks) - 1
        # Differences from block to block, the first from what was asked for last.
        self.difference = np.eye(self.count) - np.eye(self.count, k=-AXES)

    def runs(self, speeds: Array, steps: Array) -> Array:
        """Return the base run and one run per variable in which it differs by a step.

        Args:
            speeds: speeds of the plan, m/s, shape (block, 3).
            steps: m/s, shape (block, 3).

        Returns:
            Shape (count + 1, block, 3).
        """
        runs = np.repeat(speeds[None], self.count + 1, axis=0)
        variables = runs.reshape(self.count + 1, self.count)
        variables[1:][np.diag_indices(self.count)] += steps.ravel()
        return runs

    def levers(self, targets: Array, before: Array, step: Array) -> Array:
        """Return the levers tick by tick that go to targets of each block at a bounded speed.

        Args:
            targets: shape (run, block, 3).
            before: levers of the tick before, shape (3,).
            step: most that a lever moves in a tick, shape (3,).

        Returns:
            Shape (run, tick, 3).
        """
        levers = np.empty((len(targets), self.ticks, AXES))
        fill_ways(targets, before, step, self.last_ticks, levers)
        return levers
