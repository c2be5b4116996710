"""Bounded part of the columns of a log, from which a map is proposed."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from edp.errors import DataError
from edp.logs.detect import format_for, open_log
from edp.logs.formats.base import EXPERIMENTS, Column, RawLog, RawSignal
from edp.logs.formats.csv import NAME_BY_PLACE
from edp.logs.timebase import Clock, judge
from edp.signals import Kind, SignalMap
from edp.storage import write_bytes
from edp.storage.paths import is_file_at, status_of

TEXT_BYTES = 16_000_000
"""Size of the examined part of a text file: 15 min of 20 channels at 100 Hz. Text has no index, so this is its
beginning."""
_HEAD_BYTES = 1 << 20
"""Size of the examined part of a text when comparing columns with other files."""
MAX_COLUMNS = 400
"""Maximum number of examined columns. Further columns are omitted and counted."""
_ROWS = 30_000
"""Number of rows of the first segment, which determines time and relations: five minutes at 100 Hz."""
_LATER_ROWS = 10_000
"""Number of rows of the segments from the middle and the end, since a machine may rest at the start of a log."""
_VALUES = 12_000_000
"""Maximum number of stored values of all columns together (96 MB)."""
_PROBE_ROWS = 1000
"""Number of rows used to distinguish text columns from numeric columns."""
_MAX_TEXTS = 20
"""Maximum number of text columns tried as time."""
_COVERED = 0.9
"""Minimum fraction of the longest span that signals with their own times cover. A single message is not a signal."""
_SLOWEST = 200.0
"""Maximum ratio between the sample counts of the fastest and a slower signal."""
_HELD_VALUES = 4 * _VALUES
"""Maximum number of values after holding slow signals at the fastest rate. Longer logs use columns of one length."""
_OF_THE_LOGGER = ("/rosout", "rosout", "/diagnostics", "/parameter_events", "/events/")
"""Name prefixes of topics in which ROS programs report their own state."""
_TIME_WORDS = ("time", "zeit", "stamp", "date", "datum", "uhr")


@dataclass(frozen=True, eq=False)
class LogColumn:
    """One column of a log.

    Attributes:
        name: the file's own.
        pieces: values of consecutive rows, float64, NaN where missing; the first piece is the beginning.
        samples: rows that the file has.
        unit: unit stated in the file.
        kind: kind stated in the file (EDP's own formats).
        own_time: whether the column has separate time stamps, as signals of MDF files and bags do.
        clock: time in these columns; None if they were not examined.
    """

    name: str
    pieces: tuple[Column, ...]
    samples: int
    unit: str | None = None
    kind: Kind | None = None
    own_time: bool = False
    clock: Clock | None = None

    @property
    def values(self) -> Column:
        """All stored values, shape ``(rows,)``."""
        return np.concatenate(self.pieces)


@dataclass(frozen=True, eq=False)
class LogLook:
    """Part of a log that was read for a proposal.

    Attributes:
        path: the log.
        columns: numeric columns of equal length, in the order of the file.
        texts: names of columns that hold text.
        rows: number of rows of the file or part.
        rate_hz: sample rate stated in the file.
        time: the column that the reader takes for time by its name or its dates.
        step_s: median step of the times that the reader made of it, None where there are none.
        headerless: the file names no columns.
        shared: every name occurs once.
        left_out: columns that were not looked at, by the reason.
        part: description of the examined part of the file; empty for the whole file.
        experiments: names of those that stand beside each other in a variable of a MAT file.
    """

    path: Path
    columns: tuple[LogColumn, ...]
    texts: tuple[str, ...]
    rows: int
    rate_hz: float | None = None
    time: str | None = None
    step_s: float | None = None
    headerless: bool = False
    left_out: dict[str, int] = field(default_factory=dict)
    part: str = ""
    experiments: tuple[str, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the numeric columns."""
        return tuple(column.name for column in self.columns)


def look_at_log(path: Path, experiment: str | None = None) -> LogLook:
    """Read a bounded part of every column.

    Args:
        path: the log.
        experiment: the one of several in a MAT file that is looked at.

    Raises:
        DataError: the file cannot be read, or holds no column of numbers.
    """
    with _open_bounded(path, TEXT_BYTES) as (part, note):
        try:
            return _look(path, part, note, experiment)
        except DataError as error:
            # The user knows the log, not the copy of its beginning.
            raise type(error)(str(error).replace(str(part), str(path))) from error


def names_in_log(path: Path) -> frozenset[str]:
    """Return the names of the columns of a log, by the beginning of a text.

    Raises:
        DataError: the file cannot be read.
    """
    with _open_bounded(path, _HEAD_BYTES) as (part, _):
        return frozenset(_drop_status_columns(open_log(part, SignalMap(others=True, sample_time_s=1.0))).signals)


@contextmanager
def _open_bounded(path: Path, most: int) -> Iterator[tuple[Path, str]]:
    """Yield the log itself, or a temporary file with the first lines of a large text file."""
    size = status_of(path).st_size if is_file_at(path) else 0
    if size <= most or format_for(path).name != "csv":
        yield path, ""
        return
    with path.open("rb") as stream:
        head = stream.read(most)
    end = head.rfind(b"\n") + 1
    if not end:
        raise DataError(f"'{path}': no row ends within the first {most:,} bytes; it is no table")
    with tempfile.TemporaryDirectory(prefix="edp_") as folder:
        part = Path(folder) / f"beginning{path.suffix.lower()}"
        write_bytes(part, head[:end])
        yield part, f"the first {end / 1e6:.0f} of {size / 1e6:,.0f} MB"


def _look(path: Path, part: Path, note: str, experiment: str | None) -> LogLook:
    # With a stated step no column is taken for time: all of them are looked at.
    whole = SignalMap(others=True, variable=experiment)
    raw = _drop_status_columns(open_log(part, replace(whole, sample_time_s=1.0)))
    for time_name in (None, *islice((name for name in raw.signals if _is_time_word(name)), 1)):
        paced = _look_at_signals(path, part, note, replace(whole, time=time_name))
        if paced is not None:
            return paced
    length = _usual_length(raw)
    signals = [signal for signal in raw.signals.values() if signal.samples == length]
    left_out = {f"have another length than {length:,} rows": len(raw.signals) - len(signals)}
    left_out["come after the first columns"] = max(len(signals) - MAX_COLUMNS, 0)
    signals = signals[:MAX_COLUMNS]
    numbers = [signal for signal in signals if _is_numeric(signal)]
    texts = tuple(signal.name for signal in signals if signal not in numbers)
    if not numbers:
        raise DataError(f"'{path}' holds no column of numbers; nothing can be mapped")
    first = min(_ROWS, max(_VALUES // len(numbers) // 2, 100))
    ranges = _ranges(length, first, min(_LATER_ROWS, first // 3))
    pieces = _pieces(numbers, ranges)
    time, step_s, owners = _time_of(part, raw, texts, whole)
    clocks = _clocks_of([signal for signal in numbers if signal.name in owners])
    columns = tuple(
        LogColumn(
            *(signal.name, tuple(values), length, signal.unit, signal.kind),
            own_time=signal.name in owners,
            clock=clocks.get(signal.name),
        )
        for signal, values in zip(numbers, pieces)
    )
    return LogLook(
        path,
        columns,
        texts,
        length,
        raw.rate_hz,
        time,
        step_s,
        all(NAME_BY_PLACE.fullmatch(name) for name in raw.signals) and format_for(path).name == "csv",
        {reason: count for reason, count in left_out.items() if count},
        note,
        _experiments(raw),
    )


def _drop_status_columns(raw: RawLog) -> RawLog:
    """Return the log without the status columns of the logging program, unless it has no others."""
    own = {name: signal for name, signal in raw.signals.items() if not name.startswith(_OF_THE_LOGGER)}
    return replace(raw, signals=own) if own else raw


def _experiments(raw: RawLog) -> tuple[str, ...]:
    """Return the names of the experiments that a file states."""
    names = raw.meta.get(EXPERIMENTS)
    return tuple(map(str, names)) if isinstance(names, list | tuple) else ()


def _is_time_word(name: str) -> bool:
    return any(word in name.lower() for word in _TIME_WORDS)


def _look_at_signals(path: Path, part: Path, note: str, signal_map: SignalMap) -> LogLook | None:
    """Return a log whose signals have their own times at different rates, resampled to the fastest.

    None for other logs.
    """
    try:
        timed = _drop_status_columns(open_log(part, signal_map))
    except DataError:
        return None
    signals = [s for s in timed.signals.values() if s.time_s is not None and s.samples > 2]
    experiments = _experiments(timed)
    if timed.rate_hz is not None or len({s.samples for s in signals}) < 2:
        return None
    texts = tuple(s.name for s in signals if not _is_numeric(s))
    signals = [s for s in signals if s.name not in texts]
    if len({s.samples for s in signals}) < 2:
        return None
    longest = max(_span_s(s) for s in signals)
    covering = [s for s in signals if _span_s(s) >= _COVERED * longest and _step_s(s) > 0]
    if not covering or longest <= 0:
        return None
    # Messages that come in bursts have short steps and few rows.
    fastest = min(covering, key=lambda s: _span_s(s) / s.samples)
    step, stamps = _step_s(fastest), np.asarray(fastest.time_s, dtype=np.float64)
    alike = [s for s in covering if s.samples * _SLOWEST >= fastest.samples]
    numbers = alike[:MAX_COLUMNS]
    if len({s.samples for s in numbers}) < 2 or len(numbers) * len(stamps) > _HELD_VALUES:
        return None
    first = min(_ROWS, max(_VALUES // len(numbers) // 2, 100))
    ranges = _ranges(len(stamps), first, min(_LATER_ROWS, first // 3))
    columns = []
    clocks = _clocks_of(numbers)
    for signal in numbers:
        values = _hold_values(signal, stamps)
        pieces = tuple(values[start:stop] for start, stop in ranges)
        clock = clocks.get(signal.name)
        columns.append(LogColumn(signal.name, pieces, len(stamps), signal.unit, signal.kind, True, clock))
    left_out = {
        "cover another time than the others, or come far more slowly": len(signals) - len(alike),
        "come after the first columns": len(alike) - len(numbers),
    }
    counted = {reason: count for reason, count in left_out.items() if count > 0}
    return LogLook(
        path, tuple(columns), texts, len(stamps), None, signal_map.time, step, False, counted, note, experiments
    )


def _clocks_of(signals: Sequence[RawSignal]) -> dict[str, Clock]:
    """Return the clock of each signal by name, without signals that cannot be read."""
    clocks: dict[str, Clock] = {}
    judged: dict[int, tuple[Column, Clock]] = {}
    for signal in signals:
        stamps = signal.time_s
        if stamps is None:
            continue
        if id(stamps) not in judged:
            try:
                judged[id(stamps)] = stamps, judge(np.asarray(stamps, dtype=np.float64), signal.name)
            except DataError:
                continue
        clocks[signal.name] = judged[id(stamps)][1]
    return clocks


def _span_s(signal: RawSignal) -> float:
    stamps = np.asarray(signal.time_s, dtype=np.float64)
    return float(stamps[-1] - stamps[0]) if np.isfinite(stamps[[0, -1]]).all() else 0.0


def _step_s(signal: RawSignal) -> float:
    rising = np.diff(np.asarray(signal.time_s, dtype=np.float64)[:_ROWS])
    rising = rising[rising > 0]
    return float(np.median(rising)) if len(rising) else 0.0


def _hold_values(signal: RawSignal, stamps: Column) -> Column:
    """Return the latest value at each given time; the first value before that."""
    values = np.asarray(signal.load(), dtype=np.float64)
    own = np.asarray(signal.time_s, dtype=np.float64)
    if not bool(np.all(np.diff(own) >= 0)):
        order = np.argsort(own, kind="stable")
        own, values = own[order], values[order]
    return values[np.maximum(np.searchsorted(own, stamps, side="right") - 1, 0)]


def _usual_length(raw: RawLog) -> int:
    """Return the number of rows that most columns have; the larger one if two are equally frequent."""
    lengths = [signal.samples for signal in raw.signals.values()]
    if not lengths or max(lengths) < 2:
        raise DataError(f"'{raw.path}' holds no column with two rows or more; nothing can be mapped")
    return max(set(lengths), key=lambda length: (length > 1, lengths.count(length), length))


def _is_numeric(signal: RawSignal) -> bool:
    """Return whether the first rows are numeric."""
    try:
        _read([signal], 0, min(signal.samples, _PROBE_ROWS))
    except DataError:
        return False
    return True


def _ranges(length: int, first: int, later: int) -> list[tuple[int, int]]:
    """Return the rows of the beginning, the middle and the end; all of a short log."""
    if length <= first:
        return [(0, length)]
    middle, last = max(first, (length - later) // 2), max(first, length - later)
    ranges = [(0, first), (middle, min(middle + later, last)), (last, length)]
    return [(start, stop) for start, stop in ranges if stop - start > 1]


def _read(signals: Sequence[RawSignal], start: int, stop: int) -> list[Column]:
    """Read rows of columns as float64, columns of one table in one pass; invalid values become NaN."""
    columns_by_id: dict[int, Column] = {}
    tables: dict[int, list[RawSignal]] = {}
    for signal in signals:
        if signal.table is None:
            columns_by_id[id(signal)] = np.asarray(signal.load(), dtype=np.float64)[start:stop]
        else:
            tables.setdefault(id(signal.table), []).append(signal)
    for group in tables.values():
        table = group[0].table
        if table is not None:
            parts = list(table.pieces([signal.key for signal in group], start, stop))
            for i, signal in enumerate(group):
                columns = [np.asarray(part[i], dtype=np.float64) for part in parts]
                columns_by_id[id(signal)] = np.concatenate(columns) if columns else np.empty(0)
    # Recordings hold single precision: larger numbers are as infinite there as they are said to be when they are read.
    read = [columns_by_id[id(signal)] for signal in signals]
    return [np.where(np.abs(values) <= np.finfo(np.float32).max, values, np.nan) for values in read]


def _pieces(signals: Sequence[RawSignal], ranges: Sequence[tuple[int, int]]) -> list[list[NDArray[np.float64]]]:
    """Return the segments of each column. Text in later rows makes a segment missing."""
    columns: list[list[NDArray[np.float64]]] = [[] for _ in signals]
    for start, stop in ranges:
        try:
            values = _read(signals, start, stop)
        except DataError:
            values = [_read_or_missing(signal, start, stop) for signal in signals]
        for column, piece in zip(columns, values):
            column.append(piece)
    return columns


def _read_or_missing(signal: RawSignal, start: int, stop: int) -> Column:
    try:
        return _read([signal], start, stop)[0]
    except DataError:
        return np.full(stop - start, np.nan)


def _time_of(
    part: Path, raw: RawLog, texts: Sequence[str], whole: SignalMap
) -> tuple[str | None, float | None, set[str]]:
    """Return the reader's time column, the step in seconds, and the columns with their own stamps."""
    by_word = [name for name in texts if _is_time_word(name)]
    others = [name for name in texts if name not in by_word]
    for name in (None, *islice([*by_word, *others], _MAX_TEXTS)):
        try:
            timed = open_log(part, replace(whole, time=name))
            signal = next((s for s in timed.signals.values() if s.time_s is not None), None)
            stamps = None if signal is None else signal.time_s
        except DataError:
            continue
        if stamps is None or len(stamps) < 2 or not np.isfinite(stamps[:_ROWS]).any():
            continue
        steps = np.diff(stamps[:_ROWS])
        absent = [column for column in raw.signals if column not in timed.signals]
        rising = steps[steps > 0]
        step = float(np.median(rising)) if len(rising) else None
        if absent:
            return name or absent[0], step, set()
        return None, step, {s.name for s in timed.signals.values() if s.time_s is not None}
    return None, None, set()
