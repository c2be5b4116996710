"""From raw values of an MDF 4 channel to physical ones: all conversions, so that the library never applies any.

The library hands formulas to an engine that runs code; here they go through `edp.logs.formats.mdf_formula`. Texts that
a conversion states for numbers (value to text, range to text, bit fields) leave the number as it is, as in the
library's ``ignore_value2text_conversions``; a conversion that stands in such a table's place of a text is applied.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from edp.errors import DataError
from edp.logs.formats.mdf_formula import Formula, FormulaError

_NONE, _LINEAR, _RATIONAL, _FORMULA, _INTERPOLATED, _NEAREST, _RANGES, _VALUE_TEXTS, _RANGE_TEXTS = range(9)
_TEXTS_ONLY = (9, 10, 11)
"""Conversion types that do not change numbers: text to value, text to text, bit field."""
DEEPEST = 4
"""Maximum nesting depth of conversions. ASAM's examples have one level."""
_SHOWN = 80


def refuse_engines(library: Any) -> None:
    """Make the places at which the library would run a formula refuse; a second line behind never asking for it."""
    from asammdf.blocks import v2_v3_blocks, v4_blocks

    for module in (v2_v3_blocks, v4_blocks):
        for name in ("evaluate", "lambdify"):
            if not hasattr(module, name):
                raise DataError(
                    f"asammdf {library.__version__} has no '{name}' where EDP switches its formula engine off; install "
                    "the version that constraints.txt names"
                )
            setattr(module, name, _refuse)


def _refuse(*_: Any, **__: Any) -> Any:
    raise DataError("a formula of the file would have been run by the library; report this as a fault of EDP")


class Conversion:
    """One channel's conversion.

    Args:
        block: the library's block (its numbers and texts only are used), or None for values as they are.
        where: file and channel for messages.

    Raises:
        DataError: tables within tables, deeper than `DEEPEST`.
    """

    def __init__(self, block: Any, where: str, depth: int = 0) -> None:
        self.block = block
        self.where = where
        self.kind = _NONE if block is None else int(block.conversion_type)
        self.inner: list[Conversion | None] = []
        self.default: Conversion | None = None
        if depth > DEEPEST:
            raise DataError(f"{where}: its conversion holds tables nested more than {DEEPEST} deep; export it again")
        if self.kind in (_VALUE_TEXTS, _RANGE_TEXTS):
            blocks = block.referenced_blocks
            count = int(block.links_nr) - 5 if self.kind == _VALUE_TEXTS else int(block.val_param_nr) // 2
            self.inner = [self._read_nested(blocks.get(f"text_{i}"), depth) for i in range(count)]
            self.default = self._read_nested(blocks.get("default_addr"), depth)

    def _read_nested(self, block: Any, depth: int) -> Conversion | None:
        return None if block is None or isinstance(block, bytes) else Conversion(block, self.where, depth + 1)

    def __call__(self, raw: NDArray[Any]) -> NDArray[Any]:
        """Return the physical values, shape ``(rows,)``.

        Raises:
            DataError: a formula that is not of the grammar, or a table that does not fit itself.
        """
        if self.kind == _NONE or self.kind in _TEXTS_ONLY or not len(raw):
            return raw
        if raw.dtype.kind not in "fiub" or raw.ndim != 1:
            return raw
        if self.kind == _FORMULA:
            return self._formula()(raw)
        if self.kind in (_VALUE_TEXTS, _RANGE_TEXTS):
            return self._from_texts(raw)
        if self.kind > _RANGE_TEXTS:
            raise DataError(f"{self.where}: a conversion of the unknown type {self.kind}; export it again")
        with np.errstate(all="ignore"):
            return _NUMERIC[self.kind](self.block, raw)

    def _formula(self) -> Formula:
        try:
            return Formula.parse(self.block.formula)
        except FormulaError as error:
            shown = ascii(self.block.formula[:_SHOWN] + ("..." if len(self.block.formula) > _SHOWN else ""))
            raise DataError(
                f"{self.where}: its conversion formula {shown} cannot be read: {error}. Leave the channel out of the "
                "signal map, or save it with its conversion applied"
            ) from error

    def _from_texts(self, raw: NDArray[Any]) -> NDArray[Any]:
        """Return each entry's rows are converted together, so that the time is the rows', not entries times rows."""
        if self.default is None and not any(self.inner):
            return raw
        entry = self._entries(raw)
        # Rows of one entry beside each other: each conversion is called once.
        order = np.argsort(entry, kind="stable")
        sorted_entry = entry[order]
        starts = np.flatnonzero(np.r_[True, sorted_entry[1:] != sorted_entry[:-1]])
        out = raw.astype(np.float64)
        for first, stop in zip(starts, np.r_[starts[1:], len(order)]):
            entry_index = int(sorted_entry[first])
            conversion = self.default if entry_index < 0 else self.inner[entry_index]
            if conversion is not None:
                out[order[first:stop]] = conversion(raw[order[first:stop]])
        return out

    def _entries(self, raw: NDArray[Any]) -> NDArray[np.intp]:
        """Return the table index of each value, -1 for the default."""
        count = len(self.inner)
        if self.kind == _RANGE_TEXTS:
            lower, upper = (np.array([self.block[f"{end}_{i}"] for i in range(count)]) for end in _ENDS)
            return _find_ranges(lower, upper, raw)
        keys = np.array([self.block[f"val_{i}"] for i in range(count)])
        return _find_ranges(keys, keys, raw, closed=True)


_ENDS = ("lower", "upper")


def _find_ranges(
    lower: NDArray[np.float64], upper: NDArray[np.float64], raw: NDArray[Any], closed: bool | None = None
) -> NDArray[np.intp]:
    """Return the index of the range that contains each value, -1 if missing.

    ASAM: the upper end belongs to a range (`closed`) of integers, not to one of floats.
    """
    if not len(lower):
        return np.full(len(raw), -1, dtype=np.intp)
    closed = raw.dtype.kind in "uib" if closed is None else closed
    x = raw.astype(np.float64)
    # A file need not list its ranges in order.
    order = np.argsort(lower, kind="stable")
    range_index = order[np.maximum(np.searchsorted(lower[order], x, side="right") - 1, 0)]
    inside = (x >= lower[range_index]) & ((x <= upper[range_index]) if closed else (x < upper[range_index]))
    return np.where(inside, range_index, -1)


def _linear(block: Any, raw: NDArray[Any]) -> NDArray[Any]:
    # Nothing to convert: integers keep their type.
    if (block.a, block.b) == (1, 0):
        return raw
    values = raw * block.a
    result: NDArray[Any] = values + block.b if block.b else values
    return result


def _rational(block: Any, raw: NDArray[Any]) -> NDArray[Any]:
    x = raw.astype(np.float64)
    # Horner's form of ASAM's (P1 x^2 + P2 x + P3) / (P4 x^2 + P5 x + P6).
    top = (block.P1 * x + block.P2) * x + block.P3
    return np.asarray(top / ((block.P4 * x + block.P5) * x + block.P6))


def _pairs(block: Any) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    count = int(block.val_param_nr) // 2
    raw = np.array([block[f"raw_{i}"] for i in range(count)])
    physical = np.array([block[f"phys_{i}"] for i in range(count)])
    if not count:
        raise DataError("a conversion table without entries")
    return raw, physical


def _interpolate(block: Any, raw: NDArray[Any]) -> NDArray[Any]:
    result: NDArray[Any] = np.interp(raw, *_pairs(block))
    return result


def _nearest(block: Any, raw: NDArray[Any]) -> NDArray[Any]:
    """Return the entry nearest to the value; the lower one at half distance."""
    keys, physical = _pairs(block)
    x = raw.astype(np.float64)
    above = np.minimum(np.searchsorted(keys, x), len(keys) - 1)
    below = np.maximum(above - 1, 0)
    lower = np.abs(x - keys[above]) >= np.abs(x - keys[below])
    return np.asarray(np.where(lower, physical[below], physical[above]))


def _ranges(block: Any, raw: NDArray[Any]) -> NDArray[Any]:
    count = (int(block.val_param_nr) - 1) // 3
    lower, upper = (np.array([block[f"{end}_{i}"] for i in range(count)]) for end in _ENDS)
    range_index = _find_ranges(lower, upper, raw)
    physical = np.array([block[f"phys_{i}"] for i in range(count)] + [block.default])
    return np.asarray(physical[range_index])


_NUMERIC = {
    _LINEAR: _linear,
    _RATIONAL: _rational,
    _INTERPOLATED: _interpolate,
    _NEAREST: _nearest,
    _RANGES: _ranges,
}
