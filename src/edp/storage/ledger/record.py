"""Records of trainings, addressed by the content of what decides their result."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from enum import StrEnum
from functools import cache, cached_property
from pathlib import Path
from typing import Any

from edp import __version__
from edp.errors import ConfigError, NotFiniteError, StorageError
from edp.storage.reading import object_with, parse_json

SCHEMA = 1
UNREAD = ("cli", "data/screening", "front", "report", "stats", "testing", "workflows")
"""Folders whose code does not affect the result of a training."""
READ = (
    "stats/metrics.py",
    "workflows/compression",
    "workflows/search/jobs.py",
    "workflows/search/smaller.py",
    "workflows/search/trainings.py",
)
"""Exceptions within `UNREAD`: code for scores and for the trainings of a search, which does affect results."""


class TrainingStatus(StrEnum):
    """Outcome of a training."""

    DONE = "done"
    FAILED = "failed"
    """Status of a training that raised an error. A repetition would raise the same error."""
    DIVERGED = "diverged"
    """Status of a training with a non-finite loss or score. Comparisons count it as the worst result."""
    OOM = "oom"
    TIMEOUT = "timeout"
    LOST = "lost"
    """Status of a training whose process was killed repeatedly. The quality of the training is unknown."""


FINAL = frozenset(TrainingStatus) - {TrainingStatus.LOST}
"""Statuses of trainings that are never repeated. A lost training is repeated when the search is started again."""


def canonical(value: Any) -> str:
    """Return one text for one value: JSON with sorted keys, in which 1, 1.0, true and "1" differ.

    Raises:
        NotFiniteError: a number is NaN or infinite, which equals nothing, not even itself.
        ConfigError: a value or key that JSON would change, such as an array, a set or a number as a key.
    """
    _check_plain(value, "")
    return json.dumps(value, sort_keys=True, allow_nan=False, separators=(",", ":"))


def _check_plain(value: Any, where: str) -> None:
    if isinstance(value, float):
        if not math.isfinite(value):
            # NaN equals nothing, so that no training with it could be found again.
            raise NotFiniteError(f"'{where or 'value'}' is {value}; give a finite number, or none")
    elif isinstance(value, Mapping):
        for name, part in value.items():
            if not isinstance(name, str):
                raise ConfigError(f"'{where or 'value'}' has the key {name!r}; keys must be text")
            _check_plain(part, f"{where}.{name}" if where else name)
    elif isinstance(value, list | tuple):
        for number, part in enumerate(value):
            _check_plain(part, f"{where}[{number}]")
    elif value is not None and not isinstance(value, str | int):
        kind = type(value).__name__
        raise ConfigError(f"'{where or 'value'}' is of type {kind}; give text, numbers, true or false, lists or tables")


def digest_of(value: Any) -> str:
    """Return the blake2b of the canonical text."""
    return hashlib.blake2b(canonical(value).encode(), digest_size=16).hexdigest()


@cache
def code_version(whole: bool = False) -> str:
    """Return the version of the package and blake2b of its source and tables, without what decides no result.

    Args:
        whole: whether to include all of the source: a unit of work may call any part.
    """
    state = hashlib.blake2b(digest_size=16)
    root = Path(__file__).parents[2]
    for file in sorted([*root.rglob("*.py"), *root.rglob("*.toml")]):
        relative_path = file.relative_to(root).as_posix()
        if whole or not _below(relative_path, UNREAD) or _below(relative_path, READ):
            # Zero bytes between name and content: a line moved from file to file changes the hash.
            state.update(f"{relative_path}\0".encode() + file.read_bytes() + b"\0")
    return f"{__version__}+{state.hexdigest()}"


def _below(path: str, folders: tuple[str, ...]) -> bool:
    """Return whether a path is in `folders` or inside a folder of it."""
    return any(path == folder or path.startswith(f"{folder}/") for folder in folders)


@dataclass(frozen=True)
class TrainingIdentity:
    """Everything that determines the result of a training.

    Attributes:
        job: the function that trains, as ``package.module:name``.
        config: settings of network, task and training.
        split: recordings for training, validation and scores.
        seed: seed of all random values.
        epochs: number of epochs; a rung of a race is a separate training.
        code: see `code_version`.
        data: hash of the recordings.
        environment: versions, machine and threads (`edp.storage.runs.environment`).
    """

    job: str
    config: Mapping[str, Any]
    split: Mapping[str, Any]
    seed: int
    epochs: int
    code: str
    data: str
    environment: Mapping[str, str]

    @cached_property
    def key(self) -> str:
        """Content address.

        Raises:
            NotFiniteError: a NaN or infinite setting.
            ConfigError: a setting that is no plain value.
        """
        return digest_of(asdict(self))

    def to_json(self) -> dict[str, Any]:
        """Return the plain values."""
        return asdict(self)


@dataclass(frozen=True)
class Record:
    """Record of one training.

    Attributes:
        identity: settings that determined the result.
        status: final status.
        result: plain values with finite numbers, where it is done.
        message: error message, otherwise empty.
        measured: quantities that differ between repetitions: seconds, memory, worker, attempts.
    """

    identity: TrainingIdentity
    status: TrainingStatus
    result: Mapping[str, Any] | None = None
    message: str = ""
    measured: Mapping[str, Any] = field(default_factory=dict)

    @property
    def key(self) -> str:
        """Key of the identity."""
        return self.identity.key

    def reported(self) -> list[Any]:
        """Return the reproducible part of the record, equal to the bit for equal trainings."""
        return [self.key, str(self.status), self.result, self.message]

    def to_bytes(self) -> bytes:
        """Return one line of JSON: a checksum and the record in canonical form."""
        body = canonical({"schema": SCHEMA, "key": self.key} | asdict(self))
        return f'{{"checksum":"{_checksum(body.encode())}","record":{body}}}\n'.encode()

    @staticmethod
    def from_bytes(data: bytes) -> Record:
        """Parse a record.

        Raises:
            ValueError: cut off or changed.
            StorageError: written by a later version, or nothing that any version writes.
        """
        plain = object_with(parse_json(body_of(data).decode(), "a record"), ("schema",), "a record")
        if plain["schema"] != SCHEMA:
            raise StorageError(f"a record of schema {plain['schema']} was written by a later version of EDP; update it")
        object_with(plain, PARTS, "a record")
        parts = [one.name for one in fields(TrainingIdentity)]
        identity_parts = object_with(plain["identity"], parts, "a record's identity")
        measured = object_with(plain["measured"], (), "a record's measured part")
        if not isinstance(plain["key"], str) or not isinstance(plain["message"], str):
            raise StorageError("a record is damaged: its key or message is no text")
        if not isinstance(plain["result"], dict | None):
            raise StorageError("a record is damaged: its result is no table")
        identity = TrainingIdentity(**{name: identity_parts[name] for name in parts})
        identity.__dict__["key"] = plain["key"]  # the checksum covers it, so it is not hashed again
        return Record(identity, TrainingStatus(plain["status"]), plain["result"], plain["message"], measured)


def body_of(data: bytes) -> bytes:
    """Return the canonical text of a record after a check of its checksum, without the slower parsing.

    Raises:
        ValueError: cut off or changed.
    """
    if data[HEAD - len(BEFORE) : HEAD] != BEFORE or data[-2:] != b"}\n":
        raise ValueError("it is cut off or is no record")
    body = data[HEAD:-2]
    if data[len(START) : len(START) + 32] != _checksum(body).encode():
        raise ValueError("its checksum does not fit")
    return body


PARTS = ("schema", "key", "identity", "status", "result", "message", "measured")
"""Keys of a record in its JSON file."""
RECORD_BYTES = 16 * 2**20
"""Maximum size of a record file in bytes. A typical result has some hundred numbers."""
START, BEFORE = b'{"checksum":"', b'","record":'
HEAD = len(START) + 32 + len(BEFORE)


def _checksum(body: bytes) -> str:
    return hashlib.blake2b(body, digest_size=16).hexdigest()
