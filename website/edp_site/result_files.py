"""Reference of the JSON result files: keys, types and meanings, from the dataclasses that read and write them."""

from __future__ import annotations

import importlib
import inspect
import re
import typing
from collections.abc import Iterator
from dataclasses import MISSING, Field, fields, is_dataclass
from pathlib import Path
from types import NoneType, UnionType
from typing import Any

import edp
from edp.settings.results import ResultFile
from edp_site import markdown
from edp_site.parts import first_sentence

_ENTRY = re.compile(r"^    ([\w, ]+): (.*)$")


def result_files() -> list[type[ResultFile]]:
    """Return every class of result files, by file name."""
    root = Path(edp.__path__[0])
    for source in sorted(root.rglob("*.py")):
        if "(ResultFile)" in source.read_text(encoding="utf-8"):
            importlib.import_module(".".join(("edp", *source.relative_to(root).with_suffix("").parts)))
    return sorted(ResultFile.__subclasses__(), key=lambda cls: (cls.NAME, cls.__name__))


def files_page() -> str:
    """Describe every result file, then the tables that are parts of them."""
    lines = ["## Overview", "", "| File | Content | Version |", "|---|---|---|"]
    for cls in result_files():
        lines.append(f"| [`{cls.NAME}`](#{markdown.anchor_of(cls.NAME)}) | {cls.WHAT} | {cls.SCHEMA or ''} |")
    inner: dict[str, type] = {}
    for cls in result_files():
        inner |= {part.__name__: part for part in _parts(cls)}
        lines += ["", f"## `{cls.NAME}`", "", *_keys(cls)]
    lines += ["", "## Tables within the files", ""]
    for name in sorted(inner):
        lines += ["", f"### `{name}`", "", first_sentence(inner[name]), "", *_keys(inner[name])]
    return "\n".join(lines) + "\n"


def _keys(cls: type) -> list[str]:
    meanings = _meanings(cls)
    hints = typing.get_type_hints(cls)
    rows = ["| Key | Value | Meaning |", "|---|---|---|"]
    for entry in _entries(cls):
        left_out = " May be absent." if entry.default is not MISSING or entry.default_factory is not MISSING else ""
        text = f"{meanings.get(entry.name, '')}{left_out}".strip()
        rows.append(f"| `{entry.name}` | {_described(hints[entry.name])} | {text} |")
    return rows


def _entries(cls: type) -> tuple[Field[Any], ...]:
    return fields(cls) if is_dataclass(cls) else ()


def _meanings(cls: type) -> dict[str, str]:
    """Return the meaning of each attribute that the docstring describes."""
    section = (inspect.getdoc(cls) or "").partition("Attributes:\n")[2].partition("\n\n")[0]
    found: dict[str, str] = {}
    names: list[str] = []
    for line in section.replace("``", "`").replace("|", "\\|").splitlines():
        if match := _ENTRY.match(line):
            names = match[1].split(", ")
            found |= dict.fromkeys(names, match[2])
        else:
            found |= {name: f"{found[name]} {line.strip()}" for name in names}
    return {name: text[:1].upper() + text[1:] + ("" if text.endswith(".") else ".") for name, text in found.items()}


def _described(hint: Any) -> str:
    """Return the JSON type of a field in words."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, UnionType):
        return " or ".join("null" if argument is NoneType else _described(argument) for argument in arguments)
    if origin is typing.Literal:
        return " or ".join(f'`"{value}"`' for value in arguments)
    if origin is tuple:
        return f"list of {_described(arguments[0])}"
    if arguments:
        return f"table of {_described(arguments[-1])}"
    if is_dataclass(hint):
        return f"[`{hint.__name__}`](#{markdown.anchor_of(hint.__name__)})"
    return {str: "text", int: "integer", float: "number", bool: "true or false"}.get(hint, "value")


def _parts(cls: type) -> Iterator[type]:
    """Yield the dataclasses within a dataclass, at any depth."""
    for hint in typing.get_type_hints(cls).values():
        for found in _dataclasses(hint):
            yield found
            yield from _parts(found)


def _dataclasses(hint: Any) -> Iterator[type]:
    if isinstance(hint, type) and is_dataclass(hint):
        yield hint
    for argument in typing.get_args(hint):
        yield from _dataclasses(argument)
