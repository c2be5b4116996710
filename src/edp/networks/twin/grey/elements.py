"""Elements of which a grey box is made, as a settings file names them, and how they are connected."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from edp.data.roles import roles_of
from edp.data.twin_channels import TwinChannels
from edp.errors import ConfigError, closest
from edp.recording import Recording
from edp.settings.bounds import check_bounds, integer, span


@dataclass(frozen=True, kw_only=True)
class PumpElement:
    """A pump with its line: flow by the levers, power limit, open centre, main relief.

    Attributes:
        name: that valves call it by.
        pressure: channel of its line; empty: not measured.
    """

    name: str
    pressure: str = ""


@dataclass(frozen=True, kw_only=True)
class CylinderElement:
    """A cylinder with its load.

    Attributes:
        name: that valves call it by.
        velocity: channel, extension positive.
        stroke: channel of its position; empty: the one of the velocity, where strokes are measured.
        head: channel of the head chamber's pressure; empty: not measured.
        rod: channel of the rod chamber's pressure; empty: not measured.
        bore: diameter, m; 0: not known, learned from a plausible one.
        rod_diameter: m; 0: not known.
        count: cylinders side by side.

    Raises:
        ConfigError: a size out of range, or a rod as thick as the bore.
    """

    name: str
    velocity: str
    stroke: str = ""
    head: str = ""
    rod: str = ""
    bore: float = 0.0
    rod_diameter: float = 0.0
    count: int = 1

    def __post_init__(self) -> None:
        size = span(0.0, 10.0)
        check_bounds(f"cylinder '{self.name}'", self, bore=size, rod_diameter=size, count=integer(1, 100))
        if self.bore and self.rod_diameter >= self.bore:
            raise ConfigError(
                f"cylinder '{self.name}': rod_diameter = {self.rod_diameter:g} m is not below bore = {self.bore:g} m"
            )

    @property
    def areas(self) -> tuple[float, float] | None:
        """Of head and rod side, m^2; None where the bore is not known."""
        if not self.bore:
            return None
        head = self.count * np.pi / 4 * self.bore**2
        return head, head - self.count * np.pi / 4 * self.rod_diameter**2


@dataclass(frozen=True, kw_only=True)
class ValveElement:
    """A spool that connects a pump with a cylinder.

    Attributes:
        name: for readers.
        actuator: name of the cylinder.
        extend: channel that commands extension, or both ways by its sign where `retract` is empty.
        retract: channel that commands retraction.
        supply: name of the pump; empty: a supply of constant pressure.
        meter_out: whether it opens the other chamber to the tank, too; a second spool may only feed.
        regeneration: whether a part of what leaves goes to the other chamber.
    """

    name: str
    actuator: str
    extend: str
    retract: str = ""
    supply: str = ""
    meter_out: bool = True
    regeneration: bool = True


@dataclass(frozen=True)
class Elements:
    """A machine: its pumps, cylinders and valves, connected."""

    pumps: tuple[PumpElement, ...]
    cylinders: tuple[CylinderElement, ...]
    valves: tuple[ValveElement, ...]


def default_elements(channels: TwinChannels) -> Elements:
    """What names and kinds of the channels say: a cylinder for each velocity, a spool for each command of it.

    Raises:
        ConfigError: pressures whose place they do not tell.
    """
    every = channels.commands + channels.answers
    names = {channel.name for channel in channels.answers}
    recording = Recording("", every, np.zeros((1, len(every)), np.float32), channels.rate_hz, "")
    commands = tuple(channel.name for channel in channels.commands)
    roles = roles_of(recording)
    axes = {axis.velocity: axis for axis in roles.axes}
    cylinders, valves, left = [], [], [c.name for c in channels.pressures]
    for i, velocity in enumerate(channels.velocities):
        axis = axes.get(velocity.name)
        name = axis.name if axis else velocity.name
        own = [p for p in (axis.pressures if axis else ()) if p in names]
        left = [p for p in left if p not in own]
        head, rod = (*own, "", "")[:2]
        cylinders.append(CylinderElement(name=name, velocity=velocity.name, head=head, rod=rod))
        command = tuple(c for c in (axis.command if axis else ()) if c in commands)
        command = command or commands[i : i + 1] or commands[:1]
        valves.append(ValveElement(name=name, actuator=name, extend=command[0], retract=(*command, "")[1]))
    second = [
        ValveElement(
            name=f"{axis.name}_conflux", actuator=axis.name, extend=axis.conflux[0], retract=axis.conflux[1],
            meter_out=False,
        )
        for axis in roles.axes
        if axis.velocity and len(axis.conflux) == 2 and set(axis.conflux) <= set(commands)
    ]  # fmt: skip
    if len(left) > 2:
        raise ConfigError(
            f"grey box: nothing tells which element has the pressure '{left[0]}'; name all elements in the tables "
            "[[twin.cylinders]], [[twin.valves]] and [[twin.pumps]]"
        )
    pumps = tuple(PumpElement(name=f"pump_{m + 1}", pressure=name) for m, name in enumerate(left))
    return _paired(tuple(cylinders), valves, second, pumps)


def _paired(
    cylinders: tuple[CylinderElement, ...],
    valves: Sequence[ValveElement],
    second: Sequence[ValveElement],
    pumps: tuple[PumpElement, ...],
) -> Elements:
    """Valves with their pumps: of two pumps, neighbouring spools take turns, and a second spool has the other pump."""
    if not pumps:
        return Elements(pumps, cylinders, (*valves, *second))
    turn = {cylinder.name: i % len(pumps) for i, cylinder in enumerate(cylinders)}
    first = tuple(replace(v, supply=pumps[turn[v.actuator]].name) for v in valves)
    other = tuple(replace(v, supply=pumps[(turn[v.actuator] + 1) % len(pumps)].name) for v in second)
    return Elements(pumps, cylinders, first + other)


def check_elements(elements: Elements, channels: TwinChannels) -> None:
    """Refuse elements that do not connect.

    Raises:
        ConfigError: which port of which element, and what is missing.
    """
    commands = [c.name for c in channels.commands]
    parts = {
        "velocity": [c.name for c in channels.velocities],
        "stroke": [c.name for c in channels.strokes],
        "pressure": [c.name for c in channels.pressures],
    }
    used: dict[str, str] = {}

    def port(element: str, which: str, name: str, choices: Sequence[str], what: str, needed: bool) -> None:
        if not name and not needed:
            return
        if name not in choices:
            came = (
                f"is '{name}', which is no {what} of this twin{closest(name, choices)}" if name else "is not connected"
            )
            raise ConfigError(
                f"grey box: port '{which}' of {element} {came}; connect it to one of "
                f"{', '.join(choices) or 'none (this twin has none)'}"
            )

    def own(element: str, which: str, name: str) -> None:
        if name and name in used:
            raise ConfigError(f"grey box: '{name}' is connected to {used[name]} and to {element}, port '{which}'")
        used[name] = element

    for kind, entries in (("pump", elements.pumps), ("cylinder", elements.cylinders), ("valve", elements.valves)):
        names = [entry.name for entry in entries]
        twice = [name for name in names if names.count(name) > 1]
        if twice:
            raise ConfigError(f"grey box: two elements of kind {kind} are called '{twice[0]}'")
    for pump in elements.pumps:
        port(f"pump '{pump.name}'", "pressure", pump.pressure, parts["pressure"], "pressure", False)
        own(f"pump '{pump.name}'", "pressure", pump.pressure)
    for cylinder in elements.cylinders:
        here = f"cylinder '{cylinder.name}'"
        port(here, "velocity", cylinder.velocity, parts["velocity"], "velocity", True)
        port(here, "stroke", cylinder.stroke, parts["stroke"], "stroke", False)
        for which in ("velocity", "stroke", "head", "rod"):
            if which in ("head", "rod"):
                port(here, which, getattr(cylinder, which), parts["pressure"], "pressure", False)
            own(here, which, getattr(cylinder, which))
    for valve in elements.valves:
        here = f"valve '{valve.name}'"
        port(here, "actuator", valve.actuator, [c.name for c in elements.cylinders], "cylinder", True)
        port(here, "supply", valve.supply, [p.name for p in elements.pumps], "pump", False)
        port(here, "extend", valve.extend, commands, "command", True)
        port(here, "retract", valve.retract, commands, "command", False)
    for cylinder in elements.cylinders:
        if not any(valve.actuator == cylinder.name for valve in elements.valves):
            raise ConfigError(
                f"grey box: cylinder '{cylinder.name}' has no valve; give one with this name at its port 'actuator'"
            )
    for name in (*parts["velocity"], *parts["pressure"]):
        if name not in used:
            raise ConfigError(
                f"grey box: no element has the channel '{name}'; connect it, or leave it out of [channels]"
            )
