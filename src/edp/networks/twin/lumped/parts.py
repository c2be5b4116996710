"""Elements of small physical systems as named in a settings file, their connections and parameters."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edp.data.twin_channels import TwinChannels
from edp.errors import ConfigError, closest
from edp.networks.twin.parameters import Parameter
from edp.networks.twin.scales import TwinScales

Doubles = NDArray[np.float64]
MAX_ELEMENTS = 32
"""Maximum number of elements of one kind. All derivatives are computed in parallel, so twice the elements take four
times as long."""
ZERO = 0.04
"""Prior standard deviation of a level gauge's zero relative to the orifice, as a fraction of the highest level."""
LONGEST_NAME = 64
"""Maximum length of an element name. The name must fit a line of the datasheet."""


@dataclass(frozen=True, kw_only=True)
class TankElement:
    """A tank that is filled by a pump or by another tank, and leaves through an orifice and over its edge.

    Attributes:
        name: name of the tank, to which other tanks refer.
        source: channel that commands the pump, or name of the tank above.
        level: stroke of the twin that measures it; empty: a state that forms in the prefix.
    """

    name: str
    source: str
    level: str = ""


@dataclass(frozen=True, kw_only=True)
class MassElement:
    """A mass (or inertia) with a drive and friction.

    Attributes:
        name: name of the mass in reports.
        command: channel of the drive.
        velocity: channel.
    """

    name: str
    command: str
    velocity: str


@dataclass(frozen=True, kw_only=True)
class LagElement:
    """A pressure that follows a command with a lag of first order.

    Attributes:
        name: name of the lag in reports.
        command: channel.
        pressure: channel.
    """

    name: str
    command: str
    pressure: str


@dataclass(frozen=True)
class Parts:
    """The elements of a system."""

    tanks: tuple[TankElement, ...]
    masses: tuple[MassElement, ...]
    lags: tuple[LagElement, ...]


def default_parts(channels: TwinChannels) -> Parts:
    """Return a mass for each velocity and a lag for each pressure, driven by the commands in order."""
    commands = [channel.name for channel in channels.commands]

    def command(i: int) -> str:
        return commands[min(i, len(commands) - 1)]

    speeds = channels.velocities
    masses = tuple(MassElement(name=f"mass_{i + 1}", command=command(i), velocity=c.name) for i, c in enumerate(speeds))
    lags = tuple(
        LagElement(name=f"lag_{i + 1}", command=command(i), pressure=c.name) for i, c in enumerate(channels.pressures)
    )
    return Parts((), masses, lags)


def check_parts(parts: Parts, channels: TwinChannels) -> None:
    """Refuse elements that do not connect.

    Raises:
        ConfigError: which port of which element, and what is missing.
    """
    commands = [c.name for c in channels.commands]
    speeds, strokes = ([c.name for c in part] for part in (channels.velocities, channels.strokes))
    pressures = [c.name for c in channels.pressures]
    owner: dict[str, str] = {}
    names: set[str] = set()

    def port(element: str, which: str, name: str, choices: Sequence[str], what: str) -> None:
        if name not in choices:
            came = f"is '{name}', which is no {what}{closest(name, choices)}" if name else "is not connected"
            listed = ", ".join(choices) or "none (this twin has none)"
            raise ConfigError(f"elements: port '{which}' of {element} {came}; connect it to one of {listed}")

    def own(element: str, name: str) -> None:
        if name in owner:
            raise ConfigError(f"elements: '{name}' is connected to {owner[name]} and to {element}; one must hold")
        owner[name] = element

    every: list[TankElement | MassElement | LagElement] = [*parts.tanks, *parts.masses, *parts.lags]
    for entry in every:
        if not (entry.name.strip() and entry.name.isprintable() and len(entry.name) <= LONGEST_NAME):
            raise ConfigError(
                f"elements: the name {ascii(entry.name)[:80]} must be 1 to {LONGEST_NAME} printable characters; the "
                "datasheet shows it"
            )
        if entry.name in names:
            raise ConfigError(f"elements: two are called '{entry.name}'; give each a name of its own")
        names.add(entry.name)
    above: list[str] = []
    for tank in parts.tanks:
        here = f"tank '{tank.name}'"
        port(here, "source", tank.source, [*commands, *above], "command, and no tank named before it")
        above.append(tank.name)
        if tank.level:
            port(here, "level", tank.level, strokes, "stroke of this twin")
            own(here, speeds[strokes.index(tank.level)])
    for mass in parts.masses:
        here = f"mass '{mass.name}'"
        port(here, "command", mass.command, commands, "command of this twin")
        port(here, "velocity", mass.velocity, speeds, "velocity of this twin")
        own(here, mass.velocity)
    for lag in parts.lags:
        here = f"lag '{lag.name}'"
        port(here, "command", lag.command, commands, "command of this twin")
        port(here, "pressure", lag.pressure, pressures, "pressure of this twin")
        own(here, lag.pressure)
    for name in (*speeds, *pressures):
        if name not in owner:
            raise ConfigError(
                f"elements: no element has the channel '{name}'; connect it, or leave it out of [channels]"
            )


def lumped_parameters(parts: Parts, channels: TwinChannels, scales: TwinScales) -> list[Parameter]:
    """Return all parameters in a fixed order (tanks, masses, lags), with typical values from the channel scales."""
    answers = [c.name for c in channels.answers]
    commands = {c.name: float(w) for c, w in zip(channels.commands, scales.command_width, strict=True)}
    rows: list[Parameter] = []
    measured = [answers.index(tank.level) for tank in parts.tanks if tank.level]
    # Typical rate of a level: standard deviation of its changes per sample, relative to its own, times the sample rate.
    speed = [float(scales.change_width[i] / scales.answer_width[i]) * channels.rate_hz for i in measured]
    rate = float(np.mean(speed)) if speed else 0.1 * channels.rate_hz
    for tank in parts.tanks:
        first = tank.source in commands
        full = float(scales.high[answers.index(tank.level)]) if tank.level else 1.0
        rows += [
            Parameter(tank.name, "inflow", "1/s", 1.0, rate / (2.0 * commands[tank.source]) if first else rate, 1.0),
            Parameter(tank.name, "inflow_offset", "1", 1.0, 0.0, commands[tank.source], False)
            if first
            else Parameter(tank.name, "spilled_into", "1", 1.0, 0.7, 0.5),
            Parameter(tank.name, "outflow", "1/s", 1.0, rate, 1.0),
            Parameter(tank.name, "exponent", "1", 1.0, 0.5, 0.4),
            # The height of a tank with an unmeasured level is unknown, so its level is a fraction of the height.
            Parameter(tank.name, "edge", "m", 1.0, 1.03 * full, 0.1)
            if tank.level
            else Parameter(tank.name, "start", "1", 1.0, 0.6, 0.3),
            # A gauge reads zero somewhere near the orifice, not at it.
            *([Parameter(tank.name, "zero", "m", 1.0, 0.0, ZERO * full, False)] if tank.level else []),
        ]
    for mass in parts.masses:
        i = answers.index(mass.velocity)
        push = float(scales.answer_width[i]) * 2.0
        rows += [
            Parameter(mass.name, "gain", "m/s^2", 1.0, push / commands[mass.command], 1.0),
            Parameter(mass.name, "viscous", "1/s", 1.0, 2.0, 0.7),
            Parameter(mass.name, "viscous_asymmetry", "1", 1.0, 0.0, 0.2, False),
            Parameter(mass.name, "coulomb", "m/s^2", 1.0, 0.2 * push, 1.0),
            Parameter(mass.name, "offset", "m/s^2", 1.0, 0.0, 0.2 * push, False),
        ]
    for lag in parts.lags:
        i = answers.index(lag.pressure)
        wide = float(scales.answer_width[i])
        rows += [
            Parameter(lag.name, "gain", "Pa", 1.0, 0.0, wide / commands[lag.command], False),
            Parameter(lag.name, "offset", "Pa", 1.0, float(scales.answer_offset[i]), wide, False),
            Parameter(lag.name, "lag", "s", 1.0, 0.2, 1.0),
        ]
    return rows
