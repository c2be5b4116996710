"""Detection of the time column of a log, its unit and the certainty."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass

from edp.errors import DataError
from edp.logs.formats.base import time_factor
from edp.logs.proposal.behaviour import Behaviour
from edp.logs.proposal.columns import LogColumn, LogLook
from edp.logs.proposal.names import is_counter_name, is_sample_time_name, is_time_name
from edp.logs.timebase import judge
from edp.signals import TIME_UNITS, SignalMap
from edp.wording import typed

_SINCE_1970 = {"ns": 1e17, "us": 1e14, "ms": 1e11, "s": 5e8}
"""Minimum stamp of a clock that counts from 1970, by unit: about the year 2000."""
_PRINTED, _MANY_STAMPS = 0.995, 50
"""Maximum fraction of rows that repeat the previous stamp, and minimum number of different stamps: whole seconds of
some minutes at 100 Hz."""
_FASTEST_HZ = 200.0
"""Sample rate in Hz above which a rate from `_PLAIN_HZ` is proposed. Machine motion is slower than such rates."""
_PLAIN_HZ = (100.0, 200.0, 500.0, 1000.0, 2000.0)
_MAX_RESTARTS = 5
"""Maximum number of backward steps of uneven time stamps. Each is a restart of the logger."""
_MIN_ROWS = 1500
"""Minimum number of rows after resampling. With about 700, no test and validation data can be separated."""


@dataclass(frozen=True)
class ClockGuess:
    """The time of rows.

    Attributes:
        column: the time column; None where rows are even, or signals have times of their own.
        unit: unit of the time column.
        sample_time_s: step of rows without a time column.
        rate_hz: samples a second, None where nothing tells.
        wanted_hz: rate to bring a fast log to; None keeps its own.
        beside: columns that also tell time, and are no channels.
        confidence: confidence, 0 to 1.
        check: advice for a manual check.
    """

    column: str | None
    unit: str
    sample_time_s: float | None
    rate_hz: float | None
    wanted_hz: float | None = None
    beside: tuple[str, ...] = ()
    confidence: float = 0.9
    check: str = ""


def clock_of(look: LogLook, behaviours: Mapping[str, Behaviour]) -> ClockGuess:
    """Determine the time of the rows of a log."""
    if look.rate_hz is not None:
        return _brought_down(ClockGuess(None, "s", None, look.rate_hz, confidence=1.0), look.rows)
    if look.time is None and look.step_s is not None:
        return _brought_down(ClockGuess(None, "s", None, 1.0 / look.step_s, confidence=0.95), look.rows)
    by_name = {column.name: column for column in look.columns}
    if look.time is not None and look.step_s and look.time not in by_name:
        return _brought_down(ClockGuess(look.time, "s", None, 1.0 / look.step_s, confidence=0.9), look.rows)
    column = _time_column(look, behaviours)
    if column is not None:
        return _guess_clock(column, behaviours[column.name], look)
    return _guess_without_column(look, behaviours)


def _time_column(look: LogLook, behaviours: Mapping[str, Behaviour]) -> LogColumn | None:
    """Return the column of time stamps: stated by the reader, recognised by name, or the first evenly rising one."""
    rising = [
        c
        for c in look.columns
        if (behaviours[c.name].rises and not behaviours[c.name].constant) or _begins_anew(c, behaviours[c.name])
    ]
    named = [c for c in rising if c.name == look.time] + [
        c for c in rising if is_time_name(c.name) and _ticks(behaviours[c.name])
    ]
    if named:
        return named[0]
    for column in _fronts(look):
        behaviour = behaviours[column.name]
        # A name that says nothing of time is doubted more than no name at all.
        nameless = look.headerless or column is not look.columns[0]
        numbered = nameless or is_counter_name(column.name)
        if numbered and behaviour.counts and (second := _find_next_column(column, look, behaviours)) is not None:
            return second
        paced = behaviour.even or behaviour.lossy or (nameless and behaviour.steady)
        if column in rising and behaviour.climbs and paced:
            return column
    return None


def _begins_anew(column: LogColumn, behaviour: Behaviour) -> bool:
    """Return whether stamps recognised by name rise except for a few restarts. Even stamps are counted without them."""
    few = 0 < behaviour.falls <= _MAX_RESTARTS
    return few and not behaviour.even and (behaviour.steady or behaviour.lossy) and is_time_name(column.name)


def _find_next_column(column: LogColumn, look: LogLook, behaviours: Mapping[str, Behaviour]) -> LogColumn | None:
    """Return the column after a row counter, if it rises like a clock."""
    next_index = look.columns.index(column) + 1
    second = look.columns[next_index] if next_index < len(look.columns) else None
    if second is None or not behaviours[second.name].climbs or behaviours[second.name].counts:
        return None
    return second


def _ticks(behaviour: Behaviour) -> bool:
    """Return whether a column can be a clock. Stamps printed with few digits repeat over some rows."""
    return behaviour.holds < 0.5 or (behaviour.holds < _PRINTED and behaviour.levels > _MANY_STAMPS)


def _fronts(look: LogLook) -> list[LogColumn]:
    """Return the first column of the log and of each matrix in it (``data_1`` followed by ``data_2``)."""
    names = set(look.names)
    first = [c for c in look.columns if c.name.endswith("_1") and f"{c.name[:-1]}2" in names]
    return [*look.columns[:1], *(column for column in first if column is not look.columns[0])]


def _guess_clock(column: LogColumn, behaviour: Behaviour, look: LogLook) -> ClockGuess:
    unit, confidence, check = _unit(column, behaviour)
    rate = 1.0 / (behaviour.step * TIME_UNITS[unit])
    if behaviour.holds > 0:
        # Steps between stamps that repeat are not those of rows.
        with suppress(DataError):
            rate = judge(column.pieces[0] * TIME_UNITS[unit], column.name).rate_hz
    if look.time != column.name and not is_time_name(column.name):
        confidence, check = min(confidence, 0.7), check or "is it time?"
    return _brought_down(ClockGuess(column.name, unit, None, rate, None, (), confidence, check), look.rows)


def _unit(column: LogColumn, behaviour: Behaviour) -> tuple[str, float, str]:
    """Return the unit of the stamps, its certainty, and what to check."""
    stated = time_factor(column.name, column.unit, SignalMap())
    ending = column.name.lower().rpartition("_")[2]
    if column.unit or ending in TIME_UNITS:
        unit = next(unit for unit, factor in TIME_UNITS.items() if factor == stated)
        return unit, 0.95, ""
    for unit, least in _SINCE_1970.items():
        if behaviour.low > least:
            return unit, 0.85, ""
    if not behaviour.whole:
        return "s", 0.85, ""
    if behaviour.counts and behaviour.climbs and behaviour.low in (0.0, 1.0):
        return "s", 0.5, "seconds, or numbers of rows?"
    if behaviour.step < 5:
        return "s", 0.65, "seconds?"
    unit = "ms" if behaviour.step <= 1000 else "us" if behaviour.step <= 1e6 else "ns"
    return unit, 0.65, f"{unit}?"


def _guess_without_column(look: LogLook, behaviours: Mapping[str, Behaviour]) -> ClockGuess:
    """Determine the time of rows without a time column: a stated step, a restarting clock, or unknown."""
    for column in look.columns:
        behaviour = behaviours[column.name]
        if behaviour.constant and behaviour.high > 0 and is_sample_time_name(column.name):
            step = behaviour.high
            return ClockGuess(None, "s", step, 1.0 / step, None, (column.name,), 0.8, f"a row each {typed(step)} s?")
    for column in look.columns:
        behaviour = behaviours[column.name]
        if behaviour.restarts and behaviour.even and is_time_name(column.name):
            step = behaviour.step
            check = "it begins anew within the log: are rows without gaps?"
            return ClockGuess(None, "s", step, 1.0 / step, None, (column.name,), 0.65, check)
    still = [c.name for c in look.columns if behaviours[c.name].constant and is_time_name(c.name)]
    reason = f"'{still[0][:40]}' stands still" if still else "no time found"
    return ClockGuess(None, "s", 1.0, 1.0, None, (), 0.3, f"{reason}: a row counts as 1 s; set sample_time_s")


def _brought_down(clock: ClockGuess, rows: int) -> ClockGuess:
    if clock.rate_hz is None or clock.rate_hz <= _FASTEST_HZ:
        return clock
    # A short log shows what is fast: the lowest plain rate that leaves it enough rows, else its own.
    plain = (hz for hz in _PLAIN_HZ if hz < clock.rate_hz and rows * hz >= _MIN_ROWS * clock.rate_hz)
    wanted_hz = next(plain, None)
    if wanted_hz is None:
        return clock
    check = f"{typed(clock.rate_hz)} Hz are brought to {typed(wanted_hz)} Hz: set rate_hz"
    return ClockGuess(
        clock.column, clock.unit, None, clock.rate_hz, wanted_hz, clock.beside, clock.confidence, clock.check or check
    )
