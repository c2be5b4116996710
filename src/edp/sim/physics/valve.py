"""Command path: ECU shaping, dead time, pilot and spool filters with play between them, and the openings."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from edp.sim.machine import layout as at
from edp.sim.machine.machine import Machine
from edp.sim.physics.jit import compiled, inlined

Array = NDArray[np.float64]
PILOT_DAMPING = 0.9
SPOOL_DAMPING = 1.0


@compiled
def shape_demand(lever: Array, axes: Array, plant: Array, out: Array) -> None:
    """Convert lever positions in [-1, 1], shape (3,), to signed spool demands, shape (6,).

    Primary, then conflux spools.
    """
    zone, start = plant[at.LEVER_DEAD_ZONE], plant[at.CONFLUX_START]
    for i in range(at.AXES):
        size = min(max((abs(lever[i]) - zone) / (1.0 - zone), 0.0), 1.0)
        second = min(max((size - start) / (1.0 - start), 0.0), 1.0)
        sign = 1.0 if lever[i] >= 0.0 else -1.0
        share = axes[i, at.CONFLUX_SHARE_EXTEND] if sign > 0 else axes[i, at.CONFLUX_SHARE_RETRACT]
        out[i] = sign * size
        out[i + 3] = sign * second * share


@compiled
def fill_pilots(levers: Array, full: float, axes: Array, plant: Array, demand: Array, out: Array) -> None:
    """Write one-sided pilot pressures (Pa), shape (time, 12), of lever positions, shape (time, 3), to `out`.

    In the order of Table A.1; `demand` is scratch, one value per spool.
    """
    for k in range(levers.shape[0]):
        shape_demand(levers[k], axes, plant, demand)
        for j in range(at.SPOOLS):
            out[k, 2 * j] = full * demand[j] if demand[j] > 0.0 else 0.0
            out[k, 2 * j + 1] = -full * demand[j] if demand[j] < 0.0 else 0.0


def oscillator(frequency_hz: float, damping: float, step_s: float) -> list[float]:
    """Return exact transition of (error, rate) of a low-pass of damping <= 1 over one step, row by row, 4 values."""
    omega = 2.0 * math.pi * frequency_hz
    # The exact solution instead of an integration step: stable and of the same result for any step.
    ringing = omega * math.sqrt(1.0 - damping * damping)
    decay, fall = damping * omega, math.exp(-damping * omega * step_s)
    cosine = math.cos(ringing * step_s)
    # step_s is the limit of sin(w t) / w at critical damping.
    sine = math.sin(ringing * step_s) / ringing if ringing > 0.0 else step_s
    own, cross = fall * (cosine + decay * sine), fall * sine
    return [own, cross, -omega * omega * cross, fall * (cosine - decay * sine)]


def spool_filters(machine: Machine, step_s: float) -> Array:
    """Return the transitions over `step_s` of pilot and spool, shape (6, 2, 4)."""
    valves = machine.valves
    pilots = valves.pilot_frequency * 2
    spools = valves.spool_frequency + valves.conflux_spool_frequency
    return np.array(
        [
            [oscillator(pilot, PILOT_DAMPING, step_s), oscillator(spool, SPOOL_DAMPING, step_s)]
            for pilot, spool in zip(pilots, spools, strict=True)
        ]
    )


def dead_times(machine: Machine) -> Array:
    """Return the dead time of each spool's command, shape (6,), s."""
    first = np.array(machine.valves.dead_time)
    return np.concatenate((first, first + machine.valves.conflux_extra_dead_time))


@inlined
def relax(valves: Array, j: int, column: int, target: float, filters: Array, stage: int) -> None:
    """Move a value of spool `j`, its rate behind it, towards its target; `stage` 0 is the pilot, 1 the spool."""
    error, rate = valves[j, column] - target, valves[j, column + 1]
    valves[j, column] = target + filters[j, stage, 0] * error + filters[j, stage, 1] * rate
    valves[j, column + 1] = filters[j, stage, 2] * error + filters[j, stage, 3] * rate


@inlined
def pilot_half_step(demand: Array, filters: Array, axes: Array, valves: Array) -> None:
    """Advance the pilots by half a step, then move the play operator's output."""
    for j in range(at.SPOOLS):
        relax(valves, j, at.PILOT, demand[j], filters, 0)
        pilot = valves[j, at.PILOT]
        hysteresis = axes[j, at.HYSTERESIS] if j < at.AXES else axes[j - at.AXES, at.CONFLUX_HYSTERESIS]
        valves[j, at.PLAY] = max(pilot - hysteresis, min(pilot + hysteresis, valves[j, at.PLAY]))


@inlined
def spool_half_step(filters: Array, valves: Array) -> None:
    """Advance the spools by half a step towards the play operator's output."""
    for j in range(at.SPOOLS):
        relax(valves, j, at.SPOOL, valves[j, at.PLAY], filters, 1)


@inlined
def opening(spool: float, dead_band: float, widest: float = 1.0) -> float:
    """Share of the full area behind the dead band: r (0.25 + 0.75 r), fine control near closed.

    `widest` is the travel behind the dead band that the spool can reach, as a share; 1 for a sound one.
    """
    r = min(max((abs(spool) - dead_band) / (1.0 - dead_band), 0.0), widest)
    return r * (0.25 + 0.75 * r)


@inlined
def cushion(distance: float, length: float, least: float) -> float:
    """Share of the outflow area left at a distance (m) from the stop: a smoothstep down to `least`."""
    r = min(max(distance / length, 0.0), 1.0)
    return least + (1.0 - least) * r * r * (3.0 - 2.0 * r)


@inlined
def open_spools(valves: Array, stroke: Array, axes: Array, out: Array) -> None:
    """Compute the conductances of this step from spool positions and cushions, `out` shape (3, OPENINGS)."""
    for i in range(at.AXES):
        for n in range(at.OPENINGS):
            out[i, n] = 0.0
        spool, second = valves[i, at.SPOOL], valves[i + 3, at.SPOOL]
        pump, second_pump = int(axes[i, at.PRIMARY_PUMP]), int(axes[i, at.CONFLUX_PUMP])
        if second > 0.0:
            area = opening(second, axes[i, at.CONFLUX_DEAD_BAND_EXTEND], axes[i, at.CONFLUX_WIDEST])
            out[i, at.HEAD_IN_1 + second_pump] = axes[i, at.CONFLUX_EXTEND] * area
        else:
            area = opening(second, axes[i, at.CONFLUX_DEAD_BAND_RETRACT], axes[i, at.CONFLUX_WIDEST])
            out[i, at.ROD_IN_1 + second_pump] = axes[i, at.CONFLUX_RETRACT] * area
        length, least = axes[i, at.CUSHION_LENGTH], axes[i, at.CUSHION_AREA]
        if spool > 0.0:
            area = opening(spool, axes[i, at.DEAD_BAND_EXTEND], axes[i, at.WIDEST])
            left = area * cushion(axes[i, at.STROKE] - stroke[i], length, least)
            out[i, at.HEAD_IN_1 + pump] = axes[i, at.IN_EXTEND] * area
            out[i, at.ROD_OUT] = axes[i, at.OUT_EXTEND] * left
            out[i, at.ROD_TO_HEAD] = axes[i, at.REGEN_EXTEND] * left
        else:
            area = opening(spool, axes[i, at.DEAD_BAND_RETRACT], axes[i, at.WIDEST])
            left = area * cushion(stroke[i], length, least)
            out[i, at.ROD_IN_1 + pump] = axes[i, at.IN_RETRACT] * area
            out[i, at.HEAD_OUT] = axes[i, at.OUT_RETRACT] * left
            out[i, at.HEAD_TO_ROD] = axes[i, at.REGEN_RETRACT] * left
