"""Presenter of `edp.progress.Progress`: a bar in a terminal, lines in a pipe or file, silent with ``--json``."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from edp.cli.console import Steps, count_text, duration, format_time_left, progress
from edp.wording import figure, number

if TYPE_CHECKING:
    from rich.progress import Progress as Bars

WORDS = {
    "length_s": "runs of {} s",
    "free_run_error": "free-run error {} deviations",
    "targets_per_s": "{} targets/s",
    "validation_mae": "validation MAE {}",
    "refused": "{} refused",
}
"""Text of each value that a step may have, for its figure."""

FEW = 20
"""Units of a stage up to which each has a line of its own, however short it is."""


class Display:
    """Progress of a command on standard error.

    Args:
        bars: bars of the terminal.
        steps: lines for output that is not a terminal.
        command: first word of each line.
        counted: participle for units that are complete, such as ``loops run``; empty for the name of the unit alone.
        timed: state the time since the beginning in each note.
    """

    def __init__(self, bars: Bars, steps: Steps, command: str, counted: str = "", timed: bool = False) -> None:
        self.bars, self.steps, self.command, self.counted, self.timed = bars, steps, command, counted, timed
        self.began, self.values = time.monotonic(), dict[str, float]()
        self.bar = bars.add_task(command, total=1.0 if counted else None, note="reading recordings" if counted else "")

    def measured(self, name: str) -> float | None:
        """Return the last value of a step by its name; None before the first."""
        return self.values.get(name)

    def show(self, text: str, share: float | None, left: str = "", line: bool = True, force: bool = False) -> None:
        """Update the bar and print a line.

        Args:
            text: text to show.
            share: completed fraction of the command; None leaves the bar where it is.
            left: time left, for the line; the bar estimates its own.
            line: print a line.
            force: print the line even if the last one is recent.
        """
        if share is None:
            self.bars.update(self.bar, note=text)
        else:
            self.bars.update(self.bar, total=1.0, completed=share, note=text)
        if line:
            self.steps.say(f"{self.command}: {text}{left}", force=force)


class StageDisplay:
    """Progress of one stage.

    Args:
        display: display of the command.
        name: unit that the stage counts.
        total: number of units planned.
        outer: stage that this one is a part of.
    """

    def __init__(
        self, display: Display, name: str = "", total: int | None = None, outer: StageDisplay | None = None
    ) -> None:
        self.display, self.name, self.total, self.outer = display, name, total, outer
        self.began, self.done, self.text = time.monotonic(), 0, ""
        self.values: dict[str, float] = {}
        self.share = 0.0

    def stage(self, name: str, total: int | None = None) -> StageDisplay:
        """Begin a stage within this one."""
        return StageDisplay(self.display, name, total, self)

    def step(self, done: int, **values: float) -> None:
        """Show how many units are complete."""
        # Units with names have a line where they begin.
        line = not self.text and (bool(values) or done != self.done)
        self.text, self.done, self.values = "", done, values
        self.share = values.get("share", done / max(1, self.total or 1))
        left = format_time_left(values["seconds_left"]) if "seconds_left" in values else self._estimate_time_left()
        if left and self.outer is not None and self.outer.total is not None:
            left = f"{left} of it"
        # The end of an epoch has a line of its own.
        error = values.get("validation_mae")
        force = error is not None and error != self.display.measured("validation_mae")
        self.display.values |= values
        self._clear_outer()
        self.display.show(self._path(), self._share(), left, line=line, force=force)

    def note(self, sentence: str) -> None:
        """Show what begins."""
        self.text = sentence
        self._clear_outer()
        counts = self.total is not None
        spent = f", {duration(time.monotonic() - self.display.began)} so far" if self.display.timed else ""
        left = self._estimate_time_left() if counts else spent
        force = not counts or (not self.display.counted and (self.total or 0) <= FEW)
        self.display.show(self._path(), self._share() if counts else None, left, force=force)

    def _estimate_time_left(self) -> str:
        """Return the time left, estimated from the complete units; an empty text before the first one."""
        if not self.display.counted or not self.done or self.total is None:
            return ""
        return format_time_left((time.monotonic() - self.began) / self.done * (self.total - self.done))

    def _clear_outer(self) -> None:
        """Remove the notes of stages around this one that do not count units."""
        outer = self.outer
        while outer is not None:
            outer.text = outer.text if outer.total is not None else ""
            outer = outer.outer

    def _share(self, inner: float = 0.0) -> float:
        """Return the completed fraction of the command.

        Args:
            inner: completed fraction of the current unit.
        """
        share = inner if self.total is None else self.share + inner / max(1, self.total)
        return share if self.outer is None else self.outer._share(share)

    def _path(self) -> str:
        """Return the texts of this stage and those around it."""
        texts = [self.outer._path()] if self.outer is not None else []
        return ", ".join(text for text in (*texts, self._phrase()) if text)

    def _select_values(self) -> list[tuple[str, float]]:
        """Return the values of the last step that the text states: a count of zero is left out."""
        return [(name, value) for name, value in self.values.items() if name in WORDS and (value or name != "refused")]

    def _phrase(self) -> str:
        if self.total is None:
            return self.text or self.name
        if self.display.counted:
            now = f", now {self.text}" if self.text else ""
            return f"{count_text(self.done, self.total, '/')} {self.display.counted}{now}"
        if self.text:
            return f"{self.name} {count_text(self.done + 1, self.total)}, {self.text}"
        values = [WORDS[name].format(_figure(name, value)) for name, value in self._select_values()]
        return ", ".join([f"{self.name} {count_text(self.done, self.total, '/')}", *values])


def _figure(name: str, value: float) -> str:
    return number(value, 0) if name == "targets_per_s" else figure(value, 3 if name == "free_run_error" else 4)


@contextmanager
def show_progress(command: str, quiet: bool, counted: str = "", timed: bool = False) -> Iterator[StageDisplay]:
    """Show the progress of a command; see `Display`.

    Args:
        command: first word of each line.
        quiet: show nothing.
        counted: participle for units that are complete.
        timed: state the time since the beginning in each note.
    """
    with progress(quiet) as bars:
        yield StageDisplay(Display(bars, Steps(quiet), command, counted, timed))
