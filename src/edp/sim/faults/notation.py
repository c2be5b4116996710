"""Faults as one word of a command line: ``internal_leak:boom:3L/min@120s,ramp=30s``."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import fields
from typing import Any

from edp.errors import ConfigError, closest
from edp.settings.bounds import check_count, shown
from edp.sim.faults.base import FAULTS, MAX_FAULTS, FaultSpec, among
from edp.storage.reading import Table

MAX_CHARACTERS = 200
"""Maximum length of the text of one fault."""
GRAMMAR = "KIND[:SITE][:SIZE][@ONSET][,ramp=TIME][,on=TIME,off=TIME]"
EXAMPLE = "internal_leak:boom:3L/min@120s,ramp=30s"
SECONDS: Mapping[str, float] = {"s": 1.0, "ms": 1e-3, "min": 60.0, "h": 3600.0}
_NUMBER = re.compile(r"([+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?)(.*)", re.ASCII | re.DOTALL)


def parse_fault(text: str) -> FaultSpec:
    """Parse a fault from text; the grammar is `GRAMMAR`, with a unit after each number.

    Raises:
        ConfigError: the text does not follow the grammar, or names an unknown kind, site or unit.
    """
    where = f"fault {shown(text)}"
    if not text or len(text) > MAX_CHARACTERS or not text.isprintable():
        raise ConfigError(f"{where}: write {GRAMMAR} with at most {MAX_CHARACTERS} characters, such as {EXAMPLE}")
    head, *options = text.split(",")
    what, at_sign, onset = head.partition("@")
    name, *rest = what.split(":")
    if name not in FAULTS:
        raise ConfigError(f"{where}: unknown kind of fault{among(name, FAULTS)}")
    kind = FAULTS[name]
    form = ":".join([name, *(["SITE"] if kind.sites else []), *(["SIZE"] if kind.units else [])])
    if len(rest) != form.count(":"):
        parts = "nothing" if not rest else ", ".join(f"'{part}'" for part in rest)
        sites = f"; sites are {', '.join(kind.sites)}" if kind.sites else ""
        units = f"; sizes are in {', '.join(kind.units)}" if kind.units else ""
        raise ConfigError(f"{where}: {parts} came behind the kind; write {form}{sites}{units}")
    values: Table = {"kind": name}
    if kind.sites:
        values["site"] = rest.pop(0)
    if kind.units:
        values["size"], values["unit"] = _number(rest.pop(0), f"{where}: size", kind.units)
    if at_sign:
        values["onset_s"] = _seconds(onset, f"{where}: onset")
    for option in options:
        key, _, value = option.partition("=")
        if key not in ("ramp", "on", "off") or f"{key}_s" in values:
            hint = "came twice" if f"{key}_s" in values else f"is unknown{closest(key, ('ramp', 'on', 'off'))}"
            raise ConfigError(f"{where}: option '{key}' {hint}; write {GRAMMAR}")
        values[f"{key}_s"] = _seconds(value, f"{where}: {key}")
    try:
        return FaultSpec(**values)
    except ConfigError as error:
        reason = str(error).removeprefix(f"fault '{name}': ")
        raise ConfigError(f"{where}: {reason}") from None


def fault_text(fault: FaultSpec) -> str:
    """Return the text of a fault; `parse_fault(fault_text(fault)) == fault`."""
    size = "" if fault.size is None else f"{fault.size!r}{fault.unit}"
    head = ":".join(part for part in (fault.kind, fault.site, size) if part)
    onset = f"@{fault.onset_s!r}s" if fault.onset_s else ""
    times = {"ramp": fault.ramp_s, "on": fault.on_s, "off": fault.off_s}
    options = "".join(f",{key}={seconds!r}s" for key, seconds in times.items() if seconds)
    return f"{head}{onset}{options}"


def faults_of(faults: Any, where: str) -> tuple[FaultSpec, ...]:
    """Convert user input (specs, texts and tables) to faults, limited to the number that a recording may have.

    Raises:
        ConfigError: a fault is invalid, there are too many, or `faults` is not a list. `where` is the subject of the
            message.
    """
    if isinstance(faults, str) or not isinstance(faults, Iterable):
        raise ConfigError(f"{where}: faults = {shown(faults)} must be a list of faults, such as ['{EXAMPLE}']")
    specs = tuple(map(_fault_of, faults))
    check_count(where, "faults", specs, MAX_FAULTS)
    return specs


def _fault_of(fault: Any) -> FaultSpec:
    if isinstance(fault, FaultSpec):
        return fault
    if isinstance(fault, str):
        return parse_fault(fault)
    if not isinstance(fault, Mapping):
        raise ConfigError(f"fault {shown(fault)}: write a text such as '{EXAMPLE}', or a table with its keys")
    keys = [entry.name for entry in fields(FaultSpec)]
    for key in fault:
        if key not in keys:
            raise ConfigError(f"fault: key {shown(key)} is unknown{closest(str(key), keys)}")
    if not isinstance(fault.get("kind"), str):
        raise ConfigError(f"fault {shown(dict(fault))}: say which with kind{closest('', FAULTS)}")
    return FaultSpec(**fault)


def _number(text: str, where: str, units: Iterable[str]) -> tuple[float, str]:
    match = _NUMBER.fullmatch(text)
    if match is None or match[2].strip() not in units:
        raise ConfigError(f"{where} = '{text}'; write a number and its unit, one of {', '.join(units)}")
    return float(match[1]), match[2].strip()


def _seconds(text: str, where: str) -> float:
    value, unit = _number(text, where, SECONDS)
    return value * SECONDS[unit]
