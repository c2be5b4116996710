"""Provenance of a result: command, time, versions, machine and recordings."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Self

from edp import __version__
from edp.errors import StorageError
from edp.settings.results import plain_fields, read_part
from edp.storage import read_object
from edp.storage.paths import is_file_at
from edp.storage.provenance import PROVENANCE, command_line, environment
from edp.storage.runs import missing_text

WHAT, ADVICE = "provenance", "restore it or train again"


@dataclass(frozen=True, kw_only=True)
class DataPart:
    """Training, validation or test part of the data."""

    recordings: int = 0
    hours: float = 0.0
    names: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class DataOrigin:
    """Origin of recordings.

    Attributes:
        source: description of the source.
        reader: how to read them again, see `edp.logs.source.DataSource.to_dict`.
        rate_hz: samples per second.
        train, validation, test: parts; None if unknown.
        digest: content address of all recordings.
        frozen: names by digest of recordings that no later training may see.
        names: recordings by part, in files of earlier versions.
    """

    source: str | None = None
    reader: Mapping[str, object] = field(default_factory=dict)
    rate_hz: float | None = None
    train: DataPart | None = None
    validation: DataPart | None = None
    test: DataPart | None = None
    digest: str | None = None
    frozen: Mapping[str, str] = field(default_factory=dict)
    names: Mapping[str, tuple[str, ...]] = field(default_factory=dict)

    def part(self, name: str) -> DataPart | None:
        """Return ``train``, ``validation`` or ``test``."""
        part: DataPart | None = getattr(self, name)
        return part


@dataclass(frozen=True, kw_only=True)
class Provenance:
    """Provenance of a result.

    Attributes:
        edp_version: version of EDP.
        created: time, ISO 8601.
        command: command that produced the result.
        environment: versions and machine, see `edp.storage.provenance.environment`.
        data: recordings; None without recordings.
        seed: seed of random numbers.
        seconds: computing time.
        more: entries of single commands by name, such as ``strategy`` of a fine-tuning.
    """

    edp_version: str | None = None
    created: str | None = None
    command: str | None = None
    environment: Mapping[str, str] = field(default_factory=dict)
    data: DataOrigin | None = None
    seed: int | None = None
    seconds: float | None = None
    more: Mapping[str, Any] = field(default_factory=dict)

    @classmethod
    def from_table(cls, table: Mapping[str, object], where: str) -> Self:
        """Build a provenance from the content of a file, which messages call `where`.

        Raises:
            StorageError: a value has another form.
        """
        names = {entry.name for entry in fields(cls)} - {"more"}
        more = {key: value for key, value in table.items() if key not in names}
        stated = {key: value for key, value in table.items() if key in names}
        return replace(read_part(cls, stated, where, WHAT, ADVICE), more=more)

    @classmethod
    def read(cls, folder: str | Path) -> Self:
        """Read the provenance of a run.

        Raises:
            StorageError: the file cannot be read, or a value has another form.
        """
        file = Path(folder) / PROVENANCE
        return cls.from_table(read_object(file), f"'{file}'")

    def to_table(self) -> dict[str, object]:
        """Return the content of the file."""
        return {**plain_fields(replace(self, more={})), **self.more}

    def add_entries(self, **entries: Any) -> Self:
        """Return the provenance with additional entries of a command."""
        return replace(self, more={**self.more, **entries})

    @property
    def origin(self) -> DataOrigin:
        """Origin of the recordings; empty for a result without recordings."""
        return self.data or DataOrigin()

    def recording_names(self, *parts: str) -> set[str]:
        """Return the names of the recordings of some parts (``train``, ``validation``, ``test``); empty if unknown."""
        names: set[str] = set()
        for name in parts:
            part = self.origin.part(name)
            names.update((part.names if part else ()) or self.origin.names.get(name, ()))
        return names


def new_provenance(data: DataOrigin | None = None, threads: int = 1) -> Provenance:
    """Return the provenance of a result that this process makes.

    Args:
        data: origin of its recordings; None without recordings.
        threads: number of threads that computed the result.
    """
    created = time.strftime("%Y-%m-%dT%H:%M:%S%z")
    return Provenance(
        edp_version=__version__, created=created, command=command_line(), environment=environment(threads), data=data
    )


def read_provenance(folder: str | Path) -> Provenance:
    """Read the provenance of a run, required by commands on a trained run.

    Raises:
        StorageError: not a run folder, or its provenance is damaged.
    """
    file = Path(folder) / PROVENANCE
    if not is_file_at(file):
        raise StorageError(missing_text(folder, "network", "a run folder", PROVENANCE))
    provenance = Provenance.read(folder)
    origin = provenance.origin
    stated = {
        "data.source": origin.source,
        "data.reader.path": origin.reader.get("path"),
        "data.digest": origin.digest,
        "seconds": provenance.seconds,
    }
    missing = [name for name, value in stated.items() if value is None]
    if missing or not isinstance(origin.reader["path"], str):
        raise StorageError(f"'{file}' is damaged: it lacks {', '.join(missing) or 'data.reader.path'}; {ADVICE}")
    return provenance
