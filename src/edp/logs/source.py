"""Sources of recordings: a log, a folder of logs, or a data-set file; and maps of their columns."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from edp.errors import ConfigError, DataError
from edp.jobs import IN_PROCESS, Workers
from edp.jobs.packing import pack, unpack
from edp.jobs.workers import WorkUnit
from edp.logs.buckets import BucketReader, RemoteFile, bucket_address
from edp.logs.detect import list_suffixes
from edp.logs.drawn import check_hours, draw_recordings, findings_of_part
from edp.logs.quality.checks import Finding
from edp.logs.quality.cross_recording import DataQuality, compare
from edp.logs.quality.inspection import look_into, unreadable
from edp.logs.quality.quality import QualityReport, inspect
from edp.logs.quality.sketches import Sketch, Sketches, sketch
from edp.logs.read import find_recordings, read_data_set, read_recording, read_truth, unique_names
from edp.logs.repair import Repair
from edp.logs.store.building import StoredLog, build_store
from edp.logs.store.index import StoreIndex, is_store, read_index
from edp.logs.store.opening import read_store
from edp.logs.store.remote import is_remote_store, local_store
from edp.logs.units import add_kinds, drop_derived_kinds
from edp.progress import SILENT, Progress
from edp.recording import MACHINE, Recording
from edp.settings.provenance import DataOrigin
from edp.settings.tree import build, plain_tree, read_toml
from edp.signals import SignalMap
from edp.storage.ledger import TrainingIdentity, WithState
from edp.storage.paths import full_path, is_file_at, is_there, status_of
from edp.wording import setting_text, typed


@dataclass(frozen=True, kw_only=True)
class RecordingEntry:
    """One recording of a data-set file.

    Attributes:
        path: the log, relative to the data-set file; ``${NAME}`` is replaced by that environment variable.
        name: unique name; the file's stem by default.
        rows: ``[start, stop]`` to use a part of the log.
        map: signal map for this log: a table, or the path of a map file; the data set's map by default.
        machine: which machine was recorded, where parts are divided by machine.
        repair: what may be repaired of this log; what the data set allows by default.
    """

    path: str
    name: str | None = None
    rows: tuple[int, int] | None = None
    map: str | SignalMap | None = None
    machine: str = ""
    repair: Repair | None = None


@dataclass(frozen=True, kw_only=True)
class DataSetSettings:
    """Data-set file: its recordings, their common map, and allowed repairs."""

    recordings: tuple[RecordingEntry, ...] = ()
    map: str | SignalMap | None = None
    repair: Repair = field(default_factory=Repair)


STORED_UNITS = 64
"""Units that the recordings of a store are divided into, about: opening a store takes longer the more it holds."""
UNIT_BYTES = 4 * 2**20
"""Of the logs of a unit, about a second of work: a unit takes hundredths of one to hand out and to take back."""
_LONGEST_STEM = 120
"""Characters of a log's name in the name of a folder; file systems allow 255 bytes."""


@dataclass(frozen=True)
class DataSource:
    """Source of recordings.

    Attributes:
        path: a log, a folder of logs, a data-set file (``.toml``), or a store; ``s3://``, ``gs://`` or ``az://`` for a
            store in a bucket, and for logs to build one from.
        signal_map: columns to channels; None takes the vocabulary's names.
        repair: what may be repaired.
        at_most_h: of a store, evenly spread segments of at most so many hours, about, in place of all; None for all.
        more: further logs and folders of logs; a log that is named twice is read once.

    Raises:
        ConfigError: not a positive number of hours, or a data-set file, a store or an address next to other paths.
    """

    path: Path
    signal_map: SignalMap | None = None
    repair: Repair | None = None
    at_most_h: float | None = None
    more: tuple[Path, ...] = ()

    def __post_init__(self) -> None:
        for path in self.paths if self.more else ():
            if path.suffix == ".toml" or bucket_address(path) or is_store(path):
                raise ConfigError(
                    f"'{path}' came with {len(self.more)} other path(s), expected logs or folders of logs; give a "
                    "data-set file, a store or an address alone"
                )
        if self.at_most_h is not None:
            check_hours(self.at_most_h)

    @staticmethod
    def from_path(
        path: str | Path | Sequence[str | Path], map_file: str | Path | None = None, repair: Repair | None = None
    ) -> DataSource:
        """Return a source from one path or several.

        Raises:
            ConfigError: there is no path, or paths that cannot be read together.
        """
        paths = [Path(entry) for entry in ([path] if isinstance(path, str | Path) else path)]
        if not paths:
            raise ConfigError("logs: got an empty list of paths, expected at least one; give a log or a folder of logs")
        signal_map = None if map_file is None else load_signal_map(map_file)
        return DataSource(paths[0], signal_map, repair, more=tuple(paths[1:]))

    @property
    def paths(self) -> tuple[Path, ...]:
        """All paths that were given, in order."""
        return (self.path, *self.more)

    @property
    def label(self) -> str:
        """Description of the source for results and messages."""
        return str(self.path) if not self.more else f"{self.path} and {len(self.more)} more"

    @property
    def short_name(self) -> str:
        """Name for titles and folders: the stem of the path; for several paths with their count and a hash."""
        stem = self.path.stem if self.address else full_path(self.path).stem
        stem = stem[:_LONGEST_STEM]
        if not self.more:
            return stem
        # A set: the order of the paths names no other logs.
        every = "\0".join(sorted({str(full_path(path)) for path in self.paths}))
        digest = hashlib.blake2b(every.encode(errors="surrogateescape"), digest_size=4).hexdigest()
        return f"{stem}_and_{len(self.more)}_more_{digest}"

    @property
    def stored(self) -> bool:
        """Whether the source is a store, whose logs were mapped and repaired when it was built."""
        return is_remote_store(self.address) if self.address else is_store(self.path)

    @property
    def address(self) -> str:
        """Address in a bucket; empty on this machine."""
        return bucket_address(self.path)

    def store_folder(self) -> Path:
        """Return the folder of the store; for a store in a bucket, the folder of its copy."""
        return local_store(self.address) if self.address else self.path

    def to_dict(self) -> dict[str, object]:
        """Convert to a dictionary for provenance, with which the same data can be read again."""
        plain: dict[str, object] = {"path": self.address or str(full_path(self.path))}
        if self.signal_map is not None:
            # Kinds that units tell are written out: an entry without one was read by an earlier version.
            plain["map"] = plain_tree(add_kinds(self.signal_map))
        if self.repair is not None:
            plain["repair"] = plain_tree(self.repair)
        if self.at_most_h is not None:
            plain["at_most_h"] = self.at_most_h
        if self.more:
            plain["more"] = [str(full_path(path)) for path in self.more]
        return plain

    @staticmethod
    def from_dict(plain: Mapping[str, Any]) -> DataSource:
        """Create the source that `to_dict` described."""
        signal_map = drop_derived_kinds(build(SignalMap, plain["map"], "provenance map")) if "map" in plain else None
        repair = build(Repair, plain["repair"], "provenance repair") if "repair" in plain else None
        more = tuple(Path(path) for path in plain.get("more", ()))
        return DataSource(Path(plain["path"]), signal_map, repair, plain.get("at_most_h"), more)

    def origin(self, recordings: Sequence[Recording]) -> DataOrigin:
        """Return the origin of recordings that were read from this source, for the provenance of a result."""
        digests = "".join(recording.digest for recording in recordings)
        digest = hashlib.blake2b(digests.encode(), digest_size=16).hexdigest()
        return DataOrigin(source=self.label, reader=self.to_dict(), digest=digest)

    def logs(self) -> list[Log]:
        """Return the unread logs of the source, each with its map; empty for a store."""
        if self.stored:
            return []
        if self.path.suffix == ".toml":
            return _read_data_set(self.path, self.signal_map, self.repair)
        if self.address:
            return _list_bucket(self.address, self.signal_map, self.repair)
        files = dict.fromkeys(file for path in self.paths for file in find_recordings(path))
        return [Log(path, self.signal_map, self.repair) for path in files]

    def read(self) -> list[Recording]:
        """Return all recordings, at one rate.

        Raises:
            DataError: nothing to read, or a log that cannot be used as it is.
            ConfigError: a map or repairs for a store, whose logs were read with their own.
        """
        if self.stored:
            self.check_store_options()
            stored = read_store(self.store_folder())
            return stored if self.at_most_h is None else draw_recordings(stored, self.at_most_h)
        self._refuse_bucket_and_sample()
        if self.path.suffix != ".toml":
            return read_data_set(self.paths, self.signal_map, repair=self.repair)
        recordings = [log.read() for log in self.logs()]
        _check_listed(recordings, self.path)
        return recordings

    def inspect(self, progress: Progress = SILENT, workers: Workers = IN_PROCESS) -> DataQuality:
        """Report the content and the faults of each log and logs that repeat each other, without repairs.

        Args:
            progress: receiver of the progress; its units are logs, or recordings of a store.
            workers: who looks into the logs; nodes see logs or store under the same paths.

        Raises:
            DataError: none of the files can be read at all; where some can, each of the others has an error.
        """
        if self.stored:
            return self._inspect_store(progress, workers)
        self._refuse_bucket_and_sample()
        logs = self.logs()
        reports, sketches, sketched, broken = list[QualityReport](), Sketches(), list[int](), list[str]()
        looking = progress.stage("log", len(logs))
        looking.step(0)
        for result in workers.map_in_order(_units_of_logs(logs), looking):
            part = unpack(result.content or b"", LogInspections)
            broken += [why for why in part.broken if why]
            for report, one in zip(part.reports, part.sketches, strict=True):
                if one is not None:
                    sketches.add(one)
                    sketched.append(len(reports))
                reports.append(report)
        if broken and len(broken) == len(logs):
            raise DataError(broken[0])
        # Before they are compared: a finding on two recordings must tell which is which.
        names = unique_names([report.name for report in reports], [log.path for log in logs])
        sketches.all = [replace(one, name=names[i]) for one, i in zip(sketches.all, sketched, strict=True)]
        return compare([replace(report, name=name) for report, name in zip(reports, names)], sketches)

    def store(self, folder: str | Path, workers: Workers = IN_PROCESS, progress: Progress = SILENT) -> StoreIndex:
        """Read the logs into a store; see `edp.logs.store.build_store`."""
        if self.stored:
            raise ConfigError(f"'{self.path}' is a store already; give the logs that it is to be built from")
        if bucket_address(folder):
            raise ConfigError(
                f"--out {bucket_address(folder)}: a store is built on this machine; build it in a folder, then copy "
                "that with the tool of your service"
            )
        stored = [log.stored for log in self.logs()]
        if workers.cluster:
            self.check_local()
            # Nodes work in another folder than this command.
            stored = [replace(log, path=full_path(log.path)) for log in stored]
        return build_store(stored, folder, workers, progress)

    def check_local(self) -> None:
        """Refuse logs in a bucket, which the nodes of a cluster do not read.

        Raises:
            ConfigError: a log is not on this machine.
        """
        for log in self.logs():
            if log.remote is not None:
                raise ConfigError(f"'{log.path}' lies in a bucket, whose logs one computer reads; leave --cluster out")

    def visible_to(self, workers: Workers) -> DataSource:
        """Return the source for units of these workers: nodes of a cluster work in another folder than this command."""
        if not workers.cluster or self.address:
            return self
        return replace(self, path=full_path(self.path), more=tuple(map(full_path, self.more)))

    def content_key(self) -> str:
        """Return what identifies the data without reading them: hashes of a store, sizes and times of logs."""
        keys = [entry.digest for entry in read_index(self.store_folder()).recordings] if self.stored else []
        return " ".join([*keys, *(log.stored.key for log in self.logs())])

    def _inspect_store(self, progress: Progress, workers: Workers) -> DataQuality:
        recordings = self.read()
        reports, sketches = list[QualityReport](), Sketches()
        looking = progress.stage("recording", len(recordings))
        for result in workers.map_in_order(self._units_of_store(recordings, workers.are_alone), looking):
            part = unpack(result.content or b"", LogInspections)
            reports += part.reports
            for one in part.sketches:
                if one is not None:
                    sketches.add(one)
        return compare(reports, sketches, self._note_selection(recordings))

    def _units_of_store(self, recordings: Sequence[Recording], are_at_hand: bool) -> list[WorkUnit]:
        """Return the parts of the recordings of a store; recordings at hand are not read again."""
        folder = self.store_folder()
        # What decides all of them: a stretch is drawn by how many recordings there are, and how long.
        digests = "\n".join(entry.digest for entry in read_index(folder).recordings)
        digest = hashlib.blake2b(digests.encode(), digest_size=16).hexdigest()
        each = 1 if are_at_hand else max(1, -(-len(recordings) // STORED_UNITS))
        units = []
        for first in range(0, len(recordings), each):
            part = recordings[first : first + each]
            arguments = {"first": first, "count": len(part), "at_most_h": self.at_most_h}
            where = {"recordings": part} if are_at_hand else {"store": str(full_path(folder))}
            units.append(WorkUnit(f"{__name__}:inspect_stored", part[0].name, arguments, digest, where, len(part)))
        return units

    def _note_selection(self, recordings: Sequence[Recording]) -> tuple[Finding, ...]:
        """Return the note of an inspection if these recordings are only a part of the store."""
        whole = self.at_most_h is None
        return () if whole else findings_of_part(recordings, read_index(self.store_folder()).hours())

    def _refuse_bucket_and_sample(self) -> None:
        """Refuse `at_most` for logs in a bucket, since each command would download them again."""
        if self.address:
            raise ConfigError(
                f"'{self.address}' holds logs and no store; read them once with `edp data store build "
                f"{self.address} --out "
                "store`, and give this command the store"
            )
        if self.at_most_h is not None:
            raise ConfigError(
                f"--max-hours {setting_text(self.at_most_h)} came with '{self.path}', which is no store; read the logs "
                "once "
                "with `edp data store build LOGS --out STORE`, and give this command the store"
            )

    def check_store_options(self) -> None:
        """Refuse a map or repairs for a store, whose logs were read with their own.

        Raises:
            ConfigError: one came.
        """
        options = [name for name, value in (("--map", self.signal_map), ("--repair", self.repair)) if value is not None]
        if options:
            raise ConfigError(
                f"{' and '.join(options)} came with the store '{self.path}', whose logs were mapped and repaired when "
                "it was built; give them to `edp data store build`"
            )


@dataclass(frozen=True)
class Log:
    """One log of a source, with map and repairs; see `RecordingEntry`."""

    path: Path
    signal_map: SignalMap | None = None
    repair: Repair | None = None
    name: str | None = None
    rows: tuple[int, int] | None = None
    machine: str = ""
    remote: RemoteFile | None = None

    @property
    def stored(self) -> StoredLog:
        """The log as a store takes it."""
        signal_map, repair = self.signal_map or SignalMap(), self.repair or Repair()
        return StoredLog(self.path, signal_map, repair, self.name, self.rows, self.machine, self.remote)

    def read(self) -> Recording:
        """Read and return the recording."""
        if self.remote is not None:
            raise ConfigError(
                f"'{self.remote.address}' lies in a bucket; read the data set once with `edp data store build`, "
                f"and give "
                "the store"
            )
        recording = read_recording(self.path, self.signal_map, name=self.name, rows=self.rows, repair=self.repair)
        return replace(recording, meta={**recording.meta, MACHINE: self.machine}) if self.machine else recording


def _list_bucket(address: str, signal_map: SignalMap | None, repair: Repair | None) -> list[Log]:
    """Return the logs below an address of a bucket, or the log at it, selected by file ending."""
    objects = BucketReader(address).objects(address)
    suffixes = list_suffixes()
    chosen = [file for file in objects if Path(file.name).suffix.lower() in suffixes]
    if not chosen:
        raise DataError(f"'{address}' holds {len(objects):,} object(s), none with the ending of a log that EDP reads")
    # As in a folder: what only a simulation knows of the log beside it is no log.
    logs = [file for file in chosen if not Path(file.name).stem.endswith(".truth")]
    return [Log(Path(file.address), signal_map, repair, remote=file) for file in logs]


def load_signal_map(path: str | Path) -> SignalMap:
    """Load a signal map from a TOML file.

    Raises:
        ConfigError: unknown keys or wrong values, all at once.
    """
    return map_of_table(read_toml(path), f"'{path}'")


def map_of_table(table: Mapping[str, object], where: str) -> SignalMap:
    """Build a signal map from the content of a map file; `where` names it in messages.

    Raises:
        ConfigError: unknown keys or wrong values, all at once.
    """
    return build(SignalMap, _map_table(table), where)


def load_data_set(path: str | Path) -> DataSetSettings:
    """Load a data-set file; `map` entries that name files remain relative paths."""
    table = read_toml(path)
    listed = table.get("recordings", [])
    if not isinstance(listed, list):
        raise ConfigError(
            f"'{path}': recordings = {listed!r} is no list of [[recordings]]; a scenario file is simulated first, "
            "with `edp simulate FOLDER --scenario`, and then the folder is read"
        )
    for entry in [table, *listed]:
        if isinstance(entry, dict) and isinstance(entry.get("map"), dict):
            entry["map"] = _map_table(entry["map"])
    settings = build(DataSetSettings, table, f"'{path}'")
    if not settings.recordings:
        raise ConfigError(f"'{path}' lists no [[recordings]]; give at least one with its path")
    return settings


def _read_data_set(path: Path, signal_map: SignalMap | None, repair: Repair | None) -> list[Log]:
    """Return the logs of a data-set file with resolved paths; a map given here replaces the common map."""
    settings = load_data_set(path)

    def resolved(entry: str | SignalMap | None) -> SignalMap | None:
        return load_signal_map(path.parent / entry) if isinstance(entry, str) else entry

    shared = signal_map or resolved(settings.map)
    logs = []
    for entry in settings.recordings:
        expanded = _expand_variables(entry.path, path)
        address = bucket_address(expanded)
        remote = BucketReader(address).objects(address)[0] if address else None
        # An absolute path stands for itself, and so does an address.
        where = Path(address) if address else path.parent / expanded
        chosen, allowed = resolved(entry.map) or shared, repair or entry.repair or settings.repair
        logs.append(Log(where, chosen, allowed, entry.name, entry.rows, entry.machine, remote))
    return logs


def _check_listed(recordings: list[Recording], path: Path) -> None:
    names = [recording.name for recording in recordings]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise DataError(f"'{path}': recording name(s) {', '.join(twice)} occur twice; set name = \"...\" for each")
    rates = {round(recording.rate_hz, 6): recording.name for recording in recordings}
    # A thousandth, as `edp.logs.read.RATE_TOLERANCE`.
    if max(rates) > 1.001 * min(rates):
        shown = ", ".join(f"{name} {typed(rate)} Hz" for rate, name in rates.items())
        raise DataError(f"'{path}': mixed rates: {shown}; set rate_hz in the signal map")


def _expand_variables(entry: str, path: Path) -> str:
    """Return `entry` with environment variables put in, so that a data-set file can name logs on another disk."""
    full = os.path.expandvars(entry)
    if "$" in full:
        raise ConfigError(
            f"'{path}': path = '{entry}' names an environment variable that is not set; set it to the folder of the "
            "logs, or write the path out"
        )
    return full


def _map_table(table: Mapping[str, object]) -> Mapping[str, object]:
    """Convert the user's form ``[channels.NAME] column = ...`` to a list of entries."""
    channels = table.get("channels")
    if not isinstance(channels, dict):
        return table
    entries = [
        {"name": name, "column": name} | (dict(entry) if isinstance(entry, dict) else {"column": entry})
        for name, entry in channels.items()
    ]
    return {**table, "channels": entries}


def read_with_truth(source: DataSource) -> Recording:
    """Read the single recording of a source with its ground truth.

    Raises:
        DataError: more than one recording, or a log that cannot be used as it is.
    """
    recordings = source.read()
    if len(recordings) != 1:
        raise DataError(f"'{source.path}' holds {len(recordings)} recordings; give one log")
    recording, log = recordings[0], source.path
    truth = read_truth(log) if log.suffix.lower() in list_suffixes() and is_file_at(log) else None
    if truth is None:
        return recording
    new = [c for c in truth.channels if c.name not in recording.channel_names]
    # The truth may hold one sample more or less than the log.
    rows = min(recording.samples, truth.samples)
    values = np.concatenate((recording.values[:rows], truth.select([c.name for c in new])[:rows]), axis=1)
    return replace(recording, channels=(*recording.channels, *new), values=values)


@dataclass(frozen=True)
class LogInspections:
    """Result of the inspection of some logs or recordings: reports, sketches, and why a log cannot be read at all."""

    reports: tuple[QualityReport, ...]
    sketches: tuple[Sketch | None, ...]
    broken: tuple[str, ...] = ()


@dataclass(frozen=True)
class _LogPart:
    """Logs of a unit of work, with their full paths."""

    logs: tuple[Log, ...]
    paths: tuple[str, ...]


def _units_of_logs(logs: Sequence[Log]) -> list[WorkUnit]:
    """Divide logs into parts of similar size."""
    parts: list[list[Log]] = []
    room = 0
    for log in logs:
        if room <= 0:
            parts.append([])
            room = UNIT_BYTES
        parts[-1].append(log)
        room -= status_of(log.path).st_size if is_file_at(log.path) else 0
    units = []
    for part in parts:
        stored = [log.stored for log in part]
        arguments = {"logs": [log.key for log in stored], "unmapped": [log.signal_map is None for log in part]}
        where = {"part": _LogPart(tuple(part), tuple(str(full_path(log.path)) for log in part))}
        units.append(WorkUnit(f"{__name__}:inspect_logs", part[0].path.name, arguments, "", where, len(part)))
    return units


def inspect_logs(identity: TrainingIdentity, where: Mapping[str, _LogPart]) -> WithState:
    """Inspect the logs of a unit."""
    reports, sketches, broken = [], [], []
    for log, full in zip(where["part"].logs, where["part"].paths, strict=True):
        # The path as it was given stands in messages; where it leads nowhere on this node, the resolved one is read.
        path = log.path if is_there(log.path) else Path(full)
        try:
            report, one = look_into(path, log.signal_map, log.name, log.rows, log.repair)
            broken.append("")
        except DataError as error:
            report, one = unreadable(log.path, error), None
            broken.append(str(error))
        reports.append(report)
        sketches.append(one)
    return WithState({}, pack(LogInspections(tuple(reports), tuple(sketches), tuple(broken))))


def inspect_stored(identity: TrainingIdentity, where: Mapping[str, Any]) -> WithState:
    """Inspect the recordings of a unit, a part of a store."""
    config, part = identity.config, where.get("recordings")
    if part is None:
        opened = _open_store(where["store"], identity.data, config["at_most_h"])
        part = opened[config["first"] :][: config["count"]]
    return WithState({}, pack(LogInspections(tuple(map(inspect, part)), tuple(map(sketch, part)))))


@lru_cache(maxsize=1)
def _open_store(store: str, digest: str, at_most_h: float | None) -> list[Recording]:
    """Return the recordings of a store, opened once for all units of a process; `digest` identifies the content."""
    return DataSource(Path(store), at_most_h=at_most_h).read()
