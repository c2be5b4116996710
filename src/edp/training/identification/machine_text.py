"""Machine as the text of its file, with a comment after each parameter that states its origin."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from typing import Any

import tomli_w

from edp.sim.machine.machine import Machine

DIGITS = 7
"""Of a number in the file: far below any interval."""


def machine_text(machine: Machine, head: Sequence[str], comments: Mapping[tuple[str, str], str]) -> str:
    """Return TOML that `edp.sim.machine.machine_files.parse_machine` reads back to the same machine.

    Rounded to `DIGITS`.

    Args:
        machine: machine to write.
        head: lines of comment at the top.
        comments: comments by section and key, appended to their line; one line of printable text each.
    """
    lines = [f"# {_one_line(text)}" for text in head]
    tables = []
    for field in fields(machine):
        value = getattr(machine, field.name)
        if is_dataclass(value):
            tables.append((field.name, value))
        else:
            lines.append(_line("", field.name, value, comments))
    for name, table in tables:
        lines += ["", f"[{name}]"]
        lines += [_line(name, inner.name, getattr(table, inner.name), comments) for inner in fields(table)]
    return "\n".join(lines) + "\n"


def _line(section: str, key: str, value: Any, comments: Mapping[tuple[str, str], str]) -> str:
    text = f"{key} = {_value(value)}"
    comment = comments.get((section, key), "")
    return f"{text.ljust(60)}  # {_one_line(comment)}" if comment else text


def _value(value: Any) -> str:
    if isinstance(value, tuple):
        return f"[{', '.join(_value(entry) for entry in value)}]"
    if isinstance(value, str):
        # By the writer of TOML: a text of a file may hold anything.
        return tomli_w.dumps({"x": value}).removeprefix("x = ").rstrip("\n")
    if isinstance(value, int) or not math.isfinite(value):
        return str(value)
    return repr(float(f"{value:.{DIGITS}g}"))


def _one_line(text: str) -> str:
    """Replace characters that would end a comment."""
    return "".join(c if c.isprintable() else " " for c in text)
