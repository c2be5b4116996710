"""The tree of commands: as a page of the reference, and as what command lines on pages are held to."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from functools import cache
from itertools import pairwise
from typing import Any, NamedTuple

import typer

from edp.cli import PANELS, app
from edp.cli.exit_codes import EXIT_CODES
from edp.cli.groups import RUN, RunByDefault
from edp_site import markdown

_SHELLS = ("", "sh", "bash", "console", "shell")
ENDS = re.compile(r"\s(?:\||&&|;|>|2>)\s?")
"""What ends a command line in a shell: a pipe, another command or a redirection."""
_PLACES = re.compile(r"^(\.\.\.|…|\[.*|.*\])$")


class Command(NamedTuple):
    """A command by its words, such as ``monitor fit``, and its object of the command line's library."""

    words: tuple[str, ...]
    parsed: Any

    @property
    def options(self) -> dict[str, Any]:
        """Its options by each of their names; ``--help`` is one of every command."""
        return {name: option for option in self.parsed.params for name in (*option.opts, *option.secondary_opts)}


@cache
def commands() -> dict[tuple[str, ...], Command]:
    """Every command and group of ``edp`` by its words, in the order of ``edp --help``; the root has none."""
    found: dict[tuple[str, ...], Command] = {}

    def walk(words: tuple[str, ...], parsed: Any) -> None:
        found[words] = Command(words, parsed)
        for name, inner in getattr(parsed, "commands", {}).items():
            walk((*words, name), inner)

    walk((), typer.main.get_command(app))
    return found


def command_lines(text: str) -> Iterator[tuple[int, str]]:
    """Line and text of each ``edp ...`` on a page: in blocks of a shell or without a language, and in sentences."""
    for fence in markdown.fences(text):
        if fence.language in _SHELLS:
            joined = fence.code.replace("\\\n", "  ")
            for offset, line in enumerate(joined.splitlines()):
                start = re.match(r"\s*(?:\$ )?(?:\.venv/bin/)?(edp\s.*)", line)
                if start:
                    yield fence.line + offset, start[1]
    for number, code in markdown.code_spans(text):
        if code.startswith("edp "):
            yield number, code


def problems_of(line: str, known: dict[tuple[str, ...], Command]) -> list[str]:
    """Return the commands and options of a command line that do not exist; values are not checked.

    Args:
        line: ``edp ...`` as on a page; placeholders such as ``RUN`` or ``...`` may stand for values.
        known: of `commands`.
    """
    try:
        words = shlex.split(ENDS.split(f"{line} ")[0], comments=True)[1:]
    except ValueError as error:
        return [f"'{line}' cannot be read: {error}"]
    named: tuple[str, ...] = ()
    while words and (*named, words[0]) in known:
        named = (*named, words.pop(0))
    if not named and not (words and words[0].startswith("-")):
        return [f"there is no command '{words[0]}'"] if words and not _PLACES.match(words[0]) else []
    typed = named
    # `edp search DATA` is `edp search run DATA`
    if words and (*named, RUN) in known and isinstance(known[named].parsed, RunByDefault):
        named = (*named, RUN)
    command = known[named]
    options = command.options
    wrong = [
        f"'edp {' '.join(typed)}' has no option '{name}'"
        for name in (word.partition("=")[0].rstrip(",;:.") for word in words if re.match(r"--?[A-Za-z]", word))
        if name not in options and name not in ("--help",)
    ]
    if hasattr(command.parsed, "commands") and named and words and not words[0].startswith("-"):
        wrong.append(f"'edp {' '.join(named)}' has no command '{words[0]}'")
    return wrong


def settings_of(line: str) -> tuple[tuple[str, ...], list[str]]:
    """Return the words of a command line without options, and the settings that its ``--set`` options change."""
    words = shlex.split(ENDS.split(f"{line} ")[0], comments=True)[1:]
    changes = [after for word, after in pairwise(words) if word == "--set"]
    return tuple(words), changes


def commands_page() -> str:
    """Return the reference of all commands."""
    known = commands()
    parts = [
        "# Commands",
        "",
        "Generated from the code. `edp train DATA`, `edp search DATA` and `edp adapt RUN` are "
        "the commands `run` of these groups.",
        "",
        "| Panel | Command | Does |",
        "|---|---|---|",
    ]
    panels = {name: panel for panel, entries in PANELS for name in entries}
    for words, command in known.items():
        if words and not hasattr(command.parsed, "commands"):
            name = " ".join(("edp", *words))
            link = f"[`{name}`](#{markdown.anchor_of(name)})"
            parts.append(f"| {panels[words[0]]} | {link} | {_cell(_summary(command))} |")
    parts += ["", "## Exit codes", "", "| Exit code | Means |", "|---|---|"]
    parts += [f"| {code} | {_cell(meaning)} |" for code, meaning in EXIT_CODES.items()]
    for words, command in known.items():
        if words and not hasattr(command.parsed, "commands"):
            parts += ["", *_section(command)]
    return "\n".join(parts) + "\n"


def _summary(command: Command) -> str:
    return " ".join((command.parsed.help or "").split("\n\n")[0].split())


def _section(command: Command) -> list[str]:
    name = " ".join(("edp", *command.words))
    places = [option for option in command.parsed.params if not option.opts[0].startswith("-")]
    usage = " ".join([name, *(place.opts[0].upper() for place in places), "[OPTIONS]"])
    lines = [f"## {name}", "", "```text", usage, "```", ""]
    for paragraph in (command.parsed.help or "").split("\n\n"):
        text = " ".join(paragraph.split())
        example = re.fullmatch(r"Example: `(.+)`", text)
        lines += ["```sh", example[1], "```", ""] if example else [text, ""]
    lines += ["| Argument or option | Takes | Default | Meaning |", "|---|---|---|---|"]
    for option in command.parsed.params:
        if not option.hidden:
            lines.append(_row(option))
    return lines


def _row(option: Any) -> str:
    names = option.opts if option.opts[0].startswith("-") else [option.opts[0].upper()]
    takes = "a flag" if getattr(option, "is_flag", False) else option.display_type(None).strip("<>")
    default = option.default
    if option.required:
        shown = "required"
    elif callable(default) or default is False or default in (None, [], (), ""):
        shown = ""
    else:
        shown = f"`{default}`"
    repeated = " May be repeated." if option.multiple else ""
    shown_names = ", ".join(f"`{name}`" for name in (*names, *option.secondary_opts))
    return f"| {shown_names} | {_cell(takes)} | {shown} | {_cell(option.help or '')}{repeated} |"


def _cell(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|")
