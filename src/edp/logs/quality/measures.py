"""Measures of sensor and logger from the samples of one channel: step, noise, update rate, clipping, spikes.

All of it follows from the numbers alone; values are one channel, float32, shape ``(time,)``, without missing ones.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edp.logs.repair import runs

Values = NDArray[np.float32]

MAX_UNIQUE = 500_000
"""Maximum number of samples examined for quantisation. Longer channels are thinned evenly."""
_ON_LATTICE = 0.05
"""Maximum distance from a multiple of the quantisation step, in steps."""
_SHARE_ON_LATTICE = 0.99
_BLOCK = 128
"""Number of samples over which noise is measured: large for its statistics, short relative to motion."""
# Of the third difference of white noise: its gain, and the deviation of its mean square over a block, as
# sum(rho^2) over its autocorrelation -15/20, 6/20, -1/20 says.
_GAIN = 20.0
_SPREAD = (2.0 * (1.0 + 2.0 * (0.75**2 + 0.3**2 + 0.05**2)) / _BLOCK) ** 0.5
_QUARTILE = 0.6745
"""Upper quartile of the standard normal distribution."""
_HELD = 10
"""Number of equal consecutive samples from which a constant value is not a coincidence."""
_BUSY_REPEATS = 0.05
_BUSY_HELD = 0.2
_BUSY_NOISE = 2e-4
_STEADY = 0.65
"""Noise of sensors gave 0.59 to 0.91, channels without it less than 0.64 (journal)."""


@dataclass(frozen=True)
class Measures:
    """Facts of one channel in its SI unit.

    Attributes:
        quantum: step of the lattice on which all values lie, None where there is none coarser than float32.
        levels: distinct values, of at most `MAX_UNIQUE` samples.
        noise: deviation of the white part in steady state, 0 for a state of up to three levels.
        every: samples between new values; 1 where each sample is new.
        busy: sensor noise moves the last digit all the time, so that equal samples in a row mean something.
        at_low: fraction of the samples at the minimum.
        at_high: fraction of the samples at the maximum.
        end_run: longest stay at an end of the range, in samples.
        spikes: single samples far off both neighbours.
        first_spike: the first of them, -1 where there is none.
    """

    quantum: float | None
    levels: int
    noise: float
    every: float
    busy: bool
    at_low: float
    at_high: float
    end_run: int
    spikes: int
    first_spike: int


NOTHING = Measures(None, 0, 0.0, 1.0, False, 0.0, 0.0, 0, 0, -1)


def measure(values: Values) -> Measures:
    """Measure one channel; a constant or nearly empty channel has no measures."""
    if len(values) < 4 or values.min() == values.max():
        return NOTHING
    step, levels = quantum(values)
    steps = np.diff(values)
    every = update_every(steps)
    # Repeated values would hide the noise: the third differences need one value a transmission.
    fresh = values if every < 1.5 else values[np.flatnonzero(steps) + 1]
    floor, steady = noise_floor(fresh) if levels > 3 else (0.0, False)
    low, high = values == values.min(), values == values.max()
    busy = steady and every < 1.5 and floor > _BUSY_NOISE * float(values.std())
    busy = busy and _is_busy(steps == 0, (low | high)[1:])
    stays = [int((stops - starts).max()) for starts, stops in (runs(low), runs(high))]
    places = spikes(values, floor) if every < 1.5 and levels > 3 else np.empty(0, dtype=np.intp)
    first = int(places[0]) if len(places) else -1
    return Measures(
        step, levels, floor, every, busy, float(low.mean()), float(high.mean()), max(stays), len(places), first
    )


def _is_busy(same: NDArray[np.bool_], at_end: NDArray[np.bool_]) -> bool:
    """Return few equal neighbours away from the ends of the range, runs of ten and more left out, and few of those."""
    starts, stops = runs(same & ~at_end)
    lengths = stops - starts
    constant_samples = int(lengths[lengths >= _HELD].sum())
    moving = len(same) - int(at_end.sum()) - constant_samples
    return constant_samples <= _BUSY_HELD * len(same) and int(lengths.sum()) - constant_samples < _BUSY_REPEATS * moving


def quantum(values: Values) -> tuple[float | None, int]:
    """Return the quantisation step of the values, None without one, and the number of distinct values.

    The smallest distance between neighbouring values is refined over the whole range; 99 % of the distances must then
    be whole multiples within 5 % of the step. Steps of up to four units in the last place of float32 are no lattice.
    """
    # Thinned evenly instead of cut: a channel may rest for all of its beginning.
    seen = np.unique(values[:: -(-len(values) // MAX_UNIQUE)])
    if len(seen) < 2:
        return None, len(seen)
    apart = np.diff(seen.astype(np.float64))
    grain = float(np.spacing(np.abs(seen).max()))
    smallest = float(apart.min())
    # More distinct values than half of the samples: no lattice, but a continuous signal.
    if smallest <= 4 * grain or 2 * len(seen) > len(values):
        return None, len(seen)
    multiples = np.rint(apart / smallest)
    # Estimate the step from all distances, since the rounding of float32 affects the smallest distance most.
    step = float(apart.sum() / multiples.sum())
    off = np.abs(apart / step - np.rint(apart / step))
    fits = float(np.mean(off < _ON_LATTICE + 2 * grain / step)) >= _SHARE_ON_LATTICE
    return (step if fits else None), len(seen)


def update_every(steps: Values) -> float:
    """Return the samples between new values of a channel that is sampled faster than it is sent.

    The shortest distance between changes (2 % quantile) must be two samples or more, and half of all distances must
    lie within 1.5 times of it; a quantity that merely changes slowly spreads more.
    """
    between = np.diff(np.flatnonzero(steps))
    # A 2 % quantile of fewer distances is a single one.
    if len(between) < 20:
        return 1.0
    # Of most channels each sample is new: counted, which is sooner done than ordering all distances.
    if np.count_nonzero(between == 1) > 0.02 * (len(between) - 1):
        return 1.0
    shortest = float(np.quantile(between, 0.02, method="lower"))
    near = between[between <= 1.5 * shortest]
    return float(near.mean()) if shortest >= 2 and 2 * len(near) >= len(between) else 1.0


def noise_floor(values: Values) -> tuple[float, bool]:
    """Return the deviation of white noise where the channel is quietest, in its own unit.

    And whether it is there all the time.

    Third differences take out motion and keep 20 times the variance of white noise. Of their mean squares over blocks
    of 128 samples, blocks without any change left out, the lower quartile is taken, and set right for being one.
    Noise of a sensor is there all the time: the tenth part of the blocks then is hardly quieter than half of them.
    """
    rough = np.diff(values.astype(np.float64), 3)
    if len(rough) < 4 * _BLOCK:
        power = float(np.mean(rough**2)) if len(rough) else 0.0
        return float((power / _GAIN) ** 0.5), False
    blocks = rough[: len(rough) // _BLOCK * _BLOCK].reshape(-1, _BLOCK)
    power_of = np.mean(blocks**2, axis=1)
    power_of = power_of[power_of > 0]
    if not len(power_of):
        return 0.0, False
    steady = float(np.quantile(power_of, 0.1)) > _STEADY**2 * float(np.median(power_of))
    return float((np.quantile(power_of, 0.25) / (1.0 - _QUARTILE * _SPREAD) / _GAIN) ** 0.5), steady


@np.errstate(over="ignore", invalid="ignore")
def spikes(values: Values, floor: float) -> NDArray[np.intp]:
    """Return the rows of single samples that leave both neighbours by over half the usual range, while these agree.

    The usual range is that between the 0.5 and 99.5 % quantiles, and no less than forty times the noise.
    """
    low, high = np.quantile(values, (0.005, 0.995))
    least = max(0.5 * float(high - low), 40.0 * floor)
    # Of a spike both neighbours lie on the same side; of a step only one does.
    before, after = values[1:-1] - values[:-2], values[1:-1] - values[2:]
    size = np.minimum(np.abs(before), np.abs(after))
    alone = (size > least) & ((before > 0) == (after > 0)) & (np.abs(values[2:] - values[:-2]) < 0.25 * size)
    return np.flatnonzero(alone) + 1
