"""States from which trainings continue: checksummed files next to their records, deleted when no longer needed."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from edp.errors import StorageError
from edp.storage.reading import read_bytes
from edp.storage.writing import write_bytes

SUFFIX = ".state"
START = b"edp state 1 "
STATE_BYTES = 4 * 2**30
"""Maximum size of a state file in bytes: weights and optimiser state of a network with 300 million parameters."""


@dataclass(frozen=True)
class WithState:
    """Result of a training function whose final state another training continues.

    Attributes:
        result: plain values, as of any training.
        state: state to continue from; not part of the record.
    """

    result: Mapping[str, Any]
    state: bytes


def leave_state(folder: str | Path, key: str, state: bytes) -> None:
    """Keep a state for the coordinator, which takes it over with the record of the training.

    Raises:
        StorageError: the disk is full or the folder cannot be written.
    """
    write_bytes(state_path(folder, key), _head(key, state) + state)


def state_path(folder: str | Path, key: str) -> Path:
    """Return the path of the file written by `leave_state`."""
    return Path(folder, "arrived", f"{key}{SUFFIX}")


def read_state(file: str | Path) -> bytes | None:
    """Return the state in a file; None if the file is missing or not a complete state of its training."""
    path = Path(file)
    try:
        data = read_bytes(path, STATE_BYTES)
    except StorageError:
        return None
    size = len(_head("0" * 32, b""))
    state = data[size:]
    # Name and checksum at once: a state of another training is as useless as a damaged one.
    return state if data[:size] == _head(path.stem, state) else None


def _head(key: str, state: bytes) -> bytes:
    return START + f"{key} {hashlib.blake2b(state, digest_size=16).hexdigest()}\n".encode()
