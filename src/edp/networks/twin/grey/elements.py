"""Elements of a grey box, as named in a settings file or derived from names and kinds of channels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from edp.data.roles import roles_of_channels
from edp.data.twin_channels import TwinChannels
from edp.errors import ConfigError
from edp.settings.bounds import check_bounds, integer, span
from edp.signals import Channel, Kind
from edp.wording import setting_text


@dataclass(frozen=True, kw_only=True)
class PumpElement:
    """A pump with its line: flow by the levers, power limit, open centre, main relief.

    Attributes:
        name: name used by valves.
        pressure: channel of its line; empty: not measured.
    """

    name: str
    pressure: str = ""


@dataclass(frozen=True, kw_only=True)
class CylinderElement:
    """A cylinder with its load.

    Attributes:
        name: name used by valves.
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
                f"cylinder '{self.name}': rod_diameter = {setting_text(self.rod_diameter)} m is not below bore = "
                f"{setting_text(self.bore)} m"
            )

    @property
    def areas(self) -> tuple[float, float] | None:
        """Return the areas of head and rod side, m^2; None without a known bore."""
        if not self.bore:
            return None
        head = self.count * np.pi / 4 * self.bore**2
        return head, head - self.count * np.pi / 4 * self.rod_diameter**2

    @property
    def position(self) -> str:
        """Channel of its position; empty: not named."""
        return self.stroke

    @property
    def chambers(self) -> tuple[str, str]:
        """Channels of both chambers' pressures; empty: not measured."""
        return self.head, self.rod


@dataclass(frozen=True, kw_only=True)
class MotorElement:
    """A hydraulic motor with its load: chambers of constant volume, as much oil a radian on both sides, no end stops.

    A gear belongs to it: velocity, displacement and load are those of the shaft whose velocity is measured.

    Attributes:
        name: name used by valves.
        velocity: channel of its angular velocity, positive where oil goes from `a` to `b`.
        angle: channel of its angle; empty: the one of the velocity, where positions are measured.
        a: channel of the pressure at the port fed in positive direction; empty if not measured.
        b: channel of the pressure at the other port; empty if not measured.
        displacement: displacement of one motor, m^3/rad; 0 if unknown, to be fitted from its prior.
        count: number of motors on one shaft.
        load_by_angle: whether inertia and potential depend on the angle. The angle must then be measured and stays
            within the range of the training data. Otherwise the angle is unlimited, and no load depends on it.

    Raises:
        ConfigError: a size out of range.
    """

    name: str
    velocity: str
    angle: str = ""
    a: str = ""
    b: str = ""
    displacement: float = 0.0
    count: int = 1
    load_by_angle: bool = False

    def __post_init__(self) -> None:
        check_bounds(f"motor '{self.name}'", self, displacement=span(0.0, 10.0), count=integer(1, 100))

    @property
    def areas(self) -> tuple[float, float] | None:
        """Oil a radian of both sides, m^3/rad; None where the displacement is not known."""
        return (self.count * self.displacement,) * 2 if self.displacement else None

    @property
    def position(self) -> str:
        """Channel of its angle; empty: not named."""
        return self.angle

    @property
    def chambers(self) -> tuple[str, str]:
        """Channels of both ports' pressures; empty: not measured."""
        return self.a, self.b


Actuator = CylinderElement | MotorElement


@dataclass(frozen=True, kw_only=True)
class ValveElement:
    """A spool that connects a pump with a cylinder or a motor.

    Attributes:
        name: name for messages and tables.
        actuator: name of the cylinder or motor.
        extend: channel that commands extension (of a motor: positive turning), or both ways by its sign where `retract`
            is empty.
        retract: channel that commands retraction.
        supply: name of the pump; empty: a supply of constant pressure.
        meter_out: whether it opens the other chamber to the tank, too; a second spool may only feed.
        regeneration: whether a part of the outflow returns to the other chamber.
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
    """A machine: its pumps, cylinders, motors and valves, connected."""

    pumps: tuple[PumpElement, ...]
    cylinders: tuple[CylinderElement, ...]
    valves: tuple[ValveElement, ...]
    motors: tuple[MotorElement, ...] = ()

    @property
    def actuators(self) -> tuple[Actuator, ...]:
        """Cylinders, then motors: the order of the states."""
        return self.cylinders + self.motors

    @property
    def load_variables(self) -> tuple[int, ...]:
        """Actuators on whose positions inertia and potential depend."""
        return tuple(
            i for i, one in enumerate(self.actuators) if not isinstance(one, MotorElement) or one.load_by_angle
        )


def default_elements(channels: TwinChannels) -> Elements:
    """Return the elements derived from channels: a cylinder or motor per velocity, a spool per command.

    Raises:
        ConfigError: pressures that cannot be assigned to a chamber.
    """
    every = channels.commands + channels.answers
    names = {channel.name for channel in channels.answers}
    commands = tuple(channel.name for channel in channels.commands)
    roles = roles_of_channels(every)
    axes = {axis.velocity: axis for axis in roles.axes}
    actuators, valves, left = [], [], [c.name for c in channels.pressures]
    for i, velocity in enumerate(channels.velocities):
        axis = axes.get(velocity.name)
        name = axis.name if axis else velocity.name
        own = [p for p in (axis.pressures if axis else ()) if p in names]
        left = [p for p in left if p not in own]
        actuators.append(_actuator(name, velocity, own, bool(channels.strokes)))
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
            "[[twin.cylinders]], [[twin.motors]], [[twin.valves]] and [[twin.pumps]]"
        )
    pumps = tuple(PumpElement(name=f"pump_{m + 1}", pressure=name) for m, name in enumerate(left))
    return _assign_pumps(tuple(actuators), valves, second, pumps)


def _actuator(name: str, velocity: Channel, pressures: Sequence[str], angles: bool) -> Actuator:
    """Return a cylinder, or a motor for an angular velocity."""
    first, second = (*pressures, "", "")[:2]
    if velocity.kind is Kind.ANGULAR_VELOCITY:
        # A measured angle may belong to a joint with a gravity load, so the load depends on it.
        return MotorElement(name=name, velocity=velocity.name, a=first, b=second, load_by_angle=angles)
    return CylinderElement(name=name, velocity=velocity.name, head=first, rod=second)


def _assign_pumps(
    actuators: tuple[Actuator, ...],
    valves: Sequence[ValveElement],
    second: Sequence[ValveElement],
    pumps: tuple[PumpElement, ...],
) -> Elements:
    """Return the valves with their pumps: of two pumps, neighbouring spools take turns.

    And a second spool has the other pump.
    """
    cylinders = tuple(one for one in actuators if isinstance(one, CylinderElement))
    motors = tuple(one for one in actuators if isinstance(one, MotorElement))
    if not pumps:
        return Elements(pumps, cylinders, (*valves, *second), motors)
    turn = {actuator.name: i % len(pumps) for i, actuator in enumerate(actuators)}
    first = tuple(replace(v, supply=pumps[turn[v.actuator]].name) for v in valves)
    other = tuple(replace(v, supply=pumps[(turn[v.actuator] + 1) % len(pumps)].name) for v in second)
    return Elements(pumps, cylinders, first + other, motors)
