"""Results of the fits of twins, and the history of a fit."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from edp.networks.twin import Twin
from edp.networks.twin.parameters import DatasheetRow
from edp.settings.results import ResultFile
from edp.storage.reading import Table


@dataclass(frozen=True)
class FreeRunProgress(ResultFile):
    """Progress of a free-run training, in this process or in another process (``progress.json``).

    Attributes:
        update: updates done, of `updates`.
        updates: number of updates of all stages.
        length_s: present length of the free runs, s.
        seconds_left: estimated.
        validation: error of the last validation, in deviations of the velocities; None before the first.
        best: whether that is the least one so far.
    """

    NAME = "progress.json"
    WHAT = "progress"

    update: int
    updates: int
    length_s: float
    seconds_left: float
    validation: float | None
    best: bool


@dataclass(frozen=True, eq=False)
class FittedTwin:
    """A fitted twin with its history.

    Attributes:
        twin: twin with the parameters of the best validation.
        history: one row per validation; none for a twin that is fitted in closed form.
        seconds: processor time.
        datasheet: parameters with units and intervals; empty for a twin without physical parameters.
        facts: entries of the provenance.
    """

    twin: Twin
    history: list[Table]
    seconds: float
    datasheet: tuple[DatasheetRow, ...] = ()
    facts: Mapping[str, object] = field(default_factory=dict)


@dataclass(eq=False)
class FitHistory:
    """Validations of a fit, with its processor time and the reports of its progress.

    Attributes:
        updates: number of updates of the whole fit.
        on_event: receiver of a report after each validation.
        rows: one row per validation.
        done: updates so far.
    """

    updates: int
    on_event: Callable[[FreeRunProgress], None] | None
    rows: list[Table] = field(default_factory=list)
    done: int = 0
    began: float = field(default_factory=time.process_time)

    @property
    def seconds(self) -> float:
        """Processor time until now."""
        return time.process_time() - self.began

    def add(self, row: Mapping[str, object], length_s: float, error: float, better: bool) -> None:
        """Append the row of a validation and report it.

        Args:
            row: entries of the row, without the number of updates and the processor time.
            length_s: length of the free runs that were fitted.
            error: error of the validation.
            better: whether it is the least so far.
        """
        self.rows.append({"update": self.done, **row, "seconds": round(self.seconds, 2)})
        if self.on_event is not None:
            left = self.seconds * (self.updates - self.done) / self.done
            self.on_event(FreeRunProgress(self.done, self.updates, length_s, left, error, better))
