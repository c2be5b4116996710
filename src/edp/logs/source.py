"""Sources of recordings: a log, a folder of logs, or a data-set file; and maps of their columns."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from edp.errors import ConfigError, DataError
from edp.logs.buckets import BucketReader, RemoteFile, bucket_address
from edp.logs.detect import known_suffixes
from edp.logs.drawn import checked_hours, drawn_recordings, findings_of_part
from edp.logs.quality.checks import Finding
from edp.logs.quality.cross_recording import DataQuality, compare
from edp.logs.quality.inspection import look_into, unreadable
from edp.logs.quality.quality import inspect
from edp.logs.quality.sketches import Sketches, sketch
from edp.logs.read import find_recordings, read_data_set, read_recording, read_truth, unique_names
from edp.logs.repair import Repair
from edp.logs.store.building import StoredLog, build_store
from edp.logs.store.index import StoreIndex, is_store, read_index
from edp.logs.store.opening import read_store
from edp.logs.store.remote import is_remote_store, local_store
from edp.logs.units import with_kinds, without_derived_kinds
from edp.progress import SILENT, Progress
from edp.recording import MACHINE, Recording
from edp.settings.provenance import DataOrigin
from edp.settings.tree import Table, build, plain_tree, read_toml
from edp.signals import SignalMap
from edp.storage.paths import full_path, is_file_at
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
        at_most_h: of a store, evenly spread stretches of at most so many hours, about, in place of all; None for all.
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
            checked_hours(self.at_most_h)

    @staticmethod
    def of(
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
        """Folder of the store; for a store in a bucket, the folder of its copy."""
        return local_store(self.address) if self.address else self.path

    def to_plain(self) -> Table:
        """Convert to a dictionary for provenance, with which the same data can be read again."""
        plain: Table = {"path": self.address or str(full_path(self.path))}
        if self.signal_map is not None:
            # Kinds that units tell are written out: an entry without one was read by an earlier version.
            plain["map"] = plain_tree(with_kinds(self.signal_map))
        if self.repair is not None:
            plain["repair"] = plain_tree(self.repair)
        if self.at_most_h is not None:
            plain["at_most_h"] = self.at_most_h
        if self.more:
            plain["more"] = [str(full_path(path)) for path in self.more]
        return plain

    @staticmethod
    def from_plain(plain: Table) -> DataSource:
        """Create the source that `to_plain` described."""
        signal_map = without_derived_kinds(build(SignalMap, plain["map"], "provenance map")) if "map" in plain else None
        repair = build(Repair, plain["repair"], "provenance repair") if "repair" in plain else None
        more = tuple(Path(path) for path in plain.get("more", ()))
        return DataSource(Path(plain["path"]), signal_map, repair, plain.get("at_most_h"), more)

    def origin(self, recordings: Sequence[Recording]) -> DataOrigin:
        """Return the origin of recordings that were read from this source, for the provenance of a result."""
        digests = "".join(recording.digest for recording in recordings)
        digest = hashlib.blake2b(digests.encode(), digest_size=16).hexdigest()
        return DataOrigin(source=self.label, reader=self.to_plain(), digest=digest)

    def logs(self) -> list[Log]:
        """Return the unread logs of the source, each with its map; empty for a store."""
        if self.stored:
            return []
        if self.path.suffix == ".toml":
            return _listed(self.path, self.signal_map, self.repair)
        if self.address:
            return _in_bucket(self.address, self.signal_map, self.repair)
        files = dict.fromkeys(file for path in self.paths for file in find_recordings(path))
        return [Log(path, self.signal_map, self.repair) for path in files]

    def read(self) -> list[Recording]:
        """All recordings, at one rate.

        Raises:
            DataError: nothing to read, or a log that cannot be used as it is.
            ConfigError: a map or repairs for a store, whose logs were read with their own.
        """
        if self.stored:
            self.check_store_options()
            stored = read_store(self.store_folder())
            return stored if self.at_most_h is None else drawn_recordings(stored, self.at_most_h)
        self._refuse_bucket_and_sample()
        if self.path.suffix != ".toml":
            return read_data_set(self.paths, self.signal_map, repair=self.repair)
        recordings = [log.read() for log in self.logs()]
        _check_listed(recordings, self.path)
        return recordings

    def inspect(self, progress: Progress = SILENT) -> DataQuality:
        """Inspect each log and find repeated sessions. Nothing is repaired or refused.

        Args:
            progress: receiver of the progress; its units are logs.

        Raises:
            DataError: none of the files can be read at all; where some can, each of the others has an error.
        """
        if self.stored:
            return self._inspect_store(progress)
        self._refuse_bucket_and_sample()
        logs = self.logs()
        reports, sketches, sketched = [], Sketches(), []
        broken: list[DataError] = []
        reading = progress.stage("log", len(logs))
        for i, log in enumerate(logs):
            reading.step(i)
            reading.note(log.path.name)
            try:
                report, one = look_into(log.path, log.signal_map, log.name, log.rows, log.repair)
            except DataError as error:
                broken.append(error)
                report, one = unreadable(log.path, error), None
            reports.append(report)
            if one is not None:
                sketches.add(one)
                sketched.append(i)
        if broken and len(broken) == len(logs):
            raise broken[0]
        # Before they are compared: a finding on two recordings must tell which is which.
        names = unique_names([report.name for report in reports], [log.path for log in logs])
        sketches.all = [replace(one, name=names[i]) for one, i in zip(sketches.all, sketched, strict=True)]
        return compare([replace(report, name=name) for report, name in zip(reports, names)], sketches)

    def store(self, folder: str | Path, workers: int = 1, progress: Progress = SILENT) -> StoreIndex:
        """Read the logs into a store; see `edp.logs.store.build_store`."""
        if self.stored:
            raise ConfigError(f"'{self.path}' is a store already; give the logs that it is to be built from")
        if bucket_address(folder):
            raise ConfigError(
                f"--out {bucket_address(folder)}: a store is built on this machine; build it in a folder, then copy "
                "that with the tool of your service"
            )
        stored = [
            StoredLog(
                log.path,
                log.signal_map or SignalMap(),
                log.repair or Repair(),
                log.name,
                log.rows,
                log.machine,
                log.remote,
            )
            for log in self.logs()
        ]
        return build_store(stored, folder, workers, progress)

    def _inspect_store(self, progress: Progress) -> DataQuality:
        recordings = self.read()
        reports, sketches = [], Sketches()
        reading = progress.stage("recording", len(recordings))
        for i, recording in enumerate(recordings):
            reading.step(i)
            reading.note(recording.name)
            reports.append(inspect(recording))
            sketches.add(sketch(recording))
        return compare(reports, sketches, self.drawn_findings(recordings))

    def drawn_findings(self, recordings: Sequence[Recording]) -> tuple[Finding, ...]:
        """Return the inspection finding that states which part of the store was used."""
        whole = self.at_most_h is None
        return () if whole else findings_of_part(recordings, read_index(self.store_folder()).hours())

    def _refuse_bucket_and_sample(self) -> None:
        """Each command would copy logs in buckets again, and how long logs are is known once they are read."""
        if self.address:
            raise ConfigError(
                f"'{self.address}' holds logs and no store; read them once with `edp store build {self.address} --out "
                "store`, and give this command the store"
            )
        if self.at_most_h is not None:
            raise ConfigError(
                f"--at-most {setting_text(self.at_most_h)} came with '{self.path}', which is no store; read the logs "
                "once "
                "with `edp store build LOGS --out STORE`, and give this command the store"
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
                "it was built; give them to `edp store build`"
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

    def read(self) -> Recording:
        """Read and return the recording."""
        if self.remote is not None:
            raise ConfigError(
                f"'{self.remote.address}' lies in a bucket; read the data set once with `edp store build`, and give "
                "the store"
            )
        recording = read_recording(self.path, self.signal_map, name=self.name, rows=self.rows, repair=self.repair)
        return replace(recording, meta={**recording.meta, MACHINE: self.machine}) if self.machine else recording


def _in_bucket(address: str, signal_map: SignalMap | None, repair: Repair | None) -> list[Log]:
    """Return the logs below an address of a bucket, or the log at it, selected by file ending."""
    objects = BucketReader(address).objects(address)
    suffixes = known_suffixes()
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


def map_of_table(table: Table, where: str) -> SignalMap:
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


def _listed(path: Path, signal_map: SignalMap | None, repair: Repair | None) -> list[Log]:
    """Return the logs of a data-set file with resolved paths; a map given here replaces the common map."""
    settings = load_data_set(path)

    def resolved(entry: str | SignalMap | None) -> SignalMap | None:
        return load_signal_map(path.parent / entry) if isinstance(entry, str) else entry

    shared = signal_map or resolved(settings.map)
    logs = []
    for entry in settings.recordings:
        expanded = _expanded(entry.path, path)
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


def _expanded(entry: str, path: Path) -> str:
    """`entry` with environment variables put in, so that a data-set file can name logs on another disk."""
    full = os.path.expandvars(entry)
    if "$" in full:
        raise ConfigError(
            f"'{path}': path = '{entry}' names an environment variable that is not set; set it to the folder of the "
            "logs, or write the path out"
        )
    return full


def _map_table(table: Table) -> Table:
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
    truth = read_truth(log) if log.suffix.lower() in known_suffixes() and is_file_at(log) else None
    if truth is None:
        return recording
    new = [c for c in truth.channels if c.name not in recording.channel_names]
    # The truth may hold one sample more or less than the log.
    rows = min(recording.samples, truth.samples)
    values = np.concatenate((recording.values[:rows], truth.select([c.name for c in new])[:rows]), axis=1)
    return replace(recording, channels=(*recording.channels, *new), values=values)
