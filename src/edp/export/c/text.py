"""C text: identifiers, numbers, arrays, calls."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterable

import numpy as np

from edp.errors import ExportError
from edp.export.escape import Code

WIDTH = 118


def identifier(name: str) -> str:
    """Return the name of a layer as a C identifier."""
    return re.sub(r"\W", "_", name, flags=re.ASCII)


def number(value: float | np.floating) -> str:
    """Return a float32 literal with enough digits to restore the same bits.

    Raises:
        ExportError: NaN, or no float32, for which C has no literal.
    """
    with np.errstate(over="ignore"):
        # Nine significant digits give every float32 back to the bit.
        text = f"{np.float32(value):.9g}"
    if text.lstrip("-") in ("inf", "nan"):
        raise ExportError(f"a constant of the network is {value}, which is no float32 number; train it again")
    # A literal without `f` is a double: the compiler would compute in software on a controller.
    return text + ("f" if any(c in text for c in ".e") else ".0f")


def filled(items: Iterable[str], indent: str = "    ") -> Code:
    """Items with commas between them in lines of at most `WIDTH` characters."""
    return Code(textwrap.fill(", ".join(items), WIDTH, initial_indent=indent, subsequent_indent=indent))


def array(kind: str, name: str, values: Iterable[str], note: str = "") -> Code:
    """Return the definition of a constant array."""
    numbers = list(values)
    comment = f" /* {note} */" if note else ""
    return Code(f"static const {kind} {name}[{len(numbers)}] = {{{comment}\n{filled(numbers)}\n}};")


def call(function: str, *arguments: object) -> str:
    """Return a call statement; integers are written as unsigned."""
    argument_texts = [f"{x}u" if isinstance(x, int) else str(x) for x in arguments]
    return f"{function}({', '.join(argument_texts)});"


def indented(lines: Iterable[str], indent: str = "    ") -> Code:
    """Statements, broken where they are too long."""
    indented_lines = []
    for line in lines:
        own = indent + line[: len(line) - len(line.lstrip())]
        wrapped = textwrap.wrap(line.strip(), WIDTH, initial_indent=own, subsequent_indent=own + "    ")
        indented_lines += wrapped if line.strip() and not line.lstrip().startswith("/*") else [indent + line]
    return Code("\n".join(indented_lines))
