"""Fault specification: kind, site, size, onset and time course."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, fields

import numpy as np
from numpy.typing import NDArray

from edp.errors import ConfigError, closest
from edp.registry import Registry
from edp.settings.bounds import Bound, shown, span
from edp.sim.machine.machine import Machine
from edp.wording import setting_text, typed

Array = NDArray[np.float64]
Units = Mapping[str, float]
AXES = ("boom", "arm", "bucket")
SPOOLS = (*AXES, *(f"{axis}_conflux" for axis in AXES))
CHAMBERS = tuple(f"{axis}_{side}" for side in ("head", "rod") for axis in AXES)
"""Cylinder chambers in the order of the plant state and of Table A.1: head chambers, then rod chambers."""

# Factors to SI units; the first unit of each is that of bounds and ladders.
FLOW: Units = {"L/min": 1.0 / 6e4, "m^3/s": 1.0}
PRESSURE: Units = {"bar": 1e5, "MPa": 1e6, "kPa": 1e3, "Pa": 1.0}
SHARE: Units = {"%": 1e-2}
FACTOR: Units = {"x": 1.0}
TIME: Units = {"ms": 1e-3, "s": 1.0}
MASS: Units = {"kg": 1.0, "t": 1e3}
VELOCITY: Units = {"mm/s": 1e-3, "cm/s": 1e-2, "m/s": 1.0}
LENGTH: Units = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}
TEMPERATURE: Units = {"K": 1.0}
NO_UNIT: Units = {}
"""Unit of fault types without a size."""
MAX_FAULTS = 8
"""Maximum number of faults per recording. Each fault has one of the channels `edp.signals.FAULT_CHANNELS`."""
MAX_SECONDS = 1e7
"""Maximum onset, ramp and period, s. No recording is longer."""
MIN_SECONDS = 0.05
"""Minimum active and inactive time of an intermittent fault, s. The kind `dropout` describes faster loose contacts."""


@dataclass(eq=False)
class MachineNumbers:
    """Plant parameters that a fault may change.

    Attributes:
        machine: parameter set from which the arrays were packed.
        rate_hz: sample rate.
        half_steps_s: half of a coarse and of a fine integration step, s.
        axes: parameters of the cylinders, shape (3, AXIS_VALUES).
        plant: other parameters, shape (PLANT_VALUES,).
        delays: dead time of each spool in samples, shape (6,).
        coarse: transition matrices of pilots and spools over half a coarse step, shape (6, 2, 4).
        fine: transition matrices of pilots and spools over half a fine step, shape (6, 2, 4).
        soil: parameters of bucket and soil; zeros in free air.
    """

    machine: Machine
    rate_hz: float
    half_steps_s: tuple[float, float]
    axes: Array
    plant: Array
    delays: Array
    coarse: Array
    fine: Array
    soil: Array

    @property
    def arrays(self) -> tuple[Array, ...]:
        """Arrays that faults change, in the order of `edp.sim.faults.course.BLOCKS`."""
        return self.axes, self.plant, self.delays, self.coarse, self.fine, self.soil

    def copy(self) -> MachineNumbers:
        """Return a copy with its own arrays."""
        copies = [array.copy() for array in self.arrays]
        return MachineNumbers(self.machine, self.rate_hz, self.half_steps_s, *copies)


@dataclass(frozen=True, kw_only=True)
class FaultKind:
    """Kind of fault. Instances are registered in `FAULTS`.

    Attributes:
        text: description for tables and messages.
        part: faulty component. ``{site}``, ``{axis}``, ``{side}`` and ``{pair}`` are replaced by words of the site.
        words: text of a report, with the placeholders of `part`, ``{size}``, and ``{high}`` or ``{large}``, which
            depend on the sign.
        grave: whether a load may fall or a movement may not stop.
        sites: possible sites; empty if a machine has only one such component.
        units: units of the size with their factors to SI units; empty for kinds without a size.
        ladder: sizes from hardly visible to gross, in the first unit.
        bound: range of the size, in the first unit.
        neutral: size without effect, in the first unit.
    """

    text: str
    part: str
    words: str
    grave: bool = False
    sites: tuple[str, ...] = AXES
    units: Units
    ladder: tuple[float, ...] = ()
    bound: Bound = field(default_factory=lambda: span(0.0, 0.0))
    neutral: float = 0.0

    @property
    def signed(self) -> bool:
        """Whether a size may be negative."""
        return self.bound.low < 0.0

    @property
    def unit(self) -> str:
        """Unit of bounds and ladder; empty for faults without a size."""
        return next(iter(self.units), "")

    def component(self, site: str) -> str:
        """Return the faulty component, such as ``boom valve``; several fault kinds can have the same component."""
        return insert_site(self.part, site)


@dataclass(frozen=True, kw_only=True)
class MachineFault(FaultKind):
    """Machine fault, which changes plant parameters.

    Attributes:
        change: function that applies the fault to plant parameters in place. Its arguments are the parameters, which
            may have other faults already, one of `sites`, and the size in SI units (`neutral` for no fault).
        delays_commands: whether the size is an additional dead time of commands, for which the plant needs room.
    """

    change: Callable[[MachineNumbers, str, float], None]
    delays_commands: bool = False


@dataclass(frozen=True, kw_only=True)
class SensorFault(FaultKind):
    """Sensor fault, which changes one observed value per sample or swaps two.

    Attributes:
        operation: operation on the value, one of `edp.sim.sensors.alterations`.
        channels: affected channels by site, as indices of `edp.sim.sensors.chain.SENSED`; for noise, columns of the
            random values. The site is empty for kinds without sites.
    """

    operation: int
    channels: Mapping[str, tuple[int, ...]]


FAULTS: Registry[FaultKind] = Registry("kind of fault")


@dataclass(frozen=True)
class FaultSpec:
    """One fault of a scenario.

    Attributes:
        kind: name in `FAULTS`.
        site: one of the kind's sites; empty for kinds without sites.
        size: size in `unit`; None for kinds without a size.
        unit: one of the kind's units.
        onset_s: time from the start of the recording to the start of the fault, s.
        ramp_s: time in which the fault grows to its size, s.
        on_s: active time per period of an intermittent fault, s; 0 for a permanent fault.
        off_s: inactive time per period of an intermittent fault, s.

    Raises:
        ConfigError: the kind, site or unit is unknown, or a value is out of range.
    """

    kind: str
    site: str = ""
    size: float | None = None
    unit: str = ""
    onset_s: float = 0.0
    ramp_s: float = 0.0
    on_s: float = 0.0
    off_s: float = 0.0

    def __post_init__(self) -> None:
        kind = FAULTS[self.kind]
        what = f"fault '{self.kind}'"
        if kind.sites and self.site not in kind.sites:
            raise ConfigError(f"{what}: site {shown(self.site)} is unknown{among(str(self.site), kind.sites)}")
        if self.site and not kind.sites:
            raise ConfigError(f"{what}: site {shown(self.site)} must be left out; a machine has one such part")
        _check_size(what, kind, self.size, self.unit)
        seconds = span(0.0, MAX_SECONDS)
        for name in ("onset_s", "ramp_s", "on_s", "off_s"):
            value = getattr(self, name)
            if not seconds.holds(value):
                raise ConfigError(f"{what}: {name} = {shown(value)}; {seconds.rule(name)} must hold")
        if self.ramp_s > 0.0 and not kind.units:
            raise ConfigError(f"{what}: ramp_s = {setting_text(self.ramp_s)} must be 0: this kind is there or not")
        if (self.on_s > 0.0) != (self.off_s > 0.0) or 0.0 < min(self.on_s, self.off_s) < MIN_SECONDS:
            raise ConfigError(
                f"{what}: on_s = {setting_text(self.on_s)} and off_s = {setting_text(self.off_s)}; an intermittent "
                "fault needs both, "
                f"{MIN_SECONDS} s at least; leave both out for one that stays"
            )

    @property
    def full(self) -> float:
        """Size in SI units; 1 for kinds without a size."""
        kind = FAULTS[self.kind]
        return 1.0 if self.size is None else float(self.size) * kind.units[self.unit]

    @property
    def neutral(self) -> float:
        """Size without effect, in SI units."""
        kind = FAULTS[self.kind]
        return kind.neutral * kind.units.get(kind.unit, 1.0)

    def to_dict(self) -> dict[str, object]:
        """Return the fault in JSON types without default values; `FaultSpec(**fault.to_dict()) == fault`."""
        values = {entry.name: getattr(self, entry.name) for entry in fields(self)}
        return {key: value for key, value in values.items() if key == "kind" or value not in (None, "", 0.0)} | (
            # A size of zero is a size.
            {} if self.size is None else {"size": self.size}
        )


def insert_site(text: str, site: str) -> str:
    """Return a text with the words of a site inserted."""
    axis, _, side = site.partition("_")
    whole = "both pumps" if site == "both" else site.replace("_", " ")
    words = {"{site}": whole, "{axis}": axis, "{side}": side, "{pair}": f"{axis} and {side}"}
    for key, word in words.items():
        text = text.replace(key, word)
    return text


def among(name: str, options: Iterable[str]) -> str:
    """Return a suffix for messages on an unknown name: the closest option, and all options."""
    hint = closest(name, options)
    listed = ", ".join(options)
    return f"{hint}; there are {listed}" if hint.startswith("; did") else f"; there are {listed}"


def _check_size(what: str, kind: FaultKind, size: float | None, unit: str) -> None:
    if not kind.units:
        if size is not None or unit:
            raise ConfigError(f"{what}: size = {shown(size)} {shown(unit)} must be left out: this kind is there or not")
        return
    if size is None:
        raise ConfigError(f"{what}: it needs a size, such as {typed(kind.ladder[0])}{kind.unit}")
    if isinstance(size, bool) or not isinstance(size, int | float) or not math.isfinite(size):
        raise ConfigError(f"{what}: size = {shown(size)} must be a finite number")
    if not isinstance(unit, str) or unit not in kind.units:
        raise ConfigError(f"{what}: unit {shown(unit)} of the size is unknown{among(str(unit), kind.units)}")
    in_first = size * kind.units[unit] / kind.units[kind.unit]
    # The product may exceed a bound by rounding: 900 % as the fraction 9.
    if not kind.bound.low - 1e-9 <= in_first <= kind.bound.high + 1e-9:
        raise ConfigError(
            f"{what}: size = {setting_text(size)} {unit}; {kind.bound.rule('size')} {kind.unit} must hold"
        )


def ladder(
    kinds: Iterable[str] | None = None, everywhere: bool = False, onset_s: float = 0.0, ramp_s: float = 0.0
) -> Iterator[FaultSpec]:
    """Return faults of every kind in every size of its ladder, in ascending order of size.

    Args:
        kinds: names in `FAULTS`; all by default.
        everywhere: whether to use every site of a kind instead of the first one.
        onset_s: start of all faults, s.
        ramp_s: time in which faults grow, s. Kinds without a size have no ramp.
    """
    for name in FAULTS if kinds is None else kinds:
        kind = FAULTS[name]
        for site in (kind.sites if everywhere else kind.sites[:1]) or ("",):
            if not kind.units:
                yield FaultSpec(name, site, onset_s=onset_s)
            for size in kind.ladder:
                yield FaultSpec(name, site, size, kind.unit, onset_s, ramp_s)
