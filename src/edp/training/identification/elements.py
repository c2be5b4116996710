"""The grey box of an excavator front: elements by the channels of the logs and the machine that is guessed."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from edp.data.roles import Axis, roles_of
from edp.data.twin_channels import TwinChannels
from edp.errors import ConfigError, DataError
from edp.networks.twin.grey.elements import CylinderElement, Elements, PumpElement, ValveElement
from edp.networks.twin.grey.known_linkage import KnownLinkage
from edp.networks.twin.greybox import GreyTwin
from edp.recording import Recording
from edp.signals import Channel, Kind
from edp.sim.machine.machine import Machine
from edp.sim.machine.machine_checks import CYLINDERS
from edp.training.identification.mapping import GreyParts
from edp.wording import typed

NO_MOTORS = (
    "the grey box has motors; a machine of the simulator has the cylinders of boom, arm and bucket alone: leave "
    "twin.motors out, and channels of motors out of the logs with [channels]"
)
BEYOND = 0.03
"""Share of a stroke that logs may lie beyond the machine's, and of its full pilot that commands may."""


def excavator_elements(channels: TwinChannels, machine: Machine) -> Elements:
    """Return cylinders with the machine's bores, one spool each, a second one if its commands are logged, two pumps.

    Raises:
        DataError: logs that do not show a front of three cylinders with strokes and both pressures of each.
    """
    every = channels.commands + channels.answers
    recording = Recording("", every, np.zeros((1, len(every)), np.float32), channels.rate_hz, "")
    axes = roles_of(recording).axes
    if len(axes) != len(CYLINDERS) or not channels.strokes:
        raise DataError(
            f"the logs show {len(axes)} cylinders{'' if channels.strokes else ' and no strokes'}; velocities and "
            f"strokes of three ({', '.join(CYLINDERS)}, in this order) must be logged: name them with --map"
        )
    for axis, name in zip(axes, CYLINDERS, strict=True):
        _check_axis(axis, name)
    pairs = (machine.valves.primary_pump, machine.valves.conflux_pump)
    own, cylinders, valves = machine.cylinders, [], []
    for i, (axis, name) in enumerate(zip(axes, CYLINDERS, strict=True)):
        head, rod = axis.pressures
        bore, thick, count = own.bore[i], own.rod[i], int(own.count[i])
        cylinders.append(
            CylinderElement(
                name=name, velocity=axis.velocity, head=head, rod=rod, bore=bore, rod_diameter=thick, count=count
            )
        )
        spools = [(name, axis.command, pairs[0][i], True), (f"{name}_conflux", axis.conflux, pairs[1][i], False)]
        valves += [
            ValveElement(
                name=title, actuator=name, extend=pair[0], retract=pair[1], supply=f"pump_{pump}", meter_out=first,
                regeneration=first,
            )
            for title, pair, pump, first in spools
            if pair
        ]  # fmt: skip
    used = {name for axis in axes for name in axis.pressures}
    lines = [channel.name for channel in channels.pressures if channel.name not in used]
    if len(lines) > 2:
        raise DataError(
            f"the logs have {len(lines)} pressures beside those of the cylinders ({', '.join(lines[:5])}); at most "
            "two, of the pumps, must hold: name the others in [channels], or leave them out with --map"
        )
    pumps = [PumpElement(name=f"pump_{m + 1}", pressure=[*lines, "", ""][m]) for m in range(2)]
    return Elements(tuple(pumps), tuple(cylinders), tuple(valves))


def _check_axis(axis: Axis, name: str) -> None:
    if len(axis.pressures) != 2:
        raise DataError(
            f"the logs have {len(axis.pressures)} pressures of the {name} cylinder; those of head and rod must be "
            "logged: without them openings, leakage and inertia cannot be told apart"
        )
    if len(axis.command) != 2:
        raise DataError(
            f"the logs have {len(axis.command)} commands of the {name} cylinder; pilot pressures of extension and "
            "retraction must be logged"
        )


def full_commands(channels: TwinChannels, elements: Elements, machine: Machine) -> list[float]:
    """Return the full-scale command of each valve in units of its channels.

    Raises:
        DataError: commands that are neither pilot pressures nor ratios.
    """
    kinds = {channel.name: channel.kind for channel in channels.commands}
    by_kind = {Kind.PILOT_PRESSURE: machine.valves.pilot_pressure, Kind.PRESSURE: machine.valves.pilot_pressure}
    by_kind[Kind.RATIO] = 1.0
    for valve in elements.valves:
        if kinds[valve.extend] not in by_kind:
            raise DataError(
                f"command '{valve.extend}' is of kind {kinds[valve.extend]}; the spools of a machine file are moved by "
                "pilot pressures or ratios: correct its kind with --map"
            )
    return [by_kind[kinds[valve.extend]] for valve in elements.valves]


def parts_of(twin: GreyTwin, machine: Machine, celsius: float) -> GreyParts:
    """Return the mapping from grey-box elements to machine parts.

    Raises:
        ConfigError: elements that are no excavator front, or pumps that are paired otherwise.
    """
    elements = twin.spec.elements(twin.channels)
    if elements.motors:
        raise ConfigError(NO_MOTORS)
    names = [cylinder.name for cylinder in elements.cylinders]
    if len(names) != len(CYLINDERS) or len(elements.pumps) != 2:
        raise ConfigError(
            f"the grey box has {len(names)} cylinders and {len(elements.pumps)} pumps; a machine of the simulator has "
            "three and two: identify from logs of an excavator front"
        )
    places = []
    for first, pairs in ((True, machine.valves.primary_pump), (False, machine.valves.conflux_pump)):
        row = []
        for i, name in enumerate(names):
            own = [j for j, v in enumerate(elements.valves) if v.actuator == name and v.meter_out == first]
            if len(own) > 1 or (first and not own):
                raise ConfigError(
                    f"the grey box has {len(own)} valves {'with' if first else 'without'} meter_out at cylinder "
                    f"'{name}'; a machine of the simulator has {'one' if first else 'at most one'}"
                )
            if own and elements.valves[own[0]].supply != elements.pumps[pairs[i] - 1].name:
                raise ConfigError(
                    f"valve '{elements.valves[own[0]].name}' is fed by '{elements.valves[own[0]].supply}', but by pump "
                    f"{pairs[i]} in machine {machine.name}; give a --machine with the same pumps"
                )
            row.append(own[0] if own else -1)
        places.append((row[0], row[1], row[2]))
    full = full_commands(twin.channels, elements, machine)
    reach = tuple(float(own) / whole for own, whole in zip(twin.full, full, strict=True))
    far = [j for j, share in enumerate(reach) if share > 1.0 + BEYOND]
    if far:
        raise ConfigError(
            f"commands of valve '{elements.valves[far[0]].name}' reach {typed(reach[far[0]], 3)} of the full pilot of "
            f"machine {machine.name} ({typed(full[far[0]])} in SI units); correct valves.pilot_pressure of --machine"
        )
    tick_s, steps = twin.time
    return GreyParts(twin.table, places[0], places[1], reach, celsius, tick_s / steps)


def check_strokes(channels: Sequence[Channel], low: np.ndarray, high: np.ndarray, machine: Machine) -> None:
    """Raise an error if the machine's cylinders do not match the logs.

    Raises:
        ConfigError: a stroke of the logs lies beyond the machine's; which, and by how much.
    """
    for i, (channel, name) in enumerate(zip(channels, CYLINDERS, strict=True)):
        stroke = machine.cylinders.stroke[i]
        if low[i] < -BEYOND * stroke or high[i] > (1.0 + BEYOND) * stroke:
            raise ConfigError(
                f"'{channel.name}' goes from {typed(low[i])} to {typed(high[i])} m in the logs, but the {name} "
                "cylinder of "
                f"machine {machine.name} from 0 to {typed(stroke)} m; give the --machine that was logged, with "
                "strokes "
                "measured from closed"
            )


def check_same_linkage(twin: GreyTwin, base: Machine, machine: str) -> None:
    """Raise an error if the known linkage of a grey box differs from the guess, whose lengths the bodies would get.

    Raises:
        ConfigError: pins or lengths that differ.
    """
    if twin.table.front is None:
        return
    own = KnownLinkage.read(machine, twin.spec.elements(twin.channels), twin.channels, twin.scales)
    if not np.allclose(own.values, twin.table.linkage, rtol=1e-4):
        raise ConfigError(
            f"--run: its grey box has the linkage of '{twin.spec.linkage[:80]}', which is not that of --machine "
            f"({base.name}): give the same machine, or leave --run out"
        )
