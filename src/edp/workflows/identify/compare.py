"""Simulator under the commands of recordings, compared with the measured values."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edp.data.series import Series
from edp.evaluation.free_run import FreeRuns
from edp.networks.twin import Twin
from edp.networks.twin.base import even_starts
from edp.networks.twin.grey.elements import Elements
from edp.networks.twin.greybox import GreyTwin
from edp.sim.machine import layout as sim
from edp.sim.machine.machine import Machine
from edp.sim.physics.plant import Plant

Doubles = NDArray[np.float64]
LOGGED = slice(sim.HEAD, sim.BRISTLE)
"""Head, rod and pump pressures of a logged sample."""


@dataclass(frozen=True, eq=False)
class MeasuredRuns:
    """Stretches of recordings along which models run free.

    Attributes:
        names: recording of each.
        commands: ``(run, prefix + tick, command)``.
        truth: ``(run, prefix + tick + 1, answer)``.
        prefix: measured ticks before the free run.
    """

    names: tuple[str, ...]
    commands: NDArray[np.float32]
    truth: NDArray[np.float32]
    prefix: int

    @staticmethod
    def of(twin: Twin, series: Sequence[Series], seconds: float, starts: int) -> MeasuredRuns:
        """Return evenly spread stretches; `seconds` are at most those of the longest recording.

        Raises:
            DataError: all starts lie beyond an end stop.
        """
        prefix = twin.prefix_ticks
        longest = max(part.samples for part in series)
        ticks = max(1, min(round(seconds * twin.channels.rate_hz), longest - prefix - 1))
        runs = even_starts(twin, series, prefix + ticks + 1, starts)
        commands = np.stack([part.inputs[at : at + prefix + ticks] for part, at in runs])
        truth = np.stack([part.targets[at : at + prefix + ticks + 1] for part, at in runs])
        return MeasuredRuns(tuple(part.name for part, _ in runs), commands, truth, prefix)

    def answered(self, twin: Twin, answers: NDArray[np.float32]) -> FreeRuns:
        """Return free runs with these answers ``(run, tick, answer)``."""
        truth = self.truth[:, self.prefix :]
        return FreeRuns(
            twin.channels, self.names, answers, truth[:, 1:], truth[:, 0], twin.scales.low, twin.scales.high
        )

    def by_twin(self, twin: Twin) -> NDArray[np.float32]:
        """Answers of a twin."""
        state = twin.reset(self.commands[:, : self.prefix], self.truth[:, : self.prefix])
        return twin.rollout(self.commands[:, self.prefix :], state)[0]

    def group_by_machine(self, machine: Machine, front: FrontChannels) -> NDArray[np.float32]:
        """Answers of a machine of the simulator: placed at each measured tick of the prefix, then on its own."""
        answers = np.empty((len(self.names), self.commands.shape[1] - self.prefix, self.truth.shape[2]), np.float32)
        for run, (commands, truth) in enumerate(zip(self.commands, self.truth, strict=True)):
            answers[run] = _simulate(machine, front, commands, truth, self.prefix)
        return answers


@dataclass(frozen=True, eq=False)
class FrontChannels:
    """Channels of a twin by their role in an excavator front.

    Attributes:
        sides: columns of the commands that extend and retract each spool ``(6, 2)``; -1: none.
        full: what a full command of each spool is.
        columns: answers of velocity, stroke, head and rod pressure of each cylinder ``(3, 4)``.
        lines: answers of the pumps' pressures ``(2,)``; -1: not measured.
        rate_hz: ticks per second.
    """

    sides: NDArray[np.int64]
    full: Doubles
    columns: NDArray[np.int64]
    lines: NDArray[np.int64]
    rate_hz: float

    @staticmethod
    def of(twin: GreyTwin, elements: Elements, valves: Sequence[int], full: Sequence[float]) -> FrontChannels:
        """Return the channels of a grey box.

        Args:
            twin: the grey box.
            elements: of it.
            valves: place of each spool among them, -1: none ``(6,)``.
            full: what a full command of each valve is.
        """
        sides = np.array([twin.wiring.sides[j] if j >= 0 else (-1, -1) for j in valves])
        whole = np.array([full[j] if j >= 0 else 1.0 for j in valves])
        names = [channel.name for channel in twin.channels.answers]
        lines = np.array([names.index(p.pressure) if p.pressure else -1 for p in elements.pumps])
        return FrontChannels(sides, whole, np.array(twin.wiring.columns), lines, twin.channels.rate_hz)

    def demands(self, commands: NDArray[np.float32]) -> Doubles:
        """Return signed demands of the spools ``(tick, 6)``, relative to full stroke."""
        result = np.zeros((len(commands), len(self.sides)))
        for j, (extend, retract) in enumerate(self.sides):
            if extend >= 0:
                result[:, j] = commands[:, extend]
            if retract >= 0:
                result[:, j] -= commands[:, retract]
        return np.clip(result / self.full, -1.0, 1.0)

    def pressures(self, row: NDArray[np.float32]) -> Doubles:
        """Heads, rods and pump lines ``(8,)``, NaN where not measured."""
        places = np.concatenate([self.columns[:, 2], self.columns[:, 3], self.lines])
        return np.where(places >= 0, row[places], np.nan).astype(np.float64)


def _simulate(
    machine: Machine, front: FrontChannels, commands: NDArray[np.float32], truth: NDArray[np.float32], prefix: int
) -> NDArray[np.float32]:
    """Return answers ``(tick, answer)`` after the prefix."""
    demands, (speeds, strokes) = front.demands(commands), front.columns[:, :2].T
    plant = Plant(machine, truth[0, strokes] / np.array(machine.cylinders.stroke), front.rate_hz)
    plant.rest_at(demands[0])
    for t in range(prefix + 1):
        plant.place(truth[t, strokes], truth[t, speeds], front.pressures(truth[t]))
        if t < prefix:
            plant.drive(demands[t : t + 1])
    # The log of a sample is the machine before its command: one more sample shows the answer to the last one.
    log = plant.drive(np.concatenate([demands[prefix:], demands[-1:]]))[1:]
    answers = np.zeros((len(log), truth.shape[1]), np.float32)
    answers[:, strokes] = log[:, sim.LOG_STROKE : sim.LOG_STROKE + sim.AXES]
    answers[:, speeds] = log[:, sim.LOG_VELOCITY : sim.LOG_VELOCITY + sim.AXES]
    places = np.concatenate([front.columns[:, 2], front.columns[:, 3], front.lines])
    answers[:, places[places >= 0]] = log[:, LOGGED][:, places >= 0]
    return answers
