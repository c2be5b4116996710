"""Arrays in memory as recordings, by the rules of files: units, kinds, time stamps, repairs."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edp.errors import DataError
from edp.logs.assemble import assemble
from edp.logs.formats.base import RawLog, RawSignal, find_time, time_factor
from edp.logs.repair import Repair
from edp.logs.resolve import resolve
from edp.logs.units import kind_of_unit, normalise_unit
from edp.recording import Recording
from edp.settings.bounds import above, shown
from edp.signals import UNITS, VOCABULARY, Kind, SignalMap

RATE = above(0.0, 1e9)
"""Valid range of sample rates in Hz. Log clocks count nanoseconds."""
IN_MEMORY = "memory"
"""Source of a recording that was not read from a file."""


def recording_of_columns(
    name: str,
    columns: Mapping[str, NDArray[Any]],
    units: Mapping[str, str] | None = None,
    rate_hz: float | None = None,
    signal_map: SignalMap | None = None,
    repair: Repair | None = None,
) -> Recording:
    """Create a recording from named columns, as if they were the columns of a log.

    Args:
        name: the recording's name.
        columns: numbers or time stamps, each of shape ``(time,)``.
        units: unit of each column; columns without an entry are in SI units or dimensionless.
        rate_hz: samples per second; without it a column of time stamps tells the rate.
        signal_map: assignment of columns to channels. Without a map each numeric column becomes a channel of the same
            name, with the kind of the vocabulary or of its unit.
        repair: allowed repairs; none by default.

    Raises:
        DataError: no column, a rate that is not positive, no time stamps where they are needed, text for numbers, or
            values that are missing or infinite.
    """
    signal_map, units = signal_map or SignalMap(others=True), units or {}
    if not columns:
        raise DataError(f"recording '{name}' has no columns; give at least one")
    if rate_hz is not None and not RATE.holds(rate_hz):
        raise DataError(
            f"recording '{name}': rate_hz = {shown(rate_hz)}; give the samples per second, a number above 0"
        )
    where = Path(name)
    time_name = find_time(list(columns), signal_map, where) if rate_hz is None else None
    if rate_hz is None and time_name is None and signal_map.sample_time_s is None:
        raise DataError(
            f"recording '{name}' has no column of time stamps (time_s, time, timestamp); give rate_hz, the samples per "
            "second"
        )
    stamps = None
    if time_name is not None:
        stamps = _seconds(columns[time_name], time_factor(time_name, units.get(time_name), signal_map), time_name, name)
    signals = {
        column: _signal(column, values, units.get(column), stamps, name)
        for column, values in columns.items()
        if column != time_name
    }
    raw = RawLog(where, signals, rate_hz=rate_hz, name=name, source=IN_MEMORY)
    channels, problems = resolve(raw, signal_map)
    if problems:
        raise problems[0]
    if not channels:
        raise DataError(f"recording '{name}' has no column of numbers besides its time; give at least one")
    return assemble(raw, channels, signal_map, repair or Repair())[0]


def _signal(
    column: str, values: NDArray[Any], unit: str | None, stamps: NDArray[np.float64] | None, name: str
) -> RawSignal:
    def load() -> NDArray[np.float64]:
        try:
            return np.asarray(values, dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise DataError(f"recording '{name}': column '{column}' holds something else than numbers") from error

    kind = _kind(column, unit)
    description = f"in {unit}" if kind is Kind.GENERIC else ""
    return RawSignal(column, load, len(values), stamps, unit, kind, description)


def _kind(column: str, unit: str | None) -> Kind | None:
    """Return the kind of a unit that contradicts the vocabulary or is unknown; None if the rules for logs apply.

    A name of the vocabulary alone does not tell what an array holds: its unit is the stronger word.
    """
    stated, channel = normalise_unit(unit), VOCABULARY.get(column)
    if stated is None or (stated in UNITS and (channel is None or channel.kind in UNITS[stated].kinds)):
        return None
    return kind_of_unit(stated)


def _seconds(values: NDArray[Any], factor: float, column: str, name: str) -> NDArray[np.float64]:
    """Time stamps in seconds, from the first; dates and durations count in nanoseconds."""
    values = np.asarray(values)
    if values.dtype.kind in "mM":
        since = (values - values[:1]).astype("timedelta64[ns]")
        # Nanoseconds as integers first: a float of a date has no digits left for them.
        return np.where(np.isnat(since), np.nan, since.astype(np.int64) * 1e-9)
    try:
        return np.asarray(values, dtype=np.float64) * factor
    except (TypeError, ValueError) as error:
        raise DataError(f"recording '{name}': time column '{column}' holds no time stamps") from error
