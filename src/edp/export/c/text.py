"""The one writer of C text: literals, definitions of constants, enumerations, statements."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from edp.errors import ExportError
from edp.export.escape import C_SIGNIFICANT, Code, c_comment, c_names
from edp.export.si_names import si_channels
from edp.signals import Channel

WIDTH = 118


def identifier(name: str) -> str:
    """Return the name of a layer as a C identifier."""
    return re.sub(r"\W", "_", name, flags=re.ASCII)


# ---- literals --------------------------------------------------------------------------------------------------------


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


def double_number(value: float) -> str:
    """Return a double literal with enough digits to restore the same bits.

    Raises:
        ExportError: NaN or infinite, for which C has no literal.
    """
    text = repr(float(value))
    if text.lstrip("-") in ("inf", "nan"):
        raise ExportError(f"a number of the monitor is {value}; fit it again")
    return text if any(c in text for c in ".e") else f"{text}.0"


def bool_literal(value: bool) -> str:
    """Return a boolean literal."""
    return "true" if value else "false"


def unsigned_literals(values: Iterable[int]) -> list[str]:
    """Return unsigned integer literals."""
    return [f"{value}u" for value in values]


# ---- definitions -----------------------------------------------------------------------------------------------------


def filled(items: Iterable[str], indent: str = "    ") -> Code:
    """Return the items with commas between them in lines of at most `WIDTH` characters."""
    return Code(textwrap.fill(", ".join(items), WIDTH, initial_indent=indent, subsequent_indent=indent))


def initialiser(items: Iterable[str]) -> Code:
    """Return a braced initialiser on one line."""
    return Code(f"{{{', '.join(items)}}}")


def initialiser_rows(rows: Iterable[Iterable[str]]) -> Code:
    """Return braced initialisers, one per line."""
    return Code(",\n".join(f"    {initialiser(row)}" for row in rows))


def array(kind: str, name: str, values: Iterable[str], note: str = "") -> Code:
    """Return the definition of a constant array."""
    numbers = list(values)
    comment = f" /* {note} */" if note else ""
    return Code(f"static const {kind} {name}[{len(numbers)}] = {{{comment}\n{filled(numbers)}\n}};")


def struct(kind: str, name: str, members: Iterable[str]) -> Code:
    """Return the definition of a constant struct, or of a short array, on one line."""
    return Code(f"static const {kind} {name} = {initialiser(members)};")


def table(kind: str, name: str, rows: Iterable[Iterable[str]]) -> Code:
    """Return the definition of a constant array of structs or arrays, one row per line; `name` includes the sizes."""
    return Code(f"static const {kind} {name} = {{\n{initialiser_rows(rows)}\n}};")


def reference_array(kind: str, name: str, values: NDArray[np.floating], missing: bool = False) -> Code:
    """Return the definition of a constant array of reference values ``(value,)`` or ``(row, value)``.

    Args:
        kind: ``float`` or ``double``.
        name: name of the array.
        values: values of the array.
        missing: whether a value that is not finite becomes ``NAN``; else it is refused.
    """
    literal = double_number if kind == "double" else number

    def filled_row(row: NDArray[np.floating], indent: str) -> str:
        return filled(("NAN" if missing and not np.isfinite(value) else literal(value) for value in row), indent)

    if values.ndim == 1:
        return Code(f"static const {kind} {name}[{len(values)}] = {{\n{filled_row(values, '    ')}\n}};")
    body = ",\n".join("    {\n" + filled_row(row, "     ") + "}" for row in values)
    return Code(f"static const {kind} {name}[{len(values)}][{values.shape[1]}] = {{\n{body}\n}};")


def enumeration(
    prefix: str, names: Iterable[str], comments: Sequence[str], longest: int | None = None, aligned: bool = False
) -> Code:
    """Return the entries of an enumeration from 0 on, each with a comment, which is escaped here.

    Args:
        prefix: prefix of each entry.
        names: text after the prefix, any text.
        comments: comments after the entries.
        longest: characters of what follows the prefix, by default what C99 promises to tell apart.
        aligned: whether the comments begin in one column.
    """
    ends = c_names(names, C_SIGNIFICANT - len(prefix) if longest is None else longest)
    entries = [f"{prefix}{end} = {i}," for i, end in enumerate(ends)]
    wide = max(map(len, entries)) if aligned else 0
    lines = (f"    {entry:<{wide}} /* {c_comment(text)} */" for entry, text in zip(entries, comments, strict=True))
    return Code("\n".join(lines))


def channel_enumeration(
    prefix: str, channels: Sequence[Channel], longest: int | None = None, aligned: bool = False
) -> Code:
    """Return the entries of an enumeration of channels, each with its unit and description; see `enumeration`."""
    names = [channel.name for channel in si_channels(channels)]
    comments = [f"{channel.unit}; {channel.description}" for channel in channels]
    return enumeration(prefix, names, comments, longest, aligned)


# ---- statements ------------------------------------------------------------------------------------------------------


def call(function: str, *arguments: object) -> str:
    """Return a call statement; integers are written as unsigned."""
    argument_texts = [f"{x}u" if isinstance(x, int) else str(x) for x in arguments]
    return f"{function}({', '.join(argument_texts)});"


def indented(lines: Iterable[str], indent: str = "    ") -> Code:
    """Return the statements, broken where they are too long."""
    indented_lines = []
    for line in lines:
        own = indent + line[: len(line) - len(line.lstrip())]
        wrapped = textwrap.wrap(line.strip(), WIDTH, initial_indent=own, subsequent_indent=own + "    ")
        indented_lines += wrapped if line.strip() and not line.lstrip().startswith("/*") else [indent + line]
    return Code("\n".join(indented_lines))
