"""Bounded session data: a ring of rows, and a log of events. One thread writes, any thread may read."""

from __future__ import annotations

import threading
import time
from collections import deque
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

from edp.errors import DataError
from edp.live.layout import LiveLayout

Rows = NDArray[np.float32]
HISTORY_BYTES = 64 << 20
"""Maximum size of the stored rows, bytes: 46 minutes of 60 columns at 100 Hz."""
MAX_EVENTS, MOST_TEXT = 500, 400
"""Maximum number of stored events, and maximum number of characters of an event."""
KINDS = ("note", "warning", "alarm")


@dataclass(frozen=True)
class LiveEvent:
    """Something that happened.

    Attributes:
        number: number of the event in its session, from 0.
        tick: sample of the event.
        kind: one of `KINDS`.
        text: message.
        group: events of one group say the same again; empty for none.
    """

    number: int
    tick: int
    kind: str
    text: str
    group: str = ""

    def to_dict(self) -> dict[str, object]:
        """Return the plain JSON values, keys as the fields."""
        return asdict(self)


class LiveSession:
    """A session under way.

    Args:
        layout: layout of the columns.
        history_bytes: maximum size of the stored rows in bytes; the oldest rows are removed first.
        preparing: description of the work before the first row; empty if it takes no time.

    Attributes:
        layout: layout of the columns.
        preparing: see above.
        ticks: streamed so far.
        ended: why nothing more comes, in words; empty while it runs.
        stamp: time (s since 1970) of the newest tick.
    """

    def __init__(self, layout: LiveLayout, history_bytes: int = HISTORY_BYTES, preparing: str = "") -> None:
        self.preparing = preparing
        self.layout, self.ticks, self.ended, self.stamp = layout, 0, "", time.time()
        capacity = max(1, history_bytes // (4 * layout.width))
        # A source whose end is known needs no more; pages of memory are taken as they are written.
        self._rows = np.zeros((min(capacity, layout.ticks or capacity), layout.width), np.float32)
        self._events: deque[LiveEvent] = deque(maxlen=MAX_EVENTS)
        self._breaks: deque[int] = deque(maxlen=MAX_EVENTS)
        self._counted, self._lock = 0, threading.Lock()

    @property
    def oldest(self) -> int:
        """The first tick that is still there."""
        return max(0, self.ticks - len(self._rows))

    def append(self, row: Rows) -> None:
        """Append a row, shape (width,), SI units, NaN for missing values.

        Raises:
            DataError: another width.
        """
        if row.shape != (self.layout.width,):
            raise DataError(f"a row of shape {row.shape} came; ({self.layout.width},) must hold")
        with self._lock:
            self._rows[self.ticks % len(self._rows)] = row
            self.ticks += 1
            self.stamp = time.time()

    def event(self, kind: str, text: str, group: str = "", tick: int | None = None) -> None:
        """Log an event, at the present tick where no other is given."""
        with self._lock:
            at = self.ticks if tick is None else tick
            self._events.append(LiveEvent(self._counted, at, kind, text[:MOST_TEXT], group[:MOST_TEXT]))
            self._counted += 1

    def break_off(self) -> None:
        """Mark a discontinuity: predictions made before it do not apply afterwards."""
        with self._lock:
            self._breaks.append(self.ticks)

    @property
    def breaks(self) -> list[int]:
        """Return the stored samples at which the session restarted."""
        with self._lock:
            return list(self._breaks)

    def end(self, why: str) -> None:
        """End the session: no more data will be added."""
        with self._lock:
            self.ended = why[:MOST_TEXT]

    def read(self, first: int, count: int) -> tuple[int, Rows]:
        """Return the available rows from a sample: the first sample and a copy, shape (ticks, width)."""
        with self._lock:
            start = min(max(first, self.oldest), self.ticks)
            stop = min(max(first + count, start), self.ticks)
            return start, self._rows[np.arange(start, stop) % len(self._rows)]

    def events(self, first: int = 0) -> list[LiveEvent]:
        """Return the stored events from a given number."""
        with self._lock:
            return [event for event in self._events if event.number >= first]

    @property
    def event_count(self) -> int:
        """Number of all events, including discarded ones."""
        return self._counted
