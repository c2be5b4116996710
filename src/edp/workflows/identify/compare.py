"""Simulator under the commands of recordings, compared with the measured values."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edp.networks.twin.greybox import GreyTwin
from edp.networks.twin.windows import MeasuredWindows
from edp.sim.machine import layout as sim
from edp.sim.machine.machine import Machine
from edp.sim.physics.plant import Plant
from edp.training.identification.elements import full_commands
from edp.training.identification.mapping import GreyParts

Doubles = NDArray[np.float64]
LOGGED = slice(sim.HEAD, sim.BRISTLE)
"""Head, rod and pump pressures of a logged sample."""


@dataclass(frozen=True, eq=False)
class FrontChannels:
    """Channels of a twin by their role in an excavator front.

    Attributes:
        sides: columns of the commands that extend and retract each spool ``(6, 2)``; -1: none.
        full: full command of each spool.
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
    def from_twin(twin: GreyTwin, parts: GreyParts, machine: Machine) -> FrontChannels:
        """Return the channels of a grey box.

        Args:
            twin: the grey box.
            parts: mapping of its elements to the machine.
            machine: machine whose full commands hold.
        """
        elements, valves = twin.spec.elements(twin.channels), (*parts.primary, *parts.conflux)
        full = full_commands(twin.channels, elements, machine)
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
        """Return the heads, rods and pump lines ``(8,)``, NaN where not measured."""
        places = np.concatenate([self.columns[:, 2], self.columns[:, 3], self.lines])
        return np.where(places >= 0, row[places], np.nan).astype(np.float64)


def simulate_machine(
    machine: Machine, front: FrontChannels, windows: MeasuredWindows, prefix: int
) -> NDArray[np.float32]:
    """Simulate a machine in windows of recordings: placed at each measured tick of the prefix, then on its own.

    Args:
        machine: machine of the simulator.
        front: channels of the recordings.
        windows: commands and measured outputs.
        prefix: measured ticks before the free run.

    Returns:
        Outputs after the prefix ``(window, tick, output)``.
    """
    runs = zip(windows.commands, windows.outputs, strict=True)
    return np.stack([_simulate_window(machine, front, commands, truth, prefix) for commands, truth in runs])


def _simulate_window(
    machine: Machine, front: FrontChannels, commands: NDArray[np.float32], truth: NDArray[np.float32], prefix: int
) -> NDArray[np.float32]:
    """Return the outputs of one window after the prefix ``(tick, output)``."""
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
