"""Bounds of live values and counts, and the repetition limit of messages."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edp.errors import DataError
from edp.live.layout import label
from edp.signals import Channel

MAX_VALUE = 1e19
"""Largest magnitude (SI units): squares of more overflow single precision."""
MIN_VALUE = 1e-30
"""Magnitude below which a value is zero: subnormal numbers slow every model down."""
MAX_MISSED = 1_000_000
"""Largest number of missing rows that a source may state: hours at 100 Hz."""
TOLD_FIRST, TOLD_EVERY = 3, 1000
"""A message of one group is shown the first three times, then once in a thousand ticks or messages."""


class RowBounds:
    """Check of the rows of a source.

    Args:
        channels: channels of a row.
    """

    def __init__(self, channels: Sequence[Channel]) -> None:
        self._channels = channels

    def check(self, row: object) -> tuple[NDArray[np.float32], list[str]]:
        """Return a row in single precision without impossible values, and the names of the channels that had one.

        Args:
            row: numbers of any type, shape (channels,).

        Raises:
            DataError: `row` has another shape, or is not of numbers.
        """
        values = np.asarray(row)
        if values.dtype.kind not in "fiu" or values.shape != (len(self._channels),):
            raise DataError(
                f"the source gave a row of type {values.dtype}, shape {values.shape}; expected numbers, shape "
                f"({len(self._channels)},)"
            )
        size = np.abs(values.astype(np.float64))
        wrong: list[str] = []
        if not (size <= MAX_VALUE).all():
            over = size > MAX_VALUE
            wrong = [label(channel.name) for channel, out in zip(self._channels, over, strict=True) if out]
            values = np.where(over, np.nan, values)
        if ((size < MIN_VALUE) & (size > 0.0)).any():
            values = np.where(size < MIN_VALUE, 0.0, values)
        return values.astype(np.float32), wrong


def bound_missed(missed: float) -> int:
    """Return the number of missing rows that a source states, at most `MAX_MISSED`."""
    return int(missed) if 0 <= missed <= MAX_MISSED else 0 if missed < 0 else MAX_MISSED


@dataclass
class _Shown:
    times: int = 0
    tick: int = 0
    since: int = 0


class Repetition:
    """Limit on how often messages of one group are shown, so that no sender fills the page or the terminal."""

    def __init__(self) -> None:
        self._shown: dict[str, _Shown] = {}

    def is_due(self, group: str, tick: int) -> bool:
        """Return whether a message of a group is shown at a tick; messages without a group always are."""
        if not group:
            return True
        shown = self._shown.setdefault(group, _Shown())
        shown.since += 1
        if shown.times >= TOLD_FIRST and tick - shown.tick < TOLD_EVERY and shown.since < TOLD_EVERY:
            return False
        shown.times, shown.tick, shown.since = shown.times + 1, tick, 0
        return True
