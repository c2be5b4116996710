"""Content of ``tuning.json``: gains of a controller that were tuned in closed loops, and the tip errors they give."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from edp.settings.bounds import check_bounds, span
from edp.settings.results import ResultFile

ERROR_MM = span(0.0, 1e12)


@dataclass(frozen=True, kw_only=True)
class ErrorChange:
    """Root-mean-square position error of the tip with the initial gains and with the tuned gains, mm."""

    before: float
    after: float

    def __post_init__(self) -> None:
        check_bounds("judged_mm", self, before=ERROR_MM, after=ERROR_MM)

    @property
    def relative(self) -> float:
        """Relative change of the error, as a fraction of `before`; 0 if an error is 0."""
        return self.after / self.before - 1.0 if self.before > 0 < self.after else 0.0


@dataclass(frozen=True, kw_only=True)
class TipErrors(ErrorChange):
    """Errors over all references, and of each reference."""

    by_reference: Mapping[str, ErrorChange] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class TuningTrial:
    """Gains of a trial, and their tip error on the plant of the tuning, mm."""

    gains: Mapping[str, float]
    cost_mm: float


@dataclass(frozen=True, kw_only=True)
class TuningFile(ResultFile):
    """Content of ``tuning.json``.

    Attributes:
        controller: name of the controller.
        gains: tuned gains by name.
        tuned_cost_mm: tip error of the tuned gains on the plant of the tuning.
        judged_mm: tip errors on the plant of the evaluation.
        trials: all trials in order.
    """

    NAME = "tuning.json"
    SCHEMA = 1
    WHAT = "tuning"
    ADVICE = "remove the run folder and run edp loop tune"

    controller: str
    gains: Mapping[str, float]
    tuned_cost_mm: float
    judged_mm: TipErrors
    trials: tuple[TuningTrial, ...]
