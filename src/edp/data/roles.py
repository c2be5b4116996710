"""Roles of channels: which channels command an axis and which show its response, by Table A.1 or by kind."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edp.errors import DataError, closest
from edp.recording import Recording
from edp.signals import Channel, Kind

Array = NDArray[np.float64]
COMMANDS = (Kind.PILOT_PRESSURE, Kind.CURRENT, Kind.VOLTAGE, Kind.RATIO)
"""Kinds of channels that can be commands, in order of preference."""
_TABLE_A1 = (
    ("boom", ("BmUp", "BmDwn"), ("BmUpConf", "BmDwnConf")),
    ("arm", ("AmIn", "AmOut"), ("AmInConf", "AmOutConf")),
    ("bucket", ("BktIn", "BktOut"), ("BktInConf", "BktOutConf")),
)


@dataclass(frozen=True)
class Axis:
    """One axis of motion and its channels; a missing channel is an empty name.

    Attributes:
        name: name for reports.
        command: command channels of the axis: extend and retract, one signed channel, or none.
        velocity: velocity of the axis, extension positive; if unknown, another signal that responds to the command.
        pressures: head and rod pressure, or as many as there are.
        stroke: position of the axis.
        conflux: channels that connect the second pump.
    """

    name: str
    command: tuple[str, ...] = ()
    velocity: str = ""
    pressures: tuple[str, ...] = ()
    stroke: str = ""
    conflux: tuple[str, ...] = ()

    def read_signed_command(self, recording: Recording) -> Array:
        """Return the command, extension positive, shape ``(time,)``."""
        return signed(recording, self.command)


def signed(recording: Recording, names: Sequence[str]) -> Array:
    """Return the first channel minus the second, if there is one, shape ``(time,)``."""
    values = recording.column(names[0]).astype(np.float64)
    return values - recording.column(names[1]) if len(names) > 1 else values


@dataclass(frozen=True)
class Roles:
    """The axes of a recording, and all channels that command."""

    axes: tuple[Axis, ...]
    inputs: tuple[str, ...]


def roles_of(recording: Recording, inputs: Sequence[str] = ()) -> Roles:
    """Return the axes of Table A.1 if a recording has its names, otherwise one axis per velocity channel.

    Args:
        recording: recording whose channels are searched.
        inputs: names of the command channels, required if neither name nor kind identifies them.

    Raises:
        DataError: no such input channel.
    """
    for name in inputs:
        if name not in (names := recording.channel_names):
            raise DataError(f"input '{name}' is not a channel of '{recording.name}'{closest(name, names)}")
    return roles_of_channels(recording.channels, inputs)


def roles_of_channels(channels: Sequence[Channel], inputs: Sequence[str] = ()) -> Roles:
    """Return the roles of channels given without values; `inputs` names the commands."""
    names = [channel.name for channel in channels]
    table_axes = [] if inputs else [axis for i in range(3) if (axis := _find_table_axis(i, names)) is not None]
    if table_axes:
        return Roles(tuple(table_axes), tuple(name for axis in table_axes for name in axis.command))
    return _find_axes_by_kind(channels, tuple(inputs))


def _find_table_axis(i: int, names: Sequence[str]) -> Axis | None:
    title, command, conflux = _TABLE_A1[i]

    def there(*candidates: str) -> tuple[str, ...]:
        return tuple(name for name in candidates if name in names)

    axis = Axis(
        title,
        there(*command) if set(command) <= set(names) else (),
        "".join(there(f"CylVels_{i + 1}")),
        there(f"CylPressures_{i + 1}", f"CylPressures_{i + 5}"),
        "".join(there(f"CylStroke_{i + 1}")),
        there(*conflux) if set(conflux) <= set(names) else (),
    )
    return axis if axis.command or axis.velocity else None


def _find_axes_by_kind(channels: Sequence[Channel], inputs: tuple[str, ...]) -> Roles:
    """Create an axis for each velocity.

    Commands, pressures and positions are assigned in order if their counts match.
    """
    kinds = {channel.name: channel.kind for channel in channels}

    def select(*accepted: Kind) -> list[str]:
        return [name for name, kind in kinds.items() if kind in accepted and name not in inputs]

    commands = list(inputs) or next((of_kind for kind in COMMANDS if (of_kind := select(kind))), [])
    speeds = select(Kind.VELOCITY) or select(Kind.ANGULAR_VELOCITY) or (select(Kind.GENERIC) if commands else [])
    places, pressures = select(Kind.POSITION) or select(Kind.ANGLE), select(Kind.PRESSURE)
    count = max(len(speeds), min(len(commands), 1))
    # Two pilot pressures for each velocity are the two sides of a spool.
    one_sided = len(commands) == 2 * count and all(kinds[name] == Kind.PILOT_PRESSURE for name in commands)

    def command(i: int) -> tuple[str, ...]:
        if one_sided:
            return tuple(commands[2 * i : 2 * i + 2])
        return tuple(commands[i : i + 1] if len(commands) == count else commands[:1])

    # Head and rod pressure at most; more pressures an axis cannot be assigned by order.
    each = min(len(pressures) // count, 2) if count and len(pressures) % count == 0 else 0
    axes = tuple(
        Axis(
            speeds[i] if speeds else commands[0],
            command(i),
            speeds[i] if speeds else "",
            tuple(pressures[i * each : (i + 1) * each]),
            places[i] if len(places) == count else "",
        )
        for i in range(count)
    )
    return Roles(axes, tuple(commands))
