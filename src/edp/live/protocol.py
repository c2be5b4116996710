"""Messages between server and page: binary rows, otherwise JSON; and the requests of a page."""

from __future__ import annotations

import json
import math
import struct
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edp.errors import DataError

ROWS, PAST = 1, 2
HEAD = struct.Struct("<4I d")
"""Message header: kind, first sample, number of rows, number of columns; time of the newest sample (s since 1970)."""
MAX_REQUEST = 256
"""Maximum size of a request in bytes."""
MAX_PAST = 12_000
"""Maximum number of rows per response: two minutes at 100 Hz."""
REQUESTS = {"past": ("first", "count"), "pause": ("value",), "speed": ("value",), "ahead": ("tick",)}
"""Requests of the page with the names of their numbers. No request affects a machine, a disk or a setting."""


@dataclass(frozen=True)
class Request:
    """Request of a page; see `REQUESTS`."""

    name: str
    numbers: tuple[float, ...]


def rows_message(kind: int, first: int, rows: NDArray[np.float32], stamp: float) -> bytes:
    """Return the rows, shape (ticks, columns), as a message; little endian, float32."""
    head = HEAD.pack(kind, first & 0xFFFFFFFF, *rows.shape, stamp)
    return head + np.ascontiguousarray(rows, dtype="<f4").tobytes()


def text_message(kind: str, **values: Any) -> str:
    """Return everything but rows."""
    return json.dumps({"type": kind, **values}, allow_nan=False, separators=(",", ":"))


def request_of(message: Any) -> Request:
    """Parse the request of a page.

    Raises:
        DataError: anything else.
    """
    if not isinstance(message, str) or len(message) > MAX_REQUEST:
        raise DataError(f"a request is a text of at most {MAX_REQUEST} characters")
    try:
        entry = json.loads(message)
        name, names = entry["do"], REQUESTS[entry["do"]]
        values = [entry[key] for key in names]
        if any(isinstance(value, bool) or not isinstance(value, int | float) for value in values):
            raise TypeError
        numbers = tuple(map(float, values))
    except (ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
        raise DataError(f"a request names one of {', '.join(REQUESTS)} with its numbers") from error
    if not all(math.isfinite(number) and abs(number) < 2**53 for number in numbers):
        raise DataError("a request has numbers that are none")
    return Request(name, numbers)
