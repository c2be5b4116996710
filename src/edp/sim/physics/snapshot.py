"""Snapshots of a simulation: exact storage of its state in a file without pickle."""

from __future__ import annotations

import io
import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edp.errors import DataError, StorageError
from edp.storage import object_with, parse_json, read_bytes, replacing
from edp.storage.archives import ArchiveLimits, ZipReader
from edp.storage.reading import Table

SCHEMA = 4
MOST_BYTES = 1 << 30
"""Maximum size of a snapshot file, bytes: the log of several days of simulation."""
_FACTS = "facts"
_LIMITS = ArchiveLimits(MOST_BYTES, MOST_BYTES, 100_000)


@dataclass(frozen=True, eq=False)
class Snapshot:
    """A simulation at one instant.

    Attributes:
        scenario: simulated scenario, as a dictionary of JSON types.
        samples: samples done so far.
        state: everything that changes, as JSON-able data; arrays are places in `arrays`.
        arrays: the arrays.
        log: logged samples, shape (samples, columns).
    """

    scenario: Table
    samples: int
    state: Any
    arrays: tuple[NDArray[Any], ...]
    log: tuple[NDArray[np.float64], ...]

    def save(self, path: str | Path) -> Path:
        """Write the snapshot as one ``.npz`` file: arrays and embedded JSON.

        Raises:
            StorageError: the disk is full or the folder read-only.
        """
        facts = {"schema": SCHEMA, "scenario": self.scenario, "samples": self.samples, "state": self.state}
        # JSON has no NaN; `capture` writes numbers that are not finite as text.
        text = json.dumps(facts, allow_nan=False).encode()
        named: Table = {f"a{i}": array for i, array in enumerate(self.arrays)}
        named[_FACTS] = np.frombuffer(text, np.uint8)
        named["log"] = np.concatenate(self.log) if self.log else np.zeros((0, 0))
        with replacing(path) as temporary, temporary.open("wb") as stream:
            np.savez(stream, **named)
        return Path(path)

    @staticmethod
    def load(path: str | Path) -> Snapshot:
        """Read a snapshot back.

        Raises:
            StorageError: the file is missing, damaged, or of another schema.
        """
        where = f"snapshot '{path}'"
        try:
            content = read_bytes(path, MOST_BYTES, where)
            with ZipReader(content, where, _LIMITS, "save the simulation again") as archive:
                # Nothing packed, so that no small file unpacks to a large one.
                if any(entry.size != entry.packed or entry.method for entry in archive.entries.values()):
                    raise StorageError(
                        f"{where} holds packed arrays, which EDP never writes; save the simulation again"
                    )
                stored = {name.removesuffix(".npy"): _array(archive, name) for name in archive.entries}
            facts = object_with(
                parse_json(stored[_FACTS].tobytes().decode(), where), ("schema", "scenario", "samples", "state"), where
            )
            if facts["schema"] != SCHEMA:
                raise StorageError(f"{where} has schema {facts['schema']}; this version reads {SCHEMA}")
            # All members but facts and log.
            arrays, log = tuple(stored[f"a{i}"] for i in range(len(stored) - 2)), stored["log"]
            return Snapshot(
                facts["scenario"], int(facts["samples"]), facts["state"], arrays, (log,) if len(log) else ()
            )
        except (ValueError, KeyError, TypeError, OverflowError, DataError) as error:
            raise StorageError(f"'{path}' is not a snapshot of a simulation, or is damaged: {error}") from error


def _array(archive: ZipReader, name: str) -> NDArray[Any]:
    """Return one array; its header must announce the bytes that are there, before NumPy takes memory for it."""
    data = io.BytesIO(archive.read(name))
    version = np.lib.format.read_magic(data)
    read_header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, dtype = read_header(data)
    left = len(data.getvalue()) - data.tell()
    # Arrays of objects would have to be unpickled, which runs what the file says.
    if dtype.hasobject or math.prod(shape) * dtype.itemsize != left:
        raise ValueError(f"array '{name}' announces {shape} of {dtype} and holds {left} bytes")
    data.seek(0)
    array: NDArray[Any] = np.lib.format.read_array(data, allow_pickle=False)
    return array


def capture(value: Any, arrays: list[NDArray[Any]]) -> Any:
    """Return `value` as JSON-able data, its arrays copied into `arrays`; parts that never change become None."""
    # Before np.generic: these are JSON as they are.
    if value is None or isinstance(value, bool | int | str):
        return {"value": value}
    if isinstance(value, float):
        return {"value": float(value)} if math.isfinite(value) else {"float": repr(float(value))}
    if isinstance(value, np.ndarray | np.generic):
        arrays.append(np.array(value))
        return {"array": len(arrays) - 1} if isinstance(value, np.ndarray) else {"scalar": len(arrays) - 1}
    if isinstance(value, np.random.Generator):
        return {"rng": value.bit_generator.state}
    if isinstance(value, list | tuple):
        return {type(value).__name__: [capture(part, arrays) for part in value]}
    if isinstance(value, dict):
        # A list of pairs keeps the order, which a reader of JSON need not.
        return {"dict": [[str(key), capture(part, arrays)] for key, part in value.items()]}
    if not _changes(value):
        return None
    return {"object": {name: capture(part, arrays) for name, part in vars(value).items()}}


def _changes(value: Any) -> bool:
    """Return whether an object can change: functions, types and frozen dataclasses without arrays cannot."""
    if callable(value) or isinstance(value, type) or not hasattr(value, "__dict__"):
        return False
    params = getattr(value, "__dataclass_params__", None)
    if params is not None and params.frozen:
        return any(isinstance(part, np.ndarray | np.random.Generator) for part in vars(value).values())
    return True


def restored(current: Any, plain: Any, arrays: tuple[NDArray[Any], ...]) -> Any:
    """Restore the result of `capture`: set arrays and generators of `current` in place, create other objects."""
    if plain is None:
        return current
    ((kind, content),) = plain.items()
    if kind == "value":
        return content
    if kind == "float":
        return float(content)
    if kind == "scalar":
        return arrays[content][()]
    if kind == "array":
        return _restore_array(current, arrays[content])
    if kind == "rng":
        current.bit_generator.state = content
        return current
    if kind in ("list", "tuple"):
        templates = (
            current if isinstance(current, list | tuple) and len(current) == len(content) else [None] * len(content)
        )
        parts = [restored(old, part, arrays) for old, part in zip(templates, content, strict=True)]
        return parts if kind == "list" else tuple(parts)
    if kind == "dict":
        return {key: restored(current.get(key), part, arrays) for key, part in content}
    for name, part in content.items():
        old = getattr(current, name)
        new = restored(old, part, arrays)
        # Frozen objects cannot be assigned, and values restored in place need no assignment.
        if new is not old:
            setattr(current, name, new)
    return current


def _restore_array(current: Any, saved: NDArray[Any]) -> NDArray[Any]:
    # Restore in place if the shape fits, because other objects may refer to the same array.
    if isinstance(current, np.ndarray) and current.shape == saved.shape and current.dtype == saved.dtype:
        current[...] = saved
        return current
    return saved.copy()
