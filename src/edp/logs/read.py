"""Reading one recording or a data set of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edp.errors import DataError
from edp.logs.detect import format_for, known_suffixes, open_log
from edp.logs.raw import TRUTH, RawLog, RawSignal, is_truth
from edp.logs.repair import Repair, mend_gaps, mend_stamps, mend_values
from edp.logs.resolve import Wanted, resolve
from edp.logs.timebase import Clock, Grid, Rows, common_grid, hold_rows, uniform_clock
from edp.logs.write import truth_path
from edp.recording import Recording
from edp.signals import SignalMap

RATE_TOLERANCE = 1e-3


@dataclass(frozen=True, eq=False)
class _Timeline:
    """The clock of one time column, the rows it keeps, and how the grid samples it."""

    clock: Clock
    order: Rows | None
    rows: Rows | None
    missing: NDArray[np.bool_]


def read_recording(
    path: str | Path,
    signal_map: SignalMap | None = None,
    *,
    name: str | None = None,
    rows: tuple[int, int | None] | None = None,
    repair: Repair | None = None,
) -> Recording:
    """Read a log file as a uniformly sampled recording in SI units.

    Args:
        path: a CSV, Parquet or MAT file.
        signal_map: which columns become which channels; an empty map takes the vocabulary's names with the units
            that the file states (SI where it states none).
        name: the recording's name; default: as the file says, else the file's stem.
        rows: ``(start, stop)`` of the resulting samples, stop exclusive, None for the end.
        repair: what may be mended; by default nothing is, and defects are errors.

    Returns:
        values float32, shape ``(time, channel)``. Time is brought to a uniform grid by the rule stated in
        `edp.logs.timebase`: causal, so that no sample depends on a later one.

    Raises:
        DataError: the file, a column, a unit, a time stamp or a value cannot be used; the message says what to change.
    """
    signal_map, repair = signal_map or SignalMap(), repair or Repair()
    raw = open_log(path, signal_map)
    wanted, problems = resolve(raw, signal_map)
    if problems:
        more = f" (and {len(problems) - 1} more problem(s) of this kind)" if len(problems) > 1 else ""
        raise type(problems[0])(f"{problems[0]}{more}")
    return assemble(raw, wanted, signal_map, repair, (name, rows))[0]


def assemble(
    raw: RawLog,
    wanted: Sequence[Wanted],
    signal_map: SignalMap,
    repair: Repair,
    naming: tuple[str | None, tuple[int, int | None] | None] = (None, None),
) -> tuple[Recording, list[Clock]]:
    """Bring the wanted channels to one grid; also returns the clocks of the file's time columns."""
    name, rows = naming
    where = f"'{raw.path}'"
    timelines, grid, made = _timelines(raw, wanted, signal_map, repair)
    values = np.empty((grid.count, len(wanted)), dtype=np.float32)
    missing = np.zeros(grid.count, dtype=np.bool_)
    for place, entry in enumerate(wanted):
        if entry.signal is None:
            values[:, place] = entry.constant
            continue
        line = timelines[_clock_key(entry.signal)]
        column = entry.signal.values
        if line.order is not None:
            column = column[line.order]
        values[:, place] = entry.convert(column if line.rows is None else column[line.rows])
        missing |= line.missing
    if repair.gaps != "hold":
        values[missing] = np.nan
    part = _rows(rows, grid.count, where)
    values, missing = values[part], missing[part]
    keep, gap_facts = mend_gaps(missing, grid.rate_hz, repair, where)
    values, missing = values[keep], missing[keep]
    names = [entry.channel.name for entry in wanted]
    made += gap_facts + mend_values(values, missing, names, grid.rate_hz, repair, where)
    clocks = [line.clock for line in timelines.values()]
    meta: dict[str, Any] = dict(raw.meta)
    if made:
        meta["repairs"] = [*meta.get("repairs", []), *made]
    if any(line.rows is not None for line in timelines.values()):
        meta["resampled_from_hz"] = max(clock.rate_hz for clock in clocks)
    recording = Recording(
        name=name or raw.name or raw.path.stem,
        channels=tuple(entry.channel for entry in wanted),
        values=values,
        rate_hz=grid.rate_hz,
        source=raw.source or str(raw.path),
        meta=meta,
    )
    return recording, clocks


def _clock_key(signal: RawSignal) -> int:
    return 0 if signal.time_s is None else id(signal.time_s)


def _timelines(
    raw: RawLog, wanted: Sequence[Wanted], signal_map: SignalMap, repair: Repair
) -> tuple[dict[int, _Timeline], Grid, list[dict[str, Any]]]:
    if signal_map.rate_hz is not None and not 0 < signal_map.rate_hz < np.inf:
        raise DataError(f"signal map: rate_hz is {signal_map.rate_hz}; it must be a positive number")
    signals = [entry.signal for entry in wanted if entry.signal is not None]
    if not signals:
        raise DataError(f"'{raw.path}': no channel is read from the file; map at least one to a column")
    judged: dict[int, tuple[Clock, Rows | None]] = {}
    made: list[dict[str, Any]] = []
    for signal in signals:
        key = _clock_key(signal)
        if key in judged:
            _check_length(raw, signal, judged[key], signals[0])
            continue
        stated = _stated_clock(raw, signal, signal_map)
        if stated is not None:
            judged[key] = (stated, None)
            continue
        if signal.time_s is None:
            known = ", ".join(list(raw.signals)[:12])
            raise DataError(
                f"'{raw.path}' has no time column that fits '{signal.name}' (columns: {known}); "
                "set 'time' in the signal map to its name, or set 'sample_time_s'"
            )
        where = f"'{raw.path}', time of '{signal.name}'"
        clock, order, mended = mend_stamps(signal.time_s, repair, where)
        judged[key] = (clock, order)
        made += mended
    grid = common_grid([clock for clock, _ in judged.values()], signal_map.rate_hz, f"'{raw.path}'")
    lines = {key: _Timeline(clock, order, *hold_rows(clock, grid)) for key, (clock, order) in judged.items()}
    return lines, grid, made


def _stated_clock(raw: RawLog, signal: RawSignal, signal_map: SignalMap) -> Clock | None:
    """The clock of rows that are uniform because the map or the file says so."""
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
    return uniform_clock(signal.samples, rate)


def _check_length(raw: RawLog, signal: RawSignal, judged: tuple[Clock, Rows | None], first: RawSignal) -> None:
    if signal.time_s is None and signal.samples != len(judged[0].stamps):
        raise DataError(
            f"'{raw.path}': column '{signal.name}' has {signal.samples} rows, '{first.name}' has {first.samples}; "
            "map columns of one length, or give each its own time"
        )


def _rows(rows: tuple[int, int | None] | None, count: int, where: str) -> slice:
    if rows is None:
        return slice(None)
    start, stop = rows[0], count if rows[1] is None else rows[1]
    if not 0 <= start < stop <= count:
        raise DataError(f"{where}: rows {start}:{stop} asked for, but 0 <= start < stop <= {count} must hold")
    return slice(start, stop)


def read_truth(path: str | Path) -> Recording | None:
    """What only the simulation knew of a log: from the file beside it or from its own variable; None where unknown.

    Args:
        path: the log file.
    """
    log = Path(path)
    beside = truth_path(log)
    if beside.is_file():
        return read_recording(beside)
    if not format_for(log).parts:
        return None
    try:
        return read_recording(log, SignalMap(variable=TRUTH))
    except DataError:  # no such variable: logs of real machines have none
        return None


def find_recordings(path: str | Path) -> tuple[Path, ...]:
    """The log files at a path: the file itself, or all files with a known ending in a folder and below, sorted.

    In a folder, files that hold the truth of the log beside them (``NAME.truth.SUFFIX``) are passed over.

    Raises:
        DataError: the path does not exist, or holds no log file.
    """
    source = Path(path)
    if source.is_file():
        return (source,)
    if not source.exists():
        raise DataError(f"'{source}' does not exist; give a log file or a folder of log files")
    known = known_suffixes()
    found = [
        entry
        for entry in sorted(source.rglob("*"))
        if entry.suffix.lower() in known and not entry.name.startswith(".") and entry.is_file() and not _is_truth(entry)
    ]
    if not found:
        raise DataError(f"'{source}' holds no log files; known endings: {', '.join(known)}")
    return tuple(found)


def _is_truth(path: Path) -> bool:
    """Whether a file holds the truth of a log that lies beside it."""
    log = path.with_name(f"{path.stem.removesuffix(f'.{TRUTH}')}{path.suffix}")
    return log != path and log.is_file()


def read_data_set(
    paths: str | Path | Sequence[str | Path], signal_map: SignalMap | None = None, *, repair: Repair | None = None
) -> list[Recording]:
    """Read several logs that belong together: equal rates (within 0.1 %), equal channels, names made unique.

    Args:
        paths: files or folders, or one of them.
        signal_map: as in `read_recording`, the same for all.
        repair: as in `read_recording`.

    Raises:
        DataError: as `read_recording`, and for mixed rates or channel sets. Truth of a simulation that only some of
            them hold is left out instead, unless the map asks for it.
    """
    given = [paths] if isinstance(paths, str | Path) else list(paths)
    files = list(dict.fromkeys(file for path in given for file in find_recordings(path)))
    if not files:
        raise DataError("no log files given; give at least one file or folder")
    recordings = [read_recording(file, signal_map, repair=repair) for file in files]
    if signal_map is None or not signal_map.channels:
        recordings = _without_partial_truth(recordings)
    _check_same(recordings, files)
    rate = recordings[0].rate_hz
    names = _unique_names([recording.name for recording in recordings], files)
    return [replace(recording, name=name, rate_hz=rate) for recording, name in zip(recordings, names)]


def _without_partial_truth(recordings: list[Recording]) -> list[Recording]:
    """Recordings less the truth that only some of them hold: ground heights exist in soil, not in free air."""
    if len({recording.channel_names for recording in recordings}) == 1:
        return recordings
    common = set.intersection(*(set(recording.channel_names) for recording in recordings))
    made = []
    for recording in recordings:
        kept = [i for i, name in enumerate(recording.channel_names) if name in common or not is_truth(name)]
        channels = tuple(recording.channels[i] for i in kept)
        made.append(replace(recording, channels=channels, values=np.ascontiguousarray(recording.values[:, kept])))
    return made


def _check_same(recordings: Sequence[Recording], files: Sequence[Path]) -> None:
    first = recordings[0]
    for recording, file in zip(recordings, files):
        if abs(recording.rate_hz - first.rate_hz) > RATE_TOLERANCE * first.rate_hz:
            raise DataError(
                f"mixed rates: {files[0].name} {first.rate_hz:.6g} Hz, {file.name} {recording.rate_hz:.6g} Hz; "
                "set rate_hz in the signal map"
            )
        if recording.channel_names != first.channel_names:
            lacks = sorted(set(first.channel_names) - set(recording.channel_names))
            extra = sorted(set(recording.channel_names) - set(first.channel_names))
            parts = [f"lacks {', '.join(lacks)}"] if lacks else []
            parts += [f"has in addition {', '.join(extra)}"] if extra else []
            raise DataError(
                f"mixed channels: {file.name} {' and '.join(parts) or 'has another order'} compared with "
                f"{files[0].name}; list the wanted channels in the signal map"
            )


def _unique_names(names: Sequence[str], files: Sequence[Path]) -> list[str]:
    """Names as they are where unique, else with the folder in front, else numbered."""
    better = [f"{file.parent.name}/{name}" if names.count(name) > 1 else name for name, file in zip(names, files)]
    seen: dict[str, int] = {}
    unique = []
    for name in better:
        seen[name] = seen.get(name, 0) + 1
        unique.append(name if better.count(name) == 1 else f"{name}#{seen[name]}")
    return unique
