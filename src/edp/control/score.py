"""Scores of a control loop: errors to path and timed reference, energy, lever motion, and limit violations."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edp.control.limits import LoopLimits
from edp.control.reference import TipReference

Array = NDArray[np.float64]
ARRIVED_M = 0.02
"""Distance from the end of the reference within which the tip has arrived, m (a grading tolerance)."""
MOST_SEGMENTS = 2_000
"""Maximum number of path segments for distances: 20 s at 100 Hz. Longer paths are thinned."""
LIMITS = ("lever", "slew", "stroke", "pressure")


@dataclass(frozen=True, eq=False)
class LoopTrace:
    """Recorded control loop, one row per sample.

    Attributes:
        tip: true tip x, y (m) and attitude (rad), shape (ticks, 3).
        strokes: true shares of the strokes, shape (ticks, 3).
        levers: applied, shape (ticks, 3).
        pressures: measured cylinder pressures, Pa, shape (ticks, pressure); no column where none is measured.
        pump_power: hydraulic power of the pumps, W, shape (ticks,); None where the plant does not tell.
    """

    tip: Array
    strokes: Array
    levers: Array
    pressures: Array
    pump_power: Array | None


@dataclass(frozen=True)
class LoopScore:
    """Metrics of a control loop over its evaluated samples.

    Distances to the path alone reward standing still, so the position error, which is the distance to where the
    reference is at that time, always stands beside them.

    Attributes:
        path_rms_mm: distance of the tip to the nearest point of the path, root of the mean square.
        path_p95_mm: 95th percentile of the distance from the path, mm.
        path_max_mm: maximum distance from the path, mm.
        position_rms_mm: distance of the tip to the reference of the same time, root of the mean square.
        position_p95_mm: 95th percentile of the position error, mm.
        position_max_mm: maximum position error, mm.
        attitude_rms_deg: error of the bucket's attitude.
        arrived_s: seconds from the first evaluated tick until the tip stays within `ARRIVED_M` of the end; None where
            it does not.
        energy_kj: hydraulic energy of the pumps; None where the plant does not tell.
        lever_travel: sum of the changes of all levers, in full positions.
        violations: number of samples at which each of `LIMITS` was violated.
        missed: number of samples at which the controller had no output.
        finished: whether the loop ran to the end of the reference.
    """

    path_rms_mm: float
    path_p95_mm: float
    path_max_mm: float
    position_rms_mm: float
    position_p95_mm: float
    position_max_mm: float
    attitude_rms_deg: float
    arrived_s: float | None
    energy_kj: float | None
    lever_travel: float
    violations: Mapping[str, int]
    missed: int
    finished: bool


def scored(trace: LoopTrace, reference: TipReference, limits: LoopLimits, missed: int = 0) -> LoopScore:
    """Score a loop.

    Args:
        trace: trace of the loop; it may be shorter than the reference, but must include its evaluated part.
        reference: reference of the loop.
        limits: limits of the loop.
        missed: number of samples at which the controller had no output.
    """
    ticks, rate = len(trace.tip), reference.rate_hz
    judged = reference.judged[:ticks]
    # A loop that broke off before the judged part is judged by what it did.
    judged = judged if judged.any() else np.ones(ticks, bool)
    tip, goal = trace.tip[judged], reference.tip[:ticks][judged]
    path = 1e3 * path_distance(tip[:, :2], reference.tip[reference.judged][:, :2])
    position = 1e3 * np.hypot(*(tip - goal)[:, :2].T)
    # The difference of two angles, whatever turn they are counted in.
    attitude = np.angle(np.exp(1j * (tip[:, 2] - goal[:, 2])))
    energy = None if trace.pump_power is None else float(trace.pump_power[judged].sum()) / rate / 1e3
    return LoopScore(
        *_figures(path),
        *_figures(position),
        float(np.degrees(np.sqrt(np.mean(attitude**2)))),
        _arrival(tip, reference, rate) if ticks == reference.ticks else None,
        energy,
        float(np.abs(np.diff(trace.levers, axis=0, prepend=0.0)).sum()),
        _violations(trace, limits, rate),
        missed,
        ticks == reference.ticks,
    )


def path_distance(points: Array, path: Array) -> Array:
    """Return the distance of points, shape (points, 2), to a polyline, shape (corners, 2); shape (points,)."""
    moved = np.concatenate(([True], np.abs(np.diff(path, axis=0)).max(axis=1) > 0.0))
    corners = path[moved]
    if len(corners) > MOST_SEGMENTS:
        corners = corners[np.linspace(0, len(corners) - 1, MOST_SEGMENTS).round().astype(int)]
    if len(corners) == 1:
        return np.asarray(np.hypot(*(points - corners[0]).T))
    along = np.diff(corners, axis=0)
    squared = (along**2).sum(axis=1)
    least = np.full(len(points), np.inf)
    for corner, leg, size in zip(corners[:-1], along, squared, strict=True):
        share = np.clip((points - corner) @ leg / size, 0.0, 1.0)
        least = np.minimum(least, ((points - corner - share[:, None] * leg) ** 2).sum(axis=1))
    return np.asarray(np.sqrt(least))


def _figures(errors: Array) -> tuple[float, float, float]:
    """Return the root of the mean square, 95th percentile, largest value."""
    return float(np.sqrt(np.mean(errors**2))), float(np.percentile(errors, 95.0)), float(errors.max())


def _arrival(tip: Array, reference: TipReference, rate: float) -> float | None:
    """Return the seconds after which the tip stays near the end of the reference."""
    away = np.hypot(*(tip - reference.tip[-1])[:, :2].T) > ARRIVED_M
    if away[-1]:
        return None
    return float(np.flatnonzero(away)[-1] + 1) / rate if away.any() else 0.0


def _violations(trace: LoopTrace, limits: LoopLimits, rate: float) -> dict[str, int]:
    """Return the ticks at which a limit was violated, by its name."""
    # 1e-9: a lever exactly at its limit keeps it.
    levers, slew = trace.levers, np.abs(np.diff(trace.levers, axis=0, prepend=0.0)) * rate
    beyond = (levers < np.array(limits.lever_low) - 1e-9) | (levers > np.array(limits.lever_high) + 1e-9)
    ends = (trace.strokes < limits.stroke_margin) | (trace.strokes > 1.0 - limits.stroke_margin)
    over = (beyond, slew > np.array(limits.slew_per_s) * (1.0 + 1e-9), ends, trace.pressures > limits.pressure_pa)
    return {name: int(values.any(axis=1).sum()) for name, values in zip(LIMITS, over, strict=True)}
