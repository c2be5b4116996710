"""Spool demands from lever targets: first the operator's hand, then the machine's lever mapping."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from edp.sim.machine import layout as at
from edp.sim.physics import motors as places
from edp.sim.physics import valve
from edp.sim.physics.jit import compiled

Array = NDArray[np.float64]
LEVER_BANDWIDTH_HZ, LEVER_RATE = 2.5, 5.0
"""Bandwidth (Hz) of the second-order smoothing by the operator's hand, and maximum lever rate (full strokes per
second)."""


@compiled
def smooth_lever(target: Array, hand: Array, step_s: float, out: Array) -> None:
    """Filter the targets of one sample to lever positions, shape (3,): rate-limited 2nd-order low-pass.

    State in `hand`.
    """
    omega = 2.0 * np.pi * LEVER_BANDWIDTH_HZ
    for i in range(at.AXES):
        # Critically damped: an operator's hand does not ring.
        pull = omega * omega * (target[i] - hand[i, 0]) - 2.0 * omega * hand[i, 1]
        hand[i, 1] = min(max(hand[i, 1] + step_s * pull, -LEVER_RATE), LEVER_RATE)
        hand[i, 0] += step_s * hand[i, 1]
        out[i] = hand[i, 0]


@compiled
def put_first(past: Array, demands: Array) -> None:
    """Copy past demands to the first rows of `demands`."""
    for k in range(past.shape[0]):
        for j in range(past.shape[1]):
            demands[k, j] = past[k, j]


@compiled
def keep_last(demands: Array, past: Array) -> None:
    """Copy the last rows of `demands` to the past of the next block."""
    first = demands.shape[0] - past.shape[0]
    for k in range(past.shape[0]):
        for j in range(past.shape[1]):
            past[k, j] = demands[first + k, j]


@compiled
def shape_commands(
    levers: Array,
    hand: Array,
    step_s: float,
    past: Array,
    setup: tuple[Array, Array, tuple[Array, ...], tuple[Array, ...]],
    demands: Array,
    held_commands: Array,
) -> None:
    """Write the spool demands of `levers`, shape (samples, 3), after the `past` demands; then update `past`.

    With `step_s` above 0 the operator's hand smooths the levers. `held_commands` is a buffer.
    """
    axes, plant, _, _ = setup
    put_first(past, demands)
    for k in range(levers.shape[0]):
        lever = levers[k]
        if step_s > 0.0:
            lever = held_commands[: at.AXES]
            smooth_lever(levers[k], hand, step_s, lever)
        valve.shape_demand(lever, axes, plant, demands[past.shape[0] + k])
    keep_last(demands, past)


@compiled
def shape_motor_commands(
    levers: Array, hand: Array, step_s: float, past: Array, zone: float, demands: Array, shaped: Array
) -> None:
    """Write the motor demands of `levers`, shape (samples, 3), after the past demands, like `shape_commands`.

    `zone` is the dead zone of the levers, `shaped` scratch of shape (3,).
    """
    put_first(past, demands)
    for k in range(levers.shape[0]):
        lever = levers[k]
        if step_s > 0.0:
            lever = shaped[: at.MOTORS]
            smooth_lever(levers[k], hand, step_s, lever)
        places.shape_demand(lever, zone, demands[past.shape[0] + k])
    keep_last(demands, past)
