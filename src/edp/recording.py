"""A recording: uniformly sampled channels of one session, with its source and the hash of its content."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edp.errors import DataError, closest
from edp.signals import Channel

FloatArray = NDArray[np.float32]
MACHINE = "machine"
"""Where the meta of a recording says which machine it is of."""

MAX_ROWS = 1 << 22
"""Rows that screening and coverage hold at a time: eleven and a half hours at 100 Hz."""
STRETCH_S = 120.0
"""Of the segments that a large data set is looked at by."""
HASHED_ROWS = 65_536
"""Of a block that is hashed at a time: samples that lie on disk do not all come into memory."""


class Digest:
    """The digest of a recording whose samples come in parts.

    Args:
        rate_hz: samples per second.
        channels: the channels, in the order of the columns.
    """

    def __init__(self, rate_hz: float, channels: Sequence[Channel]) -> None:
        self._state = hashlib.blake2b(digest_size=16)
        self._state.update(repr((float(rate_hz), [(c.name, str(c.kind)) for c in channels])).encode())

    def update(self, values: FloatArray) -> None:
        """Add samples to the digest, float32, shape ``(time, channel)``."""
        for start in range(0, len(values), HASHED_ROWS):
            self._state.update(np.ascontiguousarray(values[start : start + HASHED_ROWS]).data)

    @property
    def text(self) -> str:
        """32 hexadecimal digits."""
        return self._state.hexdigest()


@dataclass(frozen=True, eq=False)
class Recording:
    """Uniformly sampled channels of one session, in SI units.

    Attributes:
        name: short name, unique in a data set.
        channels: the channels, in the order of the columns.
        values: float32, shape ``(time, channel)``, SI units; NaN marks a missing value.
        rate_hz: samples per second.
        source: where it came from (file path, or ``sim:M22`` and the like).
        meta: plain JSON data (seed, scenario, machine, repairs made).
    """

    name: str
    channels: tuple[Channel, ...]
    values: FloatArray
    rate_hz: float
    source: str = ""
    meta: Mapping[str, object] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.values.ndim != 2 or self.values.shape[1] != len(self.channels):
            raise DataError(
                f"recording '{self.name}': values have shape {self.values.shape}, "
                f"expected (time, {len(self.channels)}) for {len(self.channels)} channels"
            )
        if self.values.dtype != np.float32:
            raise DataError(f"recording '{self.name}': values are {self.values.dtype}, expected float32")
        if not (np.isfinite(self.rate_hz) and self.rate_hz > 0):
            raise DataError(f"recording '{self.name}': rate {self.rate_hz} Hz, expected a positive number")
        names = self.channel_names
        if len(set(names)) != len(names):
            twice = sorted({name for name in names if names.count(name) > 1})
            raise DataError(f"recording '{self.name}': channel(s) {', '.join(twice)} occur twice")

    @property
    def channel_names(self) -> tuple[str, ...]:
        """Channel names in column order."""
        return tuple(channel.name for channel in self.channels)

    @property
    def samples(self) -> int:
        """Number of samples (time steps)."""
        return int(self.values.shape[0])

    @property
    def duration_s(self) -> float:
        """Length in seconds."""
        return self.samples / self.rate_hz

    @cached_property
    def digest(self) -> str:
        """BLAKE2b digest of rate, channels and values: equal content has an equal digest, independent of the file."""
        digest = Digest(self.rate_hz, self.channels)
        digest.update(self.values)
        return digest.text

    @property
    def on_disk(self) -> bool:
        """Whether the samples lie in a file that is mapped into memory."""
        part: Any = self.values
        while isinstance(part, np.ndarray):
            if isinstance(part, np.memmap):
                return True
            part = part.base
        return False

    def with_digest(self, digest: str) -> Recording:
        """Return a copy of the recording with a digest that was computed before.

        Changing the values discards the digest.
        """
        same = replace(self)
        same.__dict__["digest"] = digest
        return same

    def index(self, name: str) -> int:
        """Return the column of the named channel.

        Raises:
            DataError: no such channel; the closest name is offered.
        """
        try:
            return self.channel_names.index(name)
        except ValueError:
            raise DataError(
                f"recording '{self.name}' ({self.source}) has no channel '{name}'{closest(name, self.channel_names)}"
            ) from None

    def column(self, name: str) -> FloatArray:
        """Return the values of one channel, shape ``(time,)``."""
        return self.values[:, self.index(name)]

    def select(self, names: Sequence[str]) -> FloatArray:
        """Return the values of several channels, shape ``(time, len(names))``, in the order of `names`.

        Neighbouring columns are a view, others a copy.
        """
        return columns(self.values, [self.index(name) for name in names])

    def rows(self, start: int, stop: int, name: str | None = None) -> Recording:
        """Return the samples ``start <= t < stop`` as a new recording."""
        if not 0 <= start < stop <= self.samples:
            raise DataError(
                f"recording '{self.name}': rows {start}:{stop} asked for, it has {self.samples}; "
                "0 <= start < stop <= samples must hold"
            )
        return replace(self, values=self.values[start:stop], name=name or f"{self.name}[{start}:{stop}]")


def columns(values: FloatArray, places: Sequence[int]) -> FloatArray:
    """Return the columns of an array ``(time, channel)``.

    A view where they lie side by side, so that samples stay on disk.
    """
    first = places[0] if places else 0
    if list(places) == list(range(first, first + len(places))):
        return values[:, first : first + len(places)]
    return values[:, list(places)]


def spread_stretches(lengths: Sequence[int], length: int, most: int = MAX_ROWS) -> list[tuple[int, int, int]]:
    """Return the segments that are evenly spread over sequences of rows.

    Number of the sequence, first row, one after the last.

    Args:
        lengths: rows of each sequence.
        length: rows of a segment; shorter sequences are taken whole.
        most: rows in all, about; where the sequences hold no more, each is taken whole.
    """
    total = sum(lengths)
    if total <= most:
        return [(i, 0, rows) for i, rows in enumerate(lengths)]
    count = max(1, most // length)
    chosen = []
    # Middles of equal shares of all rows, so that every sequence has its share.
    middles = (np.arange(count) + 0.5) * (total / count)
    ends = np.cumsum(lengths)
    last = (-1, 0)
    for middle, i in zip(middles, np.searchsorted(ends, middles, side="right"), strict=True):
        rows = lengths[i]
        start = int(min(max(middle - (ends[i] - rows) - length / 2, 0), max(rows - length, 0)))
        # Near the ends of a sequence two middles may want the same rows.
        start = max(start, last[1]) if last[0] == i else start
        stop = min(start + length, rows)
        if start < stop:
            chosen.append((int(i), start, stop))
            last = (int(i), stop)
    return chosen


def spread_recordings(recordings: Sequence[Recording], seconds: float, most: int = MAX_ROWS) -> list[Recording]:
    """Return the recordings, or evenly spaced segments of the given length in seconds if they are longer.

    Samples on disk are not loaded.
    """
    length = max(1, round(seconds * recordings[0].rate_hz))
    stretches = spread_stretches([recording.samples for recording in recordings], length, most)
    return [
        recordings[i]
        if (start, stop) == (0, recordings[i].samples)
        else replace(
            recordings[i], values=recordings[i].values[start:stop], name=f"{recordings[i].name}[{start}:{stop}]"
        )
        for i, start, stop in stretches
    ]
