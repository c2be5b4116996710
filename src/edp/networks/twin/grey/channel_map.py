"""Assignment of twin channels to grey-box states, and the bounds of outputs for turning machines."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from edp.data.twin_channels import TwinChannels
from edp.networks.twin.grey.elements import Elements
from edp.networks.twin.scales import TwinScales

Doubles = NDArray[np.float64]
FARTHEST_TURN = 1e6
"""Bound of an unlimited angle in either direction, rad (160,000 turns). No simulation reaches the bound."""


@dataclass(frozen=True, eq=False)
class GreyChannelMap:
    """Assignment of channels to grey-box states.

    Attributes:
        sides: columns of the commands that extend and retract ``(valve, 2)``; -1: none.
        actuator: index of the actuator of each valve.
        pump: index of the pump of each valve; -1 for the supply.
        ports: kind (velocity, stroke, pressure) and number of the state behind each output ``(output, 2)``.
        columns: outputs of velocity, stroke, head and rod pressure of each actuator; -1: not measured.
        z_of: middle of the strokes (m or rad) and scale to -1..1; a scale of 0 where a stroke is not measured.
        nodes: pressures that are states.
    """

    sides: NDArray[np.int64]
    actuator: NDArray[np.int64]
    pump: NDArray[np.int64]
    ports: NDArray[np.int64]
    columns: tuple[tuple[int, int, int, int], ...]
    z_of: tuple[Doubles, Doubles]
    nodes: int

    @staticmethod
    def connect(elements: Elements, channels: TwinChannels, scales: TwinScales) -> GreyChannelMap:
        """Return the wiring of connected elements."""
        names = [channel.name for channel in channels.answers]
        commands = [channel.name for channel in channels.commands]
        speeds = [channel.name for channel in channels.velocities]
        n, count = len(elements.actuators), len(speeds)
        column = {name: i for i, name in enumerate(names)} | {"": -1}
        ports = np.zeros((len(names), 2), np.int64)
        columns, middle, scale = [], np.zeros(n), np.zeros(n)
        for i, actuator in enumerate(elements.actuators):
            speed = speeds.index(actuator.velocity)
            stroke = count + speed if channels.strokes else -1
            head, rod = (column[name] for name in actuator.chambers)
            columns.append((speed, stroke, head, rod))
            for answer, kind, which in ((speed, 0, i), (stroke, 1, i), (head, 2, i), (rod, 2, n + i)):
                if answer >= 0:
                    ports[answer] = kind, which
            if stroke >= 0:
                low, high = float(scales.low[stroke]), float(scales.high[stroke])
                middle[i], scale[i] = 0.5 * (low + high), 2.0 / (high - low)
        for m, pump in enumerate(elements.pumps):
            if pump.pressure:
                ports[column[pump.pressure]] = 2, 2 * n + m
        actuators = [actuator.name for actuator in elements.actuators]
        pumps = [pump.name for pump in elements.pumps]
        sides = [(commands.index(v.extend), commands.index(v.retract) if v.retract else -1) for v in elements.valves]
        return GreyChannelMap(
            np.array(sides),
            np.array([actuators.index(v.actuator) for v in elements.valves]),
            np.array([pumps.index(v.supply) if v.supply else -1 for v in elements.valves]),
            ports,
            tuple(columns),
            (middle, scale),
            2 * n + len(pumps),
        )

    @property
    def whole(self) -> bool:
        """Whether every state of the load is measured."""
        return len(self.ports) == self.nodes + 2 * len(self.columns)


def turning_scales(elements: Elements, channels: TwinChannels, scales: TwinScales) -> TwinScales:
    """Return scales that do not bound the angles of motors, except those that influence the load.

    Bounds of a stroke are end stops: where the training data end, a cylinder stays. A motor has none.
    """
    names = [channel.name for channel in channels.velocities]
    low, high = scales.low.copy(), scales.high.copy()
    for motor in elements.motors:
        if channels.strokes and not motor.load_by_angle:
            column = len(names) + names.index(motor.velocity)
            low[column], high[column] = -FARTHEST_TURN, FARTHEST_TURN
    return replace(scales, low=low, high=high)
