"""Traces of a monitor run in addition to alarms: statistics with their limits, levels of residual groups."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edp.errors import StorageError
from edp.monitor.stored_arrays import read_stored, write_stored

FloatArray = NDArray[np.float32]
TRACES = "traces"
SCHEMA = 1
MAX_RECORDINGS, MAX_COLUMNS = 100_000, 256


@dataclass(frozen=True, eq=False)
class RecordingTrace:
    """Trace of one recording under the monitor, one row per block.

    Attributes:
        name: name of the recording.
        start: time of day of its first sample as ISO 8601 text; empty where it is not known.
        duration_s: its length.
        ratios: statistic over limit of each detector, shape (blocks, detectors); above 1 is an alarm.
        groups: level of each group of residuals, 1 for healthy, shape (blocks, groups); NaN where it is silent.
        silent: groups that were silent throughout.
    """

    name: str
    start: str
    duration_s: float
    ratios: FloatArray
    groups: FloatArray
    silent: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class RunTraces:
    """All recordings of a run.

    Attributes:
        block_s: length of a block, s.
        detectors: names of the columns of `RecordingTrace.ratios`.
        groups: names of the columns of `RecordingTrace.groups`.
        recordings: traces in the order of the run.
    """

    block_s: float
    detectors: tuple[str, ...]
    groups: tuple[str, ...]
    recordings: tuple[RecordingTrace, ...]

    @property
    def hours(self) -> float:
        """Duration of all recordings in hours."""
        return sum(trace.duration_s for trace in self.recordings) / 3600.0


def write_traces(folder: Path, traces: RunTraces) -> None:
    """Write the traces of a run into its folder.

    Raises:
        StorageError: a file cannot be written.
    """
    entries: list[dict[str, object]] = []
    arrays: dict[str, NDArray[Any]] = {}
    for n, trace in enumerate(traces.recordings):
        arrays[f"ratios_{n}"] = np.asarray(trace.ratios, dtype=np.float32)
        # Groups are read off a chart: half precision is finer than its pixels.
        arrays[f"groups_{n}"] = np.asarray(np.clip(trace.groups, 0.0, 6e4), dtype=np.float16)
        entries.append({
            "name": trace.name, "start": trace.start, "duration_s": trace.duration_s, "silent": list(trace.silent),
        })  # fmt: skip
    header = {
        "schema": SCHEMA,
        "block_s": traces.block_s,
        "detectors": list(traces.detectors),
        "groups": list(traces.groups),
        "recordings": entries,
    }
    write_stored(folder, TRACES, header, arrays)


def read_traces(folder: Path) -> RunTraces:
    """Read the traces of a run.

    Raises:
        StorageError: missing, damaged, changed or inconsistent.
    """
    header, arrays = read_stored(folder, TRACES, SCHEMA)
    where = f"'{folder / TRACES}.json'"
    block_s = _number(header.get("block_s"))
    if not 0.0 < block_s < 1e4:
        raise StorageError(f"{where}: block_s must be a number of seconds; run the monitor again")
    detectors, groups = (_names(header.get(key), f"{where}: {key}") for key in ("detectors", "groups"))
    entries = header.get("recordings")
    if not isinstance(entries, list) or len(entries) > MAX_RECORDINGS:
        raise StorageError(f"{where}: recordings must be a list of at most {MAX_RECORDINGS}; run the monitor again")
    recordings = []
    for n, entry in enumerate(entries):
        at = f"{where}, recording {n}"
        ratios = _rows(arrays.get(f"ratios_{n}"), len(detectors), at)
        levels = _rows(arrays.get(f"groups_{n}"), len(groups), at)
        duration_s = _number(entry.get("duration_s")) if isinstance(entry, dict) else math.nan
        if not isinstance(entry, dict) or len(levels) != len(ratios) or not duration_s >= 0.0:
            raise StorageError(f"{at}: its entry or arrays do not fit each other; run the monitor again")
        name, start = (_text(entry.get(key), at) for key in ("name", "start"))
        silent = _names(entry.get("silent"), at)
        recordings.append(RecordingTrace(name, start, duration_s, ratios, levels, silent))
    return RunTraces(block_s, detectors, groups, tuple(recordings))


def _rows(values: NDArray[Any] | None, columns: int, where: str) -> FloatArray:
    if values is None or values.ndim != 2 or values.shape[1] != columns or values.dtype.kind != "f":
        raise StorageError(f"{where}: an array is missing or has not {columns} columns; run the monitor again")
    return values.astype(np.float32)


def _names(value: Any, where: str) -> tuple[str, ...]:
    if not isinstance(value, list) or len(value) > MAX_COLUMNS:
        raise StorageError(f"{where}: a list of at most {MAX_COLUMNS} names must be there; run the monitor again")
    return tuple(_text(name, where) for name in value)


def _text(value: Any, where: str) -> str:
    if not isinstance(value, str) or len(value) > 4096:
        raise StorageError(f"{where}: a text of at most 4096 characters must be there; run the monitor again")
    return value


def _number(value: Any) -> float:
    """Return a number unchanged; NaN for anything else."""
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else math.nan


def pooled(values: FloatArray, most: int) -> tuple[FloatArray, int]:
    """Reduce rows to at most `most` by their largest value; return them and the number of rows per pooled row."""
    factor = max(1, -(-len(values) // most))
    if factor == 1:
        return values, 1
    padded = np.full((-(-len(values) // factor) * factor, *values.shape[1:]), np.nan, dtype=np.float32)
    padded[: len(values)] = values
    parts = padded.reshape(-1, factor, *values.shape[1:])
    # Not nanmax: a pool in which all is missing would warn.
    largest = np.where(np.isnan(parts), -np.inf, parts).max(axis=1)
    return np.where(np.isneginf(largest), np.nan, largest).astype(np.float32), factor
