"""One control step on the bucket tip: reference along a leg, inverse dead band, PI. See `excitation.tracking`."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from edp.sim.machine import layout as at
from edp.sim.physics import pose
from edp.sim.physics.jit import compiled

Array = NDArray[np.float64]

# leg[...]: start and goal (stroke shares, or tip x, y and attitude), length in s, whether it is Cartesian
START, GOAL, LENGTH, CARTESIAN = 0, 3, 6, 7
LEG_VALUES = 8
# gains[...]: ramp and control step in s, PI gains, least speed that opens a valve, stroke error at which to wait
RAMP, STEP, PROPORTIONAL, INTEGRAL, REST_SPEED, WAITS_BEHIND = range(6)
GAINS = 6
# memory[...]: time on the leg in s, largest stroke error in m, then integrals and last levers of the three axes
TIME, BEHIND, SUM, LEVER = 0, 1, 2, 5
MEMORY = 8
MAX_SUM = 0.1
"""Maximum speed (m/s) from the integral part, which prevents wind-up while a leg is blocked."""


@compiled
def progress(time: float, length: float, ramp: float) -> float:
    """Share of the way done after `time` of `length` seconds, with constant acceleration over the ramps."""
    # A short leg is ramps only.
    ramp = min(ramp, 0.5 * length)
    time = min(max(time, 0.0), length)
    top = 1.0 / (length - ramp)
    if time < ramp:
        return 0.5 * top * time * time / ramp
    if time > length - ramp:
        return 1.0 - 0.5 * top * (length - time) ** 2 / ramp
    return top * (time - 0.5 * ramp)


@compiled
def inverse_lever(speed: float, speeds: Array, levers: Array, rest: float) -> float:
    """Return the lever for a cylinder speed (m/s); `speeds` and `levers` have rows for extension and retraction."""
    size = abs(speed)
    if size < rest:
        return 0.0
    side = 0 if speed > 0.0 else 1
    last = speeds.shape[1] - 1
    lever = 1.0
    if size < speeds[side, last]:
        n = 1
        while speeds[side, n] < size:
            n += 1
        share = (size - speeds[side, n - 1]) / (speeds[side, n] - speeds[side, n - 1])
        lever = levers[side, n - 1] + share * (levers[side, n] - levers[side, n - 1])
    return lever if speed > 0.0 else -lever


@compiled
def reference(leg: Array, time: float, ramp: float, setup: tuple[Any, ...], reached: Array) -> None:
    """Write the stroke fractions at a time of a motion to `reached[:3]`; for `setup`, see `control`."""
    q = progress(time, leg[LENGTH], ramp)
    for i in range(at.AXES):
        reached[i] = leg[START + i] + q * (leg[GOAL + i] - leg[START + i])
    if leg[CARTESIAN] > 0.5:
        pose.reach(reached[0], reached[1], reached[2], setup[2], setup[3], setup[4], reached)


@compiled
def control(
    leg: Array, strokes: Array, queue: Array, memory: Array, gains: Array, setup: tuple[Any, ...], targets: Array
) -> None:
    """Write the levers of one control step to `targets`, shape (samples, 3), linearly from the last levers.

    `queue` contains reference strokes (fractions), the oldest for the current sample. `setup` contains the curves of
    `inverse_lever` per axis, `axes`, `plant`, `pose.joint_limits` and a buffer of `pose.REACHED_VALUES`.
    """
    speeds, levers, axes, reached = setup[0], setup[1], setup[2], setup[5]
    # Full speed up to half of the error at which the reference stands still.
    lag = 2.0 - 2.0 * memory[BEHIND] / gains[WAITS_BEHIND]
    memory[TIME] += gains[STEP] * min(max(lag, 0.0), 1.0)
    last = queue.shape[0] - 1
    for n in range(last):
        for i in range(at.AXES):
            queue[n, i] = queue[n + 1, i]
    reference(leg, memory[TIME], gains[RAMP], setup, reached)
    memory[BEHIND] = 0.0
    for i in range(at.AXES):
        queue[last, i] = reached[i]
        full = axes[i, at.STROKE]
        error = (queue[0, i] - strokes[i]) * full
        memory[BEHIND] = max(memory[BEHIND], abs(error))
        speed = (queue[last, i] - queue[last - 1, i]) * full / gains[STEP]
        speed += gains[PROPORTIONAL] * error + memory[SUM + i]
        lever = inverse_lever(speed, speeds[i], levers[i], gains[REST_SPEED])
        # No integration at a saturated lever, which could not follow.
        if abs(lever) < 1.0:
            total = memory[SUM + i] + gains[INTEGRAL] * gains[STEP] * error
            memory[SUM + i] = min(max(total, -MAX_SUM), MAX_SUM)
        before, samples = memory[LEVER + i], targets.shape[0]
        for k in range(samples):
            targets[k, i] = before + (lever - before) * (k + 1) / samples
        memory[LEVER + i] = lever
