"""The machines of a store: which recordings are whose."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from edp.errors import ConfigError, DataError
from edp.logs.source import DataSource
from edp.logs.store import is_store, read_index, read_store
from edp.recording import MACHINE, Recording


@dataclass(frozen=True)
class MachineSource(DataSource):
    """The recordings of one machine in a store.

    Attributes:
        machine: its name.
    """

    machine: str = ""

    def read(self) -> list[Recording]:
        """Read the machine's recordings in the order of the store.

        Raises:
            DataError: the store has none of it.
        """
        recordings = [one for one in read_store(self.path) if machine_of(one.meta) == self.machine]
        if not recordings:
            raise DataError(f"the store '{self.path}' has no recording of machine '{self.machine}'")
        return recordings


@dataclass(frozen=True)
class StoredMachine:
    """A machine of a store.

    Attributes:
        name: name of the machine.
        digests: hashes of its recordings.
        minutes: total length of its recordings, min.
    """

    name: str
    digests: tuple[str, ...]
    minutes: float


def machine_of(meta: Mapping[str, object]) -> str:
    """Return the name of the recorded machine; empty if it is not stated."""
    return str(meta.get(MACHINE, "")).strip()


def machines_of(store: str | Path) -> list[StoredMachine]:
    """Return the machines of a store in order of first appearance.

    Raises:
        ConfigError: it is no store.
        DataError: recordings that do not say their machine.
    """
    if not is_store(Path(store)):
        raise ConfigError(
            f"'{store}' is no store; a fleet's logs are stored once, by `edp data store build LOGS --out "
            f"STORE`, where a "
            "data-set file can state the machine of each log"
        )
    machines: dict[str, StoredMachine] = {}
    for entry in read_index(store).recordings:
        name = machine_of(json.loads(entry.meta))
        if not name:
            raise DataError(
                f"recording '{entry.name}' of the store '{store}' does not say which machine it is of; state `machine` "
                "in a data-set file, and build the store from that"
            )
        before = machines.get(name, StoredMachine(name, (), 0.0))
        minutes = entry.samples / entry.rate_hz / 60.0
        machines[name] = replace(before, digests=(*before.digests, entry.digest), minutes=before.minutes + minutes)
    return list(machines.values())
