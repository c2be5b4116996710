"""Reference of registered parts: every registry of the package, its parts, their options with defaults and bounds."""

from __future__ import annotations

import importlib
import inspect
import pkgutil
import re
import tomllib
from dataclasses import MISSING, Field, fields, is_dataclass
from enum import Enum
from pathlib import Path
from typing import Any

import edp
from edp.registry import Registry
from edp.sim.faults.base import MachineFault
from edp_site import markdown

_DEFINED = re.compile(r"^(\w+): Registry\[.+\] = Registry\(", re.MULTILINE)


def registries() -> dict[str, Registry[Any]]:
    """Return every registry of the package that has parts, by its place, such as ``edp.networks.heads.HEADS``."""
    root = Path(edp.__path__[0])
    found: dict[str, Registry[Any]] = {}
    for source in sorted(root.rglob("*.py")):
        for name in _DEFINED.findall(source.read_text(encoding="utf-8")):
            module = ".".join(("edp", *source.relative_to(root).with_suffix("").parts))
            # The folder, or a folder in it, imports the files that hold the parts.
            package = importlib.import_module(module.rpartition(".")[0])
            for inner in pkgutil.iter_modules(package.__path__):
                if inner.ispkg:
                    importlib.import_module(f"{package.__name__}.{inner.name}")
            registry = getattr(importlib.import_module(module), name)
            if len(registry):
                found[f"{module}.{name}"] = registry
    return found


def parts_page() -> str:
    """Describe all registries with their parts, then the machines and soils of the simulator."""
    listed = sorted(registries().items(), key=lambda item: (item[1].what, item[0]))
    lines = ["## Overview", "", "| Parts | Number |", "|---|---|"]
    titles = {place: _title(place, registry) for place, registry in listed}
    for place, registry in listed:
        lines.append(f"| [{titles[place]}](#{markdown.anchor_of(titles[place])}) | {len(registry)} |")
    for place, registry in listed:
        table = _fault_table(registry) if place.endswith(".FAULTS") else _table(registry)
        lines += ["", f"## {titles[place]}", "", f"Registry `{place}`.", "", *table]
    simulator = Path(edp.__path__[0]) / "sim"
    for title, folder in (("Machines of the simulator", "machines"), ("Soils of the simulator", "materials")):
        lines += ["", f"## {title}", "", f"Files of `edp/sim/{folder}`.", "", "| Name | What it is |", "|---|---|"]
        for path in sorted((simulator / folder).glob("*.toml")):
            # A soil has no description; the first comment of its file says what it is.
            values = tomllib.loads(path.read_text(encoding="utf-8"))
            comment = path.read_text(encoding="utf-8").partition("\n")[0].lstrip("# ")
            lines.append(f"| `{values.get('name', path.stem)}` | {_cell(values.get('description', comment))} |")
    return "\n".join(lines) + "\n"


def _title(place: str, registry: Registry[Any]) -> str:
    what = registry.what[0].upper() + registry.what[1:]
    return f"{what} ({place.split('.')[1]}, `{place.rpartition('.')[2]}`)"


def _table(registry: Registry[Any]) -> list[str]:
    rows = ["| Name | Options and their defaults | What it is |", "|---|---|---|"]
    texts = {name: first_sentence(part) for name, part in registry.items()}
    common = {text for text in texts.values() if list(texts.values()).count(text) > 1}  # of a class that all share
    for name, part in registry.items():
        rows.append(f"| `{name}` | {options(part)} | {'' if texts[name] in common else _cell(texts[name])} |")
    return rows


def _fault_table(registry: Registry[Any]) -> list[str]:
    rows = ["| Name | Sites | Sizes of the ladder | Range | Part | What is wrong |", "|---|---|---|---|---|---|"]
    for name, kind in registry.items():
        ladder = ", ".join(f"{size:g}" for size in kind.ladder)
        shown_range = f"{kind.bound.low:g} to {kind.bound.high:g} {kind.unit}" if kind.units else ""
        part = "machine" if isinstance(kind, MachineFault) else "sensor"
        sites = ", ".join(f"`{site}`" for site in kind.sites)
        cells = (f"`{name}`", sites, f"{ladder} {kind.unit}".strip(), shown_range, part, _cell(kind.text))
        rows.append(f"| {' | '.join(cells)} |")
    return rows


def options(part: Any) -> str:
    """Return the options of a part with their defaults; empty for a part that is not a dataclass."""
    if not (inspect.isclass(part) and is_dataclass(part)):
        return ""
    return ", ".join(f"`{_escaped(f'{entry.name} = {_default(entry)}')}`" for entry in fields(part) if entry.init)


def _default(entry: Field[Any]) -> str:
    if entry.default is not MISSING:
        return _shown(entry.default)
    return _shown(entry.default_factory()) if entry.default_factory is not MISSING else "..."


def _shown(value: Any) -> str:
    if isinstance(value, Enum):
        return f'"{value.value}"'
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return f'"{value}"'
    if isinstance(value, tuple | list):
        return f"[{', '.join(map(_shown, value))}]"
    if is_dataclass(value) and not isinstance(value, type):
        return type(value).__name__
    return f"{value:g}" if isinstance(value, float) else str(value)


def first_sentence(part: Any) -> str:
    """Return the first paragraph of the docstring of a part, or of its class if the part is an object."""
    own = part if inspect.isclass(part) or inspect.isroutine(part) or inspect.ismodule(part) else type(part)
    text = " ".join((inspect.getdoc(own) or "").split("\n\n")[0].split()).replace("``", "`")
    return "" if text.startswith(f"{getattr(own, '__name__', '')}(") else text


def _escaped(text: str) -> str:
    return text.replace("|", "\\|").replace("`", "'")


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("<", "&lt;")
