"""Settings of a search: budgets, arms and rules of its phases."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import pairwise

from edp.config.experiment import FeatureSettings, plain_tree
from edp.errors import ConfigError, closest
from edp.evaluation.controller import Budget
from edp.evaluation.study import MODES
from edp.settings.bounds import (
    MAX_EPOCHS,
    MAX_UNITS,
    MAX_UPDATES,
    MOST_TICKS,
    SEED,
    above,
    between,
    check_bounds,
    integer,
    shown,
    span,
)
from edp.workflows.compression import FORMATS
from edp.workflows.compression.planning import SHARES
from edp.workflows.search.modules import MODULES, TOGGLES
from edp.workflows.search.space import ELASTIC, THESIS, WIDTHS, Space
from edp.workflows.search.study import PRUNERS, SamplerSpec

COSTS = ("parameters", "macs_tick")
MAX_TRAININGS = 1_000_000
"""Of a phase, in runs, seeds, repeats or questions; of a second each they would take eleven days."""
COUNT = integer(1, MAX_TRAININGS)
LIMIT = above(0.0, 1e18)
MOVED = {
    "variance_runs": "isolation.runs",
    "variance_seeds": "isolation.seeds",
    "trials": "calibration.trials",
    "warm_rounds": "calibration.warm_rounds",
    "screening_runs": "screening.runs",
    "screening_repeats": "screening.repeats",
    "module_trials": "screening.trials",
    "least_effect": "planning.min_effect",
    "power": "planning.power",
    "most_runs": "planning.max_runs",
    "alpha": "confirmation.alpha",
    "least_gain": "confirmation.min_gain",
    "joint_trials": "synthesis.trials",
    "free_trials": "exploration.trials",
}
"""Current setting by the key of earlier versions.

The identity of a study keeps the earlier keys, so that studies of earlier versions continue.
"""


@dataclass(frozen=True, kw_only=True)
class IsolationSpec:
    """Phase 0: size of the variance estimate for each backbone and feature set.

    Attributes:
        runs: number of training runs, a multiple of the number of folds.
        seeds: number of random seeds per run.

    Raises:
        ConfigError: a value out of range.
    """

    # Two repeats of five folds, the least from which spread between sessions and runs can be told apart.
    runs: int = 10
    seeds: int = 2

    def __post_init__(self) -> None:
        check_bounds("search.isolation", self, runs=integer(2, MAX_TRAININGS), seeds=COUNT)


@dataclass(frozen=True, kw_only=True)
class CalibrationSpec:
    """Phase 1: size of the hyperparameter search for each backbone.

    Attributes:
        trials: number of trials per backbone.
        warm_rounds: number of initial rounds that try each network size once. The sampler chooses the later trials.

    Raises:
        ConfigError: a value out of range.
    """

    trials: int = 40
    warm_rounds: int = 1

    def __post_init__(self) -> None:
        check_bounds("search.calibration", self, trials=COUNT, warm_rounds=integer(0, MAX_TRAININGS))


@dataclass(frozen=True, kw_only=True)
class ModuleScreeningSpec:
    """Phase 2: size of the module screening.

    Attributes:
        runs: minimum number of runs of the two-level design, a power of two (mode ``sound``).
        repeats: number of repetitions of the design, each on another fold (mode ``sound``).
        trials: number of trials per module (mode ``thesis``).

    Raises:
        ConfigError: a value out of range.
    """

    runs: int = 32
    repeats: int = 2
    trials: int = 10

    def __post_init__(self) -> None:
        check_bounds("search.screening", self, runs=integer(2, MAX_TRAININGS), repeats=COUNT, trials=COUNT)


@dataclass(frozen=True, kw_only=True)
class PlanningSpec:
    """Phase 2.5: power analysis for the confirmation.

    Attributes:
        min_effect: smallest effect to detect, as a fraction of the baseline's mean score.
        power: probability of detecting this effect.
        max_runs: maximum number of training runs per arm.

    Raises:
        ConfigError: a value out of range.
    """

    min_effect: float = 0.02
    power: float = 0.80
    max_runs: int = 20

    def __post_init__(self) -> None:
        share = between(0.0, 1.0)
        most = integer(2, MAX_TRAININGS)
        check_bounds("search.planning", self, min_effect=share, power=share, max_runs=most)


@dataclass(frozen=True, kw_only=True)
class ConfirmationSpec:
    """Phase 3: acceptance criteria of a module.

    Attributes:
        alpha: significance level, also of the comparisons of later phases.
        min_gain: minimum improvement, as a fraction of the baseline's mean score.

    Raises:
        ConfigError: a value out of range.
    """

    alpha: float = 0.05
    min_gain: float = 0.01

    def __post_init__(self) -> None:
        check_bounds("search.confirmation", self, alpha=between(0.0, 1.0), min_gain=span(0.0, 1.0))


@dataclass(frozen=True, kw_only=True)
class TrialsSpec:
    """Size of a phase that combines modules: the confirmed modules in phase 4, all modules in phase 5.

    Attributes:
        trials: number of trials.

    Raises:
        ConfigError: the number is out of range.
    """

    trials: int

    def __post_init__(self) -> None:
        check_bounds("search", self, trials=COUNT)


@dataclass(frozen=True, kw_only=True)
class CompressionSpec:
    """Phase 6: the best network that a controller can run.

    Attributes:
        enabled: whether it is made; without it no second test set is set apart.
        budget: limits of the controller: a table, or the path of a budget file.
        units: widths to make; none given, they are planned from the budget.
        width_fractions: fractions of the widest network that fits; each gives one width.
        formats: number formats to evaluate in; none given, all.
        updates: training steps of each smaller network; 0 for as many as the teacher has, `SearchSpec.final_updates`.

    Raises:
        ConfigError: a value out of range.
    """

    enabled: bool = True
    budget: Budget = field(default_factory=Budget)
    units: tuple[int, ...] = ()
    width_fractions: tuple[float, ...] = SHARES
    formats: tuple[str, ...] = ()
    updates: int = 0

    def __post_init__(self) -> None:
        bounds = {
            "units": integer(1, MAX_UNITS),
            "width_fractions": above(0.0, 1.0),
            "updates": integer(0, MAX_UPDATES),
        }
        check_bounds("compression", self, **bounds)
        wrong = [] if self.width_fractions else ["width_fractions = [] (at least one)"]
        for name in self.formats:
            if name not in FORMATS:
                wrong.append(f"formats = {shown(name)} ({', '.join(FORMATS)}{closest(name, FORMATS)})")
        if wrong:
            raise ConfigError("compression: " + "; ".join(wrong) + " must hold")


@dataclass(frozen=True, kw_only=True)
class SearchSpec:
    """Settings of a search; the preset ``thesis`` holds the thesis's own values.

    Attributes:
        mode: ``sound`` (docs/explanation/statistics.md) or ``thesis`` (docs/explanation/thesis.md), which follows the
            tests and rules of the thesis.
        seed: root of folds, seeds of trainings and questions.
        updates: training steps of every training but the final one, over all its epochs; 0 with several epochs makes
            each of them one pass over the data.
        final_updates: training steps of what is evaluated on the test sessions, likewise.
        epochs: of every training, thesis: after each the sessions that evaluate validate it, the schedule takes notice,
            and the best one counts. 1 is one long epoch that chooses nothing.
        patience: epochs without a better validation before a training ends early; 0 never.
        horizon: horizon of the scores, one of the task's.
        test_fraction: share of the sessions that are set apart as test before anything else.
        test: names of the sessions to set apart, instead of a share that is drawn.
        second_test_fraction: share of the sessions that are set apart beside them, as second test set, for phase 6
            alone.
        second_test: names of these, instead of a share that is drawn.
        folds: into which the other sessions are dealt.
        backbones: registered backbones that are compared.
        features: feature sets that are compared: names, or sets of one's own.
        trial_runs: runs over which a question of phases 1, 4 and 5 is evaluated.
        run_seeds: seeds of each split in mode ``thesis``, and of the final trainings.
        batch: questions that are asked before the first of them is answered.
        space: dimensions and ranges of phase 1.
        elastic: reach of the window around the baseline in later phases.
        deferred: further dimensions of phases 4 and 5.
        modules: modules to screen (`edp.workflows.search.modules.MODULES`); empty for all that fit the network.
        toggles: parts of the training that may be on or off in phases 4 and 5, beside the modules.
        widths: ``equal``: every level has as many channels as units, and the head is left as it is; ``halved``: as in
            the thesis (`edp.workflows.search.space.halved`).
        sampler: sampler of the trials.
        rungs: shares of the steps at which a question of phases 1, 4 and 5 is evaluated before its end; none without
            any.
        pruner: which questions end at a rung: ``none``, or ``median``: those worse than the median of the questions of
            earlier batches, once five of them were trained to the end (Optuna's median rule with its defaults).
        cost: ``none``, or a cost that is made small beside the score in phases 1, 4 and 5: a Pareto front comes out.
        limits: the most that a cost may be; what exceeds it is not trained.
        isolation: phase 0.
        calibration: phase 1.
        screening: phase 2.
        planning: phase 2.5.
        confirmation: phase 3.
        synthesis: phase 4.
        exploration: phase 5.
        compression: phase 6.

    Raises:
        ConfigError: a value out of range.
    """

    mode: str = "sound"
    seed: int = 0
    updates: int = 400
    final_updates: int = 2000
    epochs: int = 1
    patience: int = 0
    horizon: int = 10
    test_fraction: float = 0.2
    test: tuple[str, ...] = ()
    second_test_fraction: float = 0.1
    second_test: tuple[str, ...] = ()
    folds: int = 5
    backbones: tuple[str, ...] = ("lstm", "tcn", "hybrid")
    features: tuple[str | FeatureSettings, ...] = ("FG1", "FG2")
    trial_runs: int = 1
    run_seeds: int = 3
    batch: int = 4
    space: Space = field(default_factory=lambda: dict(THESIS))
    elastic: dict[str, float] = field(default_factory=lambda: dict(ELASTIC))
    deferred: Space = field(default_factory=dict)
    modules: tuple[str, ...] = ()
    toggles: tuple[str, ...] = ()
    widths: str = "equal"
    sampler: SamplerSpec = field(default_factory=SamplerSpec)
    rungs: tuple[float, ...] = ()
    pruner: str = "none"
    cost: str = "none"
    limits: dict[str, float] = field(default_factory=dict)
    isolation: IsolationSpec = field(default_factory=IsolationSpec)
    calibration: CalibrationSpec = field(default_factory=CalibrationSpec)
    screening: ModuleScreeningSpec = field(default_factory=ModuleScreeningSpec)
    planning: PlanningSpec = field(default_factory=PlanningSpec)
    confirmation: ConfirmationSpec = field(default_factory=ConfirmationSpec)
    synthesis: TrialsSpec = field(default_factory=lambda: TrialsSpec(trials=24))
    exploration: TrialsSpec = field(default_factory=lambda: TrialsSpec(trials=48))
    compression: CompressionSpec = field(default_factory=CompressionSpec)

    def __post_init__(self) -> None:
        bounds = dict.fromkeys(("trial_runs", "run_seeds", "batch"), COUNT)
        bounds |= {"seed": SEED, "horizon": integer(0, MOST_TICKS), "folds": integer(2, MAX_TRAININGS)}
        bounds |= {"epochs": integer(1, MAX_EPOCHS), "patience": integer(0, MAX_EPOCHS)}
        check_bounds("search", self, epochs=bounds["epochs"])
        # Zero steps stand for passes over the data, which only several epochs know.
        steps = integer(1 if self.epochs == 1 else 0, MAX_UPDATES)  # 0: passes over the data
        bounds |= dict.fromkeys(("updates", "final_updates"), steps)
        bounds |= dict.fromkeys(("test_fraction", "second_test_fraction", "rungs"), between(0.0, 1.0))
        check_bounds("search", self, **bounds)
        wrong = self._wrong_epochs()
        if self.mode not in MODES:
            wrong.append(f"mode = '{self.mode}' ({' or '.join(MODES)})")
        if self.cost not in ("none", *COSTS):
            wrong.append(f"cost = '{self.cost}' (none, {' or '.join(COSTS)})")
        wrong += self._wrong_rungs()
        if self.widths not in WIDTHS:
            wrong.append(f"widths = '{self.widths}' ({' or '.join(WIDTHS)})")
        wrong += [f"modules = '{name}'{closest(name, MODULES)}" for name in self.modules if name not in MODULES]
        wrong += [f"toggles = '{name}' ({', '.join(TOGGLES)})" for name in self.toggles if name not in TOGGLES]
        wrong += [f"deferred.{name} (which is in the space)" for name in self.deferred if name in self.space]
        wrong += [f"limits.{name} ({' or '.join(COSTS)})" for name in self.limits if name not in COSTS]
        wrong += [f"limits.{name} = {most} (above 0)" for name, most in self.limits.items() if not LIMIT.holds(most)]
        wrong += [
            f"elastic.{name} = {shown(reach)} (above 0)"
            for name, reach in self.elastic.items()
            if not LIMIT.holds(reach)
        ]
        if self.isolation.runs < 2 * self.folds or self.isolation.runs % self.folds:
            wrong.append(f"isolation.runs = {self.isolation.runs} (two repeats of the {self.folds} folds or more)")
        if self.planning.max_runs < self.folds:
            wrong.append(f"planning.max_runs = {self.planning.max_runs} (at least the {self.folds} folds)")
        if not self.backbones or not self.features:
            wrong.append("backbones and features (at least one of each)")
        if len(self.feature_sets) < len(self.features):
            wrong.append("features (sets of different names)")
        if wrong:
            raise ConfigError("search: " + "; ".join(wrong) + " must hold")

    @property
    def feature_sets(self) -> dict[str, str | Mapping[str, object]]:
        """Return the values of ``task.features`` by name: a name of a set, or a plain table."""
        return {
            feature_set if isinstance(feature_set, str) else feature_set.name: feature_set
            if isinstance(feature_set, str)
            else plain_tree(feature_set)
            for feature_set in self.features
        }

    @property
    def stops(self) -> tuple[int, ...]:
        """The rungs as steps of a training, epochs where it has several; those that are the same one count once."""
        # At least one step: a rung before the first update judges nothing.
        steps = sorted({max(1, round(share * self.length)) for share in self.rungs})
        return tuple(step for step in steps if step < self.length)

    @property
    def length(self) -> int:
        """Return the length of a training in the units of its rungs: epochs if there are several, else steps."""
        return self.epochs if self.epochs > 1 else self.updates

    def _wrong_epochs(self) -> list[str]:
        wrong = []
        for name in ("updates", "final_updates"):
            if getattr(self, name) % self.epochs:
                wrong.append(
                    f"{name} = {getattr(self, name)} (a multiple of epochs = {self.epochs}, or 0: each epoch one pass "
                    "over the data)"
                )
        if self.epochs > 1 and self.mode != "thesis":
            wrong.append(
                f"epochs = {self.epochs} with mode = '{self.mode}' (epochs = 1: the sessions that judge would choose "
                "the best epoch, as only the thesis has it)"
            )
        if self.patience and self.epochs == 1:
            wrong.append(f"patience = {self.patience} with epochs = {self.epochs} (0, or several epochs)")
        return wrong

    def _wrong_rungs(self) -> list[str]:
        wrong = []
        if any(not 0 < share < 1 for share in self.rungs) or any(a >= b for a, b in pairwise(self.rungs)):
            wrong.append(f"rungs = {list(self.rungs)} (shares between 0 and 1, each above the one before)")
        if self.pruner not in PRUNERS:
            wrong.append(f"pruner = '{self.pruner}' ({' or '.join(PRUNERS)})")
        elif self.pruner != "none" and not self.rungs:
            wrong.append(f"pruner = '{self.pruner}' with rungs = [] (at least one rung, such as rungs = [0.25, 0.5])")
        if self.pruner != "none" and self.cost != "none":
            wrong.append(
                f"pruner = '{self.pruner}' with cost = '{self.cost}' (one of them 'none': the rule knows one score and "
                "would end the cheap ones of a front; a cost can be held by limits instead)"
            )
        return wrong
