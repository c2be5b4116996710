"""SI units as FMI writes them: exponents of the base units, and the units that people read."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from edp.signals import KINDS, UNITS, Kind

BASES: Mapping[str, Mapping[str, int]] = {
    "1": {},
    "m/s": {"m": 1, "s": -1},
    "m/s^2": {"m": 1, "s": -2},
    "m": {"m": 1},
    "Pa": {"kg": 1, "m": -1, "s": -2},
    "rad": {"rad": 1},
    "rad/s": {"rad": 1, "s": -1},
    "N": {"kg": 1, "m": 1, "s": -2},
    "m^3/s": {"m": 3, "s": -1},
    "kg": {"kg": 1},
    "K": {"K": 1},
    "V": {"kg": 1, "m": 2, "s": -3, "A": -1},
    "A": {"A": 1},
    "s": {"s": 1},
}
"""SI base-unit exponents of each unit, for all kinds of channels and for time."""


@dataclass(frozen=True)
class Shown:
    """A unit in which a variable may be shown: shown = factor * value + offset."""

    name: str
    factor: float
    offset: float


def shown(kind: Kind) -> Shown | None:
    """Return the report unit of a kind; None if it is the SI unit."""
    facts = KINDS[kind]
    if facts.report_unit == facts.si_unit:
        return None
    unit = UNITS[facts.report_unit]
    # Six digits of what a division leaves are enough for a display.
    return Shown(facts.report_unit, float(f"{1.0 / unit.factor:.12g}"), float(f"{-unit.offset / unit.factor:.12g}"))


def units_of(kinds: Sequence[Kind]) -> dict[str, list[Shown]]:
    """Return the units of variables of these kinds with their display units, and the second."""
    shown_units: dict[str, list[Shown]] = {}
    for kind in kinds:
        other = shown_units.setdefault(KINDS[kind].si_unit, [])
        also = shown(kind)
        if also is not None and also not in other:
            other.append(also)
    return shown_units | {"s": []}
