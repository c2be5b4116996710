"""Arrays of files: their declaration, the one reader that checks them, and values in JSON files."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edp.errors import StorageError
from edp.wording import typed

Arrays = Mapping[str, NDArray[Any]]
POSITIVE = np.nextafter(0.0, 1.0)
"""Smallest positive float, used as the minimum of arrays whose values must be above 0."""


@dataclass(frozen=True)
class ArrayRule:
    """Declaration of an array in a file.

    Attributes:
        shape: size of each dimension: a number, or the name of a dimension, which has one size in the whole file.
        dtype: type for the caller; the file may hold another precision of its kind, unless `is_exact`.
        low: lowest value.
        high: highest value; or the name of a dimension, of which the values are indices.
        is_exact: whether the file must hold `dtype` itself.
        is_finite: whether all values are finite; otherwise their range is not checked.
    """

    shape: tuple[int | str, ...]
    dtype: Any = np.float64
    low: float = -math.inf
    high: float | str = math.inf
    is_exact: bool = False
    is_finite: bool = True

    def fault_of(self, values: NDArray[Any], sizes: dict[str, int]) -> str:
        """Return the first fault of an array as text, empty without a fault; add new dimensions to `sizes`."""
        pairs = zip(self.shape, values.shape, strict=False)
        shape = tuple(one if isinstance(one, int) else sizes.setdefault(one, size) for one, size in pairs)
        is_type = values.dtype == self.dtype if self.is_exact else values.dtype.kind == np.dtype(self.dtype).kind
        if not is_type or values.ndim != len(self.shape) or values.shape != shape:
            return _kind(values)
        high = sizes[self.high] - 1 if isinstance(self.high, str) else self.high
        good = np.isfinite(values) & (values >= self.low) & (values <= high)
        if good.all() or not self.is_finite:
            return ""
        index = tuple(np.argwhere(~good)[0].tolist())
        return f"{values[index]} at {index}"

    def expected(self, sizes: Mapping[str, int]) -> str:
        """Return the expected dimensions and type as text."""
        parts = (f"{one} = {sizes[one]}" if isinstance(one, str) and one in sizes else str(one) for one in self.shape)
        words = [f"{np.dtype(self.dtype)} of shape ({', '.join(parts)})"] + ["finite"] * self.is_finite
        if self.low > -math.inf:
            words.append("above 0" if self.low == POSITIVE else f"at least {typed(self.low)}")
        if self.high != math.inf:
            words.append(f"below {self.high}" if isinstance(self.high, str) else f"at most {typed(self.high)}")
        return ", ".join(words)


def checked_arrays(
    arrays: Arrays, rules: Mapping[str, ArrayRule], where: str, sizes: Mapping[str, int] | None = None
) -> dict[str, NDArray[Any]]:
    """Return the arrays of a file in the types of their rules.

    Args:
        arrays: arrays as read.
        rules: declaration of each array; a dimension gets its size from the first array that has it.
        where: owner of the arrays, for the message.
        sizes: sizes of dimensions that other parts of the file state.

    Raises:
        ValueError: an array is missing or not declared, or has another type, shape or range.
    """
    dimensions, checked = dict(sizes or {}), {}
    if additional := sorted({*arrays} - {*rules}):
        name = additional[0]
        raise ValueError(f"{where}: array '{name[:80]}': got {_kind(arrays[name])}, expected no array of this name")
    for name, rule in rules.items():
        fault = rule.fault_of(arrays[name], dimensions) if name in arrays else "no array"
        if fault:
            raise ValueError(f"{where}: array '{name[:80]}': got {fault}, expected {rule.expected(dimensions)}")
        checked[name] = arrays[name].astype(rule.dtype, copy=False)
    return checked


def _kind(values: NDArray[Any]) -> str:
    return f"{values.dtype} of shape {values.shape}"


def arrays_under(arrays: Arrays, prefix: str) -> dict[str, NDArray[Any]]:
    """Return the arrays whose names start with a prefix, by names without the prefix."""
    return {name.removeprefix(prefix): values for name, values in arrays.items() if name.startswith(prefix)}


def numbers_in(value: Any, where: str, shape: tuple[int, ...] | None = None) -> NDArray[np.float64]:
    """Convert nested lists of a JSON file to a numeric array.

    Args:
        value: the lists, or one number.
        where: file and key, for the message.
        shape: expected shape; None accepts any.

    Raises:
        StorageError: an entry is not a finite number, lists have unequal lengths, or the shape is another one.
    """
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        array = np.array(np.nan)
    if isinstance(value, str) or not np.isfinite(array).all():
        raise StorageError(f"{where} is damaged: got something other than finite numbers; restore it or write it again")
    if shape is not None and array.shape != shape:
        raise StorageError(
            f"{where} is damaged: got shape {array.shape}, expected {shape}; restore it or write it again"
        )
    return array
