"""Bus timing: frames of an ECU with delay, jitter and loss, held at the logger's samples."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Bus:
    """Timing of the frames of every ECU, in s; `period` 0 disables the bus: values are logged directly.

    Attributes:
        period: time between two frames of an ECU.
        latency: shortest and longest time from taking a value to its arrival at the logger.
        jitter: rms of the latency from frame to frame, before it is cut to its bounds.
        loss: fraction of lost frames.
    """

    period: float
    latency: tuple[float, float]
    jitter: float
    loss: float


@dataclass(frozen=True, eq=False)
class Frames:
    """The frames of one ECU during a recording.

    A frame taken between samples k and k + 1 is seen at k + 1 at the earliest, so that reading between the two looks at
    no later sample than the one that shows it.

    Attributes:
        positions: sampling time of the values in each frame, in samples of the log, shape ``(frame,)``.
        arrivals: arrival time of each frame, in samples; infinite for a lost frame.
        seen: the newest frame that had arrived at each sample, shape ``(sample,)``.
    """

    positions: Array
    arrivals: Array
    seen: NDArray[np.intp]


def frames(samples: int, rate_hz: float, bus: Bus, phase: float, latency_s: float, rng: np.random.Generator) -> Frames:
    """Return the frames of one ECU over a recording.

    Args:
        samples: samples of the recording.
        rate_hz: their rate.
        bus: timing of the bus.
        phase: time offset between the clocks of the ECU and of the logger, as a fraction of the period.
        latency_s: usual latency of this ECU.
        rng: source of jitter and losses.
    """
    ticks = np.arange(samples)
    # No bus: a frame a sample, seen at once.
    if bus.period <= 0.0:
        return Frames(ticks.astype(float), ticks.astype(float), ticks)
    # A few frames before the start, so that the first sample has one to show.
    before = int(np.ceil(bus.latency[1] / bus.period)) + 2
    count = before + int(np.ceil(samples / rate_hz / bus.period)) + 1
    sample_times = np.asarray((np.arange(count) - before + phase) * bus.period, dtype=np.float64)
    latency = np.clip(latency_s + rng.normal(0.0, bus.jitter, count), *bus.latency)
    # Frames of one ECU keep their order: a late frame delays the following frames.
    arrivals = np.maximum.accumulate(sample_times + latency) * rate_hz
    lost = rng.random(count) < bus.loss
    # The first frame always arrives, because the first samples need a value.
    lost[0] = False
    arrived = np.flatnonzero(~lost)
    seen = arrived[np.searchsorted(arrivals[arrived], ticks, side="right") - 1]
    return Frames(sample_times * rate_hz, np.where(lost, np.inf, arrivals), seen)
