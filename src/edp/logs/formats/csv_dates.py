"""Dates and times of day in text files, as loggers and spreadsheets of several countries write them."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

_GERMAN = re.compile(r"(\d{1,2})\.(\d{1,2})\.(\d{4})(?:[ T]+(\d.*))?")
"""``31.12.2025 13:00:00``. Dates with slashes and without AM or PM are rejected because day and month are ambiguous."""
_CLOCK = re.compile(r"(\d{1,2}):(\d{2})(?::(\d{2})(?:[.,](\d{1,9})\d*)?)?")
_AMERICAN = re.compile(r"(\d{1,2})/(\d{1,2})/(\d{4})[ T]+(\d.*\d) ?([AP])M", re.IGNORECASE)
"""``06/29/2022 04:05:36.674 PM``. With AM or PM, the month comes first."""
_YEAR_FIRST = re.compile(r"(\d{4})[/.-](\d{1,2})[/.-](\d{1,2})(?:[ T]+(\d.*))?")
"""``2025/1/31 13:00:00.5``. If the year comes first, the day comes last."""
_MIDNIGHT = "1970-01-01"
"""Date assigned to times of day without a date. Only time differences are used."""


def dates_of(cells: Sequence[str | None]) -> NDArray[np.datetime64]:
    """Return the dates, times of day or both, shape ``(rows,)``, in nanoseconds; an empty cell is missing (NaT).

    Raises:
        ValueError: a cell is none of them.
    """
    return np.array([_iso(cell) for cell in cells], dtype="datetime64[ns]")


def is_date(cell: str) -> bool:
    """Return whether a cell contains a date or a time of day with digits and separators."""
    text = cell.strip()
    if not text[:1].isdigit() or not any(sign in text for sign in ":/.-"):
        return False
    try:
        return not bool(np.isnat(dates_of([text])[0]))
    except ValueError:
        return False


def _iso(cell: str | None) -> str:
    text = (cell or "").strip().removesuffix("Z")
    if not text:
        return "NaT"
    german = _GERMAN.fullmatch(text)
    if german is not None:
        day, month, year, clock = german.groups()
        date = f"{year}-{int(month):02d}-{int(day):02d}"
        return date if clock is None else f"{date}T{_clock(clock)}"
    american = _AMERICAN.fullmatch(text)
    if american is not None:
        month, day, year, clock, half = american.groups()
        return f"{year}-{int(month):02d}-{int(day):02d}T{_clock(clock, half.upper())}"
    year_first = _YEAR_FIRST.fullmatch(text)
    # What a time of day does not cover, as a zone, NumPy judges.
    if year_first is not None and (year_first[4] is None or _CLOCK.fullmatch(year_first[4])):
        year, month, day, clock = year_first.groups()
        date = f"{year}-{int(month):02d}-{int(day):02d}"
        return date if clock is None else f"{date}T{_clock(clock)}"
    if _CLOCK.fullmatch(text):
        return f"{_MIDNIGHT}T{_clock(text)}"
    # ISO 8601 allows a decimal comma, NumPy does not.
    return text.replace(",", ".")


def _clock(text: str, half: str = "") -> str:
    """Convert a time of day to ISO 8601; `half` of the day is A, P or unknown."""
    match = _CLOCK.fullmatch(text.strip())
    if match is None:
        raise ValueError(f"{text[:40]!r} is no time of day")
    hours, minutes, seconds, part = match.groups()
    if half and not 1 <= int(hours) <= 12:
        raise ValueError(f"{text[:40]!r} is no time of half a day")
    hour = int(hours) if not half else int(hours) % 12 + 12 * (half == "P")
    return f"{hour:02d}:{minutes}:{seconds or '00'}.{part or '0'}"
