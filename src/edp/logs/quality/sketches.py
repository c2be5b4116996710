"""Sketches: recordings at a low rate for comparison, to find repeated sessions and identical samples."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from edp.logs.quality.columns import columns
from edp.recording import Recording

SKETCH_HZ = 10.0
"""Sample rate of a sketch in Hz: sufficient for machine movements and available from any logger."""
MOST_BYTES = 256 * 2**20
"""Maximum size of the sketches of a data set: 40 hours of 45 channels."""
HASHED_ROWS = 65_536
Floats = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Sketch:
    """A recording at a low rate.

    Attributes:
        name: name of the recording.
        channels: names, in the order of the columns.
        values: means over 0.1 s, each channel over its deviation about its mean, shape ``(block, channel)``.
        hz: blocks per second; `SKETCH_HZ`, or the recording's own rate where that is lower.
        digest: hash of the samples, independent of channel names.
        seconds: length of the recording, s.
    """

    name: str
    channels: tuple[str, ...]
    values: Floats
    hz: float
    digest: str
    seconds: float

    def drop_values(self) -> Sketch:
        """Return the sketch without values; the recording is then compared by the hash of its samples only."""
        return replace(self, values=self.values[:0].copy())


class Sketches:
    """Sketches of a data set. After `most` bytes, additional recordings are represented by their hash."""

    def __init__(self, most: int = MOST_BYTES) -> None:
        self.left, self.all, self.by_hash = most, list[Sketch](), 0

    def add(self, sketch: Sketch) -> None:
        """Keep one more."""
        self.left -= sketch.values.nbytes
        if self.left < 0:
            sketch = sketch.drop_values()
            self.by_hash += 1
        self.all.append(sketch)


def sketch(recording: Recording, name: str | None = None) -> Sketch:
    """Return the sketch of a recording; missing values are replaced by the mean of their channel."""
    rate = recording.rate_hz
    hz = min(SKETCH_HZ, rate)
    blocks = max(int(recording.samples * hz / rate), 1)
    # 1e-9: a rate that divides evenly must not lose a sample to rounding.
    starts = np.minimum(np.ceil(np.arange(blocks) * rate / hz - 1e-9).astype(np.intp), recording.samples - 1)
    block_means = np.empty((blocks, len(recording.channels)), dtype=np.float32)
    counts = np.diff(np.append(starts, recording.samples))
    for channel_index, column in enumerate(columns(recording)):
        values = column.astype(np.float64)
        good = np.isfinite(values)
        mean = float(values[good].mean()) if good.any() else 0.0
        values = np.where(good, values - mean, 0.0)
        coarse = np.add.reduceat(values, starts) / np.maximum(counts, 1)
        std = float(coarse.std())
        # Divided by a deviation of rounding, a channel at rest would become noise.
        block_means[:, channel_index] = coarse / std if std > 1e-6 * (abs(mean) + float(np.abs(coarse).max())) else 0.0
    digest = hashlib.blake2b(digest_size=16)
    for start in range(0, recording.samples, HASHED_ROWS):
        digest.update(np.ascontiguousarray(recording.values[start : start + HASHED_ROWS]).data)
    text, seconds = digest.hexdigest(), recording.samples / rate
    return Sketch(name or recording.name, recording.channel_names, block_means, hz, text, seconds)
