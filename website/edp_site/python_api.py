"""The reference of the Python interface: every public name with its signature and docstring."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator
from types import ModuleType
from typing import Any

import edp
from edp_site import markdown
from edp_site.parts import first_sentence

_SECTION = re.compile(r"^(Args|Attributes|Returns|Yields|Raises|Example|Note):\s*$")
_ENTRY = re.compile(r"^(\*{0,2}[\w`., |*]+?)(?: \([^)]*\))?: (.*)$")
_WIDTH = 88
"""A signature that is longer gets a line for each parameter."""


def python_page() -> str:
    """Describe every name of ``edp.__all__`` and the public members of its classes, below an overview."""
    names = sorted(public_names(), key=lambda name: (name.lower(), name))
    lines = ["## Public names", "", "| Name | What it is |", "|---|---|"]
    for name in names:
        text = first_sentence(getattr(edp, name)) if name != "__version__" else "Version of the package."
        lines.append(f"| [`edp.{name}`](#{markdown.anchor_of(f'edp.{name}')}) | {text} |")
    for name in names:
        lines += ["", *_entry(f"edp.{name}", getattr(edp, name), 2)]
    return "\n".join(lines) + "\n"


def public_names() -> tuple[str, ...]:
    """The names of ``edp.__all__``."""
    return tuple(vars(edp)["__all__"])


def members(cls: type) -> Iterator[tuple[str, Any]]:
    """Public methods and properties of a class, those of its bases in this package included."""
    shown: dict[str, Any] = {}
    for owner in cls.__mro__:
        if owner.__module__.partition(".")[0] == "edp":
            for name, member in vars(owner).items():
                if not name.startswith("_") and name not in shown:
                    shown[name] = member
    for name, member in shown.items():
        target = member.__func__ if isinstance(member, classmethod | staticmethod) else member
        if inspect.isfunction(target) or isinstance(target, property):
            yield name, member


def _entry(name: str, value: Any, depth: int) -> list[str]:
    lines = [f"{'#' * depth} `{name}`", ""]
    if isinstance(value, ModuleType):
        lines += described(value)
        for inner in vars(value)["__all__"]:
            lines += ["", *_entry(f"{name}.{inner}", getattr(value, inner), depth + 1)]
        return lines
    if isinstance(value, str):
        return [*lines, f"Version of the package, a text; this page is of `{value}`."]
    if inspect.isclass(value):
        if not issubclass(value, BaseException):
            lines += _signature(name, value)
        lines += described(value)
        for member_name, member in members(value):
            lines += ["", *_member(f"{name.rpartition('.')[2]}.{member_name}", member, depth + 1)]
        return lines
    return lines + _signature(name, value) + described(value)


def _member(name: str, member: Any, depth: int) -> list[str]:
    lines = [f"{'#' * depth} `{name}`", ""]
    if isinstance(member, property):
        kind = inspect.signature(member.fget).return_annotation if member.fget else ""
        return [*lines, f"Property: `{_type(kind)}`.", "", *described(member)]
    target = member.__func__ if isinstance(member, classmethod | staticmethod) else member
    return lines + _signature(name, target, drop_first=not isinstance(member, staticmethod)) + described(target)


def _type(annotation: Any) -> str:
    return annotation if isinstance(annotation, str) else getattr(annotation, "__name__", str(annotation))


def _signature(name: str, value: Any, drop_first: bool = False) -> list[str]:
    try:
        signature = inspect.signature(value)
    except (TypeError, ValueError):
        return []
    taken = list(signature.parameters.values())[1 if drop_first else 0 :]
    # Annotations are texts here; `inspect` would put them in quotes.
    texts, starred = [], False
    for parameter in taken:
        if parameter.kind is parameter.KEYWORD_ONLY and not starred:
            texts.append("*")
        starred = starred or parameter.kind in (parameter.KEYWORD_ONLY, parameter.VAR_POSITIONAL)
        texts.append(_parameter(parameter))
    returned = "" if signature.return_annotation is signature.empty else f" -> {_type(signature.return_annotation)}"
    if inspect.isclass(value):
        returned = ""
    line = f"{name}({', '.join(texts)}){returned}"
    if len(line) > _WIDTH:
        line = f"{name}(\n" + "".join(f"    {text},\n" for text in texts) + f"){returned}"
    return ["```python", line, "```", ""]


def _parameter(parameter: inspect.Parameter) -> str:
    stars = "*" * ((parameter.kind is parameter.VAR_POSITIONAL) + 2 * (parameter.kind is parameter.VAR_KEYWORD))
    kind = "" if parameter.annotation is parameter.empty else f": {_type(parameter.annotation)}"
    default = "" if parameter.default is parameter.empty else f" = {_default(parameter.default)}"
    return f"{stars}{parameter.name}{kind}{default}"


def _default(value: Any) -> str:
    text = repr(value)
    return "..." if len(text) > 40 or text.startswith("<") else text


def described(value: Any) -> list[str]:
    """A docstring in Google's form as Markdown: sections become lists."""
    text = inspect.getdoc(value) or ""
    lines: list[str] = []
    section = ""
    for line in text.replace("``", "`").splitlines():
        match = _SECTION.match(line)
        if match:
            section = match[1]
            lines += ["", f"**{section}**", ""]
        elif section and line.startswith("    ") and not line.startswith("     "):
            entry = _ENTRY.match(line.strip())
            lines.append(f"* `{entry[1]}`: {entry[2]}" if entry and section != "Returns" else f"* {line.strip()}")
        elif section and line.strip():
            lines.append(f"  {line.strip()}")
        else:
            section = section if not line.strip() else ""
            lines.append(line)
    return _joined(lines)


def _joined(lines: list[str]) -> list[str]:
    """Entries of a ``Returns`` section that go on over lines are one entry."""
    result: list[str] = []
    returns = False
    for line in lines:
        returns = line == "**Returns**" or (returns and (not line or line.startswith("* ")))
        if returns and line.startswith("* ") and result and result[-1].startswith("* "):
            result.append(f"  {line[2:]}")
        else:
            result.append(line)
    return result
