"""C as text: identifiers, numbers, arrays, calls."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterable, Sequence

import numpy as np

WIDTH = 118
_WORDS = """
auto break case char const continue default do double else enum extern float for goto if inline int long register
restrict return short signed sizeof static struct switch typedef union unsigned void volatile while bool true false
in out s work work16 work32 main
"""
KEYWORDS = frozenset(re.findall(r"\w+", _WORDS))
"""Words that a name cannot be: those of C99, and those that the generated code uses."""


def identifier(name: str) -> str:
    """A name as a C identifier."""
    return re.sub(r"\W", "_", name, flags=re.ASCII)


def identifiers(names: Sequence[str]) -> list[str]:
    """Names as C identifiers, different ones for different names."""
    made: list[str] = []
    for name in map(identifier, names):
        made.append(next(c for n in range(len(names) + 1) if (c := f"{name}_{n}" if n else name) not in made))
    return made


def number(value: float | np.floating) -> str:
    """A float32 literal with the digits that give back the same bits."""
    text = f"{np.float32(value):.9g}"
    return text + ("f" if any(c in text for c in ".e") else ".0f")


def filled(items: Iterable[str], indent: str = "    ") -> str:
    """Items with commas between them in lines of at most `WIDTH` characters."""
    return textwrap.fill(", ".join(items), WIDTH, initial_indent=indent, subsequent_indent=indent)


def array(kind: str, name: str, values: Iterable[str], note: str = "") -> str:
    """The definition of a constant array."""
    held = list(values)
    comment = f" /* {note} */" if note else ""
    return f"static const {kind} {name}[{len(held)}] = {{{comment}\n{filled(held)}\n}};"


def call(function: str, *arguments: object) -> str:
    """A call statement; whole numbers are written as unsigned."""
    given = [f"{x}u" if isinstance(x, int) else str(x) for x in arguments]
    return f"{function}({', '.join(given)});"


def indented(lines: Iterable[str], indent: str = "    ") -> str:
    """Statements, broken where they are too long."""
    made = []
    for line in lines:
        own = indent + line[: len(line) - len(line.lstrip())]
        wrapped = textwrap.wrap(line.strip(), WIDTH, initial_indent=own, subsequent_indent=own + "    ")
        made += wrapped if line.strip() and not line.lstrip().startswith("/*") else [indent + line]
    return "\n".join(made)
