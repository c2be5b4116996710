"""Signals that Simulink logged into a MAT file while a model ran (``Dataset`` over ``MatFileDatasetStorage``).

Such a file (v7.3) has, beside its variables, a group ``#sigstream#`` with a record a signal: bytes of samples, one
after another. In the Dataset stands only which record holds the values (``DataR2``) and which the times (``TimeR2``),
or first time, step and number of samples (``CompressedTime``).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from edp.errors import DataError
from edp.logs.formats.matlab.library import MatlabOpaque

GROUP = "#sigstream#"
VALUES, TIMES, EVEN_TIMES = "DataR2", "TimeR2", "CompressedTime"
"""Fields of a signal in the Dataset."""
_TYPES = {
    name: f"<{letter}" for name, letter in {"double": "f8", "single": "f4", "logical": "u1", "boolean": "u1"}.items()
}
_TYPES |= {
    f"{sign}int{8 * size}": f"<{letter}{size}" for sign, letter in (("", "i"), ("u", "u")) for size in (1, 2, 4, 8)
}
_DEEPEST = 60
"""Maximum nesting depth of containers. A Dataset has about ten levels."""


def variable_names(path: Path) -> list[str] | None:
    """Return the variables of a file with streamed signals; None for any other file."""
    if not h5py.is_hdf5(path):
        return None
    with h5py.File(path, "r") as stored:
        return [name for name in stored if not name.startswith("#")] if GROUP in stored else None


def place_streams(path: Path, variables: dict[str, object]) -> None:
    """Put values ``(time, column)`` and times ``(time,)`` of streamed signals where the variables refer to them.

    Raises:
        DataError: a record is missing, or does not have the samples that its signal announces.
    """
    with h5py.File(path, "r") as stored:
        records = stored[GROUP]
        if not isinstance(records, h5py.Group):
            raise _damage_error(path, GROUP, "is no group")
        for signal in _signals(list(variables.values()), 0):
            values = _record(path, records, signal, VALUES)
            signal[VALUES] = values
            signal[EVEN_TIMES] = None if values is None else _times(path, records, signal, len(values))


def _times(path: Path, records: h5py.Group, signal: Any, samples: int) -> NDArray[np.float64]:
    """Return the sample times of a signal: its own record, or evenly spaced times."""
    stream = _record(path, records, signal, TIMES) if TIMES in signal.dtype.names else None
    facts = np.asarray(signal[EVEN_TIMES])
    even = facts.dtype.kind in "fiu" and facts.size == 3
    count = len(stream) if stream is not None else facts.ravel()[2] if even else 0
    # Before any array is made: a damaged file may announce more samples than memory holds.
    if count != samples:
        raise _damage_error(path, _name(signal), f"has {samples} samples and {count:.0f} times")
    if stream is not None:
        return np.asarray(stream.ravel(), dtype=np.float64)
    return np.asarray(facts.ravel()[0] + facts.ravel()[1] * np.arange(samples), dtype=np.float64)


def _signals(values: list[Any], depth: int) -> Iterator[Any]:
    """Return the structs that refer to records, within objects, cells and structs."""
    if depth > _DEEPEST:
        return
    for value in values:
        if isinstance(value, MatlabOpaque):
            inner = list(value.properties.values()) if isinstance(value.properties, dict) else []
            yield from _signals(inner, depth + 1)
        elif isinstance(value, np.ndarray) and value.dtype.names:
            for element in value.ravel():
                if {VALUES, EVEN_TIMES} <= set(value.dtype.names):
                    yield element
                else:
                    yield from _signals([element[name] for name in value.dtype.names], depth + 1)
        elif isinstance(value, np.ndarray) and value.dtype == object:
            yield from _signals(list(value.ravel()), depth + 1)


def _record(path: Path, records: h5py.Group, signal: Any, field: str) -> NDArray[Any] | None:
    """Return the samples of a record as ``(time, column)``; None without a record of real values."""
    reference = np.asarray(signal[field])
    if reference.dtype.kind not in "fiu" or reference.size != 1:
        return None
    record = records.get(str(int(reference.ravel()[0])))
    if not isinstance(record, h5py.Group) or not isinstance(record.get("#data#"), h5py.Dataset):
        raise _damage_error(path, _name(signal), f"refers to a record {int(reference.ravel()[0])}, which is not there")
    kind, width = ("<f8", 1) if field == TIMES else _sample(signal)
    if kind is None:
        return None
    count = int(np.asarray(record["#length#"]).ravel()[0]) if isinstance(record.get("#length#"), h5py.Dataset) else -1
    data = np.asarray(record["#data#"]).ravel()
    need = count * width * np.dtype(kind).itemsize
    if count < 0 or data.dtype != np.uint8 or need > data.size:
        raise _damage_error(path, _name(signal), f"announces {count} samples, its record has {data.size} bytes")
    return data[:need].view(kind).reshape(count, width)


def _sample(signal: Any) -> tuple[str | None, int]:
    """Return number type and count of the elements of one sample; the type is None unless they are real values."""
    names = signal.dtype.names
    facts = np.asarray(signal["SignalAttributes"]).ravel() if "SignalAttributes" in names else np.empty(0)
    if not facts.size or not facts.dtype.names:
        return "<f8", 1
    of_class = next((_text(facts[0][k]) for k in ("ResolvedClassName", "ClassName") if _text(facts[0][k])), "double")
    sizes = np.asarray(facts[0]["Dimension"]).ravel()
    is_complex = bool(np.any(np.asarray(facts[0]["Complexity"]))) if "Complexity" in facts.dtype.names else False
    width = math.prod(int(size) for size in sizes) if sizes.dtype.kind in "fiu" else 1
    return (None if is_complex or width < 1 else _TYPES.get(of_class)), width


def _text(value: Any) -> str:
    array = np.asarray(value) if value is not None else np.empty(0)
    return str(array.ravel()[0]) if array.size and array.dtype.kind in "UTO" else ""


def _name(signal: Any) -> str:
    return f"the signal {_text(signal['Name'])[:80]!r}" if "Name" in signal.dtype.names else "a signal"


def _damage_error(path: Path, what: str, how: str) -> DataError:
    return DataError(f"'{path}': {what} {how}; the recording was cut off or damaged: copy or export it again")
