"""The static valve map: cylinder speed by lever, as commissioning measures it, and its inverse.

It is measured through the plant's sensors alone: each lever is held at some positions, and the measured velocity after
the valve and pump have settled is averaged. Nothing of the plant's parameters is read.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edp.control.geometry import AXES
from edp.control.limits import LoopLimits
from edp.control.plant import VELOCITIES, PlantInterface
from edp.control.reference import TipReference
from edp.errors import ConfigError
from edp.wording import setting_text

Array = NDArray[np.float64]
LEVELS = (*np.arange(0.06, 0.32, 0.02).round(2).tolist(), 0.36, 0.42, 0.5, 0.6, 0.75, 1.0)
"""Lever positions at which the map is measured. The spacing is 0.02 near the ends of the dead bands."""
RUN_S, SETTLE_S = 0.9, 0.5
"""Duration of a run per lever position and its initial transient, which is discarded, s."""
BEGINS = 0.15
"""Distance of the initial stroke from mid stroke, as a fraction of the stroke, opposite to the direction of motion."""
MOVES_M_S = 0.003
"""Mean speed above which a lever position moves its cylinder, m/s: three times the sensor noise in steady state."""
SIDES = (1.0, -1.0)
CYLINDERS = ("boom", "arm", "bucket")
NEARLY = 0.8
"""Fraction of a reference's speed that the map must reach. The map holds at mid stroke; loads differ elsewhere."""


@dataclass(frozen=True, eq=False)
class ValveMap:
    """Cylinder speed by lever, for extending and retracting.

    Attributes:
        levers: positions, shape (3, 2, points): axis, then extending and retracting; rising from the end of the dead
            band.
        speeds: speeds (m/s) at these, the same shape, positive in either direction, rising from zero.
    """

    levers: Array
    speeds: Array

    def lever(self, axis: int, speed: float, rest: float = 0.0) -> float:
        """Return the lever for a cylinder speed (m/s): zero below `rest`, full beyond the largest speed."""
        size = abs(speed)
        if size <= rest:
            return 0.0
        side = 0 if speed > 0.0 else 1
        return float(SIDES[side] * np.interp(size, self.speeds[axis, side], self.levers[axis, side]))

    def speed(self, axis: int, lever: float) -> float:
        """Return the cylinder speed (m/s) at a lever position."""
        side = 0 if lever > 0.0 else 1
        # Below the first position lies the dead band, where the speed is that of the first: zero.
        return float(SIDES[side] * np.interp(abs(lever), self.levers[axis, side], self.speeds[axis, side]))


def check_levers(valves: ValveMap, reference: TipReference, limits: LoopLimits) -> None:
    """Refuse limits of the levers with which a cylinder cannot be nearly as fast as its reference.

    Args:
        valves: valve map of the plant.
        reference: reference to follow.
        limits: limits of the levers.

    Raises:
        ConfigError: names cylinder, speeds and limit.
    """
    speeds = reference.speeds()
    for axis, cylinder in enumerate(CYLINDERS):
        for side, (name, ends) in enumerate((("lever_high", limits.lever_high), ("lever_low", limits.lever_low))):
            asked = float((SIDES[side] * speeds[:, axis]).max())
            fastest = abs(valves.speed(axis, ends[axis]))
            # At full levers the reference was held to the cylinder's top speed when it was drawn.
            if abs(ends[axis]) < 1.0 and asked > max(MOVES_M_S, fastest / NEARLY):
                raise ConfigError(
                    f"limits: {name} = {setting_text(ends[axis])} of the {cylinder} gives {fastest:.3f} m/s, its "
                    "reference asks "
                    f"for {asked:.3f}; allow more, or choose a slower task (task.speed_m_s)"
                )


def measure_valve_map(env: Any, plant: PlantInterface, seed: int = 0) -> ValveMap:
    """Measure the map on a plant, one lever at a time from mid stroke.

    Args:
        env: the plant; it is reset for each of the positions.
        plant: its interface.
        seed: seed of the sensors.

    Raises:
        ConfigError: the plant measures no velocities, or a cylinder does not move.
    """
    columns, rate = plant.columns(VELOCITIES), plant.rate_hz
    ticks, settle = round(RUN_S * rate), round(SETTLE_S * rate)
    measured = np.zeros((AXES, len(SIDES), len(LEVELS)))
    for axis in range(AXES):
        for side, sign in enumerate(SIDES):
            for n, level in enumerate(LEVELS):
                start = np.full(AXES, 0.5)
                start[axis] -= sign * BEGINS
                env.reset(seed=seed, options={"strokes": tuple(map(float, start)), "material": ""})
                levers = np.zeros(AXES, np.float32)
                levers[axis] = sign * level
                rows = [env.step(levers)[0][columns[axis]] for _ in range(ticks)]
                measured[axis, side, n] = sign * float(np.nanmean(rows[settle:]))
    return map_of_speeds(np.array(LEVELS), measured, plant.source)


def map_of_speeds(levels: Array, measured: Array, source: str) -> ValveMap:
    """Create a map from mean speeds at lever positions.

    Args:
        levels: positions, shape (levels,), rising.
        measured: mean speed (m/s) at each, in its direction, shape (3, 2, levels).
        source: name of the plant in messages.

    Raises:
        ConfigError: a cylinder that no position moves.
    """
    levers, speeds = np.zeros_like(measured), np.zeros_like(measured)
    for axis in range(AXES):
        for side in range(len(SIDES)):
            moving = np.flatnonzero(measured[axis, side] > MOVES_M_S)
            # A heavy boom may sink at small levers and then rise: what counts begins after the last rest.
            still = np.flatnonzero(measured[axis, side] <= MOVES_M_S)
            first = int(still[-1]) + 1 if len(still) else 0
            if not len(moving) or first >= len(levels):
                name, way = CYLINDERS[axis], ("extends", "retracts")[side]
                raise ConfigError(f"{source}: no lever position {way} the {name}; a valve map cannot be measured")
            rising = np.maximum.accumulate(measured[axis, side, first:])
            band = _end_of_dead_band(levels, rising, first)
            count = len(levels) - first
            # Points before the band repeat it, so that all polygons have the same length.
            levers[axis, side, :first], levers[axis, side, first:] = band, levels[first:]
            speeds[axis, side, first:] = rising + 1e-6 * np.arange(count)
    # np.interp wants rising speeds also among the points that repeat the end of the dead band.
    return ValveMap(levers, speeds)


def _end_of_dead_band(levels: Array, rising: Array, first: int) -> float:
    """Return lever at which the speed is zero: the line through the first two moving points, within the last step."""
    before = levels[first - 1] if first else 0.0
    if len(rising) < 2 or rising[1] <= rising[0]:
        return float(before)
    slope = (rising[1] - rising[0]) / (levels[first + 1] - levels[first])
    return float(np.clip(levels[first] - rising[0] / slope, before, levels[first]))
