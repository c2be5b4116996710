"""When values travel: frames of an ECU on the bus, late, jittered and now and then lost, held at the logger's ticks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edp.sim.physics.jit import compiled

Array = NDArray[np.float64]


@compiled
def read_between(values: Array, positions: Array, out: Array) -> None:
    """`values` at `positions` (in samples), linear between samples and constant beyond them, into `out`."""
    last = values.shape[0] - 1
    for k in range(positions.shape[0]):
        position = min(max(positions[k], 0.0), float(last))
        low = int(position)
        part, high = position - low, min(low + 1, last)
        for channel in range(values.shape[1]):
            out[k, channel] = values[low, channel] + part * (values[high, channel] - values[low, channel])


@dataclass(frozen=True)
class Bus:
    """Timing of the frames of every ECU, in s; `period` 0 stands for no bus: values are logged as they are.

    Attributes:
        period: time between two frames of an ECU.
        latency: shortest and longest time from taking a value to its arrival at the logger.
        jitter: rms of the latency from frame to frame, before it is cut to its bounds.
        loss: share of frames that never arrive.
    """

    period: float
    latency: tuple[float, float]
    jitter: float
    loss: float


@dataclass(frozen=True, eq=False)
class Frames:
    """The frames of one ECU during a recording.

    Attributes:
        positions: when the values of each frame were taken, in samples of the log, shape ``(frame,)``.
        arrivals: when it arrived, in samples; infinite for a lost frame.
        seen: the newest frame that had arrived at each sample, shape ``(sample,)``.
    """

    positions: Array
    arrivals: Array
    seen: NDArray[np.intp]

    def take(self, values: Array) -> Array:
        """A signal at the instants of the frames, linear between samples, shape ``(frame, channel)``.

        What lies before the first sample has its value. A frame taken between samples k and k + 1 is seen at k + 1 at
        the earliest, so that reading between the two looks at no later sample than the one that shows it.
        """
        frame_values = np.empty((len(self.positions), values.shape[1]))
        read_between(np.ascontiguousarray(values), self.positions, frame_values)
        return frame_values

    def hold(self, values: Array) -> Array:
        """The newest value that had arrived at each sample, shape ``(sample, channel)``."""
        return values[self.seen]


def frames(samples: int, rate_hz: float, bus: Bus, phase: float, latency_s: float, rng: np.random.Generator) -> Frames:
    """Frames of one ECU over a recording.

    Args:
        samples: samples of the recording.
        rate_hz: their rate.
        bus: timing of the bus.
        phase: the ECU's clock against the logger's, as a share of the period.
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
    # Frames of one ECU keep their order: a late one holds up those behind it.
    arrivals = np.maximum.accumulate(sample_times + latency) * rate_hz
    lost = rng.random(count) < bus.loss
    # The first frame always arrives, or the first samples would have nothing to show.
    lost[0] = False
    arrived = np.flatnonzero(~lost)
    seen = arrived[np.searchsorted(arrivals[arrived], ticks, side="right") - 1]
    return Frames(sample_times * rate_hz, np.where(lost, np.inf, arrivals), seen)
