"""Index of all error messages, read from the source code: identifier, template, error class and remedy.

The identifier is ``E-`` and six hexadecimal digits of a hash of the template, so it changes only with the wording.
"""

from __future__ import annotations

import ast
import builtins
import hashlib
import re
import traceback
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import FunctionType

from edp.storage.paths import files_below

PACKAGE = Path(__file__).parents[1]
DIGITS = 6
VALUE = "..."
"""Stands in a template for a value that is known when the error occurs."""
MIN_LETTERS = 8
"""Templates with fewer letters, such as a prefix for another message, fit too many messages."""
MAX_CHARACTERS = 20_000
"""Longer messages are not searched; they quote values from files."""
_TEXTS = ("missing_text", "describe_unfinished", "memory_message", "_describe_failure")
"""Functions that return the message of an error."""
_ERRORS = ("Error", "_error", "broken", "refused", "_Damaged", "_failure", "_busy", "Diverged", "Missing")
"""Endings of classes and helper functions that create an error from its message."""


@dataclass(frozen=True)
class ErrorMessage:
    """Error message in the source code.

    Attributes:
        identifier: ``E-`` and `DIGITS` hexadecimal digits.
        template: message with `VALUE` in place of values.
        error: name of the error class, or of the function that creates it.
        module: dotted name of the module.
    """

    identifier: str
    template: str
    error: str
    module: str

    @property
    def cause(self) -> str:
        """Finding: the template up to its remedy."""
        return self.template.partition("; ")[0]

    @property
    def remedy(self) -> str:
        """Remedy: the template after the first semicolon; empty for a message without one."""
        return self.template.partition("; ")[2]

    def fits(self, text: str) -> bool:
        """Return whether a message can come from this template."""
        if self.letters < MIN_LETTERS:
            return False
        first, *others = self.template.split(VALUE)
        if not others:
            return text == first
        # A search for one part after the other takes linear time, unlike a pattern with many wildcards.
        position, end = len(first), len(text) - len(others[-1])
        if not (text.startswith(first) and text.endswith(others[-1])):
            return False
        for part in others[:-1]:
            position = text.find(part, position) + len(part)
            if position < len(part):
                return False
        return position <= end

    @property
    def letters(self) -> int:
        """Number of letters that do not depend on a value."""
        return sum(map(str.isalpha, self.template))


def list_messages() -> tuple[ErrorMessage, ...]:
    """Return the error messages of EDP, sorted by module, then in the order of the source code."""
    messages = [message for path in sorted(files_below(PACKAGE, "*.py")) for message in _read_messages(path)]
    return tuple({message.identifier: message for message in reversed(messages)}.values())[::-1]


def identify(error: BaseException) -> str:
    """Return the identifier of the most specific template that an error's message fits; empty if no template fits.

    The modules of the traceback and the functions that they import are searched first. All other modules are read only
    for an error of another process.
    """
    text = str(error)
    if len(text) > MAX_CHARACTERS:
        return ""
    for paths in (_find_near_sources(error), files_below(PACKAGE, "*.py")):
        fitting = [entry for path in sorted(paths) for entry in _read_messages(path) if entry.fits(text)]
        if fitting:
            return max(fitting, key=lambda entry: entry.letters).identifier
    return ""


def _find_near_sources(error: BaseException) -> set[Path]:
    """Return the source files of EDP that raised an error, and of the functions that these files import."""
    files = set()
    for frame, _ in traceback.walk_tb(error.__traceback__):
        functions = [value for value in frame.f_globals.values() if isinstance(value, FunctionType)]
        files |= {frame.f_code.co_filename, *(function.__code__.co_filename for function in functions)}
    return {path for path in map(Path, files) if path.is_relative_to(PACKAGE)}


@cache
def _read_messages(path: Path) -> tuple[ErrorMessage, ...]:
    text = _read_text(path)
    if not any(f"{ending}(" in text for ending in (*_ERRORS, *_TEXTS)):
        return ()
    parts = (PACKAGE.name, *path.relative_to(PACKAGE).with_suffix("").parts)
    module = ".".join(parts).removesuffix(".__init__")
    return tuple(
        ErrorMessage(f"E-{hashlib.sha256(template.encode()).hexdigest()[:DIGITS]}", template, error, module)
        for error, template in _find_templates(ast.parse(text))
    )


def _read_text(path: Path) -> str:
    """Return the text of a source file; empty if the file cannot be read."""
    try:
        return path.read_text(encoding="utf-8")
    except OSError:
        return ""


def _find_templates(tree: ast.Module) -> Iterator[tuple[str, str]]:
    """Yield error name and template of every message that a module creates."""
    for node in ast.walk(tree):
        name, texts = "", []
        if isinstance(node, ast.Call) and node.args:
            name = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
            texts = [node.args[0]] if name.endswith(_ERRORS) and not hasattr(builtins, name) else []
        elif isinstance(node, ast.FunctionDef) and node.name in _TEXTS:
            name = node.name
            texts = [part for part in ast.walk(node) if isinstance(part, ast.JoinedStr)]
        for template in map(_read_template, texts):
            if any(map(str.isalpha, template.replace(VALUE, ""))):
                yield name, re.sub(r"\.\.\.(?:\s*\.\.\.)+", VALUE, template)


def _read_template(node: ast.expr) -> str:
    """Return the constant text of an expression with `VALUE` in place of its other parts."""
    if isinstance(node, ast.Constant):
        return node.value if isinstance(node.value, str) else VALUE
    if isinstance(node, ast.JoinedStr):
        return "".join(map(_read_template, node.values))
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
        return _read_template(node.left) + _read_template(node.right)
    return VALUE
