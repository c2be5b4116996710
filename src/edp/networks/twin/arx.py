"""A linear model with feedback: the next state from the commands and states of the last ticks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from edp.data.lags import LagTask
from edp.data.ridge import ridge_solution
from edp.data.series import Series
from edp.data.twin_channels import TwinChannels
from edp.ir import Builder
from edp.ir.memory import Convolution
from edp.networks.twin.base import PREFIX, TWINS, Twin, TwinState, list_solved_columns
from edp.networks.twin.scales import Array, TwinScales
from edp.settings.bounds import MOST_TICKS, check_bounds, integer

PENALTY = 1e-6
"""Ridge penalty per row on standardised inputs, because neighbouring lags are nearly equal."""


@TWINS.register("arx")
@dataclass(frozen=True, kw_only=True)
class Arx:
    """ARX model, fitted one step ahead and simulated in free run: the baseline of every twin.

    Attributes:
        lags: ticks that it reads.
        prefix_ticks: measured ticks before a free run.

    Raises:
        ConfigError: a value out of range.
    """

    lags: int = 25
    prefix_ticks: int = 30

    def __post_init__(self) -> None:
        check_bounds("arx", self, lags=integer(1, MOST_TICKS), prefix_ticks=PREFIX)

    def start(self, channels: TwinChannels, scales: TwinScales, train: Sequence[Series], seed: int) -> Twin:
        """Fit by least squares; no random values are used."""
        solved, commands = list_solved_columns(channels), len(channels.commands)
        rows = [Series(s.name, np.concatenate([s.inputs, s.targets], axis=1), s.targets[:, solved]) for s in train]
        task = LagTask((1,), tuple(commands + column for column in solved), self.lags)
        solution = ridge_solution(rows, task, penalties=(PENALTY,), histories=(self.lags,))
        weight = solution.weights[:, :, 0].reshape(-1, len(solved))
        arrays = {"weight": weight.astype(np.float32), "intercept": solution.intercept[0].astype(np.float32)}
        return self.build(channels, scales, arrays)

    def shapes(self, channels: TwinChannels) -> dict[str, tuple[int, ...]]:
        """Return the shapes of the weights by lag, channel and output, and of the intercepts."""
        solved = len(list_solved_columns(channels))
        rows = self.lags * (len(channels.commands) + len(channels.answers))
        return {"weight": (rows, solved), "intercept": (solved,)}

    def build(self, channels: TwinChannels, scales: TwinScales, arrays: Mapping[str, Array]) -> Twin:
        """Build the model with these parameters."""
        return ArxTwin(channels, scales, self, {name: arrays[name] for name in self.shapes(channels)})


class ArxTwin(Twin):
    """State: ``answer`` (outputs) in SI units, and the previous rows, newest first ``(batch, lags - 1, channel)``."""

    def __init__(self, channels: TwinChannels, scales: TwinScales, spec: Arx, numbers: Mapping[str, Array]) -> None:
        super().__init__(channels, scales, spec.prefix_ticks)
        self.numbers, self.lags = dict(numbers), spec.lags

    def initial_state(self, command: Array, measured: Array) -> TwinState:
        row = np.concatenate([command, measured], axis=1)
        return {"answer": measured, "rows": np.repeat(row[:, None], self.lags - 1, axis=1)}

    def _run(self, commands: Array, measured: Array, state: TwinState) -> tuple[Array, TwinState]:
        velocities = len(self.channels.velocities)
        answers, answer, rows = np.empty_like(measured), state["answer"], state["rows"]
        # Sums of hundreds of pressures in Pa cancel: double precision.
        weight, intercept = (self.numbers[name].astype(np.float64) for name in ("weight", "intercept"))
        for t in range(commands.shape[1]):
            fed = np.where(np.isnan(measured[:, t]), answer, measured[:, t])
            rows = np.concatenate([np.concatenate([commands[:, t], fed], axis=1)[:, None], rows], axis=1)
            solved = (rows.reshape(len(rows), -1).astype(np.float64) @ weight + intercept).astype(np.float32)
            answers[:, t] = answer = self.bounded(fed, solved[:, :velocities], solved[:, velocities:])
            rows = rows[:, :-1]
        return answers, {"answer": answer, "rows": rows}

    def lower(self, build: Builder, commands: str, fed: str) -> str:
        scales, solved = self.scales, list_solved_columns(self.channels)
        offset = np.concatenate([scales.command_offset, scales.answer_offset]).astype(np.float64)
        width = np.concatenate([scales.command_width, scales.answer_width]).astype(np.float64)
        unit = scales.answer_width[solved].astype(np.float64)
        weight, intercept = (self.numbers[name].astype(np.float64) for name in ("weight", "intercept"))
        by_lag = weight.reshape(self.lags, len(offset), len(solved))
        # In scaled numbers the sums of pressures do not cancel: single precision is enough.
        bias = (intercept + np.einsum("lio,i->o", by_lag, offset) - scales.answer_offset[solved]) / unit
        taps = (by_lag * width[:, None] / unit)[::-1].transpose(2, 0, 1)
        return build.add(Convolution, "proposed", build.join("rows", commands, fed), weight=taps, bias=bias)

    def arrays(self) -> dict[str, Array]:
        return self.scales.arrays() | self.numbers
