"""Flow through a spool: spool position from commands, opening of each path, and driving pressure.

Single precision and a fixed order throughout, so that C gives the same numbers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.signal import cont2discrete, lfilter

Array = NDArray[np.float64]
Singles = NDArray[np.float32]
DAMPING = 0.95
"""Damping ratio of both valve stages. Pilots and spools hardly oscillate."""
KNOTS = np.array([0.04, 0.08, 0.11, 0.14, 0.17, 0.21, 0.26, 0.33, 0.42, 0.54, 0.7, 0.85, 1.0], np.float32)
"""Knots of the piecewise-linear opening curves, as fractions of spool travel. The opening is zero at the first knot,
and knots are dense where flow begins.
"""
MEGA = np.float32(1e-6)
SMOOTH = np.float32(0.01)
"""Smoothing of the orifice equation in MPa^2. Flow becomes laminar below 1 bar, so the root has a finite slope."""
RELIEFS = np.array([25.0, 30.0, 33.0, 36.0, 38.0], np.float32)
"""Pressures in MPa above which the flow through a port relief valve may rise."""
CAVITY = np.float32(0.1)
"""Pressure in MPa added in the oil-stiffness term for free air: atmospheric pressure."""
EMPTY = np.float32(0.8)
"""Chamber pressure in MPa below which cavitation is possible."""
BEGUN = 0.01
"""Fraction of its largest opening above which a flow path counts as open."""
DOUBTS = 8
"""Number of terms of the uncertainty; see `doubts_of`."""
LINES = 9 + len(RELIEFS)
"""Number of terms that do not depend on a spool; see `lines_of`."""
BACK = 2
"""Delay of a balance in samples. The pressure rate at a sample needs two samples on either side."""


@dataclass(frozen=True, eq=False)
class SpoolModel:
    """Spool positions from commands: dead time, two second-order stages, and play between them.

    Attributes:
        extend: place of the command that extends, among the inputs, shape (spools,).
        retract: index of the command that retracts; -1 if one signed channel commands both directions.
        gain: inverse of the full command of each spool, shape (spools,).
        dead: dead time in ticks, shape (spools,).
        stages: b1, b2, a1, a2 of each stage, shape (spools, 2, 4).
        play: half width, as a share of travel, shape (spools,).
    """

    extend: NDArray[np.int64]
    retract: NDArray[np.int64]
    gain: Singles
    dead: Array
    stages: Singles
    play: Singles

    def adjust_to_sister(self, rng: np.random.Generator, tolerance: float, rate_hz: float) -> SpoolModel:
        """Return the spools of another machine of the series; see `ResidualSource.adjust_to_sister`."""
        gain, dead, play = (
            values * (1.0 + rng.uniform(-tolerance, tolerance, values.shape))
            for values in (self.gain, self.dead, self.play)
        )
        # The last number of a stage is exp(-2 DAMPING w / rate).
        turns = -np.log(np.maximum(self.stages[..., 3].astype(np.float64), 1e-30)) / (4.0 * np.pi * DAMPING)
        frequencies = turns * rate_hz * (1.0 + rng.uniform(-tolerance, tolerance, turns.shape))
        stages = np.array([[stage_of(float(one), rate_hz) for one in spool] for spool in frequencies])
        single = (values.astype(np.float32) for values in (gain, stages, play))
        gains, both, plays = single
        return SpoolModel(self.extend, self.retract, gains, dead, both, plays)

    @property
    def memory(self) -> int:
        """Rows before a tick that are needed for it."""
        return int(np.floor(self.dead).max(initial=0.0)) + BACK + 2

    def demands(self, rows: Singles) -> Singles:
        """Return the commands as fractions of full scale, shape (..., spools)."""
        away = np.where(self.retract >= 0, rows[..., np.maximum(self.retract, 0)], np.float32(0.0))
        scaled: Singles = (rows[..., self.extend] - away) * self.gain
        return scaled

    def start(self, demand: Singles) -> list[Singles]:
        """Return the steady state for a demand, shape (streams, spools): two values per stage, and the play's."""
        stages = [
            np.stack([demand, demand * (self.stages[:, stage, 1] - self.stages[:, stage, 3])], axis=-1)
            for stage in (0, 1)
        ]
        return [*stages, demand]

    def run(self, rows: Singles, state: Sequence[Singles]) -> tuple[Singles, list[Singles]]:
        """Return the positions `BACK` samples before each of the last samples, as fractions of travel.

        Args:
            rows: `memory` rows, and the ticks behind them, shape (streams, memory + ticks, inputs).
            state: before them.

        Returns:
            Shape (streams, ticks, spools), and the state behind them.
        """
        demands, ticks = self.demands(rows), rows.shape[1] - self.memory
        out = np.empty((len(rows), ticks, len(self.gain)), np.float32)
        first, second, rest = (part.copy() for part in state)
        for spool in range(len(self.gain)):
            whole = int(np.floor(self.dead[spool]))
            part = np.float32(self.dead[spool] - whole)
            at = self.memory - BACK - whole
            late, later = demands[:, at : at + ticks, spool], demands[:, at - 1 : at - 1 + ticks, spool]
            moved = late + part * (later - late)
            moved, first[:, spool] = _stage(moved, self.stages[spool, 0], first[:, spool])
            moved, rest[:, spool] = played(moved, self.play[spool], rest[:, spool])
            out[..., spool], second[:, spool] = _stage(moved, self.stages[spool, 1], second[:, spool])
        return out, [first, second, rest]


def stage_of(frequency_hz: float, rate_hz: float) -> Singles:
    """Return b1, b2, a1, a2 of a second-order low-pass with an input held between samples."""
    w = 2.0 * np.pi * frequency_hz
    b, a, _ = cont2discrete(([w * w], [1.0, 2.0 * DAMPING * w, w * w]), 1.0 / rate_hz, "zoh")
    return np.array([b[0, 1], b[0, 2], a[1], a[2]], np.float32)


def _stage(values: Singles, stage: Singles, state: Singles) -> tuple[Singles, Singles]:
    b = np.array([0.0, stage[0], stage[1]], np.float32)
    a = np.array([1.0, stage[2], stage[3]], np.float32)
    out, left = lfilter(b, a, values, axis=1, zi=state)
    return out, left


def played(values: Singles, width: np.float32, before: Singles) -> tuple[Singles, Singles]:
    """Return the output of play: it stays where it is until its input is more than `width` away.

    A tick limits what was before to a range, and two such limits are one: all ticks take a few rounds instead of a
    loop, with the same bits, since limits round nothing.

    Args:
        values: input, shape (streams, ticks).
        width: half the play.
        before: output at the tick before, shape (streams,).

    Returns:
        Output, shape (streams, ticks), and its last value.
    """
    low, high = values - width, values + width
    step = 1
    while step < values.shape[1]:
        own = low[:, step:], high[:, step:]
        low_before, high_before = low[:, :-step], high[:, :-step]
        both = [np.maximum(own[0], np.minimum(own[1], ends)) for ends in (low_before, high_before)]
        low = np.concatenate([low[:, :step], both[0]], axis=1)
        high = np.concatenate([high[:, :step], both[1]], axis=1)
        step *= 2
    out: Singles = np.maximum(low, np.minimum(high, before[:, None]))
    return out, out[:, -1].copy()


def root(drop: Singles) -> Singles:
    """Return the smooth root of a positive pressure difference in MPa: dp / (dp^2 + 0.01)^(1/4)."""
    positive = np.maximum(drop, np.float32(0.0))
    return np.asarray(positive / np.sqrt(np.sqrt(positive * positive + SMOOTH)), np.float32)


@dataclass(frozen=True, eq=False)
class ChamberPlaces:
    """Indices of the channels of a chamber's balance among the inputs.

    Attributes:
        velocity: index of the velocity of its cylinder.
        own: index of the chamber's pressure.
        other: index of the pressure of the opposite chamber.
        stroke: -1 where there is none.
        supplies: pressures of the pumps.
        spools: indices of `SpoolModel`: the first spool and, if present, that of the second pump.
        sign: 1 for a chamber that grows with the velocity, -1 for the other.
        end: stroke at which its outflow is cushioned, m.
        far: stroke at the other end, m.
        cushion: length of the cushion, m.
        tank: pressure of the return line, MPa.
    """

    velocity: int
    own: int
    other: int
    stroke: int
    supplies: tuple[int, ...]
    spools: tuple[int, ...]
    sign: int
    end: float
    far: float
    cushion: float
    tank: float

    @property
    def paths(self) -> int:
        """Number of curves; see `paths_of`."""
        return len(self.supplies) * len(self.spools) + 4


def paths_of(spots: ChamberPlaces, rows: Singles, spools: Singles) -> list[tuple[Singles, Singles]]:
    """Return the travel that opens each path and the root of its driving pressure.

    Paths: from the pumps, from the opposite chamber, to the tank, to the opposite chamber, and the parts
    blocked by a cushion.

    Args:
        spots: indices of the channels of the chamber.
        rows: inputs, shape (..., inputs).
        spools: shape (..., spools).
    """
    own, other = rows[..., spots.own] * MEGA, rows[..., spots.other] * MEGA
    none = np.float32(0.0)
    sign = np.float32(spots.sign)
    supplies = [root(rows[..., supply] * MEGA - own) for supply in spots.supplies]
    first = spools[..., spots.spools[0]] * sign
    inward, outward = np.maximum(first, none), np.maximum(-first, none)
    away = root(own - np.float32(spots.tank))
    paths = [(inward, drive) for drive in supplies]
    paths += [(inward, root(other - own)), (outward, away), (outward, root(own - other))]
    paths.append((outward, away * shut_of(spots, rows)))
    for spool in spots.spools[1:]:
        travel = np.maximum(spools[..., spool] * sign, none)
        paths += [(travel, drive) for drive in supplies]
    return paths


def shut_of(spots: ChamberPlaces, rows: Singles) -> Singles:
    """Return the fraction of the outflow blocked by a cushion, from 0 at its beginning to 1 at the end."""
    near = _measure_end_distance(spots, rows, spots.end)
    shut: Singles = np.float32(1.0) - near * near * (np.float32(3.0) - near - near)
    return shut


def _measure_end_distance(spots: ChamberPlaces, rows: Singles, end: float) -> Singles:
    """Return the distance to an end of the stroke in cushion lengths, limited to 1; 1 without a stroke signal."""
    if spots.stroke < 0:
        return np.ones(rows.shape[:-1], np.float32)
    distance = np.abs(rows[..., spots.stroke] - np.float32(end)) * np.float32(1.0 / spots.cushion)
    near: Singles = np.minimum(distance, np.float32(1.0))
    return near


def doubts_of(spots: ChamberPlaces, rows: Singles, rates: Singles, through: Singles) -> list[Singles]:
    """Return the non-negative sources of uncertainty of a balance.

    They are constant; fast compression, also of soft oil; an emptied chamber; the ends of the stroke; flow through
    spools.

    Args:
        spots: indices of the channels of the chamber.
        rows: inputs, shape (..., inputs).
        rates: rates of all inputs, per second, shape (..., inputs).
        through: sizes of the flows of all paths, summed, shape (...).
    """
    own, rate = rows[..., spots.own] * MEGA, np.abs(rates[..., spots.own] * MEGA)
    none, whole = np.float32(0.0), np.float32(1.0)
    soft = whole / (np.maximum(own, none) + CAVITY)
    doubts = [np.ones_like(own), rate, rate * soft, np.maximum(EMPTY - own, none)]
    doubts += [
        whole - _measure_end_distance(spots, rows, spots.end),
        whole - _measure_end_distance(spots, rows, spots.far),
    ]
    return [*doubts, np.maximum(own - RELIEFS[1], none), through]


def lines_of(spots: ChamberPlaces, rows: Singles, rates: Singles) -> list[Singles]:
    """Return the terms without a spool: constant; compression by volume and free air; suction from the tank; leaks.

    Relief valves.

    Args:
        spots: indices of the channels of the chamber.
        rows: inputs, shape (..., inputs).
        rates: rates of all inputs, per second, shape (..., inputs).
    """
    own, other, rate = rows[..., spots.own] * MEGA, rows[..., spots.other] * MEGA, rates[..., spots.own] * MEGA
    soft = np.float32(1.0) / (np.maximum(own, np.float32(0.0)) + CAVITY)
    stroke = rows[..., spots.stroke] if spots.stroke >= 0 else np.zeros_like(own)
    lines = [np.ones_like(own), rate, rate * stroke, rate * soft, rate * soft * soft]
    lines += [root(np.float32(spots.tank) - own), own - other, own, rate * stroke * soft]
    return lines + [np.maximum(own - limit, np.float32(0.0)) for limit in RELIEFS]


def hats(travel: Singles) -> Array:
    """Return the weights of the knots behind the first at a travel, shape (..., knots - 1): a curve is their sum."""
    knots = KNOTS.astype(np.float64)
    inside = np.clip(np.asarray(travel, np.float64), knots[0], knots[-1])
    return np.stack([np.interp(inside, knots, column) for column in np.eye(len(knots))[1:]], axis=-1)


def slopes_of(values: Array) -> Array:
    """Return the slopes of curves from each knot on, the last one zero, shape (paths, knots)."""
    slopes = np.zeros_like(values)
    slopes[:, :-1] = np.diff(values, axis=1) / np.diff(KNOTS.astype(np.float64))
    return slopes


def opening_later(values: Array, shares: Array) -> Array:
    """Return curves whose opening begins later by fractions of its position, shape (paths, knots); see `BEGUN`."""
    knots, later = KNOTS.astype(np.float64), np.empty_like(values)
    for path, (curve, share) in enumerate(zip(values, shares, strict=True)):
        begun = np.abs(curve) > BEGUN * np.abs(curve).max()
        first = knots[int(begun.argmax())] if begun.any() else 0.0
        later[path] = np.interp(knots - share * first, knots, curve)
    return later


def opened(travel: Singles, values: Singles, slopes: Singles) -> Singles:
    """Evaluate a curve at a travel: linear between knots, constant after the last.

    Args:
        travel: any shape.
        values: values at the knots, shape (knots,).
        slopes: slopes after each knot, shape (knots,); the last one is zero.
    """
    inside = np.maximum(travel, KNOTS[0])
    at = np.searchsorted(KNOTS, inside, side="right") - 1
    curve: Singles = values[at] + (inside - KNOTS[at]) * slopes[at]
    return curve
