"""Alarms in words: what reads or does what by how much, since when, and how sure that is."""

from __future__ import annotations

import math
from collections.abc import Sequence
from datetime import datetime, timedelta

from edp.monitor.diagnosis.causes import NONE_OF_THESE, Cause, FaultClass
from edp.wording import number

UNKNOWN = "something changed that no fault of the dictionary explains"
UNNAMED = "the machine or a sensor behaves otherwise than on the healthy sessions"
SURE = 0.5
"""Probability above which a cause is stated. Below it, the cause is called a guess."""


def size_text(size: float, unit: str) -> str:
    """Format a size with two to three digits and its unit, without its sign."""
    value = abs(size)
    digits = max(0, 1 - math.floor(math.log10(value))) if value > 0.0 else 0
    text = number(value, min(digits, 4))
    return f"{text}x" if unit == "x" else f"{text} {unit}".rstrip()


def cause_words(fault: FaultClass, size: float | None) -> str:
    """Describe a fault of this size in words, without a full stop."""
    text = fault.words
    if size is not None:
        over = size >= fault.neutral
        # Replaced, never formatted: the text comes from a file.
        for key, word in (
            ("{size}", size_text(size, fault.unit)),
            ("{high}", "high" if over else "low"),
            ("{large}", "large" if over else "small"),
        ):
            text = text.replace(key, word)
    return text


def clock(seconds: float, start: datetime | None = None) -> str:
    """Format a time in a recording: time of day if its start is known, otherwise time since its start, h:mm:ss."""
    if start is not None:
        return f"{start + timedelta(seconds=round(seconds)):%H:%M:%S}"
    whole = max(0, round(seconds))
    return f"{whole // 3600}:{whole // 60 % 60:02d}:{whole % 60:02d}"


def alarm_sentence(causes: Sequence[Cause], since_s: float, start: datetime | None = None) -> str:
    """Return one sentence for an alarm, such as "head pressure of the boom reads 9.8 bar too high since 14:02:11.

    0.93".

    Args:
        causes: the most likely one first; may be empty where there is no dictionary.
        since_s: estimated onset, s from the start of the recording.
        start: time of day at the start of the recording.
    """
    since = f"since {clock(since_s, start)}"
    if not causes:
        return f"{UNNAMED} {since}"
    first = causes[0]
    if first.kind == NONE_OF_THESE:
        return f"{UNKNOWN} {since}; {first.probability:.2f}"
    if first.probability >= SURE:
        return f"{first.words} {since}; {first.probability:.2f}"
    part = component_probability(causes, first.component)
    if part >= SURE:
        sure = f"{part:.2f} for the part, {first.probability:.2f} for this"
        return f"{first.component}: perhaps {first.words} {since}; {sure}"
    return f"not clear what changed {since}: perhaps {first.words}; {first.probability:.2f}"


def component_probability(causes: Sequence[Cause], component: str) -> float:
    """Return the probability of all causes of one part."""
    return sum(cause.probability for cause in causes if cause.component == component)
