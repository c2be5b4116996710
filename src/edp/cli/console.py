"""What every command shares: where text goes, progress with rate and time left, tables, and how errors end."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn
from rich.table import Table

from edp.errors import EdpError

out = Console(highlight=False, soft_wrap=True)
err = Console(stderr=True, highlight=False, soft_wrap=True)

JsonFlag = Annotated[bool, typer.Option("--json", help="Print one JSON document to standard output and nothing else.")]
INTERRUPTED = 130


def emit(as_json: bool, facts: dict[str, Any], show: Callable[[], None]) -> None:
    """Print facts as JSON for machines, or run `show` for people."""
    if as_json:
        sys.stdout.write(json.dumps(facts, indent=1, allow_nan=False) + "\n")
    else:
        show()


def table(title: str, headings: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    """Print a table; the first column is text, the others are aligned right."""
    made = Table(title=title, title_justify="left", title_style="bold", header_style="bold", box=None, pad_edge=False)
    for i, heading in enumerate(headings):
        made.add_column(heading, justify="left" if i == 0 else "right")
    for row in rows:
        made.add_row(*(f"{cell:,}" if isinstance(cell, int) else str(cell) for cell in row))
    out.print(made)


@contextmanager
def progress(quiet: bool = False) -> Iterator[Progress]:
    """A progress display on standard error with a bar, a note (rate and figures) and the time left."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(bar_width=24),
        TaskProgressColumn(),
        TextColumn("{task.fields[note]}"),
        TimeRemainingColumn(elapsed_when_finished=True),
    )
    with Progress(*columns, console=err, disable=quiet or not err.is_terminal, refresh_per_second=4) as shown:
        yield shown


class Steps:
    """Plain progress lines for output that is not a terminal, at most one every few seconds."""

    def __init__(self, quiet: bool, every_s: float = 5.0) -> None:
        self.active = not quiet and not err.is_terminal
        self.every_s = every_s
        self._last = 0.0

    def say(self, text: str, force: bool = False) -> None:
        """Print a line, unless the last one is too recent."""
        now = time.monotonic()
        if self.active and (force or now - self._last >= self.every_s):
            self._last = now
            err.print(text)


def counted(shown: Progress, steps: Steps, command: str, verb: str) -> Callable[[str, int, int], None]:
    """What shows, when called with the name of the one that begins, how many are done and how many there are, a count.

    Args:
        shown: progress display.
        steps: for output that is not a terminal.
        command: name of the command.
        verb: what was done with those that are done.
    """
    began = time.monotonic()
    bar = shown.add_task(command, total=1.0, note="reading recordings")

    def on_next(name: str, done: int, count: int) -> None:
        left = f", {duration((time.monotonic() - began) / done * (count - done))} left" if done else ""
        shown.update(bar, completed=done / count, note=f"{done}/{count}, {name}")
        steps.say(f"{command}: {done}/{count} {verb}, now {name}{left}")

    return on_next


def duration(seconds: float) -> str:
    """Seconds as ``1 h 05 min``, ``3 min 20 s`` or ``12 s``."""
    whole = round(seconds)
    if whole >= 3600:
        return f"{whole // 3600} h {whole % 3600 // 60:02d} min"
    return f"{whole // 60} min {whole % 60:02d} s" if whole >= 60 else f"{whole} s"


def run_app(app: typer.Typer) -> int:
    """Run the command line; a user's mistake ends in one message and that error's exit code, Ctrl-C in 130."""
    try:
        code = app(standalone_mode=False)  # of a command that raised typer.Exit; 130 after Ctrl-C; else None
        if code == INTERRUPTED:
            raise KeyboardInterrupt
    except EdpError as error:
        err.print(f"[bold red]error:[/] {_escaped(str(error))}")
        return error.exit_code
    except typer.Exit as done:
        return done.exit_code
    except (KeyboardInterrupt, typer.Abort):
        err.print("stopped; what was finished is on disk: give the same command again to go on")
        return INTERRUPTED
    except Exception as error:
        show = getattr(error, "show", None)  # a usage error of the command line itself
        if show is None:
            raise
        show()
        return int(getattr(error, "exit_code", 2))
    return code if isinstance(code, int) else 0


def _escaped(text: str) -> str:
    return text.replace("[", r"\[")
