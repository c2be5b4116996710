"""Events of MDF 4: named time intervals with a text, which measurement tools mark along the signals."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any
from xml.sax.saxutils import escape

from edp.errors import DataError

LONGEST_TEXT = 2_000
"""Maximum number of characters of a name or comment. Longer texts are cut."""
MAX_EVENTS = 100_000
"""Maximum number of events in a file: a segment takes two blocks of about 150 bytes and its texts."""
_NS = 10**9
_MARKER, _RECORDED_AFTERWARDS = 6, 1
"""Event type of a marker, and flag of events that were added after the recording."""
_BEGIN, _END = 1, 2
_SECONDS, _BY_TOOL = 1, 2


@dataclass(frozen=True)
class LogEvent:
    """Time interval of a recording with a name and a text.

    Attributes:
        name: a few words, shown along the signals.
        start_s: s from the beginning of the recording.
        end_s: not before `start_s`.
        comment: a sentence about it.

    Raises:
        DataError: times that are no segment.
    """

    name: str
    start_s: float
    end_s: float
    comment: str = ""

    def __post_init__(self) -> None:
        if not (math.isfinite(self.start_s) and math.isfinite(self.end_s) and 0.0 <= self.start_s <= self.end_s < 1e9):
            raise DataError(
                f"event '{self.name}' from {self.start_s!r} to {self.end_s!r} s; an end not before the start, both "
                "from 0 to 1e9 s, must hold"
            )


def event_blocks(events: Sequence[LogEvent]) -> list[Any]:
    """Return the asammdf blocks of the begin and end of each event, in file order.

    Raises:
        DataError: more than `MAX_EVENTS`.
    """
    from asammdf.blocks.v4_blocks import EventBlock

    if len(events) > MAX_EVENTS:
        raise DataError(f"{len(events):,} events; at most {MAX_EVENTS:,} are written to a file")
    blocks: list[Any] = []
    for event in events:
        for kind, time_s in ((_BEGIN, event.start_s), (_END, event.end_s)):
            block: Any = EventBlock(
                event_type=_MARKER,
                sync_type=_SECONDS,
                range_type=kind,
                cause=_BY_TOOL,
                flags=_RECORDED_AFTERWARDS,
                # Nanoseconds are integers: a float of seconds after hours is not exact.
                sync_base=round(time_s * _NS),
                sync_factor=1.0 / _NS,
            )
            block.name = _plain(event.name)
            # The library takes text that begins so for XML, and other text as it is; ours is XML, and escaped.
            block.comment = f"<EVcomment><TX>{escape(_plain(event.comment))}</TX></EVcomment>"
            block.range_start = len(blocks) - 1 if kind == _END else None
            blocks.append(block)
    return blocks


def _plain(text: str) -> str:
    """Return text that XML and UTF-8 can hold."""
    cut = text[:LONGEST_TEXT].encode("utf-8", "replace").decode()
    return "".join(c if c.isprintable() else " " for c in cut)
