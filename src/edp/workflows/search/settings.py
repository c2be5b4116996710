"""Settings of a search: budgets, arms and rules of its phases."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise

from edp.config.experiment import FeatureSettings, Table, plain_tree
from edp.errors import ConfigError, closest
from edp.evaluation.controller import Budget
from edp.evaluation.study import MODES
from edp.settings.bounds import (
    MOST_EPOCHS,
    MOST_TICKS,
    MOST_UNITS,
    MOST_UPDATES,
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
MOST_TRAININGS = 1_000_000
"""Of a phase, in runs, seeds, repeats or questions; of a second each they would take eleven days."""
LIMIT = above(0.0, 1e18)


@dataclass(frozen=True, kw_only=True)
class CompressionSpec:
    """Phase 6: the best network that a controller can run.

    Attributes:
        on: whether it is made; without it no second test set is set apart.
        budget: what the controller grants: a table, or the path of a budget file.
        units: widths to make; none given, they are planned from the budget.
        shares: of the widest that fits; each plans a width.
        formats: number formats to judge in; none given, all.
        updates: training steps of each smaller network; 0 for as many as the teacher has, `SearchSpec.final_updates`.

    Raises:
        ConfigError: a value out of range.
    """

    on: bool = True
    budget: Budget = field(default_factory=Budget)
    units: tuple[int, ...] = ()
    shares: tuple[float, ...] = SHARES
    formats: tuple[str, ...] = ()
    updates: int = 0

    def __post_init__(self) -> None:
        bounds = {"units": integer(1, MOST_UNITS), "shares": above(0.0, 1.0), "updates": integer(0, MOST_UPDATES)}
        check_bounds("compression", self, **bounds)
        wrong = [] if self.shares else ["shares = [] (at least one)"]
        for name in self.formats:
            if name not in FORMATS:
                wrong.append(f"formats = {shown(name)} ({', '.join(FORMATS)}{closest(name, FORMATS)})")
        if wrong:
            raise ConfigError("compression: " + "; ".join(wrong) + " must hold")


@dataclass(frozen=True, kw_only=True)
class SearchSpec:
    """Settings of a search; the preset ``thesis`` holds the thesis's own numbers.

    Attributes:
        mode: ``sound`` (docs/statistics.md) or ``thesis``, whose tests and rules are followed (docs/thesis_preset.md).
        seed: root of folds, seeds of trainings and questions.
        updates: training steps of every training but the final one, over all its epochs; 0 with several epochs makes
            each of them one pass over the data.
        final_updates: training steps of what is judged on the test sessions, likewise.
        epochs: of every training, thesis: after each the sessions that judge validate it, the schedule takes notice,
            and the best one counts. 1 is one long epoch that chooses nothing.
        patience: epochs without a better validation before a training ends early; 0 never.
        horizon: at which scores are taken, one of the task's.
        test_share: share of the sessions that are set apart as test before anything else.
        test: names of the sessions to set apart, instead of a share that is drawn.
        second_share: share of the sessions that are set apart beside them, as second test set, for phase 6 alone.
        second: names of these, instead of a share that is drawn.
        folds: into which the other sessions are dealt.
        backbones: registered backbones that are compared.
        features: feature sets that are compared: names, or sets of one's own.
        variance_runs: phase 0: training runs of each backbone with each feature set, in whole repeats of the folds.
        variance_seeds: phase 0: seeds of each of these runs.
        trials: phase 1: questions for each backbone.
        warm_rounds: phase 1: rounds in which every size is asked once before the sampler is free to choose.
        trial_runs: runs over which a question of phases 1, 4 and 5 is judged.
        screening_runs: phase 2, sound: runs of the two-level design, a power of two; more where the modules need more.
        screening_repeats: phase 2, sound: how often the design is repeated, each time on another fold.
        module_trials: phase 2, thesis: questions for each module.
        least_effect: phase 2.5: the effect to be seen, as a share of the baseline's mean score.
        power: phase 2.5: wanted.
        most_runs: phase 3: training runs of each arm that may be spent at most.
        run_seeds: phase 3, thesis: seeds of each split.
        alpha: level of the confirmation.
        least_gain: least relevant improvement, as a share of the baseline's mean score.
        joint_trials: phase 4: questions about the confirmed modules together.
        free_trials: phase 5: questions about all modules together.
        batch: questions that are asked before the first of them is answered.
        space: dimensions and ranges of phase 1.
        elastic: reach of the window around the baseline in later phases.
        deferred: further dimensions of phases 4 and 5.
        modules: which are screened (`edp.workflows.search.modules.MODULES`); empty for all that fit the network.
        toggles: parts of the training that may be on or off in phases 4 and 5, beside the modules.
        widths: ``equal``: every level has as many channels as units, and the head is left as it is; ``halved``: as in
            the thesis (`edp.workflows.search.space.halved`).
        sampler: how questions are chosen.
        rungs: shares of the steps at which a question of phases 1, 4 and 5 is judged before its end; none without any.
        pruner: which questions end at a rung: ``none``, or ``median``: those worse than the median of the questions of
            earlier batches, once five of them were trained to the end (Optuna's median rule with its defaults).
        cost: ``none``, or a cost that is made small beside the score in phases 1, 4 and 5: a Pareto front comes out.
        limits: the most that a cost may be; what exceeds it is not trained.
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
    test_share: float = 0.2
    test: tuple[str, ...] = ()
    second_share: float = 0.1
    second: tuple[str, ...] = ()
    folds: int = 5
    backbones: tuple[str, ...] = ("lstm", "tcn", "hybrid")
    features: tuple[str | FeatureSettings, ...] = ("FG1", "FG2")
    # Ten runs: two repeats of five folds, the least from which spread between sessions and runs can be told apart.
    variance_runs: int = 10
    variance_seeds: int = 2
    trials: int = 40
    warm_rounds: int = 1
    trial_runs: int = 1
    screening_runs: int = 32
    screening_repeats: int = 2
    module_trials: int = 10
    least_effect: float = 0.02
    power: float = 0.80
    most_runs: int = 20
    run_seeds: int = 3
    alpha: float = 0.05
    least_gain: float = 0.01
    joint_trials: int = 24
    free_trials: int = 48
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
    compression: CompressionSpec = field(default_factory=CompressionSpec)

    def __post_init__(self) -> None:
        counts = (
            *("variance_seeds", "trials", "trial_runs", "screening_repeats"),
            *("module_trials", "run_seeds", "joint_trials", "free_trials", "batch"),
        )
        bounds = dict.fromkeys(counts, integer(1, MOST_TRAININGS)) | {"seed": SEED, "horizon": integer(0, MOST_TICKS)}
        bounds |= {"epochs": integer(1, MOST_EPOCHS), "patience": integer(0, MOST_EPOCHS)}
        check_bounds("search", self, epochs=bounds["epochs"])
        # Zero steps stand for passes over the data, which only several epochs know.
        steps = integer(1 if self.epochs == 1 else 0, MOST_UPDATES)  # 0: passes over the data
        bounds |= dict.fromkeys(("updates", "final_updates"), steps)
        bounds |= dict.fromkeys(("folds", "variance_runs", "most_runs", "screening_runs"), integer(2, MOST_TRAININGS))
        bounds |= {"warm_rounds": integer(0, MOST_TRAININGS), "least_gain": span(0.0, 1.0)}
        bounds |= dict.fromkeys(("test_share", "second_share", "least_effect", "power", "alpha"), between(0.0, 1.0))
        bounds |= {"rungs": between(0.0, 1.0)}
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
        if self.folds < 2 or self.variance_runs < 2 * self.folds or self.variance_runs % self.folds:
            wrong.append(
                f"folds = {self.folds} (at least 2), variance_runs = {self.variance_runs} (two repeats of them or more)"
            )
        if self.most_runs < self.folds:
            wrong.append(f"most_runs = {self.most_runs} (at least the {self.folds} folds)")
        if not self.backbones or not self.features:
            wrong.append("backbones and features (at least one of each)")
        if len(self.feature_sets) < len(self.features):
            wrong.append("features (sets of different names)")
        if wrong:
            raise ConfigError("search: " + "; ".join(wrong) + " must hold")

    @property
    def feature_sets(self) -> dict[str, str | Table]:
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
