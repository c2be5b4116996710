"""Channels, their kinds and units, the built-in names of Table A.1, and maps from anyone's columns to channels."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from edp.errors import ConfigError, closest
from edp.settings.bounds import shown
from edp.wording import setting_text, typed

Number = TypeVar("Number", float, NDArray[np.floating])


class Kind(StrEnum):
    """Physical quantity of a channel; it determines the SI unit, the scaler and the plausibility limits."""

    VELOCITY = "velocity"
    ACCELERATION = "acceleration"
    POSITION = "position"
    PRESSURE = "pressure"
    PILOT_PRESSURE = "pilot_pressure"
    ANGLE = "angle"
    ANGULAR_VELOCITY = "angular_velocity"
    FORCE = "force"
    FLOW = "flow"
    MASS = "mass"
    TEMPERATURE = "temperature"
    VOLTAGE = "voltage"
    CURRENT = "current"
    RATIO = "ratio"
    GENERIC = "generic"


@dataclass(frozen=True)
class KindFacts:
    """SI unit, unit of reports with its factor, plausible SI limits, nominal SI size.

    Values (`to_report`) have the offset of the unit of reports, such as that of degrees Celsius. Differences have none:
    errors, standard deviations, noise and widths of intervals are multiplied by `report_factor` alone.
    """

    si_unit: str
    report_unit: str
    report_factor: float
    plausible: tuple[float, float]
    nominal: float
    bounded: bool = False

    @property
    def report_offset(self) -> float:
        """Offset of the unit of reports, see `display_offset`."""
        return display_offset(self.report_unit)

    def to_report(self, value: Number) -> Number:
        """Return a value, not a difference, in the unit of reports; `value` is in SI units."""
        return value * self.report_factor + self.report_offset

    def from_report(self, value: Number) -> Number:
        """Return a value, not a difference, in SI units; `value` is in the unit of reports."""
        return (value - self.report_offset) / self.report_factor


_INF = float("inf")
KINDS: Mapping[Kind, KindFacts] = {
    Kind.VELOCITY: KindFacts("m/s", "mm/s", 1e3, (-5.0, 5.0), 0.1),
    Kind.ACCELERATION: KindFacts("m/s^2", "m/s^2", 1.0, (-500.0, 500.0), 1.0),
    Kind.POSITION: KindFacts("m", "mm", 1e3, (-50.0, 50.0), 1.0, bounded=True),
    Kind.PRESSURE: KindFacts("Pa", "bar", 1e-5, (-2e5, 1e8), 1e7),
    Kind.PILOT_PRESSURE: KindFacts("Pa", "bar", 1e-5, (-2e5, 1e7), 2e6),
    Kind.ANGLE: KindFacts("rad", "deg", 57.29577951308232, (-100.0, 100.0), 1.0, bounded=True),
    Kind.ANGULAR_VELOCITY: KindFacts("rad/s", "deg/s", 57.29577951308232, (-2100.0, 2100.0), 0.2),
    Kind.FORCE: KindFacts("N", "kN", 1e-3, (-1e7, 1e7), 1e5),
    Kind.FLOW: KindFacts("m^3/s", "L/min", 6e4, (-1.0, 1.0), 3e-3),
    Kind.MASS: KindFacts("kg", "kg", 1.0, (-1e5, 1e6), 1e3),
    Kind.TEMPERATURE: KindFacts("K", "degC", 1.0, (200.0, 500.0), 20.0),
    Kind.VOLTAGE: KindFacts("V", "V", 1.0, (-1e3, 1e3), 1.0),
    Kind.CURRENT: KindFacts("A", "A", 1.0, (-1e3, 1e3), 1.0),
    Kind.RATIO: KindFacts("1", "1", 1.0, (-1e6, 1e6), 1.0, bounded=True),
    Kind.GENERIC: KindFacts("1", "1", 1.0, (-_INF, _INF), 1.0),
}


@dataclass(frozen=True)
class Unit:
    """SI value = value * factor + offset."""

    kinds: tuple[Kind, ...]
    factor: float
    offset: float = 0.0


_PRESSURES = (Kind.PRESSURE, Kind.PILOT_PRESSURE)
UNITS: Mapping[str, Unit] = {
    "m/s": Unit((Kind.VELOCITY,), 1.0),
    "cm/s": Unit((Kind.VELOCITY,), 1e-2),
    "in/s": Unit((Kind.VELOCITY,), 0.0254),
    "mm/s": Unit((Kind.VELOCITY,), 1e-3),
    "m/s^2": Unit((Kind.ACCELERATION,), 1.0),
    "mm/s^2": Unit((Kind.ACCELERATION,), 1e-3),
    "g": Unit((Kind.ACCELERATION,), 9.80665),
    "m": Unit((Kind.POSITION,), 1.0),
    "cm": Unit((Kind.POSITION,), 1e-2),
    "in": Unit((Kind.POSITION,), 0.0254),
    "mm": Unit((Kind.POSITION,), 1e-3),
    "Pa": Unit(_PRESSURES, 1.0),
    "kPa": Unit(_PRESSURES, 1e3),
    "MPa": Unit(_PRESSURES, 1e6),
    "bar": Unit(_PRESSURES, 1e5),
    "psi": Unit(_PRESSURES, 6894.757293168361),
    "rad": Unit((Kind.ANGLE,), 1.0),
    "deg": Unit((Kind.ANGLE,), 0.017453292519943295),
    "rad/s": Unit((Kind.ANGULAR_VELOCITY,), 1.0),
    "deg/s": Unit((Kind.ANGULAR_VELOCITY,), 0.017453292519943295),
    "rpm": Unit((Kind.ANGULAR_VELOCITY,), 0.10471975511965977),
    "N": Unit((Kind.FORCE,), 1.0),
    "kN": Unit((Kind.FORCE,), 1e3),
    "lbf": Unit((Kind.FORCE,), 4.4482216152605),
    "kip": Unit((Kind.FORCE,), 4448.2216152605),
    "m^3/s": Unit((Kind.FLOW,), 1.0),
    "L/min": Unit((Kind.FLOW,), 1.0 / 6e4),
    "gal/min": Unit((Kind.FLOW,), 3.785411784e-3 / 60.0),
    "kg": Unit((Kind.MASS,), 1.0),
    "t": Unit((Kind.MASS,), 1e3),
    "K": Unit((Kind.TEMPERATURE,), 1.0),
    "degC": Unit((Kind.TEMPERATURE,), 1.0, 273.15),
    "degF": Unit((Kind.TEMPERATURE,), 5.0 / 9.0, 273.15 - 32.0 * 5.0 / 9.0),
    "V": Unit((Kind.VOLTAGE,), 1.0),
    "mV": Unit((Kind.VOLTAGE,), 1e-3),
    "A": Unit((Kind.CURRENT,), 1.0),
    "mA": Unit((Kind.CURRENT,), 1e-3),
    "1": Unit((Kind.RATIO, Kind.GENERIC), 1.0),
    "%": Unit((Kind.RATIO,), 1e-2),
}


UNIT_ENDINGS: Mapping[str, str] = {
    ending: unit
    for unit, endings in {
        **{
            unit: unit for unit in ("bar", "kPa", "MPa", "psi", "mm", "cm", "rpm", "kN", "deg", "rad", "mV", "mA", "kg")
        },
        "%": "percent prozent pct",
        "m/s": "mps",
        "mm/s": "mmps",
        "L/min": "lpm lmin",
        "V": "volt volts",
        "A": "ampere",
        "deg/s": "dps degps",
        "rad/s": "radps",
        "K": "kelvin",
        "degC": "degC celsius",
    }.items()
    for ending in endings.lower().split()
}
"""Last words of names, in lower case, that are units."""
UNIT_TAILS: Mapping[str, str] = {
    "degC": "degC",
    "degF": "degF",
    **{unit: unit for unit in ("kPa", "MPa", "kN", "mA", "mV")},
    "m_s": "m/s",
    "mm_s": "mm/s",
    "cm_s": "cm/s",
    **dict.fromkeys(("m_s2", "mps2"), "m/s^2"),
    **dict.fromkeys(("mm_s2", "mmps2"), "mm/s^2"),
    "rad_s": "rad/s",
    "deg_s": "deg/s",
    **dict.fromkeys(("l_min", "L_min"), "L/min"),
}
"""Ends of names behind an underscore that are units as they are written, capitals and divisions included. Single
letters are not among them: ``p_A`` is a chamber, ``x_m`` may be a measured one."""


def display_offset(unit: str) -> float:
    """Return the offset of a display unit, added to SI value * factor: -273.15 for degrees Celsius."""
    of_logs = UNITS.get(unit)
    return -of_logs.offset / of_logs.factor if of_logs is not None and of_logs.offset else 0.0


@dataclass(frozen=True)
class Channel:
    """One signal of a recording; values are always in the SI unit of its kind."""

    name: str
    kind: Kind
    description: str = ""

    @property
    def unit(self) -> str:
        """SI unit of the stored values."""
        return KINDS[self.kind].si_unit


def conversion(unit: str, kind: Kind, where: str) -> Unit:
    """Return the conversion from `unit` to the SI unit of `kind`.

    Raises:
        ConfigError: the unit is unknown or does not measure `kind`; `where` names the column and the file.
    """
    conversion_of_unit = UNITS.get(unit)
    fitting = [name for name, entry in UNITS.items() if kind in entry.kinds]
    if conversion_of_unit is None:
        raise ConfigError(f"{where}: unknown unit '{unit}' for kind '{kind}'{closest(unit, fitting)}")
    if kind not in conversion_of_unit.kinds:
        raise ConfigError(f"{where}: unit '{unit}' does not measure '{kind}'; expected one of {', '.join(fitting)}")
    return conversion_of_unit


_CYLINDERS = ("Boom", "Arm", "Bucket")
_PILOTS = {
    "BmUp": "Boom pilot pressure (raise)",
    "BmDwn": "Boom pilot pressure (lower)",
    "AmIn": "Arm pilot pressure (retract)",
    "AmOut": "Arm pilot pressure (extend)",
    "BktIn": "Bucket pilot pressure (curl)",
    "BktOut": "Bucket pilot pressure (dump)",
}


def _table_a1() -> dict[str, Channel]:
    channels = [Channel(f"CylVels_{i + 1}", Kind.VELOCITY, f"{c} cylinder velocity") for i, c in enumerate(_CYLINDERS)]
    channels += [
        Channel(f"CylAcc_{i + 1}", Kind.ACCELERATION, f"{c} cylinder acceleration") for i, c in enumerate(_CYLINDERS)
    ]
    for first, side in ((1, "piston-side pressure (P_A)"), (5, "rod-side pressure (P_B)")):
        channels += [
            Channel(f"CylPressures_{first + i}", Kind.PRESSURE, f"{c} cylinder {side}")
            for i, c in enumerate(_CYLINDERS)
        ]
    channels += [Channel(name, Kind.PILOT_PRESSURE, text) for name, text in _PILOTS.items()]
    channels += [
        Channel(f"{name}Conf", Kind.PILOT_PRESSURE, text.replace("pilot", "conflux pilot"))
        for name, text in _PILOTS.items()
    ]
    return {channel.name: channel for channel in channels}


TABLE_A1: Mapping[str, Channel] = _table_a1()
"""The 24 logged names of Table A.1 (thesis, appendix A), in its order: the built-in vocabulary and FG1."""

_JOINTS = ("boom", "arm", "bucket")


def _truth() -> dict[str, Channel]:
    channels = [Channel("PumpPressure_1", Kind.PRESSURE, "Pump 1 delivery pressure")]
    channels += [Channel("PumpPressure_2", Kind.PRESSURE, "Pump 2 delivery pressure")]
    for i, joint in enumerate(_JOINTS, start=1):
        channels += [
            Channel(f"CylStroke_{i}", Kind.POSITION, f"{joint} cylinder stroke from closed"),
            Channel(f"JointAngle_{i}", Kind.ANGLE, f"{joint} relative joint angle"),
            Channel(f"JointVel_{i}", Kind.ANGULAR_VELOCITY, f"{joint} relative joint velocity"),
        ]
    channels += [
        Channel("TipX", Kind.POSITION, "bucket tip, forward of the boom foot"),
        Channel("TipY", Kind.POSITION, "bucket tip, above the boom foot"),
        Channel("TipAngle", Kind.ANGLE, "direction from bucket pin to tip, from the horizontal"),
        Channel("TipForceX", Kind.FORCE, "force of the ground on the bucket, forward"),
        Channel("TipForceY", Kind.FORCE, "force of the ground on the bucket, upward"),
        Channel("Payload", Kind.MASS, "soil in the bucket"),
        Channel("OilTemperature", Kind.TEMPERATURE, "oil temperature in the tank"),
        Channel("Event_Relief", Kind.RATIO, "1 while a relief valve is open"),
        Channel("Event_Cavitation", Kind.RATIO, "1 while a chamber is below atmospheric pressure"),
        Channel("Event_Regeneration", Kind.RATIO, "1 while oil passes a regeneration check"),
        Channel("Event_PowerLimit", Kind.RATIO, "1 while the power limit reduces the pumps"),
        Channel("Event_SoilContact", Kind.RATIO, "1 where the bucket touched soil since the last sample"),
    ]
    channels += [Channel(f"PumpDisplacement_{m}", Kind.RATIO, f"Pump {m} displacement, share of full") for m in (1, 2)]
    channels += [
        Channel(f"SpoolPos_{j + 1}", Kind.RATIO, f"{joint} {which}spool position, extension positive")
        for j, (which, joint) in enumerate((w, c) for w in ("", "conflux ") for c in _JOINTS)
    ]
    return {channel.name: channel for channel in channels}


EXTRA_CHANNELS: Mapping[str, Channel] = _truth()
"""Further names that the simulator logs; never model inputs by default."""

GROUND_POINTS = 32
GROUND_CHANNELS: Mapping[str, Channel] = {
    name: Channel(name, Kind.POSITION, "ground height above the boom foot, from the nearest point to the farthest")
    for name in (f"Ground_{k:02d}" for k in range(GROUND_POINTS))
}
"""Logged beside `EXTRA_CHANNELS` where a recording was made in soil."""


def _motors() -> dict[str, Channel]:
    channels = [
        Channel("SwingAngle", Kind.ANGLE, "angle of the upper structure from where the recording began"),
        Channel("SwingVel", Kind.ANGULAR_VELOCITY, "angular velocity of the upper structure"),
    ]
    tracks = ("left", "right")
    channels += [Channel(f"TrackVel_{n}", Kind.VELOCITY, f"velocity of the {s} track") for n, s in enumerate(tracks, 1)]
    ports = [("Swing", 1, "swing motor, port that drives it onwards"), ("Swing", 2, "swing motor, the other port")]
    for n, side in enumerate(tracks):
        ports += [("Track", 2 * n + 1, f"{side} track's motor, port that drives it forwards")]
        ports += [("Track", 2 * n + 2, f"{side} track's motor, the other port")]
    channels += [Channel(f"{what}Pressure_{n}", Kind.PRESSURE, f"pressure of the {text}") for what, n, text in ports]
    for word, text in (("Demand", "demand of the section, as a share of full"), ("Spool", "spool position")):
        channels += [Channel(f"Swing{word}", Kind.RATIO, f"swing: {text}")]
        channels += [Channel(f"Track{word}_{n}", Kind.RATIO, f"{s} track: {text}") for n, s in enumerate(tracks, 1)]
    return {channel.name: channel for channel in channels}


MOTOR_CHANNELS: Mapping[str, Channel] = _motors()
"""Logged beside `EXTRA_CHANNELS`, without noise, where a recording swings and travels."""

FAULT_CHANNELS: Mapping[str, Channel] = {
    name: Channel(name, Kind.RATIO, "share of the full size of a fault that is there, in the order of the recording's")
    for name in (f"Fault_{k}" for k in range(1, 9))
}
"""Logged beside `EXTRA_CHANNELS` where a recording was made with faults."""

VOCABULARY: Mapping[str, Channel] = {
    **TABLE_A1,
    **EXTRA_CHANNELS,
    **GROUND_CHANNELS,
    **MOTOR_CHANNELS,
    **FAULT_CHANNELS,
}


_SLOWEST, _FASTEST = 1e-9, 1e9
"""Bounds of a rate in Hz and of a step in s: clocks of logs count nanoseconds."""
LARGEST = 1e30
"""Largest scale or constant of a channel, of either sign; values are kept in float32."""
_LONGEST = 1024
"""Characters of a name, a column or a description in a signal map."""


@dataclass(frozen=True)
class ChannelMap:
    """Mapping from a file's column, with unit and kind, to one channel.

    Or a constant if the machine lacks the channel.

    Attributes:
        name: name of the channel.
        column: name of the column in the file; empty for a constant.
        unit: unit of the column.
        kind: physical quantity of the channel.
        scale: factor on the column, for example -1 to change the sign.
        constant: value of the channel where the machine lacks it.
        description: description for reports.
    """

    name: str
    column: str
    unit: str | None = None
    kind: Kind | None = None
    constant: float | None = None
    scale: float = 1.0
    description: str = ""

    def check(self) -> None:
        """Raise ConfigError for names, constants or scales that a channel cannot have.

        Raises:
            ConfigError: a name that is empty, too long or holds control characters, or a number that is not finite.
        """
        for key in ("name", "column", "description"):
            text = getattr(self, key)
            if len(text) > _LONGEST or not all(letter.isprintable() for letter in text):
                raise ConfigError(
                    f"signal map, channel {self.name[:80]!r}: its {key} has {len(text)} characters; at most {_LONGEST} "
                    "are taken, and no control characters: change it"
                )
        for key in ("constant", "scale"):
            number = getattr(self, key)
            if number is not None and not (math.isfinite(number) and abs(number) <= LARGEST):
                where = f"signal map, channel '{self.name}'"
                raise ConfigError(
                    f"{where}: {key} = {setting_text(number)}; give a finite number of at most {typed(LARGEST)}"
                )


@dataclass(frozen=True)
class SignalMap:
    """Anyone's columns to channels; an empty map takes every column whose name is in the vocabulary.

    Attributes:
        channels: the wanted channels, in order.
        time: name of the time column; None looks for ``time``, ``t``, ``Time`` and the like.
        time_unit: ``s``, ``ms``, ``us`` or ``ns``.
        sample_time_s: step when the file has no time column (or overrides it: rows are taken as uniform).
        rate_hz: wanted rate; None keeps the file's own.
        header: False for a file without a header row; `columns` then names its columns.
        columns: column names of a headerless file.
        variable: the variable of a MAT file that holds the signals, when there are several.
        delimiter: character between columns of a text file; None finds it.
        decimal: decimal mark of a text file, a point or a comma.
        others: also take every column of numbers that `channels` does not name, under its own name; the vocabulary
            or else the file's unit tells its kind.
    """

    channels: tuple[ChannelMap, ...] = ()
    time: str | None = None
    time_unit: str = "s"
    sample_time_s: float | None = None
    rate_hz: float | None = None
    header: bool = True
    columns: tuple[str, ...] = ()
    variable: str | None = None
    delimiter: str | None = None
    decimal: str = "."
    others: bool = False

    def __post_init__(self) -> None:
        counts = Counter(entry.name for entry in self.channels)
        twice = sorted(name for name, count in counts.items() if count > 1)
        if twice:
            raise ConfigError(f"signal map names channel(s) twice: {', '.join(twice)}; keep one entry each")
        if self.time_unit not in TIME_UNITS:
            raise ConfigError(f"signal map: time_unit {shown(self.time_unit)} is not one of {', '.join(TIME_UNITS)}")
        for key in ("sample_time_s", "rate_hz"):
            value = getattr(self, key)
            if value is not None and not (math.isfinite(value) and _SLOWEST <= value <= _FASTEST):
                raise ConfigError(
                    f"signal map: {key} = {setting_text(value)}; give a number from {typed(_SLOWEST)} to "
                    f"{typed(_FASTEST)}, or leave it out"
                )
        if self.delimiter is not None and (len(self.delimiter) != 1 or self.delimiter in '"\r\n\0'):
            raise ConfigError(
                f"signal map: delimiter = {shown(self.delimiter)}; give one character, such as ',' or ';'"
            )
        if self.decimal not in (".", ","):
            raise ConfigError(f"signal map: decimal = {shown(self.decimal)}; give '.' or ','")
        for entry in self.channels:
            entry.check()


TIME_UNITS: Mapping[str, float] = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
