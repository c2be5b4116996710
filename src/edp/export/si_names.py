"""Names of channels in exported forms, whose values are in SI units: a unit of the log in a name is replaced."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import replace

from edp.signals import KINDS, UNIT_ENDINGS, UNIT_TAILS, UNITS, Channel, Kind

_BRACKETS = re.compile(r"(.*?)([\s_.-]*)([\[(]\s*)([^\[\]()]+?)(\s*[\])])\s*", re.DOTALL)
_LAST_WORD = re.compile(r"(.*?)([\s_.-]+)([^\s_.-]+)", re.DOTALL)
_SPELLINGS = {
    **UNIT_ENDINGS,
    **{unit.lower(): unit for unit in UNITS if unit != "1"},
    "l/min": "L/min",
    "°c": "degC",
}
"""Units by their lower-case spelling within brackets."""


def si_channels(channels: Iterable[Channel]) -> list[Channel]:
    """Return the channels with names that do not contradict their SI units; see `si_names`."""
    listed = list(channels)
    names = si_names([channel.name for channel in listed], [channel.kind for channel in listed])
    return [replace(channel, name=name) for channel, name in zip(listed, names, strict=True)]


def si_names(names: Iterable[str], kinds: Iterable[Kind]) -> list[str]:
    """Return the names with SI units in place of other units at their ends, all different if `names` are.

    ``Weg_Hub_mm`` of a position becomes ``Weg_Hub_m``, ``valve_percent`` becomes ``valve``. Names that end in no unit,
    in the SI unit, or that belong to a generic channel, whose numbers are those of the log, stay as they are.

    Args:
        names: names of the channels in the log.
        kinds: kinds of these channels.
    """
    listed = list(names)
    si_forms = [_si_name(name, kind) for name, kind in zip(listed, kinds, strict=True)]
    # Names that stay are never given to another channel.
    used = {name for name, new in zip(listed, si_forms, strict=True) if name == new}
    out: list[str] = []
    for name, new in zip(listed, si_forms, strict=True):
        chosen, number = new, 0
        while name != new and chosen in used:
            number += 1
            chosen = f"{new}_{number}"
        used.add(chosen)
        out.append(chosen)
    return out


def _si_name(name: str, kind: Kind) -> str:
    si_unit = KINDS[kind].si_unit
    if kind is Kind.GENERIC:
        return name
    if (match := _BRACKETS.fullmatch(name)) is not None:
        stem, gap, opening, text, closing = match.groups()
        unit = _SPELLINGS.get(text.lower())
        if unit is None or unit == si_unit or not stem:
            return name
        return stem if si_unit == "1" else f"{stem}{gap}{opening}{si_unit}{closing}"
    ending = _unit_at_end(name)
    if ending is None or ending[2] == si_unit:
        return name
    stem, gap, _ = ending
    return stem if si_unit == "1" else f"{stem}{gap}{_word_of(si_unit)}"


def _unit_at_end(name: str) -> tuple[str, str, str] | None:
    """Split a name into stem, separator and trailing unit; return None for a name without a unit."""
    for tail in sorted(UNIT_TAILS, key=len, reverse=True):
        if name.endswith("_" + tail) and len(name) > len(tail) + 1:
            return name[: -len(tail) - 1], "_", UNIT_TAILS[tail]
    match = _LAST_WORD.fullmatch(name)
    unit = None if match is None else UNIT_ENDINGS.get(match[3].lower())
    return None if match is None or unit is None or not match[1] else (match[1], match[2], unit)


def _word_of(unit: str) -> str:
    """Return a unit as the end of a name: ``m_s`` for m/s."""
    return unit.replace("^", "").replace("/", "_")
