"""Ground truth at an instant by channel name; values are computed on access."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edp.signals import FAULT_CHANNELS, TABLE_A1
from edp.sim.machine import layout as at
from edp.sim.sensors.sensors import KELVIN, OIL, truth_columns

Array = NDArray[np.float64]
FAULTS = tuple(FAULT_CHANNELS)


@cache
def sources(in_soil: bool) -> Mapping[str, tuple[int, float]]:
    """Return column and sign of each name in a log row; sign 0 for unchanged values."""
    width = at.LOG_GROUND + (at.GROUND_POINTS if in_soil else 0)
    columns = {name: (column, 0.0) for name, column in truth_columns(width).items()}
    names = list(TABLE_A1)
    columns.update({name: (at.LOG_VELOCITY + i, 0.0) for i, name in enumerate(names[:3])})
    columns.update({name: (at.HEAD + n, 0.0) for n, name in enumerate(names[6:12])})
    # Each spool has two one-sided pilot pressures.
    columns.update({name: (at.LOG_DEMAND + n // 2, 1.0 - 2.0 * (n % 2)) for n, name in enumerate(names[12:])})
    return columns


class Truth(Mapping[str, object]):
    """Noise-free channels in SI units: Table A.1 without accelerations, and the additional ones logged by `simulate`.

    Args:
        rows: current row of the plant's log, shape (columns,), or one row per machine.
        pilot_pressure: full pilot pressure, Pa; for many machines shape (machine,).
        in_soil: whether the truth includes the ground.
        faults: maximum number of faults in the truth.
        shares: function that returns the current fraction of each fault, shape (machine, fault); None without faults.
    """

    __slots__ = ("_faults", "_pilot_pressure", "_rows", "_shares", "_sources")

    def __init__(
        self,
        rows: Array,
        pilot_pressure: float | Array,
        in_soil: bool,
        faults: int = 0,
        shares: Callable[[], Array] | None = None,
    ) -> None:
        self._rows, self._pilot_pressure, self._sources = rows, pilot_pressure, sources(in_soil)
        self._faults, self._shares = FAULTS[:faults], shares

    def __getitem__(self, name: str) -> Any:
        """Return a number, or an array of shape (machine,)."""
        if name in self._faults and self._shares is not None:
            share = self._shares()[:, self._faults.index(name)]
            return float(share[0]) if self._rows.ndim == 1 else share
        column, sign = self._sources[name]
        value = self._rows[..., column]
        if sign != 0.0:
            value = self._pilot_pressure * np.maximum(sign * value, 0.0)
        if name == OIL:
            value = value + KELVIN
        return float(value) if self._rows.ndim == 1 else value.copy()

    def __iter__(self) -> Iterator[str]:
        return iter((*self._sources, *self._faults))

    def __len__(self) -> int:
        return len(self._sources) + len(self._faults)
