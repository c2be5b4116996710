"""Results of the phases of a model search, one class per phase, stored in ``study.json``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from edp.evaluation.compression import Scores
from edp.evaluation.controller import Budget, ResourceUsage
from edp.stats.confirm import ModuleEvidence
from edp.stats.importance import MainEffect
from edp.stats.thesis_confirm import ThesisEvidence
from edp.stats.variance import PairedVariance, SplitVariance

Scalar = float | int | str | bool
OPTIONAL = {"optional": True}
"""Metadata of fields that the file omits if they are None."""


@dataclass(frozen=True)
class RelativeChange:
    """Difference of two arms as a fraction of the reference: its 95 % interval and one-sided p-value."""

    change: float
    low: float
    high: float
    p: float


@dataclass(frozen=True, kw_only=True)
class FeatureComparison(RelativeChange):
    """The chosen feature set against the next best one, `reference`."""

    reference: str


@dataclass(frozen=True, kw_only=True)
class ArmComparison(RelativeChange):
    """The best arm against another one."""

    best: str


@dataclass(frozen=True, kw_only=True)
class ArmFacts(SplitVariance):
    """Variance components of an arm of phase 0, its scores by run and seed, and the components of its MAE."""

    by_run: tuple[tuple[float, ...], ...]
    mae: SplitVariance


@dataclass(frozen=True, kw_only=True)
class IsolationFacts:
    """Results of phase 0: scores of every arm, mean score of every feature set, and the selected feature set.

    An arm is a backbone with a feature set. `comparisons` has the comparison of feature sets for each backbone.
    `backbones` compares the backbones with the selected feature set. `variance` is the variance of paired differences,
    which planning uses.
    """

    arms: Mapping[str, ArmFacts]
    runs: int
    seeds: int
    features: str
    mean_scores: Mapping[str, float]
    comparisons: Mapping[str, FeatureComparison]
    backbones: Mapping[str, ArmComparison]
    variance: PairedVariance


@dataclass(frozen=True, kw_only=True)
class TrialRow:
    """A trial of phase 1, 4 or 5.

    Attributes:
        values: values of its dimensions, and of the options of its modules.
        score, mae: mean over runs; None if it was not trained to its end.
        modules: active modules; None in phase 1.
        parameters, macs_tick: size of its network; None if the values give no network.
        statuses: final statuses of its trainings; phase 1 only.
        rungs: steps and scores before the end; `pruned`: whether it was ended at the last of them.
    """

    number: int
    values: Mapping[str, Scalar]
    score: float | None
    mae: float | None
    modules: tuple[str, ...] | None = field(default=None, metadata=OPTIONAL)
    parameters: float | None = field(default=None, metadata=OPTIONAL)
    macs_tick: float | None = field(default=None, metadata=OPTIONAL)
    statuses: tuple[str, ...] | None = field(default=None, metadata=OPTIONAL)
    rungs: tuple[tuple[int, float], ...] | None = field(default=None, metadata=OPTIONAL)
    pruned: bool | None = field(default=None, metadata=OPTIONAL)

    @property
    def costs(self) -> dict[str, float]:
        """The costs that are known, by name."""
        costs = {"parameters": self.parameters, "macs_tick": self.macs_tick}
        return {name: cost for name, cost in costs.items() if cost is not None}


@dataclass(frozen=True, kw_only=True)
class CalibratedBackbone(TrialRow):
    """The trial that the efficiency rule takes of a backbone, and all trials of the backbone."""

    trials: tuple[TrialRow, ...]


@dataclass(frozen=True)
class FinalRound:
    """Mean scores of the best trials of the backbones on all folds, and the lowest against the others."""

    runs: int
    scores: Mapping[str, float]
    against: Mapping[str, ArmComparison]


@dataclass(frozen=True, kw_only=True)
class CalibrationFacts:
    """Phase 1: `backbone`, values (`baseline`) and experiment (`settings`) of the baseline.

    `front` holds the trials of each backbone that no other surpasses in score and cost.
    """

    backbones: Mapping[str, CalibratedBackbone]
    final: FinalRound | None = field(default=None, metadata=OPTIONAL)
    backbone: str
    baseline: Mapping[str, Scalar]
    settings: Mapping[str, object]
    front: Mapping[str, tuple[TrialRow, ...]] | None = field(default=None, metadata=OPTIONAL)


@dataclass(frozen=True, kw_only=True)
class ModuleEffect(MainEffect):
    """Main effect of a module, and the same as a fraction of the mean score."""

    change: float


@dataclass(frozen=True)
class ModuleGain:
    """Lowest score of a module's trials, and the baseline's median minus that; None if no training ended well."""

    best: float | None
    gain: float | None


@dataclass(frozen=True, kw_only=True)
class ScreeningFacts:
    """Phase 2: modules that were screened, and those that go to confirmation."""

    passed: tuple[str, ...]
    registered: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class SoundScreening(ScreeningFacts):
    """Phase 2, sound: effects by module, and the largest alias between effects of the design."""

    modules: Mapping[str, ModuleEffect]
    alias: float


@dataclass(frozen=True, kw_only=True)
class ThesisScreening(ScreeningFacts):
    """Phase 2, thesis: gains by module."""

    modules: Mapping[str, ModuleGain]


@dataclass(frozen=True, kw_only=True)
class PlanningFacts:
    """Phase 2.5: training runs of each arm."""

    runs: int


@dataclass(frozen=True, kw_only=True)
class SoundPlanning(PlanningFacts):
    """Phase 2.5, sound: see `ConfirmationPlan`; `enough` runs reach the power, None if no number does."""

    power: float
    limit: float
    sessions_needed: int | None
    reason: str
    enough: int | None


@dataclass(frozen=True, kw_only=True)
class ThesisPlanning(PlanningFacts):
    """Phase 2.5, thesis: see `edp.stats.thesis_power.ThesisPlan`; MAE and its deviation between seeds behind it."""

    splits: int
    simulated: int | None
    analytical: float
    mae: float
    sigma_seed: float


@dataclass(frozen=True, kw_only=True)
class ConfirmationFacts:
    """Phase 3: modules that were confirmed."""

    confirmed: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class SoundConfirmation(ConfirmationFacts):
    """Phase 3, sound: evidence on every module that was screened."""

    evidence: tuple[ModuleEvidence, ...]


@dataclass(frozen=True, kw_only=True)
class ThesisConfirmation(ConfirmationFacts):
    """Phase 3, thesis: evidence on every module that was tested, by metric."""

    evidence: tuple[ThesisEvidence, ...]


@dataclass(frozen=True, kw_only=True)
class JointFacts:
    """Common results of phases 4 and 5: the best trial, and how often each module was active.

    Attributes:
        settings: settings of the best trial; also `values`, `modules`, `score` and `costs`.
        on: fraction of the trials with each module.
        said_of_pruned: a sentence on trials that were ended at a rung, if any were.
        front: numbers of the trials that no other surpasses in score and cost.
    """

    settings: Mapping[str, object]
    values: Mapping[str, Scalar]
    modules: tuple[str, ...]
    score: float
    costs: Mapping[str, float]
    on: Mapping[str, float]
    trials: tuple[TrialRow, ...]
    said_of_pruned: tuple[str, ...]
    front: tuple[int, ...] | None = field(default=None, metadata=OPTIONAL)


@dataclass(frozen=True, kw_only=True)
class SynthesisFacts(JointFacts):
    """Phase 4: scores of ``synthesis`` and ``baseline`` on the test sessions, and the change by the winner there.

    `antagonistic` are confirmed modules that the winner does without.
    """

    test: Mapping[str, Mapping[str, float | None]]
    test_gain: RelativeChange | None
    antagonistic: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class ExplorationFacts(JointFacts):
    """Phase 5: comparison of its winner with the winner of phase 4 on folds that no phase has used before.

    `options` are the values that were searched, by option of a module; `teacher` is the phase whose winner is it.
    """

    options: Mapping[str, tuple[Scalar, ...]]
    change: float
    low: float
    high: float
    p: float
    fresh: Mapping[str, float]
    runs: int
    teacher: str
    teacher_settings: Mapping[str, object]


@dataclass(frozen=True, kw_only=True)
class SmallerNetwork:
    """A network of phase 6 in one number format; see `edp.evaluation.compression.CompressedRow`."""

    name: str
    recipe: str
    units: int | None
    pruned: bool
    rounded: bool
    format: str
    resource_usage: ResourceUsage
    over: Mapping[str, tuple[int, int]]
    scores: Scores
    before: Scores
    error: float


@dataclass(frozen=True)
class ComparingSessions:
    """Sessions that train, and those that compare networks."""

    train: tuple[str, ...]
    validation: tuple[str, ...]


@dataclass(frozen=True)
class SecondTest:
    """Scores of ``teacher`` and ``chosen`` on the second test set, and the error of one divided by the other's."""

    scores: Mapping[str, Scores]
    error: float


@dataclass(frozen=True, kw_only=True)
class SmallerFacts:
    """Phase 6; see `edp.evaluation.compression.CompressionResult`. Without the phase `on` is false."""

    on: bool = True
    budget: Budget | None = field(default=None, metadata=OPTIONAL)
    sessions: ComparingSessions | None = field(default=None, metadata=OPTIONAL)
    second: tuple[str, ...] = ()
    rows: tuple[SmallerNetwork, ...] = ()
    front: tuple[int, ...] = ()
    chosen: int | None = None
    notes: tuple[str, ...] = ()
    held_out_test: SecondTest | None = None


_COMMON: dict[str, type] = {
    "isolation": IsolationFacts,
    "calibration": CalibrationFacts,
    "synthesis": SynthesisFacts,
    "exploration": ExplorationFacts,
    "compression": SmallerFacts,
}
FACTS: Mapping[str, Mapping[str, type]] = {
    "sound": _COMMON | {"screening": SoundScreening, "planning": SoundPlanning, "confirmation": SoundConfirmation},
    "thesis": _COMMON | {"screening": ThesisScreening, "planning": ThesisPlanning, "confirmation": ThesisConfirmation},
}
"""Data class by mode and phase."""
