"""Whether the elements of a grey box connect: every port to a channel or an element of its kind, every channel once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from edp.data.twin_channels import TwinChannels
from edp.errors import ConfigError, closest
from edp.networks.twin.grey.elements import Actuator, CylinderElement, Elements, MotorElement
from edp.signals import Channel, Kind


def check_elements(elements: Elements, channels: TwinChannels) -> None:
    """Refuse elements that do not connect.

    Raises:
        ConfigError: which port of which element, and what is missing.
    """
    pressures = _names(channels.pressures)
    _check_names(elements)
    ports = _Ports()
    for pump in elements.pumps:
        here = f"pump '{pump.name}'"
        ports.connect(here, "pressure", pump.pressure, pressures, "pressure", False)
        ports.claim(here, "pressure", pump.pressure)
    for actuator in elements.actuators:
        _check_actuator(actuator, channels, ports)
    commands = _names(channels.commands)
    for valve in elements.valves:
        here = f"valve '{valve.name}'"
        actuators = [one.name for one in elements.actuators]
        what = "cylinder or motor" if elements.motors else "cylinder"
        ports.connect(here, "actuator", valve.actuator, actuators, what, True)
        ports.connect(here, "supply", valve.supply, [p.name for p in elements.pumps], "pump", False)
        ports.connect(here, "extend", valve.extend, commands, "command", True)
        ports.connect(here, "retract", valve.retract, commands, "command", False)
    for actuator in elements.actuators:
        if not any(valve.actuator == actuator.name for valve in elements.valves):
            raise ConfigError(
                f"grey box: {_title(actuator)} has no valve; give one with this name at its port 'actuator'"
            )
    for name in (*_names(channels.velocities), *pressures):
        if name not in ports.used:
            raise ConfigError(
                f"grey box: no element has the channel '{name}'; connect it, or leave it out of [channels]"
            )


@dataclass(frozen=True)
class _Ports:
    """Ports that are connected; `used`: by each channel that an element has for its own."""

    used: dict[str, str] = field(default_factory=dict)

    def connect(self, element: str, which: str, name: str, choices: Sequence[str], what: str, needed: bool) -> None:
        """Refuse a port that leads nowhere."""
        if name in choices or (not name and not needed):
            return
        came = f"is '{name}', which is no {what} of this twin{closest(name, choices)}" if name else "is not connected"
        raise ConfigError(
            f"grey box: port '{which}' of {element} {came}; connect it to one of "
            f"{', '.join(choices) or 'none (this twin has none)'}"
        )

    def claim(self, element: str, which: str, name: str) -> None:
        """Refuse a channel that two ports have."""
        if name and name in self.used:
            raise ConfigError(f"grey box: '{name}' is connected to {self.used[name]} and to {element}, port '{which}'")
        self.used[name] = element


def _check_names(elements: Elements) -> None:
    kinds = (("pump", elements.pumps), ("actuator", elements.actuators), ("valve", elements.valves))
    for kind, entries in kinds:
        names = [entry.name for entry in entries]
        twice = [name for name in names if names.count(name) > 1]
        if twice:
            kind = "cylinder" if kind == "actuator" and not elements.motors else kind
            raise ConfigError(f"grey box: two elements of kind {kind} are called '{twice[0]}'")


def _check_actuator(actuator: Actuator, channels: TwinChannels, ports: _Ports) -> None:
    """Check that an actuator has its own ports and that its velocity has the right kind."""
    here = _title(actuator)
    cylinder = isinstance(actuator, CylinderElement)
    position, first, second = ("stroke", "head", "rod") if cylinder else ("angle", "a", "b")
    velocities, strokes, pressures = map(_names, (channels.velocities, channels.strokes, channels.pressures))
    ports.connect(here, "velocity", actuator.velocity, velocities, "velocity", True)
    which = velocities.index(actuator.velocity)
    _check_kind(actuator, channels.velocities[which])
    ports.connect(here, position, actuator.position, strokes, "stroke" if cylinder else "position", False)
    if actuator.position and actuator.position != strokes[which]:
        raise ConfigError(
            f"grey box: port '{position}' of {here} is '{actuator.position}', but the position of its velocity "
            f"'{actuator.velocity}' is '{strokes[which]}'; name velocities and strokes in the same order in [channels]"
        )
    if isinstance(actuator, MotorElement) and actuator.load_by_angle and not strokes:
        raise ConfigError(
            f"grey box: the load of {here} is to depend on its angle, but this twin has no strokes; name them in "
            "channels.strokes, or leave load_by_angle out"
        )
    chambers = zip((first, second), actuator.chambers, strict=True)
    for port, name in (("velocity", actuator.velocity), (position, actuator.position), *chambers):
        if port in (first, second):
            ports.connect(here, port, name, pressures, "pressure", False)
        ports.claim(here, port, name)


def _check_kind(actuator: Actuator, velocity: Channel) -> None:
    """Check that a cylinder has a linear velocity and a motor an angular velocity."""
    cylinder = isinstance(actuator, CylinderElement)
    needed, other = (Kind.VELOCITY, "[[twin.motors]]") if cylinder else (Kind.ANGULAR_VELOCITY, "[[twin.cylinders]]")
    if velocity.kind is not needed:
        raise ConfigError(
            f"grey box: port 'velocity' of {_title(actuator)} is '{velocity.name}' of kind {velocity.kind} "
            f"({velocity.unit}); {needed} must hold: name the element in {other}, or correct the kind in the signal map"
        )


def _title(actuator: Actuator) -> str:
    return f"{'cylinder' if isinstance(actuator, CylinderElement) else 'motor'} '{actuator.name}'"


def _names(channels: Sequence[Channel]) -> list[str]:
    return [channel.name for channel in channels]
