"""Mapping of FMU variables to commands, outputs and start values of an excavator, by name and unit."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from edp.control.fmu.description import FmuDescription, FmuVariable
from edp.control.model_batch import check_plant_channels
from edp.control.plant import PILOTS, STROKES
from edp.errors import ConfigError, DataError, closest
from edp.networks.twin.plant import FLAG
from edp.signals import VOCABULARY, Channel
from edp.storage.archives import printable

AHEAD = "_ahead_1"
"""Suffix of the name of an output one sample after the inputs, as in exported twins."""
START = "_start"
"""Suffix of a stroke's name for the parameter with its initial value."""
BASES: Mapping[str, Mapping[str, float]] = {
    "Pa": {"kg": 1, "m": -1, "s": -2},
    "m": {"m": 1},
    "m/s": {"m": 1, "s": -1},
    "m/s^2": {"m": 1, "s": -2},
    "rad": {"rad": 1},
    "rad/s": {"rad": 1, "s": -1},
}
"""SI base-unit exponents of units that an FMU may spell differently, such as N/m2."""


@dataclass(frozen=True, eq=False)
class FmuPorts:
    """Value references of an FMU as a plant.

    Attributes:
        commands: pilot pressures that it reads.
        answers: channels that it gives.
        inputs: value references of the commands.
        outputs: value references of the outputs.
        measured: inputs that take a measured value of each output, and their flags; empty where it has none.
        starts: parameters of the strokes at the start; empty where it has none.
    """

    commands: tuple[Channel, ...]
    answers: tuple[Channel, ...]
    inputs: tuple[int, ...]
    outputs: tuple[int, ...]
    measured: tuple[tuple[int, ...], tuple[int, ...]]
    starts: tuple[int, ...]


def ports_of(description: FmuDescription, where: str) -> FmuPorts:
    """Return the ports of an FMU.

    Args:
        description: description of the FMU.
        where: the FMU, for messages.

    Raises:
        ConfigError: it is no excavator of Table A.1.
        DataError: a variable has another unit or type.
    """
    variables = description.variables
    inputs = {name: entry for name, entry in variables.items() if entry.causality == "input"}
    outputs = {name: entry for name, entry in variables.items() if entry.causality == "output"}
    # In the order of the FMU, which for exported twins is that of the twin.
    plain_names = {name: name if name in VOCABULARY else name.removesuffix(AHEAD) for name in outputs}
    answers = {VOCABULARY[name]: outputs[own] for own, name in plain_names.items() if name in VOCABULARY}
    names = [channel.name for channel in answers]
    commands = {VOCABULARY[name]: inputs[name] for name in PILOTS if name in inputs}
    change = "give an FMU with variables of these names, such as edp export makes of a twin"
    # Other inputs, such as a load, keep what the FMU sets them to.
    if not commands:
        first = next(iter(inputs), "")
        raise ConfigError(
            f"{where} has no input of a pilot pressure, such as BmUp{closest(printable(first), PILOTS)}; {change}"
        )
    check_plant_channels(where, [channel.name for channel in commands], names, change)
    ports = [(inputs.get(name), inputs.get(name + FLAG)) for name in names]
    starts = [variables.get(name + START) for name in STROKES]
    measured = [(value, flag) for value, flag in ports if value is not None and flag is not None]
    for channel, entry in (*commands.items(), *answers.items()):
        _check_unit(channel, entry, where)
    for channel, (value, _) in zip(answers, measured if len(measured) == len(answers) else (), strict=False):
        _check_unit(channel, value, where)
    for name, start in zip(STROKES, starts, strict=True):
        if start is not None:
            _check_unit(VOCABULARY[name], start, where)
    fed = len(measured) == len(answers)
    return FmuPorts(
        tuple(commands),
        tuple(answers),
        tuple(entry.reference for entry in commands.values()),
        tuple(entry.reference for entry in answers.values()),
        (
            tuple(value.reference for value, _ in measured if fed),
            tuple(flag.reference for _, flag in measured if fed),
        ),
        tuple(start.reference for start in starts if start is not None) if all(starts) else (),
    )


def _check_unit(channel: Channel, entry: FmuVariable, where: str) -> None:
    """Raise an error unless a variable is a real number in the SI unit of its channel.

    Raises:
        DataError: it is not.
    """
    if not entry.real:
        raise DataError(
            f"{where}: variable '{printable(entry.name)}' is no real number of double precision; export it as one"
        )
    bases, expected = entry.bases, BASES.get(channel.unit)
    same = entry.unit in ("", channel.unit)
    if bases is not None:
        same = bases["factor"] == 1.0 and bases["offset"] == 0.0
        powers = {name: power for name, power in bases.items() if power and name not in ("factor", "offset")}
        same = same and (powers == expected if expected is not None else entry.unit == channel.unit)
    if not same:
        raise DataError(
            f"{where}: variable '{printable(entry.name)}' is in {printable(entry.unit)}; expected "
            f"{channel.unit}: export it in SI units"
        )
