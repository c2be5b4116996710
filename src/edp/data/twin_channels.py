"""Channels of a plant model for free-run simulation: commands, and the simulated velocities, strokes and pressures.

The roles of the channels come from names and kinds (`edp.data.roles`) or from settings, for any number of actuators.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, fields

from edp.data.features import FeatureSet
from edp.data.roles import roles_of
from edp.data.task import TargetMode, Task
from edp.errors import ConfigError, DataError
from edp.recording import Recording
from edp.settings.bounds import MAX_NAMES, check_count
from edp.signals import Channel, Kind

INTEGRAL = {Kind.VELOCITY: Kind.POSITION, Kind.ANGULAR_VELOCITY: Kind.ANGLE}
"""Kind of the integral of a velocity, by the kind of the velocity."""


@dataclass(frozen=True, kw_only=True)
class TwinChannelSettings:
    """Names of channels by their part; a part that is left empty follows from names and kinds of the recordings.

    Attributes:
        commands: commands of operator or controller; by default pilot pressures, else currents, voltages, ratios.
        velocities: one for each actuator; by default every velocity.
        strokes: position of each of these axes, in the same order; by default the positions that match the velocities.
        pressures: pressures of chambers and pumps; by default every pressure that is not a command.

    Raises:
        ConfigError: a name twice, or too many.
    """

    commands: tuple[str, ...] = ()
    velocities: tuple[str, ...] = ()
    strokes: tuple[str, ...] = ()
    pressures: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for entry in fields(self):
            check_count("channels", entry.name, getattr(self, entry.name), MAX_NAMES)
        counts = Counter(name for entry in fields(self) for name in getattr(self, entry.name))
        twice = sorted(name for name, count in counts.items() if count > 1)
        if twice:
            raise ConfigError(f"channels: {', '.join(twice)} is named twice; each channel has one part in a twin")


@dataclass(frozen=True)
class TwinChannels:
    """Channels by role; outputs are ordered velocities, strokes, pressures.

    Attributes:
        commands: command channels that are read in each sample.
        velocities: velocities of the actuators.
        strokes: positions of all actuators in the order of the velocities, or none.
        pressures: pressures of chambers and pumps.
        rate_hz: samples per second.

    Raises:
        ConfigError: no command, no velocity, or strokes that are not the integrals of the velocities.
    """

    commands: tuple[Channel, ...]
    velocities: tuple[Channel, ...]
    strokes: tuple[Channel, ...]
    pressures: tuple[Channel, ...]
    rate_hz: float

    def __post_init__(self) -> None:
        if not self.commands or not self.velocities:
            missing = "commands" if not self.commands else "velocities"
            raise ConfigError(
                f"channels: a twin has no {missing}; name them in the settings, channels.{missing} = [...]"
            )
        wrong = [c for c in self.velocities if c.kind not in INTEGRAL and c.kind is not Kind.GENERIC]
        if wrong:
            raise ConfigError(
                f"channels: '{wrong[0].name}' is of kind {wrong[0].kind}; {', '.join(INTEGRAL)} or generic must hold: "
                "correct its kind in the signal map (velocity for a speed in any unit, generic for whatever else shall "
                "be answered with and is no position or pressure), or name other velocities"
            )
        wrong = [c for c in self.pressures if c.kind not in (Kind.PRESSURE, Kind.PILOT_PRESSURE)]
        if wrong:
            raise ConfigError(f"channels: '{wrong[0].name}' is of kind {wrong[0].kind}; a pressure must hold")
        expected = [INTEGRAL.get(channel.kind, Kind.GENERIC) for channel in self.velocities]
        if self.strokes and [channel.kind for channel in self.strokes] != expected:
            names = ", ".join(f"{channel.name} ({channel.kind})" for channel in self.strokes)
            raise ConfigError(
                f"channels: strokes are {names}; one for each velocity, in their order, must hold, of the kinds "
                f"{', '.join(expected)}: name them in the table [channels]"
            )

    @property
    def answers(self) -> tuple[Channel, ...]:
        """Output channels of the twin: velocities, then strokes, then pressures."""
        return self.velocities + self.strokes + self.pressures

    @property
    def parts(self) -> dict[str, slice]:
        """Column ranges of the outputs by type: velocities, strokes, pressures; a range may be empty."""
        first, second = len(self.velocities), len(self.velocities) + len(self.strokes)
        return {"velocities": slice(0, first), "strokes": slice(first, second), "pressures": slice(second, None)}

    def task(self) -> Task:
        """Return a task with commands as inputs and outputs one sample later as targets, to cut recordings."""
        commands = FeatureSet("commands", tuple(channel.name for channel in self.commands))
        names = tuple(channel.name for channel in self.answers)
        return Task(commands, names, (1,), TargetMode.ABSOLUTE, self.rate_hz)


def twin_channels(recording: Recording, settings: TwinChannelSettings | None = None) -> TwinChannels:
    """Return the channels of a recording by role.

    Args:
        recording: recording whose channel names and kinds are searched.
        settings: channel names, required if the kinds do not identify the channels.

    Raises:
        DataError: a named channel is not recorded.
        ConfigError: a part that nothing fills, or kinds that do not fit.
    """
    chosen = settings or TwinChannelSettings()

    def find_channels(names: Sequence[str]) -> tuple[Channel, ...]:
        return tuple(recording.channels[recording.index(name)] for name in names)

    roles = roles_of(recording, chosen.commands)
    # The second pump's pilot pressures are also commands, because the lever decides which actuator gets the oil.
    commands = chosen.commands or roles.inputs + tuple(name for axis in roles.axes for name in axis.conflux)
    axes = [axis for axis in roles.axes if axis.velocity]
    velocities = chosen.velocities or tuple(axis.velocity for axis in axes)
    strokes = chosen.strokes or _strokes(velocities, {axis.velocity: axis.stroke for axis in axes})
    pressures = chosen.pressures or tuple(
        c.name for c in recording.channels if c.kind is Kind.PRESSURE and c.name not in commands
    )
    return TwinChannels(
        find_channels(commands),
        find_channels(velocities),
        find_channels(strokes),
        find_channels(pressures),
        recording.rate_hz,
    )


def _strokes(velocities: Sequence[str], by_velocity: dict[str, str]) -> tuple[str, ...]:
    """Return the stroke of each velocity; empty unless every velocity has one."""
    strokes = tuple(by_velocity.get(name, "") for name in velocities)
    return strokes if all(strokes) else ()


def same_channels(channels: TwinChannels, recording: Recording) -> None:
    """Refuse a recording that lacks a channel, or measures it as another kind.

    Raises:
        DataError: names the channel and both kinds.
    """
    for channel in channels.commands + channels.answers:
        kind = recording.channels[recording.index(channel.name)].kind
        if kind is not channel.kind:
            raise DataError(
                f"recording '{recording.name}' ({recording.source}): channel '{channel.name}' is of kind {kind}, the "
                f"twin was trained on {channel.kind}; correct the signal map"
            )
