"""Twin kinds available in settings: a single formulation, or a choice among several."""

from __future__ import annotations

from dataclasses import dataclass

from edp.errors import ConfigError
from edp.networks.twin import TWINS
from edp.networks.twin.base import PREFIX
from edp.networks.twin.elements import ElementsBox
from edp.networks.twin.recurrent import MAX_MEMBERS
from edp.registry import Registry
from edp.settings.bounds import MAX_NAMES, SHARE, check_bounds, check_count, integer, span

BUDGET = span(0.0, 100_000.0)
KINDS: Registry[type] = Registry("twin")
"""Every formulation, and the choice among several of them."""
FOLDS = integer(1, MAX_MEMBERS)
"""Number of folds of a selection; a recurrent twin has one member per fold."""
for _name, _formulation in TWINS.items():
    KINDS.register(_name)(_formulation)


@KINDS.register("auto")
@dataclass(frozen=True, kw_only=True)
class AutoTwin:
    """Several twin kinds are fitted, and the best free runs on left-out data decide (cross-validation).

    Attributes:
        candidates: formulations, the simplest first.
        min_gain: share of error by which a candidate must be better than a simpler one.
        folds: parts of training and validation part together that are left out in turn, where both are short; with 1
            the validation part alone is left out.
        prefix_ticks: measured ticks before a free run.
        time_budget_min: counted processor time for the recurrent networks: trainings that do not fit into it are left
            out; 0: no bound.
        elements: what a small system is known to be made of, as one more candidate, tried before the networks.

    Raises:
        ConfigError: a value out of range, no candidate, or an unknown one.
    """

    candidates: tuple[str, ...] = ("static", "arx", "n4sid", "recurrent")
    min_gain: float = 0.02
    folds: int = 5
    prefix_ticks: int = 30
    time_budget_min: float = 0.0
    elements: ElementsBox | None = None

    def __post_init__(self) -> None:
        check_bounds("automatic twin", self, min_gain=SHARE, folds=FOLDS, prefix_ticks=PREFIX, time_budget_min=BUDGET)
        check_count("automatic twin", "candidates", self.candidates, MAX_NAMES, least=1)
        for name in self.candidates:
            try:
                _ = TWINS[name]
            except ConfigError as error:
                raise ConfigError(f"twin.candidates: {error}") from None
        if len(set(self.candidates)) < len(self.candidates):
            raise ConfigError(f"twin.candidates: {', '.join(self.candidates)}; each once must hold")

    @property
    def tried(self) -> tuple[str, ...]:
        """Every candidate in the order of trial.

        Given elements are tried where they are listed, otherwise before networks.
        """
        if self.elements is None or "elements" in self.candidates:
            return self.candidates
        before = self.candidates.index("recurrent") if "recurrent" in self.candidates else len(self.candidates)
        return (*self.candidates[:before], "elements", *self.candidates[before:])
