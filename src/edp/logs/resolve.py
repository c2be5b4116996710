"""From a file's columns to the wanted channels: the built-in vocabulary or a signal map."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edp.errors import DataError, EdpError, closest
from edp.logs.formats.base import RawLog, RawSignal
from edp.logs.units import channel_from_entry, check_unit, kind_of_unit, unit_for
from edp.signals import VOCABULARY, Channel, ChannelMap, SignalMap, Unit

_LOOKED_ROWS = 1000
"""Number of rows examined to recognise a numeric column."""


@dataclass(frozen=True)
class ChannelSource:
    """One channel and where its values come from: a column with its conversion, or a constant in SI."""

    channel: Channel
    signal: RawSignal | None
    unit: Unit
    scale: float = 1.0
    constant: float = float("nan")

    def convert(self, values: NDArray[Any]) -> NDArray[np.float32]:
        """Return the file values to SI, float32."""
        if values.dtype == np.float32 and self.scale == 1.0 and self.unit.factor == 1.0 and not self.unit.offset:
            return values
        # Damaged files hold bits that are no numbers; what they become is reported as missing.
        with np.errstate(invalid="ignore"):
            values = values.astype(np.float64, copy=False)
        # Too large for float32, or for a number, becomes infinite, which the value check then reports.
        with np.errstate(over="ignore", invalid="ignore"):
            if self.scale != 1.0 or self.unit.factor != 1.0:
                values = values * (self.scale * self.unit.factor)
            if self.unit.offset:
                values = values + self.unit.offset
            return values.astype(np.float32)


def resolve(raw: RawLog, signal_map: SignalMap) -> tuple[list[ChannelSource], list[EdpError]]:
    """Return the requested channels in order, and the problems of map or file for unavailable channels."""
    sources: list[ChannelSource] = []
    problems: list[EdpError] = []
    if not signal_map.channels and not signal_map.others:
        entries = _vocabulary_entries(raw)
        if not entries:
            problems.append(_nothing_known(raw))
    else:
        entries = [*signal_map.channels, *(_other_entries(raw, signal_map) if signal_map.others else ())]
    for entry in entries:
        try:
            sources.append(_one(raw, entry))
        except EdpError as error:
            problems.append(error)
    return sources, problems


def _vocabulary_entries(raw: RawLog) -> list[ChannelMap]:
    """Return the columns whose names are known; files that state kinds (EDP's own) are taken whole."""
    stated = [signal for signal in raw.signals.values() if signal.kind is not None]
    if stated:
        return [ChannelMap(s.name, s.name, kind=s.kind, description=s.description) for s in stated]
    # A name that occurs twice is refused when its column is looked up, with the names that tell them apart.
    return [ChannelMap(name, name) for name in VOCABULARY if name in raw or name in raw.repeated]


def _other_entries(raw: RawLog, signal_map: SignalMap) -> list[ChannelMap]:
    """Return an entry for every numeric column that the map does not name."""
    columns = {raw.aliases.get(entry.column, entry.column) for entry in signal_map.channels}
    names = {entry.name for entry in signal_map.channels}
    entries = []
    for name, signal in raw.signals.items():
        if name in columns or name in names or not _holds_numbers(signal):
            continue
        usual_channel = VOCABULARY.get(name)
        kind = signal.kind or (usual_channel.kind if usual_channel is not None else kind_of_unit(signal.unit))
        entries.append(ChannelMap(name, name, kind=kind, description=signal.description))
    return entries


def _holds_numbers(signal: RawSignal) -> bool:
    """Return whether the first rows are numeric. Text in later rows is an error when the column is read."""
    try:
        if signal.table is None:
            signal.load()
        else:
            next(iter(signal.table.pieces([signal.key], 0, min(signal.samples, _LOOKED_ROWS))), None)
    except DataError:
        return False
    return True


def _nothing_known(raw: RawLog) -> DataError:
    names = list(raw.signals)
    near = [f"'{name}'{hint}" for name in names if (hint := closest(name, VOCABULARY)).startswith("; did")]
    shown = ", ".join(names[:12]) + (", ..." if len(names) > 12 else "")
    text = near[0] if near else "none is in the built-in vocabulary (Table A.1)"
    return DataError(
        f"'{raw.path}' has the columns {shown}: {text}; rename columns or give a signal map (--map; edp init "
        "proposes one)"
    )


def _one(raw: RawLog, entry: ChannelMap) -> ChannelSource:
    channel = channel_from_entry(entry)
    where = f"'{raw.path}', column '{entry.column}'"
    stated = check_unit(entry.unit, f"{where}: signal map, channel '{entry.name}'")
    present = entry.column in raw
    if not present and entry.column in raw.scalars:
        unit = unit_for(stated, channel.kind, where)
        value = raw.scalars[entry.column] * entry.scale * unit.factor + unit.offset
        # A single number of a MAT file fills a channel: gains are constant by nature.
        return ChannelSource(channel, None, unit, constant=value)
    if not present and entry.constant is not None:
        return ChannelSource(channel, None, Unit((channel.kind,), 1.0), constant=entry.constant)
    signal = raw.signal(entry.column)
    return ChannelSource(channel, signal, unit_for(stated or signal.unit, channel.kind, where), entry.scale)
