"""Reference of registered parts: every registry of the package, its parts, their options with defaults and bounds."""

from __future__ import annotations

import importlib
import inspect
import re
from dataclasses import MISSING, Field, fields, is_dataclass
from enum import Enum
from pathlib import Path
from typing import Any

import edp
from edp.registry import Registry
from edp_site import markdown

_DEFINED = re.compile(r"^(\w+): Registry\[.+\] = Registry\(", re.MULTILINE)


def registries() -> dict[str, Registry[Any]]:
    """Every registry of the package that has parts, by the place of its definition: ``edp.networks.heads.HEADS``."""
    root = Path(edp.__path__[0])
    found: dict[str, Registry[Any]] = {}
    for source in sorted(root.rglob("*.py")):
        for name in _DEFINED.findall(source.read_text(encoding="utf-8")):
            module = ".".join(("edp", *source.relative_to(root).with_suffix("").parts))
            # The folder imports the files that hold the parts.
            importlib.import_module(module.rpartition(".")[0])
            registry = getattr(importlib.import_module(module), name)
            if len(registry):
                found[f"{module}.{name}"] = registry
    return found


def parts_page() -> str:
    """All registries with their parts."""
    listed = sorted(registries().items(), key=lambda item: (item[1].what, item[0]))
    lines = [
        "# Parts",
        "",
        "Made from the code: every registered part by its name, with its options. In settings a table with `kind` "
        "names one; [settings](../settings.md) say in which table and what the options do, "
        "[the architecture](../architecture.md#to-add-a-part) how to add one.",
        "",
        "| Parts | Number |",
        "|---|---|",
    ]
    titles = {place: _title(place, registry) for place, registry in listed}
    for place, registry in listed:
        lines.append(f"| [{titles[place]}](#{markdown.anchor_of(titles[place])}) | {len(registry)} |")
    for place, registry in listed:
        lines += ["", f"## {titles[place]}", "", f"Registry `{place}`.", "", *_table(registry)]
    return "\n".join(lines) + "\n"


def _title(place: str, registry: Registry[Any]) -> str:
    what = registry.what[0].upper() + registry.what[1:]
    return f"{what} ({place.split('.')[1]}, `{place.rpartition('.')[2]}`)"


def _table(registry: Registry[Any]) -> list[str]:
    rows = ["| Name | Options and their defaults | What it is |", "|---|---|---|"]
    texts = {name: first_sentence(part) for name, part in registry.items()}
    common = {text for text in texts.values() if list(texts.values()).count(text) > 1}  # of a class that all share
    for name, part in registry.items():
        rows.append(f"| `{name}` | {_options(part)} | {'' if texts[name] in common else _cell(texts[name])} |")
    return rows


def _options(part: Any) -> str:
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
    """The first sentence of a part's docstring; of an object that of its class."""
    own = part if inspect.isclass(part) or inspect.isroutine(part) else type(part)
    text = " ".join((inspect.getdoc(own) or "").split("\n\n")[0].split()).replace("``", "`")
    return "" if text.startswith(f"{getattr(own, '__name__', '')}(") else text


def _escaped(text: str) -> str:
    return text.replace("|", "\\|").replace("`", "'")


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("<", "&lt;")
