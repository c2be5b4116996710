"""Spellings of units found in files, brought to the names of `edp.signals.UNITS`."""

from __future__ import annotations

import difflib
from dataclasses import replace

from edp.errors import ConfigError, DataError
from edp.settings.bounds import shown
from edp.signals import TIME_UNITS, UNITS, VOCABULARY, Channel, ChannelMap, Kind, SignalMap, Unit, conversion

ALIASES = {
    "m/s²": "m/s^2",
    "m/s2": "m/s^2",
    "m/s/s": "m/s^2",
    "mm/s²": "mm/s^2",
    "mm/s2": "mm/s^2",
    "m³/s": "m^3/s",
    "m3/s": "m^3/s",
    "l/min": "L/min",
    "lpm": "L/min",
    "LPM": "L/min",
    "GPM": "gal/min",
    "gpm": "gal/min",
    "US gal/min": "gal/min",
    "PSI": "psi",
    "BAR": "bar",
    "°": "deg",
    "degree": "deg",
    "degrees": "deg",
    "°/s": "deg/s",
    "deg/sec": "deg/s",
    "rad/sec": "rad/s",
    "m/sec": "m/s",
    "°C": "degC",
    "°F": "degF",
    "Bar": "bar",
    "pa": "Pa",
    "Volt": "V",
    "volt": "V",
    "Ampere": "A",
    "-": "1",
    "inch": "in",
    "inches": "in",
    "in/sec": "in/s",
    "inch/s": "in/s",
    "kips": "kip",
    "µs": "us",
    "sec": "s",
    "seconds": "s",
    "U/min": "rpm",
    "1/min": "rpm",
    "min-1": "rpm",
    "RPM": "rpm",
    "r/min": "rpm",
    "rev/min": "rpm",
    "Grad": "deg",
    "grad": "deg",
}
"""Alternative spellings of units, with the standard name."""

OTHER_UNITS = frozenset(
    [
        *("N·m", "Nm", "N*m", "N.m", "Ncm", "kN·m", "kNm", "kgf", "gf", "N/m"),
        *("W", "kW", "VA", "Wh", "kWh", "J", "kJ", "kgf/W", "Hz", "kHz", "MHz", "dB", "ohm", "Ω", "kΩ"),
        *("L", "l", "mL", "ml", "µm", "um", "nm", "ft", "lb", "lbs", "counts", "digit"),
    ]
)
"""Units of quantities without a kind. Their values are used unchanged, and they are not removed from names."""


def normalise_unit(text: str | None) -> str | None:
    """Return the unit in its usual spelling; None for an empty text; unknown units are unchanged."""
    unit = (text or "").strip()
    if not unit:
        return None
    return ALIASES.get(unit, unit)


def check_unit(stated: str | None, where: str) -> str | None:
    """Return the usual name of a unit that a user wrote; None for an empty text.

    Units that a file states are not checked: a logger may write anything, and such a column has no kind.

    Args:
        stated: the unit as written in a signal map or a call.
        where: the channel and its source, for the message.

    Raises:
        DataError: the unit is unknown; names the closest units.
    """
    unit = normalise_unit(stated)
    if unit is None or unit in UNITS or unit in TIME_UNITS or unit in OTHER_UNITS:
        return unit
    near = _closest_units(unit)
    hint = f"did you mean {' or '.join(repr(name) for name in near)}?" if near else f"known: {', '.join(UNITS)}"
    raise DataError(
        f"{where}: unknown unit {shown(unit)}; {hint} (docs/reference/channels.md lists all); "
        "correct it, or leave it out to take the numbers unconverted"
    )


def _closest_units(unit: str, count: int = 3) -> list[str]:
    """Return the usual names of the known units whose spelling is closest, without regard to capitals."""
    spellings: dict[str, str] = {}
    for spelling, usual in {**ALIASES, **{name: name for name in UNITS}}.items():
        spellings.setdefault(spelling.lower(), usual)
    near = difflib.get_close_matches(unit.lower()[:40], list(spellings), n=3 * count, cutoff=0.5)
    return list(dict.fromkeys(spellings[spelling] for spelling in near))[:count]


def kind_of_unit(stated: str | None) -> Kind:
    """Return the first kind that a unit measures; generic if it is unknown."""
    unit = UNITS.get(normalise_unit(stated) or "1")
    return Kind.GENERIC if unit is None or Kind.GENERIC in unit.kinds else unit.kinds[0]


def channel_from_entry(entry: ChannelMap) -> Channel:
    """Return the channel of an entry of a signal map.

    The kind is the stated one, else that of the vocabulary, else that of the stated unit (`kind_of_unit`: bar is a
    pressure, not a pilot pressure), else generic.
    """
    standard_channel = VOCABULARY.get(entry.name)
    if standard_channel is not None and entry.kind in (None, standard_channel.kind):
        return standard_channel
    return Channel(entry.name, entry.kind or kind_of_unit(entry.unit), entry.description)


def add_kinds(signal_map: SignalMap) -> SignalMap:
    """Return a map whose entries state the kinds given by their units."""
    return replace(signal_map, channels=tuple(map(_add_kind, signal_map.channels)))


def drop_derived_kinds(signal_map: SignalMap) -> SignalMap:
    """Return a map as earlier versions read it: channels without a kind are dimensionless."""
    entries = (
        replace(entry, kind=Kind.GENERIC) if _add_kind(entry) != entry else entry for entry in signal_map.channels
    )
    return replace(signal_map, channels=tuple(entries))


def _add_kind(entry: ChannelMap) -> ChannelMap:
    kind = channel_from_entry(entry).kind
    is_derived = entry.kind is None and entry.name not in VOCABULARY and kind is not Kind.GENERIC
    return replace(entry, kind=kind) if is_derived else entry


def unit_for(stated: str | None, kind: Kind, where: str) -> Unit:
    """Return the conversion for the unit stated by file or map; SI if no unit is stated.

    A generic channel has no unit of its own: its numbers are taken as they are.

    Raises:
        DataError: the unit is unknown or does not measure `kind`.
    """
    unit = normalise_unit(stated)
    if unit is None or kind is Kind.GENERIC:
        # Nothing stated means SI, and a generic channel has no unit to convert from.
        return Unit((kind,), 1.0)
    try:
        return conversion(unit, kind, where)
    except ConfigError as error:
        advice = "" if unit not in UNITS else "; correct the unit or the kind in the signal map"
        raise DataError(f"{error}{advice}") from error
