"""Serialisation of unit results: plain values as JSON, arrays as safetensors, without pickle.

Frozen dataclasses are taken apart by field and built again from the classes that the reader names, so that bytes can
make nothing else.
"""

from __future__ import annotations

import enum
import functools
import json
import types
import typing
from collections.abc import Iterable, Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, TypeVar, cast

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load, save

from edp.errors import DataError

T = TypeVar("T")
_NESTED = (list, dict)
TREE, KIND, VALUE = "tree", "of", "is"
MAX_DEPTH = 40


def pack(value: Any) -> bytes:
    """Serialise a value: plain values, tuples, enums, numeric arrays, and frozen dataclasses.

    Raises:
        TypeError: anything else.
    """
    arrays: dict[str, NDArray[Any]] = {}
    tree = json.dumps(_apart(value, arrays), allow_nan=False, separators=(",", ":"))
    return bytes(save({**arrays, TREE: np.frombuffer(tree.encode(), dtype=np.uint8)}))


def _apart(value: Any, arrays: dict[str, NDArray[Any]]) -> Any:
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, enum.Enum):
        return {KIND: type(value).__name__, VALUE: value.value}
    if value is None or isinstance(value, bool | int | str):
        return str(value) if isinstance(value, str) else value
    if isinstance(value, float):
        return value if np.isfinite(value) else {KIND: "float", VALUE: str(value)}
    if isinstance(value, np.ndarray):
        # Sums over an array follow its order in memory, so that the order is a part of the value.
        is_fortran = value.flags.f_contiguous and not value.flags.c_contiguous
        arrays[str(len(arrays))] = np.array(value.T if is_fortran else value, order="C")
        return {KIND: "fortran array" if is_fortran else "array", VALUE: len(arrays) - 1}
    if isinstance(value, Path):
        return {KIND: "path", VALUE: str(value)}
    if isinstance(value, list):
        return [_apart(part, arrays) for part in value]
    if isinstance(value, tuple):
        return {KIND: "tuple", VALUE: [_apart(part, arrays) for part in value]}
    if isinstance(value, Mapping):
        return {KIND: "map", VALUE: [[_apart(k, arrays), _apart(v, arrays)] for k, v in value.items()]}
    if is_dataclass(value) and not isinstance(value, type):
        parts = {field.name: _apart(getattr(value, field.name), arrays) for field in fields(value)}
        return {KIND: type(value).__name__, VALUE: parts}
    raise TypeError(f"{type(value).__name__} cannot be packed")


def unpack(data: bytes, kind: type[T], also: Iterable[type] = ()) -> T:
    """Restore a value of a class from the bytes of `pack`.

    Args:
        data: the bytes.
        kind: class of the value; only it and the dataclasses that its fields name are built.
        also: further dataclasses that are built, such as those of a registry.

    Raises:
        DataError: damaged, or of another class.
    """
    try:
        tensors = load(data)
        tree = json.loads(tensors.pop(TREE).tobytes())
        classes = {**classes_in(cast(type, kind)), **{one.__name__: one for one in also}}
        value = _together(tree, tensors, classes, 0)
    except (SafetensorError, KeyError, ValueError, TypeError, AttributeError, IndexError, RecursionError) as error:
        raise DataError(f"the result of a unit of work is damaged: {error}; give the same command again") from error
    if not isinstance(value, kind):
        raise DataError(f"the result of a unit of work is no {kind.__name__}; do all nodes run the same EDP?")
    return value


def _together(tree: Any, tensors: dict[str, NDArray[Any]], classes: Mapping[str, type], depth: int) -> Any:
    if depth > MAX_DEPTH:
        raise ValueError(f"nested deeper than {MAX_DEPTH} levels")
    if not isinstance(tree, _NESTED):
        return tree
    if isinstance(tree, list):
        return [_together(part, tensors, classes, depth + 1) for part in tree]
    kind, value = tree[KIND], tree[VALUE]
    if kind == "float":
        return float(value)
    if kind == "path":
        return Path(value)
    if kind == "array":
        return tensors[str(value)]
    if kind == "fortran array":
        return tensors[str(value)].T
    if kind == "tuple":
        return tuple(
            _together(part, tensors, classes, depth + 1) if isinstance(part, _NESTED) else part for part in value
        )
    if kind == "map":
        # Two levels: a pair, and what is in it.
        pairs = [[_together(part, tensors, classes, depth + 2) for part in pair] for pair in value]
        return dict(pairs)
    if issubclass(classes[kind], enum.Enum):
        return classes[kind](value)
    # Plain values, most of all, are not handed down.
    return classes[kind](
        **{
            name: _together(part, tensors, classes, depth + 1) if isinstance(part, _NESTED) else part
            for name, part in value.items()
        }
    )


# Asked for with every unit of work, and the same in each.
@functools.cache
def classes_in(kind: type) -> Mapping[str, type]:
    """Return a dataclass and all classes in the types of its fields, by name."""
    classes: dict[str, type] = {}
    waiting: list[Any] = [kind]
    while waiting:
        one = waiting.pop()
        if isinstance(one, type) and issubclass(one, enum.Enum):
            classes[one.__name__] = one
        elif isinstance(one, type) and is_dataclass(one) and one.__name__ not in classes:
            classes[one.__name__] = one
            waiting += list(typing.get_type_hints(one).values())
        elif isinstance(one, types.UnionType) or typing.get_origin(one) is not None:
            waiting += list(typing.get_args(one))
    return types.MappingProxyType(classes)
