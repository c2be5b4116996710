"""The state of a simulation as plain data: what any of its objects holds, to a file without pickle and back, exact."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from edp.errors import StorageError
from edp.storage import replacing

SCHEMA = 2
_FACTS = "facts"


@dataclass(frozen=True, eq=False)
class Snapshot:
    """A simulation at one instant.

    Attributes:
        scenario: what is simulated, as plain data.
        samples: samples done so far.
        state: everything that changes, as JSON-able data; arrays are places in `arrays`.
        arrays: the arrays.
        log: what was logged so far, shape (samples, columns).
    """

    scenario: dict[str, Any]
    samples: int
    state: Any
    arrays: tuple[NDArray[Any], ...]
    log: tuple[NDArray[np.float64], ...]

    def save(self, path: str | Path) -> Path:
        """Write the snapshot as one ``.npz`` file: arrays, and the rest as JSON in it.

        Raises:
            StorageError: the disk is full or the folder read-only.
        """
        facts = {"schema": SCHEMA, "scenario": self.scenario, "samples": self.samples, "state": self.state}
        text = json.dumps(facts, allow_nan=False).encode()
        named: dict[str, Any] = {f"a{i}": array for i, array in enumerate(self.arrays)}
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
        try:
            with Path(path).open("rb") as stream, np.load(stream, allow_pickle=False) as stored:
                facts = json.loads(bytes(stored[_FACTS]))
                arrays = tuple(stored[f"a{i}"] for i in range(len(stored.files) - 2))
                log = stored["log"]
            if facts["schema"] != SCHEMA:
                raise StorageError(f"snapshot '{path}' has schema {facts['schema']}; this version reads {SCHEMA}")
            return Snapshot(
                facts["scenario"], int(facts["samples"]), facts["state"], arrays, (log,) if len(log) else ()
            )
        except (OSError, ValueError, KeyError, TypeError, BadZipFile) as error:
            raise StorageError(f"'{path}' is not a snapshot of a simulation, or is damaged: {error}") from error


def capture(value: Any, arrays: list[NDArray[Any]]) -> Any:
    """`value` as JSON-able data, its arrays copied into `arrays`; parts that never change become None."""
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
        return {"dict": [[str(key), capture(part, arrays)] for key, part in value.items()]}
    if not _changes(value):
        return None
    return {"object": {name: capture(part, arrays) for name, part in vars(value).items()}}


def _changes(value: Any) -> bool:
    """Whether an object can change: functions, types and frozen dataclasses without arrays cannot."""
    if callable(value) or isinstance(value, type) or not hasattr(value, "__dict__"):
        return False
    params = getattr(value, "__dataclass_params__", None)
    if params is not None and params.frozen:
        return any(isinstance(part, np.ndarray | np.random.Generator) for part in vars(value).values())
    return True


def restored(current: Any, plain: Any, arrays: tuple[NDArray[Any], ...]) -> Any:
    """What `capture` saw: objects, arrays and generators of `current` are set in place, the rest is made anew."""
    if plain is None:
        return current
    ((kind, held),) = plain.items()
    if kind == "value":
        return held
    if kind == "float":
        return float(held)
    if kind == "scalar":
        return arrays[held][()]
    if kind == "array":
        return _restored_array(current, arrays[held])
    if kind == "rng":
        current.bit_generator.state = held
        return current
    if kind in ("list", "tuple"):
        known = current if isinstance(current, list | tuple) and len(current) == len(held) else [None] * len(held)
        parts = [restored(old, part, arrays) for old, part in zip(known, held, strict=True)]
        return parts if kind == "list" else tuple(parts)
    if kind == "dict":
        return {key: restored(current.get(key), part, arrays) for key, part in held}
    for name, part in held.items():
        old = getattr(current, name)
        new = restored(old, part, arrays)
        if new is not old:
            setattr(current, name, new)
    return current


def _restored_array(current: Any, saved: NDArray[Any]) -> NDArray[Any]:
    # In place where it fits: other parts may hold the same array.
    if isinstance(current, np.ndarray) and current.shape == saved.shape and current.dtype == saved.dtype:
        current[...] = saved
        return current
    return saved.copy()
