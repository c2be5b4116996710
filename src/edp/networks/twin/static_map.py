"""The static valve map: velocities and pressures as a piecewise linear function of the commands a little earlier."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from edp.data.lags import LagTask
from edp.data.ridge import RidgeSolution, ridge_solution
from edp.data.series import Series
from edp.data.twin_channels import TwinChannels
from edp.ir import Builder
from edp.ir.layers import Clip, Dense, ScaleShift
from edp.ir.memory import Convolution
from edp.networks.twin.base import PREFIX, TWINS, Twin, TwinState, list_solved_columns
from edp.networks.twin.scales import Array, TwinScales
from edp.settings.bounds import MOST_TICKS, check_bounds, check_count, integer
from edp.wording import typed

PENALTY = 1e-6
"""Ridge penalty per row on standardised features. Knots without data stay flat."""


@TWINS.register("static")
@dataclass(frozen=True, kw_only=True)
class StaticMap:
    """Static map from commands to velocities and pressures with a delay as its only memory: a baseline of every twin.

    Each command enters by a polygon with `knots` corners over its range, so dead bands and saturation are followed; the
    polygons of all commands add up. The delay with the smallest error on the training data is kept.

    Attributes:
        knots: corners of each command's polygon.
        delays: delays to choose from, in ticks.
        prefix_ticks: measured ticks before a free run.

    Raises:
        ConfigError: a value out of range, or no delay.
    """

    knots: int = 12
    delays: tuple[int, ...] = (0, 2, 5, 10, 15, 20, 30)
    prefix_ticks: int = 30

    def __post_init__(self) -> None:
        check_bounds("static map", self, knots=integer(2, 1000), delays=integer(0, MOST_TICKS), prefix_ticks=PREFIX)
        check_count("static map", "delays", self.delays, 100, least=1)

    def start(self, channels: TwinChannels, scales: TwinScales, train: Sequence[Series], seed: int) -> StaticTwin:
        """Fit by least squares; no random values are used."""
        low = np.min([series.inputs.min(axis=0) for series in train], axis=0)
        high = np.max([series.inputs.max(axis=0) for series in train], axis=0)
        # A command that never moved has no range; its polygon is flat.
        corners = np.linspace(low, np.where(high > low, high, low + 1), self.knots + 1, dtype=np.float32)[:-1]
        solved = list_solved_columns(channels)
        rows = [Series(s.name, polygon(s.inputs, corners), s.targets[:, solved]) for s in train]
        longest = max(s.samples for s in train)
        delays = tuple(sorted({delay for delay in self.delays if delay + 1 < longest} or {min(self.delays)}))
        task = LagTask(tuple(delay + 1 for delay in delays), (None,) * len(solved), 1)
        solution = ridge_solution(rows, task, penalties=(PENALTY,))
        # Compare all delays on the same samples: those with an output after the longest delay.
        judged = [s for s in rows if s.samples > delays[-1] + 1]
        best = int(np.argmin([_error(solution, judged, i, delay) for i, delay in enumerate(delays)]))
        arrays = {"corners": corners, "delay": np.array([delays[best]], dtype=np.float32)}
        return self.build(channels, scales, arrays | _solve_delay(solution, best))

    def shapes(self, channels: TwinChannels) -> dict[str, tuple[int, ...]]:
        """Return the shapes of corners, rises of each output between corners, intercepts, and the delay."""
        commands, solved = len(channels.commands), len(list_solved_columns(channels))
        corners = (self.knots, commands)
        return {"corners": corners, "rise": (self.knots * commands, solved), "intercept": (solved,), "delay": (1,)}

    def build(self, channels: TwinChannels, scales: TwinScales, arrays: Mapping[str, Array]) -> StaticTwin:
        """Build the map with these parameters."""
        return StaticTwin(channels, scales, self.prefix_ticks, {name: arrays[name] for name in self.shapes(channels)})


class StaticTwin(Twin):
    """State: ``answer`` (outputs) in SI units, and the commands of the delay ``(batch, delay, command)``."""

    def __init__(
        self, channels: TwinChannels, scales: TwinScales, prefix_ticks: int, numbers: Mapping[str, Array]
    ) -> None:
        super().__init__(channels, scales, prefix_ticks)
        self.numbers, delay = dict(numbers), float(numbers["delay"][0])
        if not (0 <= delay <= MOST_TICKS and delay == int(delay)):
            raise ValueError(f"its delay is {typed(delay)} ticks; an integer from 0 to {MOST_TICKS:,} must hold")
        self.delay = int(delay)
        lengths = np.diff(numbers["corners"].astype(np.float64), axis=0)
        # Evenly spaced up to the rounding of single precision; a length of zero would divide by it.
        if not (lengths > 0).all() or not (lengths <= 1.5 * _lengths(numbers["corners"])).all():
            raise ValueError("its corners do not rise evenly")

    def refitted(self, train: Sequence[Series]) -> StaticTwin:
        """Return the map fitted to other segments, with the corners and the delay of this map."""
        solved = list_solved_columns(self.channels)
        corners = self.numbers["corners"]
        rows = [Series(s.name, polygon(s.inputs, corners), s.targets[:, solved]) for s in train]
        solution = ridge_solution(rows, LagTask((self.delay + 1,), (None,) * len(solved), 1), penalties=(PENALTY,))
        numbers = self.numbers | _solve_delay(solution, 0)
        return StaticTwin(self.channels, self.scales, self.prefix_ticks, numbers)

    @staticmethod
    def mean(maps: Sequence[StaticTwin], weights: Array) -> StaticTwin:
        """Return the weighted mean of maps with equal corners and delay.

        Args:
            maps: list of at least one map.
            weights: weight of each map and output ``(map, all answers but strokes)``, with sum 1 over the maps.
        """
        first = maps[0]
        if all(one is first for one in maps):
            return first
        mean = {
            name: np.sum([w * one.numbers[name] for w, one in zip(weights, maps, strict=True)], axis=0)
            for name in ("rise", "intercept")
        }
        return StaticTwin(first.channels, first.scales, first.prefix_ticks, first.numbers | mean)

    def initial_state(self, command: Array, measured: Array) -> TwinState:
        return {"answer": measured, "commands": np.repeat(command[:, None], self.delay, axis=1)}

    def _run(self, commands: Array, measured: Array, state: TwinState) -> tuple[Array, TwinState]:
        velocities = len(self.channels.velocities)
        solved, later = self.mapped(commands, state["commands"])
        answers, answer = np.empty_like(measured), state["answer"]
        for t in range(commands.shape[1]):
            fed = np.where(np.isnan(measured[:, t]), answer, measured[:, t])
            answers[:, t] = answer = self.bounded(fed, solved[:, t, :velocities], solved[:, t, velocities:])
        return answers, {"answer": answer, "commands": later}

    def mapped(self, commands: Array, before: Array) -> tuple[Array, Array]:
        """Return the outputs of the map for commands, SI units, without bounds.

        Args:
            commands: ``(batch, tick, command)``.
            before: commands of the delay before them ``(batch, delay, command)``.

        Returns:
            All outputs but the strokes ``(batch, tick, output)``, and the commands of the delay behind the last tick.
        """
        numbers, ticks = self.numbers, commands.shape[1]
        earlier = np.concatenate([before, commands], axis=1)
        # One product per sample, so that a chunk and its single samples are rounded equally.
        rows = [polygon(earlier[:, t], numbers["corners"]) @ numbers["rise"] for t in range(ticks)]
        return np.stack(rows, axis=1) + numbers["intercept"], earlier[:, ticks:]

    def along(self, commands: Array) -> Array:
        """Return the outputs of the map along commands ``(tick, command)``: ``(tick, all answers but strokes)``.

        All ticks in one product: quicker than `mapped`, and up to rounding the same.
        """
        earlier = np.concatenate([np.repeat(commands[:1], self.delay, axis=0), commands])[: len(commands)]
        solved = polygon(earlier, self.numbers["corners"]) @ self.numbers["rise"] + self.numbers["intercept"]
        return np.asarray(solved, dtype=np.float32)

    def lower(self, build: Builder, commands: str, fed: str) -> str:
        scales, solved, count = self.scales, list_solved_columns(self.channels), len(self.channels.commands)
        if self.delay:
            # Two taps: zero for the present, one for the sample at the end of the delay.
            taps = np.stack([np.eye(count), np.zeros((count, count))], axis=1)
            options = {"weight": taps, "bias": np.zeros(count), "dilation": self.delay}
            commands = build.add(Convolution, "earlier", commands, **options)
        corners = self.numbers["corners"].astype(np.float64)
        knots, length = len(corners), corners[1] - corners[0]
        each = build.pick("each", commands, list(range(count)) * knots)
        gain = np.tile(scales.command_width / length, knots)
        shift = ((scales.command_offset - corners) / length).ravel()
        past = build.add(ScaleShift, "past", each, gain=gain, shift=shift)
        zero = np.zeros(knots * count)
        polygons = build.add(Clip, "polygons", past, low=zero, high=zero + 1.0)
        width = scales.answer_width[solved].astype(np.float64)
        bias = (self.numbers["intercept"] - scales.answer_offset[solved]) / width
        return build.add(Dense, "proposed", polygons, weight=(self.numbers["rise"] / width).T, bias=bias)

    def arrays(self) -> dict[str, Array]:
        return self.scales.arrays() | self.numbers


def polygon(commands: Array, corners: Array) -> Array:
    """Return how much of the way from each corner ``(knot, command)`` to the next a command has gone, 0 to 1.

    Fractions are used instead of distances, so that sums have no large cancelling parts, even with 8-bit weights. A
    command outside the training range gives the output of the nearest corner.

    Args:
        commands: ``(row, command)``.
        corners: evenly spaced; the range ends one length behind the last one.

    Returns:
        ``(row, knot times command)``.
    """
    past = np.clip((commands[:, None] - corners) / _lengths(corners), 0.0, 1.0)
    return np.asarray(past.reshape(len(commands), -1), dtype=np.float32)


def _solve_delay(solution: RidgeSolution, which: int) -> dict[str, Array]:
    """Return the rises and intercepts of one delay."""
    rise = np.ascontiguousarray(solution.weights[0, :, which], dtype=np.float32)
    return {"rise": rise, "intercept": solution.intercept[which].astype(np.float32)}


def _lengths(corners: Array) -> Array:
    """Return the distance between neighbouring corners for each command, ``(command,)``."""
    return np.asarray(corners[1] - corners[0])


def _error(solution: RidgeSolution, rows: Sequence[Series], which: int, delay: int) -> float:
    """Sum of squares of one delay, each target in its own deviation."""
    total = 0.0
    for series in rows:
        truth = series.targets[delay + 1 :]
        error = solution.predict(series.inputs)[: len(truth), which] - truth
        total += float(np.square(error).mean(axis=0) @ (1.0 / np.maximum(series.targets.var(axis=0), 1e-12)))
    return total
