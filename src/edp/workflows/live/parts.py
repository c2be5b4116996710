"""Computed columns of a live session: each part adds columns and describes them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from edp.errors import ConfigError, closest
from edp.live.layout import Forecast
from edp.signals import Channel

if TYPE_CHECKING:
    from edp.sim.machine.machine import Machine

Row = NDArray[np.float32]
Note = Callable[[str, str, str], None]


class LivePart(ABC):
    """Columns that are computed from the source's channels, a row at a time.

    Attributes:
        width: number of columns.
    """

    width: int

    @abstractmethod
    def step(self, row: Row, missed: int) -> Row:
        """Return the columns of a tick, shape (width,), SI units, NaN without a value.

        Args:
            row: row of the source's channels.
            missed: ticks that went by without a row before it.
        """

    def at_once(self, rows: Row) -> Row | None:
        """Return the results of `step` for consecutive rows, shape (ticks, width), by one call of a model.

        None where it would not be the same, or is not known: the rows are then taken one by one.

        Args:
            rows: rows of the source's channels, shape (ticks, channels).
        """
        return None

    @abstractmethod
    def reset(self) -> None:
        """Forget all rows."""

    def forecasts(self, first: int) -> Sequence[Forecast]:
        """Return which columns are predictions; `first` is the session's column of the first one."""
        return ()


def columns_of(names: Sequence[str], channels: Sequence[Channel], reader: str) -> NDArray[np.int64]:
    """Return the positions of channels in a row of the source.

    Raises:
        ConfigError: the source lacks one; the closest is offered.
    """
    there = [channel.name for channel in channels]
    missing = [name for name in names if name not in there]
    if missing:
        more = " and more" if len(missing) > 8 else ""
        raise ConfigError(
            f"{reader} reads {', '.join(missing[:8])}{more}, which the source does not give{closest(missing[0], there)}"
            "; map the columns that hold them (--map), or choose another source"
        )
    return np.array([there.index(name) for name in names], np.int64)


class LiveFront(LivePart):
    """Joint angles for the side view, from angles or from strokes.

    Args:
        machine: machine whose geometry is displayed.
        channels: channels of the source.
    """

    width = 3

    def __init__(self, machine: Machine, channels: Sequence[Channel]) -> None:
        from edp.report.animation.page import geometry_of, stroke_tables

        names = [channel.name for channel in channels]
        angles, strokes = ([f"{kind}_{i}" for i in (1, 2, 3)] for kind in ("JointAngle", "CylStroke"))
        self.geometry: Mapping[str, object] = geometry_of(machine)
        self._tables = None if set(angles) <= set(names) else stroke_tables(machine)
        self._columns = columns_of(angles if self._tables is None else strokes, channels, "the side view")

    @staticmethod
    def possible(channels: Sequence[Channel]) -> bool:
        """Test whether a source has the channels of the side view."""
        names = {channel.name for channel in channels}
        return any({f"{kind}_{i}" for i in (1, 2, 3)} <= names for kind in ("JointAngle", "CylStroke"))

    def step(self, row: Row, missed: int) -> Row:
        """See `LivePart`."""
        angles: Row = self.at_once(row[None])[0]
        return angles

    def at_once(self, rows: Row) -> Row:
        """See `LivePart`."""
        values: Row = rows[:, self._columns]
        if self._tables is None:
            return values
        bent = [np.interp(value, *table) for value, table in zip(values.T, self._tables, strict=True)]
        return np.array(bent, np.float32).T

    def reset(self) -> None:
        """See `LivePart`."""
