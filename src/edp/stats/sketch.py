"""Quantiles of data that do not fit into memory."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

MAX_EXACT = 1 << 20
"""Maximum number of values that are stored exactly, 8 MB."""
FINE = 10
"""Number of mantissa bits that select a bin: 1,024 bins per octave, so the relative error of a quantile is at most 0.05
%."""
_SHIFT = 23 - FINE
_BINS = 1 << (31 - _SHIFT)


class QuantileSketch:
    """Quantile sketch of non-negative values: exact up to `MAX_EXACT` values, beyond that to 0.05 %.

    A bin is a single-precision number with a shortened mantissa. The memory is two megabytes for any number of values.
    """

    def __init__(self) -> None:
        self.count = 0
        self._kept: list[NDArray[np.float64]] = []
        self._bins: NDArray[np.int64] | None = None

    @property
    def exact(self) -> bool:
        """Whether quantiles are computed from all single values."""
        return self._bins is None

    def update(self, values: ArrayLike) -> None:
        """Take in finite values of at least 0, of any shape."""
        new = np.asarray(values, dtype=np.float64).ravel()
        self.count += new.size
        self._kept.append(new)
        if self.count > MAX_EXACT or self._bins is not None:
            self._fill_bins()

    def _fill_bins(self) -> NDArray[np.int64]:
        """Move the single values into the bins and return the bins."""
        bins = np.zeros(_BINS, dtype=np.int64) if self._bins is None else self._bins
        for part in self._kept:
            bins += np.bincount(_bin_of(part), minlength=_BINS)
        self._bins, self._kept = bins, []
        return bins

    def state(self) -> dict[str, NDArray[Any]]:
        """Return the state as arrays: single values, or the counts of bins."""
        if self._bins is None:
            return {"values": np.concatenate([np.zeros(0), *self._kept])}
        filled = np.flatnonzero(self._bins)
        return {"bins": filled, "counts": self._bins[filled]}

    def add(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Add the content of another sketch, given its `state`."""
        if "values" in state:
            self.update(state["values"])
            return
        self._fill_bins()[state["bins"]] += state["counts"]
        self.count += int(state["counts"].sum())

    def quantiles(self, shares: Sequence[float]) -> list[float]:
        """Return the quantiles at the given probabilities; at least one value is required."""
        if self._bins is None:
            return [float(value) for value in np.quantile(np.concatenate(self._kept), shares)]
        reached = np.cumsum(self._bins)
        places = np.searchsorted(reached, [share * (self.count - 1) for share in shares], side="right")
        return [float(value) for value in _middle_of(places)]


def _bin_of(values: NDArray[np.float64]) -> NDArray[np.int64]:
    # Numbers of at least 0 in single precision are in the order of their bits.
    return np.asarray(values.astype(np.float32).view(np.int32) >> _SHIFT, dtype=np.int64)


def _middle_of(places: NDArray[np.int64]) -> NDArray[np.float64]:
    edges = [np.asarray((places + step) << _SHIFT, dtype=np.int32).view(np.float32) for step in (0, 1)]
    return np.where(places == 0, 0.0, 0.5 * (edges[0].astype(np.float64) + edges[1]))
