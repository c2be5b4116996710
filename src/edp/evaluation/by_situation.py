"""Errors by motion of the axes: steady, starting, stopping, reversing, fast, at an end stop, lever released."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edp.data.prepared import Prepared
from edp.data.roles import Axis, roles_of_channels
from edp.data.series import Series
from edp.data.twin_channels import INTEGRAL
from edp.evaluation.free_run_parts import AT_REST
from edp.evaluation.scores_file import SituationErrors
from edp.signals import Kind
from edp.stats.sketch import QuantileSketch

Values = NDArray[np.float64]
Ticks = NDArray[np.bool_]
SITUATIONS = ("rest", "starting", "stopping", "reversing", "fast", "dead_band", "end_stop", "other")
"""Situations in the order of tables. A sample may belong to several of them; `other` is a sample without a
situation."""
FAST = 0.5
"""Fraction of the maximum speed above which an axis is fast."""
NEAR_STOP = 0.05
"""Fraction of a stroke: distance from its ends within which cushions act (docs/explanation/simulator.md: 4 to 6 %)."""
DEAD_BAND = 0.15
"""Fraction of the largest command: spools open at 12 to 17 % in the machine files, and slowly at first."""
FASTEST = 0.995
"""Quantile of the speeds that defines the maximum speed. Larger speeds are single events."""


@dataclass(frozen=True)
class SeenAxis:
    """Inputs that describe the axis of a target.

    Attributes:
        target: index among the targets.
        fastest: speed, SI units.
        stroke: column of the stroke among the inputs, and the range of its values; None if no input measures it.
        command: columns of its command, extend and retract or one that is signed; empty where no input shows it.
        dead_band: size of the command up to which the axis is not asked to move.
    """

    target: int
    fastest: float
    stroke: tuple[int, float, float] | None = None
    command: tuple[int, ...] = ()
    dead_band: float = 0.0


class Situations:
    """Tells the situations of the axes whose velocities are targets, by measured channels alone.

    Velocity and command belong together as `edp.data.roles` has it. A position belongs to a velocity where it is of
    the kind of its integral. Sizes are those of the series that are evaluated, ranges those of all series.

    Args:
        data: evaluated series; their inputs contain strokes and commands.
    """

    def __init__(self, data: Prepared) -> None:
        self.axes = _find_axes(data)

    def find_masks(self, series: Series, horizon: int, ticks: int) -> list[tuple[int, Mapping[str, Ticks]]]:
        """Return per axis its target column and a mask ``(ticks,)`` of each situation.

        Args:
            series: measured inputs and targets.
            horizon: samples ahead.
            ticks: number of samples from the first one; the last one must have a measured target.
        """
        return [(axis.target, _ticks_of(axis, series, horizon, ticks)) for axis in self.axes]


def _ticks_of(axis: SeenAxis, series: Series, horizon: int, ticks: int) -> dict[str, Ticks]:
    now = series.targets[:ticks, axis.target].astype(np.float64)
    then = series.targets[horizon : horizon + ticks, axis.target].astype(np.float64)
    slow = AT_REST * axis.fastest
    still, still_then = np.abs(now) < slow, np.abs(then) < slow
    masks: dict[str, Ticks] = {
        "rest": still & still_then,
        "starting": still & ~still_then,
        "stopping": ~still & still_then,
        "reversing": ~still & ~still_then & (now * then < 0),
        "fast": np.abs(now) > FAST * axis.fastest,
    }
    if axis.command:
        asked = _read_signed(series, axis.command, ticks)
        # A lever at neutral says nothing of an axis that stands: `rest` has those ticks.
        masks["dead_band"] = (np.abs(asked) <= axis.dead_band) & ~masks["rest"]
    if axis.stroke is not None:
        column, low, high = axis.stroke
        position = series.inputs[:ticks, column].astype(np.float64)
        near = NEAR_STOP * (high - low)
        masks["end_stop"] = (position < low + near) | (position > high - near)
    masks["other"] = ~np.logical_or.reduce(list(masks.values()))
    return masks


def _read_signed(series: Series, columns: Sequence[int], ticks: int) -> Values:
    first = series.inputs[:ticks, columns[0]].astype(np.float64)
    return first - series.inputs[:ticks, columns[1]] if len(columns) > 1 else first


def _find_axes(data: Prepared) -> tuple[SeenAxis, ...]:
    names, roles = [channel.name for channel in data.inputs], roles_of_channels(data.inputs)
    parts = [part for part in (*data.train, *data.validation, *data.test) if part.samples]
    by_velocity: dict[str, Axis] = {axis.velocity: axis for axis in roles.axes if axis.velocity}
    axes = []
    for number, (name, kind) in enumerate(zip(data.task.targets, data.target_kinds, strict=True)):
        fastest = _fastest(data.test, number) if kind in INTEGRAL else 0.0
        if not fastest:
            continue  # a target of another kind has no rest, and one that never moves nothing else
        axis = by_velocity.get(name, Axis(name))
        command = tuple(names.index(one) for one in axis.command)
        largest = max(
            (float(np.abs(_read_signed(part, command, part.samples)).max()) for part in parts if command), default=0.0
        )
        axes.append(SeenAxis(number, fastest, _range(data, axis.stroke, kind, parts), command, DEAD_BAND * largest))
    return tuple(axes)


def _fastest(parts: Sequence[Series], column: int) -> float:
    speeds = QuantileSketch()
    for part in parts:
        speeds.update(np.abs(part.targets[:, column].astype(np.float64)))
    return float(speeds.quantiles([FASTEST])[0])


def _range(data: Prepared, stroke: str, kind: Kind, parts: Sequence[Series]) -> tuple[int, float, float] | None:
    """Return column and range of a position; None if it does not belong to the velocity or never moves."""
    places = [n for n, channel in enumerate(data.inputs) if channel.name == stroke and channel.kind is INTEGRAL[kind]]
    if not places:
        return None
    low = min(float(part.inputs[:, places[0]].min()) for part in parts)
    high = max(float(part.inputs[:, places[0]].max()) for part in parts)
    return (places[0], low, high) if high > low else None


class SituationTally:
    """Absolute errors of one model at one horizon by situation and target.

    Args:
        targets: names of the targets.
    """

    def __init__(self, targets: Sequence[str]) -> None:
        self.targets = tuple(targets)
        shape = (len(SITUATIONS), len(self.targets))
        self.ticks, self.errors = np.zeros(shape, dtype=np.int64), np.zeros(shape)
        self.seen, self.scored, self.total = np.zeros(shape, dtype=bool), np.zeros(shape[1]), np.zeros(shape[1])

    def update(self, size: Values, scored: Ticks, by_axis: Sequence[tuple[int, Mapping[str, Ticks]]]) -> None:
        """Take in a recording.

        Args:
            size: absolute errors in report units ``(tick, target)``.
            scored: ticks that count.
            by_axis: result of `Situations.of` for the same samples.
        """
        for target, ticks_of in by_axis:
            self.scored[target] += scored.sum()
            self.total[target] += size[scored, target].sum()
            for name, ticks in ticks_of.items():
                row = SITUATIONS.index(name)
                self.seen[row, target] = True
                self.ticks[row, target] += (ticks & scored).sum()
                self.errors[row, target] += size[ticks & scored, target].sum()

    def state(self) -> dict[str, NDArray[Any]]:
        """Return all that it holds, as arrays."""
        return {name: getattr(self, name) for name in ("ticks", "errors", "seen", "scored", "total")}

    def add(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Take in what another one held, by its `state`."""
        for name in ("ticks", "errors", "scored", "total"):
            getattr(self, name).__iadd__(state[name])
        self.seen |= state["seen"]

    def rows(self) -> tuple[SituationErrors, ...]:
        """Return one row per occurring situation: samples, fractions of time and error, error by target.

        The error of a target is None where the situation never occurs or cannot be told.
        """
        rows = []
        for row, name in enumerate(SITUATIONS):
            axes = np.flatnonzero(self.seen[row] & (self.scored > 0))
            ticks, errors = self.ticks[row], self.errors[row]
            if not ticks.any():
                continue
            some = [axis for axis in axes if self.total[axis] > 0]
            rows.append(
                SituationErrors(
                    situation=name,
                    ticks=int(ticks.sum()),
                    share=float(np.mean(ticks[axes] / self.scored[axes])),
                    of_error=float(np.mean(errors[some] / self.total[some])) if some else 0.0,
                    mae={
                        target: float(errors[i] / ticks[i]) if ticks[i] else None
                        for i, target in enumerate(self.targets)
                    },
                )
            )
        return tuple(rows)
