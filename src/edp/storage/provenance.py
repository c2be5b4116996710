"""Provenance of a result: command, time, versions, machine and recordings."""

from __future__ import annotations

import platform
import sys
import time
from collections.abc import Mapping
from importlib import metadata
from pathlib import Path
from typing import Any

from edp import __version__
from edp.errors import StorageError
from edp.storage.paths import is_file_at
from edp.storage.reading import object_with, read_object
from edp.storage.runs import missing_text

PROVENANCE = "provenance.json"
RECORDED = ("torch", "numpy", "scipy", "numba", "scikit-learn", "safetensors")
"""Libraries whose versions can change a result."""


def environment(threads: int) -> dict[str, str]:
    """Return versions and machine properties that can change a result, as flat strings."""
    facts = {"python": platform.python_version(), "machine": platform.machine(), "system": platform.system()}
    for name in RECORDED:
        try:
            facts[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            # Also a fact: without a library another way may be taken.
            facts[name] = "absent"
    # The number of threads changes the order of sums, and so their last bits.
    return facts | {"threads": str(threads)}


def new_provenance(data: Mapping[str, Any] | None = None, threads: int = 1) -> dict[str, Any]:
    """Return the provenance of a result that this process makes: command, time, versions, machine, data.

    Args:
        data: where its recordings come from, with ``source``, ``reader`` and ``digest``; None without recordings.
        threads: with which it was computed.
    """
    facts: dict[str, Any] = {
        "edp_version": __version__,
        "created": time.strftime("%Y-%m-%dT%H:%M:%S%z"),
        "command": command_line(),
        "environment": environment(threads),
    }
    return facts if data is None else facts | {"data": dict(data)}


def read_provenance(folder: str | Path) -> dict[str, Any]:
    """Read the provenance of a run, required by commands on a trained run.

    Raises:
        StorageError: not a run folder, or its provenance is damaged.
    """
    file = Path(folder) / PROVENANCE
    if not is_file_at(file):
        raise StorageError(missing_text(folder, "network", "a run folder", PROVENANCE))
    provenance = read_object(file, ("data", "seconds"))
    data = object_with(provenance["data"], ("source", "reader", "digest"), f"'{file}', data,")
    reader = object_with(data["reader"], ("path",), f"'{file}', data.reader,")
    texts = {"data.reader.path": reader["path"], "data.digest": data["digest"], "data.source": data["source"]}
    wrong = [name for name, value in texts.items() if not isinstance(value, str)]
    wrong += [] if isinstance(provenance["seconds"], int | float) else ["seconds"]
    if wrong:
        raise StorageError(f"'{file}' is damaged: {', '.join(wrong)} is of another kind; restore it or train again")
    return provenance


def recording_names(provenance: Mapping[str, Any], *parts: str) -> set[str]:
    """Return the names of the recordings of some parts (``train``, ``validation``, ``test``); empty if unknown."""
    data = provenance.get("data")
    data = data if isinstance(data, Mapping) else {}
    names: set[str] = set()
    for part in parts:
        entry = data.get(part)
        stated = entry.get("names", ()) if isinstance(entry, Mapping) else ()
        # Twins of earlier versions state the names in a table of their own.
        names.update(stated or data.get("names", {}).get(part, ()))
    return names


def command_line() -> str:
    """Return the command line of this process as a user would type it."""
    return " ".join([Path(sys.argv[0]).name, *sys.argv[1:]])
