"""Raw content of a log file before conversion of units and time, and the registry of file formats."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from edp.errors import DataError, closest
from edp.recording import Recording
from edp.registry import Registry
from edp.signals import TABLE_A1, TIME_UNITS, VOCABULARY, Kind, SignalMap

Column = NDArray[np.float64]

PIECE_ROWS = 1 << 16
"""Number of rows that a table reads at a time, which bounds the memory for a log of any length."""


class ColumnTable(Protocol):
    """Columns of one file with common rows, which are read together in one pass."""

    def pieces(self, names: Sequence[str], start: int, stop: int) -> Iterator[list[NDArray[Any]]]:
        """Yield the rows ``start <= row < stop`` of the named columns in order, in chunks of rows.

        Yields:
            one array of numbers a name, all of the same length, shape ``(rows of the segment,)``.

        Raises:
            DataError: a column is damaged or holds text.
        """


def load_column(table: ColumnTable, name: str, samples: int) -> Column:
    """Return one whole column of a table, shape ``(samples,)``."""
    parts = [columns[0] for columns in table.pieces([name], 0, samples)]
    return np.concatenate(parts).astype(np.float64, copy=False) if parts else np.empty(0)


TORN_LINE = "torn_line"
"""Metadata key of a text file: number of its incomplete last line, which is omitted."""
EXPERIMENTS = "experiments"
"""Metadata key of a MAT file that was read completely: names of parallel experiments in one variable."""
NAMES_AGAIN = "names_again_line"
"""Metadata key of a text file: number of the first line that repeats the column names. All such lines are omitted."""
BEHIND_TABLE = "behind_table_line"
"""Metadata key of a text file: number of the first line after the table. The lines from there on are omitted."""


@dataclass(frozen=True, eq=False)
class RawSignal:
    """One column as the file has it.

    Attributes:
        name: the file's own name.
        load: returns the values, float64, shape ``(time,)``; called when needed so that columns pass one by one.
        samples: number of values.
        time: its time stamps in seconds, shape ``(time,)``, or what reads them; columns of one table share the same.
        unit: the unit the file gives, None when it says nothing.
        kind: the kind the file gives (only files that EDP wrote do).
        description: the file's description.
        table: the table that it is a column of, where several columns are best read together.
        key: its name in the table.
    """

    name: str
    load: Callable[[], Column]
    samples: int
    time: Column | Callable[[], Column] | None = None
    unit: str | None = None
    kind: Kind | None = None
    description: str = ""
    table: ColumnTable | None = None
    key: str = ""

    @property
    def values(self) -> Column:
        """Read and return the values; they are not cached."""
        return self.load()

    @property
    def time_s(self) -> Column | None:
        """The time stamps in seconds, shape ``(time,)``; columns of one table give the same array."""
        return self.time() if callable(self.time) else self.time


@dataclass(frozen=True)
class RawLog:
    """All columns of one file.

    Attributes:
        path: the file.
        signals: columns by the file's names, in the file's order.
        scalars: single numbers of a MAT file (gains and the like); used only where a map names them.
        rate_hz: the rate the file itself states; its rows are then uniform.
        name: the recording's name as the file states it.
        source: origin of the recording as stated in the file.
        meta: data the file carries.
        aliases: further names of columns, each with its name in `signals` (the whole path of a signal).
        repeated: names that several columns have, with the names in `signals` that tell them apart.
        digest: hash of the values that EDP wrote (`Recording.digest`), if the file states it.
    """

    path: Path
    signals: Mapping[str, RawSignal]
    scalars: Mapping[str, float] = field(default_factory=dict)
    rate_hz: float | None = None
    name: str | None = None
    source: str = ""
    meta: Mapping[str, object] = field(default_factory=dict)
    aliases: Mapping[str, str] = field(default_factory=dict)
    repeated: Mapping[str, Sequence[str]] = field(default_factory=dict)
    digest: str | None = None

    def __post_init__(self) -> None:
        check_names(self.path, self.signals)

    def __contains__(self, name: str) -> bool:
        """Return whether the file has a column of this name or alias."""
        return name in self.signals or name in self.aliases

    def signal(self, name: str) -> RawSignal:
        """Return the column with the given name.

        Raises:
            DataError: no such column, or several; the names to choose from are offered.
        """
        name = self.aliases.get(name, name)
        if name in self.signals:
            return self.signals[name]
        if name in self.repeated:
            raise DataError(
                f"'{self.path}' has {len(self.repeated[name])} columns named '{name}': "
                f"{self._list_signals(name)}; name the wanted one in the signal map"
            )
        raise DataError(
            f"'{self.path}' has no column '{name}'{closest(name, [*self.signals, *self.scalars])}; "
            "name an existing column in the signal map"
        )

    def _list_signals(self, name: str) -> str:
        same_named = [self.signals[full] for full in self.repeated[name]]
        return ", ".join(signal.name + (f" [{signal.unit}]" if signal.unit else "") for signal in same_named[:8])


LONGEST_NAME = 256
"""Maximum number of characters of a column name. A full path of a Simulink signal has some hundred."""
MAX_COLUMNS = 65_536
"""Maximum number of columns of a log. A large Simulink model logs some thousand."""


def check_names(path: Path, names: Iterable[str]) -> None:
    """Refuse names that pictures, tables and generated programs cannot carry.

    Raises:
        DataError: a name that is too long or holds control characters, or more columns than a log has.
    """
    count = 0
    for name in names:
        count += 1
        if len(name) > LONGEST_NAME:
            raise DataError(
                f"'{path}': column {name[:40]!r}... has a name of {len(name)} characters, at most {LONGEST_NAME} are "
                "read; rename it"
            )
        if not name.isprintable() and any(ord(letter) < 32 or 127 <= ord(letter) < 160 for letter in name):
            raise DataError(f"'{path}': the name of column {name[:80]!r} holds control characters; rename it")
    if count > MAX_COLUMNS:
        raise DataError(f"'{path}' has {count} columns, at most {MAX_COLUMNS} are read; split it")


TRUTH_PLACES = ("with", "apart", "without")
TRUTH = "truth"
"""Variable name in a MAT file, and middle part of a file name, for noise-free values."""


@dataclass(frozen=True)
class WriteOptions:
    """Write options: layout of a MAT file, and handling of ground truth (vocabulary beyond Table A.1).

    Attributes:
        mat_layout: a name in `edp.logs.formats.mat_layouts.LAYOUTS`; other formats have one layout.
        mat_version: ``v5`` or ``v7.3``.
        truth: ``with`` the other channels; ``apart``, in a variable ``truth`` of the MAT file or a file
            ``NAME.truth.SUFFIX`` beside the log; or ``without`` it.

    Raises:
        DataError: no such way to keep the truth.
    """

    mat_layout: str = "struct"
    mat_version: str = "v5"
    truth: str = "with"

    def __post_init__(self) -> None:
        if self.truth not in TRUTH_PLACES:
            raise DataError(f"truth = '{self.truth}' cannot be written{closest(self.truth, TRUTH_PLACES)}")


def is_truth(name: str) -> bool:
    """Return whether a channel is known to simulations only: in the vocabulary, but not in Table A.1."""
    return name in VOCABULARY and name not in TABLE_A1


def parted(recording: Recording) -> tuple[Recording | None, Recording | None]:
    """Split a recording into measured channels and ground truth; None for a part without channels."""
    of_truth = [is_truth(name) for name in recording.channel_names]

    def part(truth_part: bool) -> Recording | None:
        places = [i for i, is_truth_channel in enumerate(of_truth) if is_truth_channel == truth_part]
        channels = tuple(recording.channels[i] for i in places)
        return replace(recording, channels=channels, values=recording.values[:, places]) if places else None

    return part(False), part(True)


class LogFormat(Protocol):
    """One file format; instances are entered in `FORMATS`.

    A format may also have `parts`, whether one file can hold truth apart (`holds_truth_apart`), and `libraries`, names
    of modules that reading imports, which the sandbox then imports once instead of once a log.
    """

    name: str
    suffixes: tuple[str, ...]
    content: str

    def claims(self, head: bytes) -> bool:
        """Return whether a file that begins with `head` (up to 4 KiB) holds this format."""

    def read(self, path: Path, signal_map: SignalMap) -> RawLog:
        """Read a file; raises `DataError` if it cannot be read."""

    def write(self, recording: Recording, path: Path, options: WriteOptions) -> None:
        """Write a recording to `path`, which need not carry the format's suffix."""


FORMATS: Registry[LogFormat] = Registry("file format")


def holds_truth_apart(log_format: LogFormat) -> bool:
    """Return whether one file of a format can hold the truth apart from what sensors show."""
    return bool(getattr(log_format, "parts", False))


_TIME_NAMES = (
    "time_s",
    "time",
    "timestamp",
    "timestamps",
    "tout",
    "time_ms",
    "time_us",
    "time_ns",
    "date/time",
    "__time",
)
_TIME_UNIT_NAMES = {"sec": "s", "seconds": "s", "milliseconds": "ms", "microseconds": "us", "nanoseconds": "ns"}


def find_time(names: Sequence[str], signal_map: SignalMap, path: Path) -> str | None:
    """Return the name of the time column; None if rows are uniform by the map or no name looks like time.

    Raises:
        DataError: the map names a time column that the file lacks.
    """
    if signal_map.sample_time_s is not None:
        return None
    if signal_map.time is not None:
        if signal_map.time not in names:
            raise DataError(
                f"'{path}' has no time column '{signal_map.time}'{closest(signal_map.time, names)}; "
                "set 'time' in the signal map (--map) to an existing column, or set 'sample_time_s'"
            )
        return signal_map.time
    for time_name in _TIME_NAMES:
        for name in names:
            if name.lower() == time_name:
                return name
    # Last, as the weakest hint, and in lower case only: T may be a temperature.
    return "t" if "t" in names else None


def time_factor(name: str, unit: str | None, signal_map: SignalMap) -> float:
    """Return seconds per unit of the time column: the map's unit, else the header's, else the name's ending, else s."""
    stated = _TIME_UNIT_NAMES.get(unit or "", unit or "")
    ending = name.lower().rpartition("_")[2]
    # s is the map's default, so it may not have been stated: the unit in the file then decides.
    if signal_map.time_unit != "s":
        return TIME_UNITS[signal_map.time_unit]
    if stated in TIME_UNITS:
        return TIME_UNITS[stated]
    return TIME_UNITS.get(ending, 1.0)
