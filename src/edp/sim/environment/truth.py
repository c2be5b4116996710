"""What is true at an instant, by the names of channels; nothing is computed before it is asked for."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import cache

import numpy as np
from numpy.typing import NDArray

from edp.signals import TABLE_A1
from edp.sim.machine import layout as at
from edp.sim.sensors.sensors import KELVIN, OIL, truth_columns

Array = NDArray[np.float64]


@cache
def _sources(width: int) -> Mapping[str, tuple[int, float]]:
    """Column and sign of each name in a log of so many columns; 0 for those that are shown as they are."""
    columns = {name: (column, 0.0) for name, column in truth_columns(width).items()}
    names = list(TABLE_A1)
    columns.update({name: (at.LOG_VELOCITY + i, 0.0) for i, name in enumerate(names[:3])})
    columns.update({name: (at.HEAD + n, 0.0) for n, name in enumerate(names[6:12])})
    # Each spool has two one-sided pilot pressures.
    columns.update({name: (at.LOG_DEMAND + n // 2, 1.0 - 2.0 * (n % 2)) for n, name in enumerate(names[12:])})
    return columns


class Truth(Mapping[str, float]):
    """Noise-free channels in SI units: those of Table A.1 but accelerations, and those that `simulate` logs beside it.

    Args:
        row: one row of the plant's log.
        pilot_pressure: full pilot pressure, Pa.
    """

    __slots__ = ("_pilot_pressure", "_row")

    def __init__(self, row: Array, pilot_pressure: float) -> None:
        self._row, self._pilot_pressure = row, pilot_pressure

    def __getitem__(self, name: str) -> float:
        column, sign = _sources(len(self._row))[name]
        value = float(self._row[column])
        if sign != 0.0:
            return self._pilot_pressure * max(sign * value, 0.0)
        return value + KELVIN if name == OIL else value

    def __iter__(self) -> Iterator[str]:
        return iter(_sources(len(self._row)))

    def __len__(self) -> int:
        return len(_sources(len(self._row)))
