"""Groups of channels that are monitored together, and the inputs excluded for each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from edp.signals import EXTRA_CHANNELS, FAULT_CHANNELS, GROUND_CHANNELS, MOTOR_CHANNELS, TABLE_A1, Channel, Kind

SENSED = ("PumpPressure_1", "PumpPressure_2", "CylStroke_1", "CylStroke_2", "CylStroke_3", "OilTemperature")
"""Channels of `EXTRA_CHANNELS` for which a real machine may have sensors. The others exist only in simulation."""
MOTION = (Kind.VELOCITY, Kind.ACCELERATION, Kind.POSITION)
TURNING = (Kind.ANGULAR_VELOCITY, Kind.ANGLE)
MAX_SINGLE = 24
"""Maximum number of channels for one group per channel. With more channels, each kind is a group."""


@dataclass(frozen=True)
class Group:
    """Channels that are monitored together.

    Attributes:
        name: name for messages.
        judged: the channels.
        unread: channels that would tell what is evaluated and must not be read, those that are evaluated left out.
    """

    name: str
    judged: tuple[str, ...]
    unread: tuple[str, ...] = ()


def select_sensed(channels: Sequence[Channel]) -> tuple[Channel, ...]:
    """Return the channels that sensors can give: without truth of a simulation."""
    truth = {*EXTRA_CHANNELS, *GROUND_CHANNELS, *MOTOR_CHANNELS, *FAULT_CHANNELS} - {*SENSED}
    return tuple(channel for channel in channels if channel.name not in truth)


def groups_of(channels: Sequence[Channel]) -> tuple[Group, ...]:
    """Return the groups by Table A.1; for other machines one per channel, or per kind if there are many."""
    names = {channel.name for channel in channels}
    if len(names & {*TABLE_A1}) >= 9:
        return _excavator_groups(names)
    if len(channels) <= MAX_SINGLE:
        return tuple(Group(channel.name, (channel.name,)) for channel in channels)
    kinds = list(dict.fromkeys(channel.kind for channel in channels))
    return tuple(Group(str(kind), tuple(c.name for c in channels if c.kind is kind)) for kind in kinds)


def _excavator_groups(names: set[str]) -> tuple[Group, ...]:
    """Return the velocities, head pressures, rod pressures, pump pressures, pilots."""
    numbers = range(1, 4)
    velocities = tuple(f"CylVels_{n}" for n in numbers)
    shadows = (*(f"CylAcc_{n}" for n in numbers), *(f"CylStroke_{n}" for n in numbers))
    groups = (
        Group("velocities", velocities, shadows),
        Group("head pressures", tuple(f"CylPressures_{n}" for n in numbers)),
        Group("rod pressures", tuple(f"CylPressures_{n + 4}" for n in numbers)),
        Group("pump pressures", ("PumpPressure_1", "PumpPressure_2")),
        Group("pilot pressures", tuple(TABLE_A1)[12:18], ()),
        Group("conflux pilot pressures", tuple(TABLE_A1)[18:], ()),
    )
    present = (
        Group(g.name, tuple(n for n in g.judged if n in names), tuple(n for n in g.unread if n in names))
        for g in groups
    )
    return tuple(group for group in present if group.judged)
