"""Reading of one recording, or of a data set."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path

from edp.errors import DataError
from edp.logs.assemble import assemble, parts, prepare
from edp.logs.detect import BAG_MARK, export_advice, format_for, is_text_log, list_suffixes, open_log
from edp.logs.formats.base import TRUTH, RawLog, holds_truth_apart, is_truth
from edp.logs.formats.names import name_of_file
from edp.logs.repair import Repair
from edp.logs.resolve import ChannelSource, resolve
from edp.logs.write import truth_path
from edp.recording import Recording, columns
from edp.signals import SignalMap
from edp.storage.paths import files_below, is_file_at, is_there
from edp.wording import typed

TEXT = (".txt", ".dat")
"""File endings that logs share with other files. They are used if a folder has no logs with other endings."""
_MAX_FILES = 10_000
"""Maximum number of files in a folder without logs whose endings are examined."""
RATE_TOLERANCE = 1e-3
"""Relative tolerance between the rates of logs in one data set. Loggers state one rate with different digits."""


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
        path: a log of any known format (`edp.logs.list_suffixes`), or the folder of a ROS 2 bag.
        signal_map: which columns become which channels; an empty map takes the vocabulary's names with the units
            that the file states (SI where it states none).
        name: the recording's name; default: as the file says, else the file's stem.
        rows: ``(start, stop)`` of the resulting samples, stop exclusive, None for the end.
        repair: allowed repairs. By default there are none, and defects are errors.

    Returns:
        values float32, shape ``(time, channel)``. Time is brought to a uniform grid by the rule stated in
        `edp.logs.timebase`: causal, so that no sample depends on a later one.

    Raises:
        DataError: the file, a column, a unit, a time stamp or a value cannot be used; the message says what to change.
    """
    signal_map, repair = signal_map or SignalMap(), repair or Repair()
    raw, sources = _open_with_channels(path, signal_map)
    return assemble(raw, sources, signal_map, repair, name, rows)[0]


def read_parts(
    path: str | Path,
    signal_map: SignalMap | None = None,
    *,
    samples: int = 1 << 18,
    repair: Repair | None = None,
) -> Iterator[Recording]:
    """Read a log in consecutive parts, for logs whose channels do not fit into memory together.

    Args:
        path: see `read_recording`.
        signal_map: see `read_recording`.
        samples: length of a part in samples; the last part is shorter.
        repair: see `read_recording`. A part that begins with a missing value repeats the last valid one before it.

    Yields:
        recordings that, one after the other, hold the values of `read_recording`; named ``NAME[start:stop]``.

    Raises:
        DataError: see `read_recording`. Defects of time are reported before the first part, defects of values with
            their part.
    """
    if samples < 1:
        raise DataError(f"parts of {samples} samples asked for; give at least 1")
    signal_map, repair = signal_map or SignalMap(), repair or Repair()
    raw, sources = _open_with_channels(path, signal_map)
    yield from parts(prepare(raw, sources, signal_map, repair), samples, raw.name or name_of_file(raw.path))


def _open_with_channels(path: str | Path, signal_map: SignalMap) -> tuple[RawLog, list[ChannelSource]]:
    """Open the file and return the requested channels, all of which must exist."""
    raw = open_log(path, signal_map)
    sources, problems = resolve(raw, signal_map)
    if problems:
        more = f" (and {len(problems) - 1} more problem(s) of this kind)" if len(problems) > 1 else ""
        raise type(problems[0])(f"{problems[0]}{more}")
    return raw, sources


def read_truth(path: str | Path) -> Recording | None:
    """Return the ground truth of a simulated log, from its separate file or variable; None if unknown.

    Args:
        path: the log file.
    """
    log = Path(path)
    beside = truth_path(log)
    if is_file_at(beside):
        return read_recording(beside)
    if not holds_truth_apart(format_for(log)):
        return None
    try:
        return read_recording(log, SignalMap(variable=TRUTH))
    except DataError:  # no such variable: logs of real machines have none
        return None


def find_recordings(path: str | Path) -> tuple[Path, ...]:
    """Return the log files at a path: the file itself, or all files with a known ending in a folder tree, sorted.

    In a folder, files that hold the truth of the log beside them (``NAME.truth.SUFFIX``) are passed over, and text
    files (``.txt``) where there are other logs. A folder that is a ROS 2 bag counts as one log.

    Raises:
        DataError: the path does not exist, or holds no log file.
    """
    source = Path(path)
    if is_file_at(source) or is_file_at(source / BAG_MARK):
        return (source,)
    if not is_there(source):
        raise DataError(f"'{source}' does not exist; give a log file or a folder of log files")
    there = list(files_below(source))
    bags = {entry.parent for entry in there if entry.name == BAG_MARK}
    suffixes = list_suffixes()
    files = [
        entry
        for entry in there
        if entry.suffix.lower() in suffixes
        # Files that are being written have names that begin with a dot.
        and not entry.name.startswith(".")
        and not _is_truth(entry)
        and (entry.suffix.lower() not in TEXT or is_text_log(entry))
    ]
    # Beside logs of other endings text files hold remarks and licences; loggers of text write nothing else.
    if bags or any(file.suffix.lower() not in TEXT for file in files):
        files = [file for file in files if file.suffix.lower() not in TEXT]
    recording_paths = sorted([*bags, *(file for file in files if file.parent not in bags)])
    if not recording_paths:
        raise DataError(f"'{source}' holds no log files; known endings: {', '.join(suffixes)}{_instead(source)}")
    return tuple(recording_paths)


def _instead(folder: Path) -> str:
    """Return advice on the most frequent unsupported files of a folder; otherwise empty."""
    endings = Counter(entry.suffix.lower() for entry in islice(files_below(folder), _MAX_FILES))
    advised = [(suffix, export_advice(suffix)) for suffix, _ in endings.most_common()]
    return next((f". {endings[suffix]} end in '{suffix}': {advice}" for suffix, advice in advised if advice), "")


def _is_truth(path: Path) -> bool:
    """Return whether a file holds the ground truth of a log next to it."""
    log = path.with_name(f"{path.stem.removesuffix(f'.{TRUTH}')}{path.suffix}")
    return log != path and is_file_at(log)


def read_data_set(
    paths: str | Path | Sequence[str | Path], signal_map: SignalMap | None = None, *, repair: Repair | None = None
) -> list[Recording]:
    """Read several logs that belong together: equal rates (within 0.1 %), equal channels, names made unique.

    Args:
        paths: files or folders, or one of them.
        signal_map: see `read_recording`; common to all logs.
        repair: see `read_recording`.

    Raises:
        DataError: see `read_recording`; also for mixed sample rates or channel sets. Simulated truth that only some
            logs contain is omitted instead, unless the map selects it. If the map takes `others`, any channel that only
            some logs contain is omitted.
    """
    path_list = [paths] if isinstance(paths, str | Path) else list(paths)
    # A folder and a file in it may both be given; each log counts once.
    files = list(dict.fromkeys(file for path in path_list for file in find_recordings(path)))
    if not files:
        raise DataError("no log files given; give at least one file or folder")
    recordings = [read_recording(file, signal_map, repair=repair) for file in files]
    if signal_map is not None and signal_map.others:
        recordings = common_channels(recordings)
    names = unique_names([recording.name for recording in recordings], files)
    named = [replace(recording, name=name) for recording, name in zip(recordings, names)]
    return alike(named, files, truth_asked=signal_map is not None and bool(signal_map.channels))


def alike(recordings: list[Recording], files: Sequence[Path], truth_asked: bool = False) -> list[Recording]:
    """Return recordings of one data set after a check of rates and channels against the first.

    Args:
        recordings: recordings with unique names.
        files: their logs, for messages.
        truth_asked: truth of a simulation that only some hold is an error instead of left out.

    Raises:
        DataError: mixed rates or channels.
    """
    if not truth_asked:
        recordings = _drop_partial_truth(recordings)
    _check_same(recordings, files)
    rate = recordings[0].rate_hz
    return [recording if recording.rate_hz == rate else replace(recording, rate_hz=rate) for recording in recordings]


def _drop_partial_truth(recordings: list[Recording]) -> list[Recording]:
    """Remove ground truth that only some recordings hold: ground heights exist in soil, not in free air."""
    if len({recording.channel_names for recording in recordings}) == 1:
        return recordings
    common = set.intersection(*(set(recording.channel_names) for recording in recordings))
    reduced = []
    for recording in recordings:
        column_indices = [i for i, name in enumerate(recording.channel_names) if name in common or not is_truth(name)]
        channels = tuple(recording.channels[i] for i in column_indices)
        reduced.append(replace(recording, channels=channels, values=columns(recording.values, column_indices)))
    return reduced


def common_channels(recordings: Sequence[Recording]) -> list[Recording]:
    """Reduce recordings to their common channels, in the order of the first.

    Raises:
        DataError: no channel is in all of them.
    """
    first = recordings[0].channel_names
    names = [name for name in first if all(name in recording.channel_names for recording in recordings)]
    if not names:
        raise DataError(
            f"no channel is in all of the {len(recordings)} recordings; bring them to one set of names in maps"
        )
    if all(recording.channel_names == first for recording in recordings):
        return list(recordings)
    return [
        replace(
            recording,
            channels=tuple(recording.channels[recording.index(name)] for name in names),
            values=recording.select(names),
        )
        for recording in recordings
    ]


def _check_same(recordings: Sequence[Recording], files: Sequence[Path]) -> None:
    first = recordings[0]
    for recording, file in zip(recordings, files):
        if abs(recording.rate_hz - first.rate_hz) > RATE_TOLERANCE * first.rate_hz:
            raise DataError(
                f"mixed rates: {files[0].name} {typed(first.rate_hz)} Hz, {file.name} {typed(recording.rate_hz)} Hz; "
                "set rate_hz in the signal map (--map)"
            )
        if recording.channel_names != first.channel_names:
            lacks = sorted(set(first.channel_names) - set(recording.channel_names))
            extra = sorted(set(recording.channel_names) - set(first.channel_names))
            parts = [f"lacks {', '.join(lacks)}"] if lacks else []
            parts += [f"has in addition {', '.join(extra)}"] if extra else []
            raise DataError(
                f"mixed channels: {file.name} {' and '.join(parts) or 'has another order'} compared with "
                f"{files[0].name}; list the wanted channels in the signal map (--map)"
            )


def unique_names(names: Sequence[str], files: Sequence[Path]) -> list[str]:
    """Return unique names: unchanged if unique, otherwise with the folder as prefix, otherwise numbered."""
    better = [f"{file.parent.name}/{name}" if names.count(name) > 1 else name for name, file in zip(names, files)]
    seen: dict[str, int] = {}
    unique = []
    for name in better:
        seen[name] = seen.get(name, 0) + 1
        unique.append(name if better.count(name) == 1 else f"{name}#{seen[name]}")
    return unique
