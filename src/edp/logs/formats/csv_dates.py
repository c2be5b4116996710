"""Dates and times of day in text files, as loggers and spreadsheets of several countries write them."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

_GERMAN = re.compile(r"(\d{1,2})\.(\d{1,2})\.(\d{4})(?:[ T]+(\d.*))?")
"""``31.12.2025 13:00:00``; a date with slashes may mean day or month first and is not read."""
_CLOCK = re.compile(r"(\d{1,2}):(\d{2})(?::(\d{2})(?:[.,](\d{1,9})\d*)?)?")
_MIDNIGHT = "1970-01-01"
"""Of times of day without a date: only their differences count."""


def dates_of(cells: Sequence[str | None]) -> NDArray[np.datetime64]:
    """Dates, times of day or both, shape ``(rows,)``, in nanoseconds; an empty cell is missing (NaT).

    Raises:
        ValueError: a cell is none of them.
    """
    return np.array([_iso(cell) for cell in cells], dtype="datetime64[ns]")


def _iso(cell: str | None) -> str:
    text = (cell or "").strip().removesuffix("Z")
    if not text:
        return "NaT"
    german = _GERMAN.fullmatch(text)
    if german is not None:
        day, month, year, clock = german.groups()
        date = f"{year}-{int(month):02d}-{int(day):02d}"
        return date if clock is None else f"{date}T{_clock(clock)}"
    if _CLOCK.fullmatch(text):
        return f"{_MIDNIGHT}T{_clock(text)}"
    # ISO 8601 allows a decimal comma, NumPy does not.
    return text.replace(",", ".")


def _clock(text: str) -> str:
    match = _CLOCK.fullmatch(text.strip())
    if match is None:
        raise ValueError(f"{text[:40]!r} is no time of day")
    hours, minutes, seconds, part = match.groups()
    return f"{int(hours):02d}:{minutes}:{seconds or '00'}.{part or '0'}"
