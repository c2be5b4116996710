"""Columns of samples on disk, whose rows are read on demand."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, cast

import numpy as np
from numpy.lib.mixins import NDArrayOperatorsMixin

from edp.data.features import Derived, derive
from edp.recording import FloatArray, Recording

Make = Callable[[], FloatArray]


class _OnDemand(NDArrayOperatorsMixin):
    """Array-like ``(time, column)`` of float32 that computes its values on access.

    Rows are read by index. Whatever else arrays can do reads all rows first, and drops them afterwards.
    """

    dtype = np.dtype(np.float32)
    ndim = 2
    shape: tuple[int, int]

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, key: Any) -> Any:
        return np.asarray(self)[key]

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> Any:
        raise NotImplementedError

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, **options: Any) -> Any:
        return getattr(ufunc, method)(*(np.asarray(x) if isinstance(x, _OnDemand) else x for x in inputs), **options)

    def __getattr__(self, name: str) -> Any:
        # Special names are asked for by pickle and copy, which must not read hours of samples.
        if name.startswith("_"):
            raise AttributeError(name)
        return getattr(np.asarray(self), name)


class _Gathered(_OnDemand):
    """Columns of memory-mapped samples, and differences of columns between samples, for one segment.

    Args:
        values: all samples of the recording, ``(time, channel)``.
        places: column of each.
        gains: gain of each column. For a gain other than 0 the column is ``(x[t] - x[t - 1]) gain``, with 0 at the
            first sample of the recording.
        rows: first row, and the one after the last.
    """

    def __init__(
        self, values: FloatArray, places: Sequence[int], gains: Sequence[float], rows: tuple[int, int]
    ) -> None:
        self._values, self._rows = values, rows
        self._places = np.array(places, dtype=np.intp)
        self._gains = np.array(gains, dtype=np.float32)
        self._changing = np.flatnonzero(self._gains)
        self.shape = (rows[1] - rows[0], len(places))

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> Any:
        return self._read(slice(*self._rows)).astype(dtype or np.float32, copy=False)

    def __getitem__(self, key: Any) -> Any:
        rows, *rest = key if isinstance(key, tuple) else (key,)
        if rows is not None and rows is not ... and len(rest) == 1 and isinstance(rest[0], int | list | slice):
            # Of a few columns the others need not be gathered.
            chosen = np.atleast_1d(np.arange(self.shape[1])[rest[0]])
            some = _Gathered(self._values, self._places[chosen].tolist(), self._gains[chosen].tolist(), self._rows)
            return some[rows][..., 0] if isinstance(rest[0], int) else some[rows]
        if isinstance(rows, slice) and rows.step in (None, 1) and not rest:
            start, stop, _ = rows.indices(self.shape[0])
            return self._read(slice(self._rows[0] + start, self._rows[0] + max(start, stop)))
        if isinstance(rows, np.ndarray) and rows.ndim == 1 and rows.dtype.kind == "i":
            return self._read(np.where(rows < 0, rows + self.shape[0], rows) + self._rows[0])[(slice(None), *rest)]
        return np.asarray(self)[key]

    def _read(self, rows: Any) -> FloatArray:
        block: FloatArray = np.take(self._values[rows], self._places, axis=1)
        if len(self._changing) and len(block):
            places = self._places[self._changing]
            if isinstance(rows, slice):
                # The first tick is its own predecessor, as in `derive`.
                first = max(rows.start - 1, 0)
                before = np.take(self._values[first : rows.stop - 1], places, axis=1)
                before = before if rows.start else np.concatenate([block[:1, self._changing], before])
            else:
                before = np.take(self._values[np.maximum(rows - 1, 0)], places, axis=1)
            block[:, self._changing] = (block[:, self._changing] - before) * self._gains[self._changing]
        return block


class LastMade:
    """Holds the array that was made last."""

    def __init__(self) -> None:
        self._owner: object = None
        self._values: FloatArray | None = None

    def values(self, owner: object, make: Make) -> FloatArray:
        """Return the result of `make`, computed again if another owner used the slot in between."""
        if self._owner is not owner or self._values is None:
            self._owner, self._values = None, None  # before the next one is made: two would lie in memory
            self._values, self._owner = make(), owner
        return self._values


class _Made(_OnDemand):
    """Array that is computed on access; a slot keeps only the array used last."""

    def __init__(self, shape: tuple[int, int], make: Make, slot: LastMade) -> None:
        self.shape, self._make, self._slot = shape, make, slot

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> Any:
        return self._slot.values(self, self._make).astype(dtype or np.float32, copy=False)


def make_lazy_array(shape: tuple[int, int], make: Make, slot: LastMade) -> FloatArray:
    """Return an array ``(time, column)`` that is computed on access, for data that are read recording by recording.

    Args:
        shape: shape of the result of `make`.
        make: gives the whole array, the same each time.
        slot: shared by arrays of which one at a time is to be in memory.
    """
    return cast(FloatArray, _Made(shape, make, slot))


def some_columns(values: FloatArray, places: Sequence[int]) -> FloatArray:
    """Return the columns of an array that may be a gathered one.

    A view where they lie side by side, rows on demand otherwise.
    """
    if list(places) == list(range(values.shape[1])):
        return values
    if isinstance(values, np.ndarray):
        return on_demand(values, places)
    if isinstance(values, _Gathered):
        gains = values._gains[list(places)].tolist()
        return cast(FloatArray, _Gathered(values._values, values._places[list(places)].tolist(), gains, values._rows))
    return values[:, list(places)]


def some_rows(values: FloatArray, start: int, stop: int) -> FloatArray:
    """Return the rows ``start:stop`` of an array without loading rows that are on disk."""
    if isinstance(values, _Gathered):
        first = values._rows[0]
        rows = first + start, min(first + stop, values._rows[1])
        some = _Gathered(values._values, values._places.tolist(), values._gains.tolist(), rows)
        return cast(FloatArray, some)
    return values[start:stop]


def on_demand(values: FloatArray, places: Sequence[int]) -> FloatArray:
    """Return columns of samples, ``(time, column)``: a view where they lie side by side, else gathered row by row."""
    first = places[0] if places else 0
    if list(places) == list(range(first, first + len(places))):
        return values[:, first : first + len(places)]
    return cast(FloatArray, _Gathered(values, places, [0.0] * len(places), (0, len(values))))


def read_stored_columns(
    recording: Recording, names: Sequence[str], derived: Sequence[Derived], start: int, stop: int | None
) -> FloatArray:
    """Return logged and derived channels of a segment whose samples are on disk, ``(time, column)``.

    Channels and their changes from tick to tick stay there; means and changes over a span are copied into memory, the
    whole table with them.
    """
    entries = {entry.name: entry for entry in derived}
    rows = slice(start, stop).indices(recording.samples)
    sources = [entries[name].source if name in entries else name for name in names]
    places = [recording.index(name) for name in sources]
    if all(name not in entries for name in names):
        return on_demand(recording.values[slice(*rows)], places)
    spans = [entries[name].span_s is not None for name in names if name in entries]
    if any(spans):
        columns = [
            derive(entries[name], recording.column(source), recording.rate_hz)
            if name in entries
            else recording.column(name)
            for name, source in zip(names, sources, strict=True)
        ]
        return np.stack([column[slice(*rows)] for column in columns], axis=1)
    gains = [entries[name].gain(recording.rate_hz) if name in entries else 0.0 for name in names]
    return cast(FloatArray, _Gathered(recording.values, places, gains, (rows[0], max(rows[:2]))))
