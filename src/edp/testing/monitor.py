"""Recordings of a small test rig for tests of what watches machines: a valve, a cylinder, two pressures."""

from __future__ import annotations

import numpy as np
from scipy.signal import lfilter

from edp.recording import Recording
from edp.signals import Channel, Kind

RIG = (
    Channel("command", Kind.RATIO, "valve"),
    Channel("velocity", Kind.VELOCITY, "cylinder"),
    Channel("stroke", Kind.POSITION, "cylinder"),
    Channel("pressure_a", Kind.PRESSURE, "head"),
    Channel("pressure_b", Kind.PRESSURE, "rod"),
)


def rig_sessions(count: int, ticks: int, seed: int = 0, rate_hz: float = 100.0, first: int = 0) -> list[Recording]:
    """Return the healthy sessions of a linear rig with sensor noise, all channels of `RIG` in SI units.

    Args:
        count: number of sessions.
        ticks: length of each session in samples.
        seed: root of every random choice; session n is the same however many there are.
        rate_hz: ticks per second.
        first: number of the first session.
    """
    sessions = []
    for number in range(first, first + count):
        chance = np.random.default_rng([seed, number])
        levels = chance.uniform(-1.0, 1.0, ticks // 40 + 1)
        command = np.repeat(levels, 40)[:ticks]
        velocity = 0.2 * lfilter([0.08], [1.0, -0.92], command)
        stroke = 0.5 + np.cumsum(velocity) / rate_hz
        load = lfilter([0.02], [1.0, -0.98], chance.normal(size=ticks)) * 5.0
        pressure_a = 1e7 + 2e6 * load + 8e6 * velocity
        pressure_b = 6e6 - 1.2e6 * load + 5e6 * velocity
        clean = np.stack([command, velocity, stroke, pressure_a, pressure_b], axis=1)
        noise = chance.normal(size=clean.shape) * [0.0, 5e-4, 2e-5, 3e4, 3e4]
        values = (clean + noise).astype(np.float32)
        sessions.append(Recording(f"session_{number:03d}", RIG, values, rate_hz, "rig"))
    return sessions
