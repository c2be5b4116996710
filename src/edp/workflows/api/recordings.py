"""Recordings as a user handles them: from files, arrays and frames, and back."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, overload

import numpy as np
from numpy.typing import NDArray

from edp.errors import DataError, closest
from edp.logs.arrays import recording_of_columns
from edp.logs.repair import Repair
from edp.logs.source import DataSource, load_signal_map, map_of_table
from edp.logs.store import is_store
from edp.recording import FloatArray, Recording
from edp.report.notebook import html_of, recordings_figure, text_of
from edp.settings.bounds import SEED, between, check_bounds
from edp.settings.tree import build
from edp.signals import SignalMap
from edp.table import Column, Table
from edp.wording import typed
from edp.workflows.api.arguments import check_together, check_width, matrix_of, names_of, units_of
from edp.workflows.api.frames import columns_of, frame_of

SHOWN_CHANNELS = 12
"""Channels that `Recordings.plot` draws where none are named."""
SHOWN_RECORDINGS = 20
"""Recordings that the table of a notebook lists."""


class Recordings(Sequence[Recording]):
    """Recordings of one set of channels at one rate, in SI units.

    Iterating and indexing give a `Recording` each (by number or by name), a slice gives `Recordings`.

    Args:
        recordings: at least one recording; equal channels, equal rates and unique names.
        source: source from which they can be read again, if there is one.

    Raises:
        DataError: there are no recordings, or they do not belong together.
    """

    def __init__(self, recordings: Sequence[Recording], source: DataSource | None = None) -> None:
        self._recordings, self._source = tuple(recordings), source
        check_together(self._recordings)

    @classmethod
    def from_arrays(
        cls,
        arrays: Sequence[NDArray[Any]] | NDArray[Any],
        *,
        rate_hz: float,
        names: Sequence[str] | None = None,
        units: Sequence[str | None] | Mapping[str, str] | None = None,
        recording_names: Sequence[str] | None = None,
        repair: Mapping[str, str] | None = None,
    ) -> Recordings:
        """Create recordings from arrays ``(time, channel)``, one array per recording. A single array is one recording.

        Args:
            arrays: numbers, each of shape ``(time, channel)``.
            rate_hz: samples per second.
            names: channel names; ``channel_0``, ``channel_1``, ... by default.
            units: channel units, in the order of the channels or by name. Values are converted to SI units; without a
                unit they are used unchanged.
            recording_names: names of the recordings; ``recording_0``, ... by default.
            repair: allowed repairs: ``{"nan": "hold"}`` repeats the last valid value, ``{"nan": "keep"}`` keeps NaN.

        Raises:
            DataError: shapes, names or units that do not fit, a rate that is not positive, or missing values.
        """
        if not isinstance(arrays, Sequence | np.ndarray) or isinstance(arrays, str):
            raise DataError(f"arrays is a {type(arrays).__name__}; give a list of arrays (time, channel)")
        matrices = [arrays] if isinstance(arrays, np.ndarray) and arrays.ndim == 2 else list(arrays)
        tables = [matrix_of(values, number) for number, values in enumerate(matrices)]
        if not tables:
            raise DataError("no arrays given; give one array (time, channel) for each recording")
        width = tables[0].shape[1]
        channel_names = names_of(names, [f"channel_{i}" for i in range(width)], "names", "channels")
        columns = [dict(zip(channel_names, values.T, strict=True)) for values in check_width(tables, channel_names)]
        return cls._from_columns(columns, rate_hz, units_of(units, channel_names), recording_names, repair)

    @classmethod
    def from_frames(
        cls,
        frames: Any,
        *,
        rate_hz: float | None = None,
        units: Mapping[str, str] | None = None,
        recording_names: Sequence[str] | None = None,
        repair: Mapping[str, str] | None = None,
    ) -> Recordings:
        """Create recordings from pandas or Polars data frames: one frame per recording, one column per channel.

        Args:
            frames: a frame, or a sequence of them.
            rate_hz: samples per second; every column is then a channel. Without it a column of time stamps (``time_s``,
                ``time``, ``timestamp`` or the like; numbers or dates) tells the rate, under the time rule of logs.
            units: unit of each column. Values are converted to SI units; without a unit they are used unchanged.
            recording_names: names of the recordings; ``recording_0``, ... by default.
            repair: allowed repairs, see `read`.

        Raises:
            DataError: no frame, no time stamps and no rate, text for numbers, or missing values.
        """
        listed = list(frames) if isinstance(frames, list | tuple) else [frames]
        if not listed:
            raise DataError("no frames given; give one DataFrame for each recording")
        columns = [columns_of(frame, f"frame {number}") for number, frame in enumerate(listed)]
        return cls._from_columns(columns, rate_hz, units_of(units, list(columns[0])), recording_names, repair)

    @classmethod
    def _from_columns(
        cls,
        tables: Sequence[Mapping[str, NDArray[Any]]],
        rate_hz: float | None,
        units: Mapping[str, str],
        recording_names: Sequence[str] | None,
        repair: Mapping[str, str] | None,
    ) -> Recordings:
        names = names_of(
            recording_names, [f"recording_{i}" for i in range(len(tables))], "recording_names", "recordings"
        )
        allowed = repair_of(repair)
        return cls(
            [
                recording_of_columns(name, columns, units, rate_hz, repair=allowed)
                for name, columns in zip(names, tables, strict=True)
            ]
        )

    @property
    def source(self) -> DataSource | None:
        """Data source from which the recordings can be read again; None for arrays, frames and slices."""
        return self._source

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the channels."""
        return self._recordings[0].channel_names

    @property
    def units(self) -> dict[str, str]:
        """SI unit of each channel, by name."""
        return {channel.name: channel.unit for channel in self._recordings[0].channels}

    @property
    def rate_hz(self) -> float:
        """Samples per second."""
        return self._recordings[0].rate_hz

    @property
    def recording_names(self) -> tuple[str, ...]:
        """Names of the recordings."""
        return tuple(recording.name for recording in self._recordings)

    def __len__(self) -> int:
        """Return the number of recordings."""
        return len(self._recordings)

    def __iter__(self) -> Iterator[Recording]:
        """Iterate over the recordings."""
        return iter(self._recordings)

    @overload
    def __getitem__(self, which: int | str) -> Recording: ...
    @overload
    def __getitem__(self, which: slice) -> Recordings: ...
    def __getitem__(self, which: int | str | slice) -> Recording | Recordings:
        """Return a recording by number or name, or several recordings by a slice.

        Raises:
            DataError: there is no recording of this name, or the slice is empty.
            IndexError: there is no recording of this number.
        """
        if isinstance(which, slice):
            return Recordings(self._recordings[which])
        if isinstance(which, str):
            if which not in self.recording_names:
                raise DataError(f"there is no recording '{which}'{closest(which, self.recording_names)}")
            return self._recordings[self.recording_names.index(which)]
        return self._recordings[which]

    def to_numpy(self) -> list[FloatArray]:
        """Return the values of each recording, float32 ``(time, channel)``, SI units."""
        return [recording.values for recording in self._recordings]

    def to_pandas(self) -> list[Any]:
        """Return one pandas data frame per recording: ``time_s`` and one column per channel, SI units.

        Raises:
            ConfigError: pandas is not installed.
        """
        return [frame_of("pandas", _columns(recording)) for recording in self._recordings]

    def to_polars(self) -> list[Any]:
        """Return one Polars data frame per recording: ``time_s`` and one column per channel, SI units.

        Raises:
            ConfigError: Polars is not installed.
        """
        return [frame_of("polars", _columns(recording)) for recording in self._recordings]

    def split(self, test: float = 0.2, seed: int = 0) -> tuple[Recordings, Recordings]:
        """Split into training and test data: whole recordings, chosen at random.

        One recording alone is cut in time: its end tests.

        Args:
            test: share that tests, above 0 and below 1; at least one recording is in each part.
            seed: random seed of the draw.

        Raises:
            ConfigError: a share or seed out of range.
        """
        check_bounds("split", SimpleNamespace(test=test, seed=seed), test=between(0.0, 1.0), seed=SEED)
        if len(self) == 1:
            (only,) = self._recordings
            # At least one row on each side, however small the share.
            cut = min(max(1, only.samples - round(test * only.samples)), only.samples - 1)
            return Recordings([only.rows(0, cut)]), Recordings([only.rows(cut, only.samples)])
        order = np.random.default_rng(seed).permutation(len(self))
        # At least one recording on each side: an empty part could neither be trained nor judged on.
        count = min(max(1, round(test * len(self))), len(self) - 1)
        # Order of the recordings is kept within each part, so that only membership is drawn.
        tests = set(order[:count].tolist())
        parts = [[r for i, r in enumerate(self._recordings) if (i in tests) == testing] for testing in (False, True)]
        return Recordings(parts[0]), Recordings(parts[1])

    def plot(self, recording: int | str = 0, channels: Sequence[str] = ()) -> Any:
        """Plot the channels of a recording over time, one row per channel (Plotly).

        Args:
            recording: number or name.
            channels: names; without any, the first twelve.

        Raises:
            DataError: there is no such recording or channel.
        """
        return recordings_figure(self[recording], list(channels) or self.names[:SHOWN_CHANNELS])

    def __repr__(self) -> str:
        """Return recordings and channels as text."""
        return "\n\n".join(text_of(table) for table in self._tables())

    def _repr_html_(self) -> str:
        """Return recordings and channels as HTML for a notebook."""
        return html_of(self._tables())

    def _tables(self) -> list[Table]:
        shown = self._recordings[:SHOWN_RECORDINGS]
        more = f", the first {len(shown)} of {len(self)}" if len(shown) < len(self) else ""
        rows = tuple((r.name, f"{r.samples:,}", f"{r.duration_s:,.1f}") for r in shown)
        columns = (Column("Recording"), Column("Samples"), Column("Duration", "s"))
        channels = tuple((c.name, str(c.kind), c.unit, c.description) for c in self._recordings[0].channels)
        return [
            Table(f"Recordings at {typed(self.rate_hz)} Hz{more}", columns, rows),
            Table("Channels", (Column("Channel"), Column("Kind"), Column("SI unit"), Column("Description")), channels),
        ]


def read(
    path: str | Path | Sequence[str | Path],
    map: str | Path | Mapping[str, object] | None = None,
    repair: Mapping[str, str] | None = None,
) -> Recordings:
    """Read recordings from logs and folders of logs, from a data-set file, or from a store.

    Args:
        path: source of the recordings (docs/howto/map_columns.md): one path, or a sequence of logs and folders.
        map: assignment of columns to channels: a map file, or its content as a mapping. Without a map each numeric
            column becomes a channel of the same name, whose kind follows from the vocabulary or the unit in the file.
        repair: allowed repairs, by default none: ``nan`` (``hold``, ``keep``), ``gaps`` (``hold``, ``cut``, ``keep``),
            ``duplicates`` (``last``), ``falling`` (``sort``, ``cut``).

    Raises:
        DataError: nothing to read, or a log that cannot be used as it is.
        ConfigError: a map or a repair that cannot be.
    """
    source = DataSource.from_path(path)
    if map is None:
        # The maps of a data-set file are in it, and those of a store were applied when it was built.
        signal_map = None if source.path.suffix == ".toml" or is_store(source.path) else SignalMap(others=True)
    elif isinstance(map, Mapping):
        signal_map = map_of_table(dict(map), "map")
    else:
        signal_map = load_signal_map(map)
    source = replace(source, signal_map=signal_map, repair=repair_of(repair))
    return Recordings(source.read(), source)


def to_recordings(data: Recordings | Recording | Sequence[Recording]) -> Recordings:
    """Convert user data to `Recordings`.

    Raises:
        DataError: it is something else.
    """
    if isinstance(data, Recordings):
        return data
    listed = [data] if isinstance(data, Recording) else data
    if not isinstance(listed, list | tuple) or not all(isinstance(entry, Recording) for entry in listed):
        raise DataError(
            f"the data is a {type(data).__name__}; give edp.Recordings (edp.read, edp.Recordings.from_arrays or "
            "edp.Recordings.from_frames)"
        )
    return Recordings(listed)


@dataclass(frozen=True)
class MemorySource(DataSource):
    """Recordings of this process, as a source; `path` is where they lie once they are written."""

    recordings: tuple[Recording, ...] = ()

    def read(self) -> list[Recording]:
        """Return the recordings."""
        return list(self.recordings)


def repair_of(table: Mapping[str, str] | None) -> Repair | None:
    """Build the repair settings from a mapping.

    Raises:
        ConfigError: an unknown repair or choice.
    """
    return None if table is None else build(Repair, dict(table), "repair")


def _columns(recording: Recording) -> dict[str, NDArray[Any]]:
    time_name = "time_s"
    if time_name in recording.channel_names:
        raise DataError(f"recording '{recording.name}' has a channel '{time_name}'; rename it to have frames")
    time_s = np.arange(recording.samples) / recording.rate_hz
    return {time_name: time_s, **dict(zip(recording.channel_names, recording.values.T, strict=True))}
