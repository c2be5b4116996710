"""Common part of all commands: output, progress with rate and time left, tables, and error handling."""

from __future__ import annotations

import json
import math
import os
import re
import sys
import threading
import time
import unicodedata
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cache, partial
from typing import Annotated, Any, cast

import typer
from rich.console import Console, ConsoleDimensions
from rich.progress import BarColumn, Progress, ProgressColumn, Task, TaskID, TaskProgressColumn
from rich.table import Table as RichTable
from rich.text import Text

from edp.cli.error_index import identify
from edp.cli.exit_codes import EXIT_CODES_AT
from edp.cli.options import check_belonging, setting_of, words_of
from edp.cli.process import exit_code_of_stop, memory_message, out_of_memory
from edp.errors import ConfigError, EdpError
from edp.table import Column, Table

UNFOLDED_COLUMNS = 100_000
"""Width of output that is not a terminal."""
KEPT_BREAK = re.compile(r"\n(?=  - )")
"""The line break that messages list several things with; any other may come from a name."""


def visible(text: str) -> str:
    r"""Escape characters that move the cursor, change the text direction or are invalid.

    Control characters and escape sequences, bidirectional and other invisible controls, line breaks, and the bytes of
    file names that are not UTF-8 become ``\x1b``, ``\u202e``, ``\n`` and ``\xff``.
    """
    # Control characters of a file name could move the cursor or hide text.
    return "".join(c if c.isprintable() or unicodedata.category(c) == "Zs" else _escape(c) for c in text)


def _escape(character: str) -> str:
    code = ord(character)
    if 0xDC80 <= code <= 0xDCFF:  # a byte of a file name, as Python holds it
        return f"\\x{code - 0xDC00:02x}"
    return character.encode("unicode_escape", "surrogatepass").decode("ascii")


class Terminal(Console):
    """Console for all text of the command line: no markup, invisible characters escaped."""

    def __init__(self, stderr: bool = False) -> None:
        # Names of channels may look like markup.
        super().__init__(stderr=stderr, markup=False, emoji=False, highlight=False, soft_wrap=True)

    @property
    def size(self) -> ConsoleDimensions:
        """Size of the terminal; the size of a pipe or file is `COLUMNS` if set, otherwise wide enough for any row.

        A row that is folded in a file can no longer be searched or cut into columns.
        """
        if self.is_terminal or "COLUMNS" in os.environ:
            return super().size
        return ConsoleDimensions(UNFOLDED_COLUMNS, 25)

    @size.setter
    def size(self, dimensions: tuple[int, int]) -> None:
        self._width, self._height = dimensions

    def print(self, *objects: Any, **options: Any) -> None:
        """Print text, or a renderable of this module."""
        super().print(*(_to_text(part) if isinstance(part, str) else part for part in objects), **options)


def _to_text(text: str) -> Text:
    return Text("\n".join(map(visible, KEPT_BREAK.split(text))))


out = Terminal()
err = Terminal(stderr=True)

JsonFlag = Annotated[bool, typer.Option("--json", help="Print one JSON document to standard output and nothing else.")]
INTERRUPTED = 130
CLOSED_PIPE = 141
"""Exit code where nobody reads the output any more: 128 and SIGPIPE."""
_GAP = 2
"""Blanks between two columns of a table."""
PATH_OPTIONS = frozenset(
    f"--{name}"
    for name in (
        *("base", "budget", "config", "data", "deltas", "features", "fleet", "unlabelled", "limit", "map", "out"),
        *("page", "scenario", "start", "tuning-plant"),
        *(
            "log",
            "mdf",
            "monitor",
            "plant",
            "plots",
            "predictor",
            "record",
            "run",
            "save",
            "teacher",
            "twin",
            "w8a16",
        ),
    )
)
"""Options of all commands that name a file or folder."""


def emit(as_json: bool, facts: Mapping[str, object], show: Callable[[], None]) -> None:
    """Print a result as JSON, or call `show` for readable output."""
    if as_json:
        # Strict JSON: NaN would break every other reader.
        sys.stdout.write(json.dumps(facts, indent=1, allow_nan=False) + "\n")
    else:
        show()


def print_table(table: Table) -> None:
    """Print a table; columns of words are aligned left and folded, figures are aligned right, marked rows are bold.

    Figures that do not fit beside each other stand below each other, each block with the first column.
    """
    table = table.drop_empty_columns()
    headings, rows = table.heads(), [[_to_text(cell) for cell in row] for row in table.texts()]
    widths = _widths(headings, rows)
    has_words = any(column.is_text for column in table.columns[1:])
    for i, block in enumerate([list(range(len(widths)))] if has_words else _blocks(widths, out.width)):
        printed_table = RichTable(
            title=_to_text(table.caption) if table.caption and not i else None,
            title_justify="left",
            title_style="bold",
            header_style="bold",
            box=None,
            pad_edge=False,
        )
        for column in block:
            # Names are folded, never cut: six rows of a table once all read CylPress... A text that is wider than what
            # the names leave stands alone beside them, and would be cut, too, if it could not go on in the next row.
            wide = len(block) == 2 and sum(widths[other] + _GAP for other in block) > out.width
            folded = column == 0 or wide or table.columns[column].is_text
            printed_table.add_column(
                _to_text(headings[column]), justify="left" if folded else "right", overflow="fold", no_wrap=not folded
            )
        for row, cells in enumerate(rows):
            printed_table.add_row(
                *(cells[j] for j in block if j < len(cells)), style="bold" if row in table.marked else None
            )
        out.print(printed_table)


def table(title: str, headings: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    """Print rows of figures, the first column as text; see `print_table`."""
    print_table(Table(title, tuple(Column(heading, show=_cell) for heading in headings), tuple(map(tuple, rows))))


def listing(title: str, headings: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """Print rows of text, everything to the left and folded where it is wide."""
    columns = tuple(Column(heading, show=str, is_text=True) for heading in headings)
    print_table(Table(title, columns, tuple(map(tuple, rows))))


def _cell(value: Any) -> str:
    return f"{value:,}" if isinstance(value, int) else str(value)


def _widths(headings: Sequence[str], rows: Sequence[Sequence[Text]]) -> list[int]:
    """Return the width of each column."""
    return [
        max([_to_text(heading).cell_len, *(row[i].cell_len for row in rows if i < len(row))])
        for i, heading in enumerate(headings)
    ]


def _blocks(widths: Sequence[int], width: int) -> list[list[int]]:
    """Columns by blocks that fit into a width, each with the first one."""
    # A long name takes at most half of a line, and is folded.
    first = min(widths[0], max(width // 2, 1)) if widths else 0
    blocks: list[list[int]] = []
    for column in range(1, len(widths)):
        used_width = first + sum(widths[other] + _GAP for other in blocks[-1][1:]) if blocks else 0
        if not blocks or used_width + widths[column] + _GAP > width:
            blocks.append([0, column])
        else:
            blocks[-1].append(column)
    return blocks or [list(range(len(widths)))]


class Words(ProgressColumn):
    """The description or the note of a task, as text."""

    def __init__(self, of_task: Callable[[Task], str]) -> None:
        super().__init__()
        self.of_task = of_task

    def render(self, task: Task) -> Text:
        """Return the present words."""
        return _to_text(self.of_task(task))


class BoundedProgress(Progress):
    """Progress display that bounds each task by its total."""

    def update(self, task_id: TaskID, **changes: Any) -> None:
        """Update a task; completed work is bounded by the total."""
        task = self._tasks[task_id]
        total = changes["total"] if changes.get("total") is not None else task.total
        advance = changes.pop("advance", None)
        if advance is not None:
            changes["completed"] = task.completed + advance
        if total is not None and changes.get("completed") is not None:
            changes["completed"] = min(max(changes["completed"], 0.0), total)
        super().update(task_id, **changes)


class TimeLeft(ProgressColumn):
    """Time left of a task at work, at least one second; the time taken once all is done."""

    max_refresh = 0.5

    def render(self, task: Task) -> Text:
        """Return the time now."""
        if task.finished:
            return Text("" if task.finished_time is None else duration(task.finished_time))
        return Text("" if task.time_remaining is None else format_time_left(task.time_remaining).removeprefix(", "))


def format_time_left(seconds: float) -> str:
    """Return ``, 5 s left`` for a line of progress; empty where the estimate is used up or not finite.

    Args:
        seconds: estimated time that the remaining work takes.
    """
    if not 0.0 < seconds < math.inf:
        return ""
    return f", {duration(max(1.0, seconds))} left"


def count_text(done: int, planned: int, sign: str = " of ") -> str:
    """Return the progress of a plan as text, such as "3 of 8" or "9, more than the 8 planned".

    Args:
        done: number done, or of the one at work.
        planned: number planned.
        sign: between both.
    """
    return f"{done}, more than the {planned} planned" if done > planned else f"{done}{sign}{planned}"


@contextmanager
def progress(quiet: bool = False) -> Iterator[Progress]:
    """Show progress on standard error: a bar, a note (rate and figures) and the time left."""
    columns = (
        Words(lambda task: task.description),
        BarColumn(bar_width=24),
        TaskProgressColumn(),
        Words(lambda task: task.fields["note"]),
        TimeLeft(),
    )
    # Four updates a second: more only flickers, and slow terminals lag behind.
    with BoundedProgress(*columns, console=err, disable=quiet or not err.is_terminal, refresh_per_second=4) as shown:
        yield shown


class Steps:
    """Plain progress lines for output that is not a terminal, at most one every few seconds."""

    def __init__(self, quiet: bool, every_s: float = 5.0) -> None:
        # Lines instead of a bar where output goes to a file.
        self.active = not quiet and not err.is_terminal
        self.every_s = every_s
        self._last = 0.0

    def say(self, text: str, force: bool = False) -> None:
        """Print a line, unless the last one is too recent."""
        now = time.monotonic()
        if self.active and (force or now - self._last >= self.every_s):
            self._last = now
            err.print(text)


@contextmanager
def waiting(text: str, quiet: bool = False, every_s: float = 15.0) -> Iterator[None]:
    """Report a long step of unknown duration on standard error, at increasing intervals.

    Args:
        text: description of the step.
        quiet: say nothing.
        every_s: until it is said again; twice as long each time.
    """
    if quiet:
        yield
        return
    began, ended = time.monotonic(), threading.Event()

    def repeat() -> None:
        pause = every_s
        while not ended.wait(pause):
            err.print(f"{text}: {duration(time.monotonic() - began)} so far")
            pause *= 2.0

    err.print(text)
    teller = threading.Thread(target=repeat, daemon=True)
    teller.start()
    try:
        yield
    finally:
        ended.set()
        teller.join()


def duration(seconds: float) -> str:
    """Seconds as ``1 h 05 min``, ``3 min 20 s`` or ``12 s``."""
    whole = round(seconds)
    if whole >= 3600:
        return f"{whole // 3600} h {whole % 3600 // 60:02d} min"
    return f"{whole // 60} min {whole % 60:02d} s" if whole >= 60 else f"{whole} s"


def run_app(app: typer.Typer | Callable[..., Any]) -> int:
    """Run the command line; a user's mistake ends in one message and that error's exit code, Ctrl-C in 130."""
    try:
        refuse_empty(sys.argv[1:])
        # Click would end the process itself; errors are to be told here.
        command = partial(_command(app), prog_name="edp") if isinstance(app, typer.Typer) else app
        # The code of a command that raised typer.Exit; 130 after Ctrl-C; else None.
        code = command(standalone_mode=False)
        sys.stdout.flush()  # a full disk or a closed pipe is told here, not by Python at its end
        if code == INTERRUPTED:
            raise KeyboardInterrupt
    except EdpError as error:
        identifier = identify(error)
        _say_error(f"{error} [{identifier}]" if identifier else str(error))
        return error.exit_code
    except typer.Exit as done:
        return done.exit_code
    except (KeyboardInterrupt, typer.Abort):
        err.print("stopped; what was finished is on disk: give the same command again to go on")
        return exit_code_of_stop(INTERRUPTED)
    except OSError as error:
        return _say_system(error)
    except Exception as error:
        if out_of_memory(error):
            _say_error(memory_message(error))
            return 1
        # Errors of usage have a message; anything else is a fault of the program, with its traceback.
        if not hasattr(error, "format_message"):
            raise
        _say_usage(error)
        return int(getattr(error, "exit_code", 2))
    return code if isinstance(code, int) else 0


@cache
def _command(app: typer.Typer) -> Callable[..., Any]:
    """Return the commands with their options, read from the function signatures once per process."""
    command: Any = typer.main.get_command(app)
    _check_options_of(command)
    return cast(Callable[..., Any], command)


def _check_options_of(command: Any) -> None:
    """Prepare every command below a group: it refuses options without effect, and its help names the exit codes."""
    for inner in getattr(command, "commands", {}).values():
        _check_options_of(inner)
    if not hasattr(command, "commands"):
        command.epilog = EXIT_CODES_AT
        run = command.invoke

        def invoke(context: typer.Context) -> Any:
            check_belonging(context)
            return run(context)

        command.invoke = invoke


def refuse_empty(words: Sequence[str]) -> None:
    """Refuse an empty path, which Python would interpret as the working directory.

    Raises:
        ConfigError: an empty word, or an option of `PATH_OPTIONS` with nothing behind it.
    """
    for position, word in enumerate(words):
        before = words[position - 1] if position else ""
        behind_option = before.startswith("--") and before not in PATH_OPTIONS
        option, sign, value = word.partition("=")
        if (not word and not behind_option) or (sign and not value and option in PATH_OPTIONS):
            what = option or (before if before in PATH_OPTIONS else "an argument")
            raise ConfigError(f"{what} is empty; give a path (. is the folder that you are in)")


def _say_system(error: OSError) -> int:
    """Print the message of an operating-system error and return the exit code."""
    if isinstance(error, BrokenPipeError):
        # As of a program that SIGPIPE ends: who reads the output, such as `head`, wants no more of it.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return CLOSED_PIPE
    where = f"'{os.fsdecode(error.filename)}'" if isinstance(error.filename, str | bytes) else "a file or the output"
    _say_error(
        f"cannot read or write {where}: {error.strerror or error}; free space, or give a place that you may read and "
        "write"
    )
    return 1


def _say_error(text: str) -> None:
    err.print("error: ", style="bold red", end="")
    err.print(text)


def _say_usage(error: Any) -> None:
    """Print a usage error, such as an unknown option; or the help if no words were given."""
    context = getattr(error, "ctx", None)
    if type(error).__name__ == "NoArgsIsHelpError":
        error.show()
        return
    if context is not None:
        err.print(" ".join(context.get_usage().split()))
        err.print(f"Try '{context.command_path} --help' for help.", style="dim")
    setting = setting_of("" if context is None else words_of(context), str(getattr(error, "option_name", "")))
    _say_error(error.format_message() if setting is None else f"{error.option_name} is a setting now: give {setting}")
