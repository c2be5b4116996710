"""Assembly of recordings from the columns of a file: clocks, common grid, repairs, values chunk by chunk."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from edp.errors import DataError
from edp.logs.formats.base import ColumnTable, RawLog, RawSignal
from edp.logs.formats.names import name_of_file
from edp.logs.repair import Mask, Repair, repair_gaps, repair_stamps, repair_values, repairs_of
from edp.logs.resolve import ChannelSource
from edp.logs.timebase import Clock, Grid, Rows, common_grid, hold_rows, uniform_clock
from edp.recording import FloatArray, Recording
from edp.signals import SignalMap
from edp.storage.memory import check_memory
from edp.wording import typed

_CACHED_ROWS = 4096
"""Rows written at a time: blocks of 1,000 to 4,000 are fastest, 500 or 8,000 take 1.5 to 2 times as long (journal)."""
_MAX_EMPTY = 0.5
"""Maximum fraction of a log that is omitted because a channel has no value yet."""
_TICK_BYTES = 25
"""Memory per sample for the time rule: time, row and gap flag."""


@dataclass(frozen=True, eq=False)
class _Timeline:
    """The clock of one time column, the rows it keeps, and how the grid samples it."""

    clock: Clock
    order: Rows | None
    rows: Rows | None
    missing: NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Assembly:
    """A log brought to one grid, its values still in the file.

    Attributes:
        raw: the file.
        sources: the channels, in order.
        repair: allowed repairs.
        lines: sampling of each time column.
        rate_hz: sample rate of the grid.
        ticks: the ticks of the grid that the recording keeps.
        missing: mask of samples in a gap, shape ``(time,)``.
        repairs: repairs of the time axis.
        untouched: every row of every channel is taken as it is in the file, by its own rate and map.
    """

    raw: RawLog
    sources: Sequence[ChannelSource]
    repair: Repair
    lines: dict[int, _Timeline]
    rate_hz: float
    ticks: slice
    missing: Mask
    repairs: list[dict[str, object]] = field(default_factory=list)
    untouched: bool = False

    @property
    def samples(self) -> int:
        """Number of samples of the recording."""
        return len(self.missing)

    @property
    def clocks(self) -> list[Clock]:
        """The clocks of the file's time columns."""
        return [line.clock for line in self.lines.values()]

    @property
    def resampled(self) -> bool:
        """Whether a tick may take another row than its own."""
        return any(line.rows is not None for line in self.lines.values())

    def recording(self, start: int, stop: int, name: str | None, before: FloatArray | None = None) -> Recording:
        """Return the samples ``start <= t < stop`` as a recording.

        Args:
            start: the first.
            stop: index after the last sample.
            name: the recording's name; None: as the file says.
            before: the last good value of each channel before `start`, shape ``(channel,)``, to hold.

        Raises:
            DataError: a column cannot be read, or holds missing values that may not be repaired.
        """
        values, repairs = self._repair_columns(start, stop, before)
        meta = dict(self.raw.meta)
        if self.repairs or repairs:
            meta["repairs"] = [*repairs_of(meta), *self.repairs, *repairs]
        if self.resampled:
            meta["resampled_from_hz"] = max(clock.rate_hz for clock in self.clocks)
        return Recording(
            name=name or self.raw.name or name_of_file(self.raw.path),
            channels=tuple(entry.channel for entry in self.sources),
            values=values,
            rate_hz=self.rate_hz,
            source=self.raw.source or str(self.raw.path),
            meta=meta,
        )

    def _repair_columns(
        self, start: int, stop: int, before: FloatArray | None
    ) -> tuple[FloatArray, list[dict[str, object]]]:
        values = self.values(start, stop)
        missing = self.missing[start:stop]
        if self.repair.gaps != "hold":
            values[missing] = np.nan
        if before is not None:
            values, missing = np.vstack([before[None], values]), np.append(False, missing)
        names = [entry.channel.name for entry in self.sources]
        offset = start if before is None else start - 1
        repairs = repair_values(values, missing, names, self.rate_hz, self.repair, f"'{self.raw.path}'", offset)
        return (values if before is None else values[1:]), repairs

    def values(self, start: int, stop: int) -> FloatArray:
        """Return the unrepaired samples ``start <= t < stop``, float32, shape ``(time, channel)``."""
        return self._values(self.ticks.start + start, self.ticks.start + stop)

    def _values(self, first: int, last: int) -> FloatArray:
        """Return the ticks ``first <= k < last`` of the grid, float32, shape ``(time, channel)``."""
        # Before the array is made: a damaged time column may ask for years of samples.
        check_memory(
            self.raw.path,
            4 * (last - first) * len(self.sources),
            f"{last - first} samples of {len(self.sources)} channels",
            "read some rows, fewer channels, or in parts (edp.logs.read_parts)",
        )
        values = np.empty((last - first, len(self.sources)), dtype=np.float32)
        tables: dict[tuple[int, int], tuple[ColumnTable, list[int]]] = {}
        for column_index, entry in enumerate(self.sources):
            if entry.signal is None:
                values[:, column_index] = entry.constant
                continue
            clock = _clock_key(entry.signal)
            line, table = self.lines[clock], entry.signal.table
            # Rows that have to be sorted need the whole column; all others pass in pieces.
            if table is not None and line.order is None:
                tables.setdefault((id(table), clock), (table, []))[1].append(column_index)
                continue
            column = entry.signal.values
            if line.order is not None:
                column = column[line.order]
            values[:, column_index] = entry.convert(
                column[slice(first, last) if line.rows is None else line.rows[first:last]]
            )
        for table, places in tables.values():
            self._fill(values, table, places, first)
        return values

    def _fill(self, values: FloatArray, table: ColumnTable, places: list[int], first: int) -> None:
        """Fill in the columns of one table and one clock, chunk by chunk."""
        chosen = [
            (column_index, entry, entry.signal)
            for column_index in places
            if (entry := self.sources[column_index]).signal is not None
        ]
        keys = [signal.key for _, _, signal in chosen]
        ticks = slice(first, first + len(values))
        rows = self.lines[_clock_key(chosen[0][2])].rows
        source_rows = np.arange(ticks.start, ticks.stop) if rows is None else rows[ticks]
        at, tick = int(source_rows[0]), 0
        for columns in table.pieces(keys, at, int(source_rows[-1]) + 1):
            end = at + len(columns[0])
            stop = int(np.searchsorted(source_rows, end))
            part = source_rows[tick:stop] - at
            plain = len(part) == end - at and rows is None
            converted = [
                entry.convert(column if plain else column[part]) for (_, entry, _), column in zip(chosen, columns)
            ]
            _interleave(values[tick:stop], [column_index for column_index, _, _ in chosen], converted)
            at, tick = end, stop
        # The rest of the array would hold whatever memory held before.
        if tick != len(values):
            raise DataError(
                f"'{self.raw.path}' ends after {at} rows, {int(source_rows[-1]) + 1} were announced (truncated "
                "or damaged); "
                "copy or export it again"
            )


def _interleave(values: FloatArray, places: list[int], columns: list[FloatArray]) -> None:
    """Write columns into rows, some rows at a time: a whole column at once would leave the cache at each step."""
    for start in range(0, len(values), _CACHED_ROWS):
        block = values[start : start + _CACHED_ROWS]
        for column_index, column in zip(places, columns):
            block[:, column_index] = column[start : start + _CACHED_ROWS]


def prepare(
    raw: RawLog,
    sources: Sequence[ChannelSource],
    signal_map: SignalMap,
    repair: Repair,
    rows: tuple[int, int | None] | None = None,
) -> Assembly:
    """Bring the times of the chosen channels to one grid; no value is read yet.

    Raises:
        DataError: times that cannot be used or may not be repaired; rows outside the log.
    """
    where = f"'{raw.path}'"
    lines, grid, repairs = _timelines(raw, sources, signal_map, repair)
    missing = np.zeros(grid.count, dtype=np.bool_)
    for line in lines.values():
        missing |= line.missing
    part = _rows(rows, grid.count, where)
    # Gaps of the wanted rows only: those outside of them do not matter to the reader.
    keep, gap_facts = repair_gaps(missing[part], grid.rate_hz, repair, where)
    first = part.start + (keep.start or 0)
    last = part.start + (len(missing[part]) if keep.stop is None else keep.stop)
    # Only values that are taken as they were written have the digest that was written with them.
    own_way = not signal_map.channels and signal_map.rate_hz is None and signal_map.sample_time_s is None
    untouched = own_way and repair == Repair() and (first, last) == (0, grid.count)
    assembly = Assembly(
        raw,
        sources,
        repair,
        lines,
        grid.rate_hz,
        slice(first, last),
        missing[first:last],
        repairs + gap_facts,
        untouched,
    )
    return _drop_empty_start(assembly) if repair.nan == "hold" and rows is None else assembly


def _drop_empty_start(assembly: Assembly) -> Assembly:
    """Remove the samples before every channel has its first value, since earlier values cannot be held.

    Raises:
        DataError: more than `_MAX_EMPTY` of the log would be left out.
    """
    late = np.full(len(assembly.sources), -1)
    # The first row by itself: most logs have all their values there.
    edges = sorted({0, 1, *range(_CACHED_ROWS, assembly.samples, _CACHED_ROWS), assembly.samples})
    for start, stop in pairwise(edges):
        values = assembly.values(start, stop)
        for i in np.flatnonzero(late < 0):
            good = np.flatnonzero(np.isfinite(values[:, i]))
            late[i] = start + good[0] if len(good) else -1
        if (late >= 0).all():
            break
    first, slowest = int(late.max()), int(late.argmax() if (late >= 0).all() else late.argmin())
    if not first and (late >= 0).all():
        return assembly
    name = assembly.sources[slowest].channel.name
    if late[slowest] < 0 or first > _MAX_EMPTY * assembly.samples:
        reason = "holds no number" if late[slowest] < 0 else f"has its first number in row {first}"
        raise DataError(
            f"'{assembly.raw.path}': channel '{name}' {reason} of {assembly.samples:,}; leave it out of the signal "
            "map, or leave the log out"
        )
    fact = {"repair": "nan = hold: start left out", "channel": name, "count": first, "row": 0}
    ticks = slice(assembly.ticks.start + first, assembly.ticks.stop)
    return replace(assembly, ticks=ticks, missing=assembly.missing[first:], repairs=[*assembly.repairs, fact])


def assemble(
    raw: RawLog,
    sources: Sequence[ChannelSource],
    signal_map: SignalMap,
    repair: Repair,
    name: str | None = None,
    rows: tuple[int, int | None] | None = None,
) -> tuple[Recording, list[Clock]]:
    """Bring the chosen channels to one grid; also returns the clocks of the file's time columns."""
    assembly = prepare(raw, sources, signal_map, repair, rows)
    recording = assembly.recording(0, assembly.samples, name)
    if assembly.untouched and raw.digest is not None and recording.digest != raw.digest:
        raise DataError(
            f"'{raw.path}': the values are not the ones that EDP wrote; the file is damaged, or was changed by another "
            "program: copy it again, or where the change is wanted, remove EDP's facts from it (edp_info)"
        )
    return recording, assembly.clocks


def parts(assembly: Assembly, samples: int, name: str) -> Iterator[Recording]:
    """Yield the recording in consecutive parts of `samples` (the last may be shorter), each named by its samples."""
    before: FloatArray | None = None
    for start in range(0, assembly.samples, samples):
        stop = min(start + samples, assembly.samples)
        # A part that begins with a missing value holds the last good one of the parts before.
        part = assembly.recording(start, stop, f"{name}[{start}:{stop}]", before)
        before = _last_good(part.values, before)
        yield part


def _last_good(values: FloatArray, before: FloatArray | None) -> FloatArray:
    last = np.full(values.shape[1], np.nan, dtype=np.float32) if before is None else before.copy()
    for column_index, column in enumerate(values.T):
        good = np.flatnonzero(np.isfinite(column))
        if len(good):
            last[column_index] = column[good[-1]]
    return last


def _clock_key(signal: RawSignal) -> int:
    return 0 if signal.time_s is None else id(signal.time_s)


@dataclass(frozen=True)
class _Stamps:
    """A clock, and the order that its rows are brought into; None where they are in order."""

    clock: Clock
    order: Rows | None


def _timelines(
    raw: RawLog, sources: Sequence[ChannelSource], signal_map: SignalMap, repair: Repair
) -> tuple[dict[int, _Timeline], Grid, list[dict[str, object]]]:
    if signal_map.rate_hz is not None and not 0 < signal_map.rate_hz < np.inf:
        raise DataError(f"signal map: rate_hz is {signal_map.rate_hz}; it must be a positive number")
    signals = [entry.signal for entry in sources if entry.signal is not None]
    if not signals:
        raise DataError(f"'{raw.path}': no channel is read from the file; map at least one to a column")
    stamps: dict[int, _Stamps] = {}
    repairs: list[dict[str, object]] = []
    for signal in signals:
        key = _clock_key(signal)
        if key in stamps:
            _check_length(raw, signal, stamps[key].clock, signals[0])
            continue
        stated = _find_clock(raw, signal, signal_map)
        if stated is not None:
            stamps[key] = _Stamps(stated, None)
            continue
        if signal.time_s is None:
            signal_names = ", ".join(list(raw.signals)[:12])
            raise DataError(
                f"'{raw.path}' has no time column that fits '{signal.name}' (columns: {signal_names}); "
                "set 'time' in the signal map (--map) to its name, or set 'sample_time_s'"
            )
        where = f"'{raw.path}', time of '{signal.name}'"
        clock, order, repaired = repair_stamps(signal.time_s, repair, where)
        stamps[key] = _Stamps(clock, order)
        repairs += repaired
    grid = common_grid([each.clock for each in stamps.values()], signal_map.rate_hz, f"'{raw.path}'")
    check_memory(
        raw.path,
        _TICK_BYTES * grid.count * (1 + sum(not each.clock.uniform for each in stamps.values())),
        f"{grid.count} samples from {typed(grid.start_s)} s on at {typed(grid.rate_hz)} Hz",
        "check the time column for a stamp that is far off, or set a lower rate_hz in the signal map",
    )
    lines = {key: _Timeline(each.clock, each.order, *hold_rows(each.clock, grid)) for key, each in stamps.items()}
    return lines, grid, repairs


def _find_clock(raw: RawLog, signal: RawSignal, signal_map: SignalMap) -> Clock | None:
    """Return the clock of uniform rows, if the map or the file states a rate or sample time."""
    rate = None
    if signal_map.sample_time_s is not None:
        if not signal_map.sample_time_s > 0:
            raise DataError(f"signal map: sample_time_s is {signal_map.sample_time_s}; it must be positive")
        rate = 1.0 / signal_map.sample_time_s
    elif raw.rate_hz is not None:
        rate = float(raw.rate_hz)
    if rate is None:
        return None
    if signal.samples < 1:
        raise DataError(f"'{raw.path}': column '{signal.name}' holds no rows")
    check_memory(
        raw.path, _TICK_BYTES * signal.samples, f"{signal.samples} rows", "the file may be damaged: copy it again"
    )
    return uniform_clock(signal.samples, rate)


def _check_length(raw: RawLog, signal: RawSignal, clock: Clock, first: RawSignal) -> None:
    if signal.time_s is None and signal.samples != len(clock.stamps):
        raise DataError(
            f"'{raw.path}': column '{signal.name}' has {signal.samples} rows, '{first.name}' has {first.samples}; "
            "map columns of one length, or give each its own time"
        )


def _rows(rows: tuple[int, int | None] | None, count: int, where: str) -> slice:
    if rows is None:
        return slice(0, count)
    start, stop = rows[0], count if rows[1] is None else rows[1]
    if not 0 <= start < stop <= count:
        raise DataError(f"{where}: rows {start}:{stop} asked for, but 0 <= start < stop <= {count} must hold")
    return slice(start, stop)
