"""Progress of long computations: one protocol that every workflow reports to and one presenter shows."""

from __future__ import annotations

from typing import Protocol


class Progress(Protocol):
    """Receiver of the progress of a computation.

    A stage with a total counts units, such as trials or epochs; its `note` names the unit that begins. A stage without
    a total has notes alone. Stages may be nested: a unit of one is then divided by the stage in it.
    """

    def stage(self, name: str, total: int | None = None) -> Progress:
        """Begin a part of the computation and return its progress.

        Args:
            name: unit that the stage counts, in singular, such as ``trial``; without a total what it does.
            total: number of units planned; None if they are not counted.
        """
        ...

    def step(self, done: int, **values: float) -> None:
        """Report how many units of the stage are complete.

        Args:
            done: number of complete units; of a training the epoch or update at work.
            values: measured values by name. ``share`` is the completed fraction of the stage where it is known more
                precisely than by `done`, ``seconds_left`` an estimate of the time that the stage still takes.
        """
        ...

    def note(self, sentence: str) -> None:
        """Report what begins: the name of the next unit, or a sentence."""
        ...


class SilentProgress:
    """Progress that is not shown."""

    def stage(self, name: str, total: int | None = None) -> Progress:
        """Return this progress."""
        return self

    def step(self, done: int, **values: float) -> None:
        """Ignore a step."""

    def note(self, sentence: str) -> None:
        """Ignore a note."""


SILENT = SilentProgress()
"""Default of every workflow."""
