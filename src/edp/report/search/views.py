"""Data of a study's figures as plain values; `charts` gives their look."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from edp.errors import count_of
from edp.evaluation.study import NUMBERS, StudyFile
from edp.evaluation.study_facts import (
    CalibrationFacts,
    ExplorationFacts,
    IsolationFacts,
    JointFacts,
    Scalar,
    ScreeningFacts,
    SoundConfirmation,
    SoundScreening,
    SynthesisFacts,
    ThesisConfirmation,
    ThesisPlanning,
    ThesisScreening,
)
from edp.report.common.chart import append_unit
from edp.report.search.facts import finite, require_phase
from edp.stats.effects import effect_interval
from edp.stats.variance import SplitVariance

COSTS = {"parameters": "Parameters", "macs_tick": "Multiply-accumulates per tick"}
BACKBONES = {"lstm": "LSTM", "gru": "GRU", "tcn": "TCN", "hybrid": "Hybrid"}
METRICS = {"mae": "MAE", "rmse": "RMSE", "p95": "P95", "p99": "P99"}


@dataclass(frozen=True)
class ArmView:
    """An arm of phase 0.

    Attributes:
        backbone, features: backbone and features of the arm.
        chosen: whether its feature set goes on.
        scores: score of each run by seed.
        composite: spread of the composite score.
        mae: score of the mean absolute error.
    """

    backbone: str
    features: str
    chosen: bool
    scores: tuple[tuple[float, ...], ...]
    composite: SplitVariance
    mae: SplitVariance


@require_phase(IsolationFacts, ())
def arm_views(study: StudyFile, facts: IsolationFacts) -> tuple[ArmView, ...]:
    """Return the arms of phase 0 in their order."""
    views = []
    for name, arm in facts.arms.items():
        backbone, _, features = name.partition(" ")
        if not all(arm.by_run):
            raise ValueError("an arm without a score")
        chosen = features == facts.features
        views.append(ArmView(titled(backbone), features, chosen, arm.by_run, arm, arm.mae))
    return tuple(views)


def titled(backbone: str) -> str:
    """Return the readable name of a backbone."""
    return BACKBONES.get(backbone, backbone)


@dataclass(frozen=True)
class PointView:
    """Network of phase 1, 4 or 5; all are evaluated on the same folds with the same seeds.

    Attributes:
        group: phase and, in phase 1, backbone.
        score: score at the horizon.
        costs: known costs by name in `COSTS`.
        label: description of the network.
        picked: criterion for which it was chosen; empty for most.
    """

    group: str
    score: float
    costs: Mapping[str, float]
    label: str
    picked: str = ""


def point_views(study: StudyFile) -> tuple[PointView, ...]:
    """Return every network with a score and a cost; for an undecided phase, the networks of the history."""
    points = [*_view_calibration(study)]
    for kind, number in ((SynthesisFacts, 4), (ExplorationFacts, 5)):
        facts = study.facts(kind)
        points += [] if facts is None else _joint(study, facts, number)
    for name in ("calibration", "synthesis", "exploration"):
        if name not in study.decided:
            points += [
                PointView(f"Phase {NUMBERS[name]}, so far", row.score, costs, row.label)
                for row in study.ended
                if row.phase == name and row.score is not None
                if (costs := _select_positive({"parameters": row.parameters, "macs_tick": row.macs_tick}))
            ]
    return tuple(points)


@require_phase(CalibrationFacts, ())
def _view_calibration(study: StudyFile, facts: CalibrationFacts) -> tuple[PointView, ...]:
    points = []
    for backbone, calibration in facts.backbones.items():
        for trial in calibration.trials:
            if trial.score is not None:
                what = "baseline" if backbone == facts.backbone else f"taken of {titled(backbone)}"
                picked = what if trial.number == calibration.number else ""
                group, costs = f"Phase 1, {titled(backbone)}", _select_positive(trial.costs)
                points.append(PointView(group, trial.score, costs, valued(trial.values), picked))
    return tuple(points)


def _joint(study: StudyFile, facts: JointFacts, number: int) -> list[PointView]:
    scores = {trial.number: trial.score for trial in facts.trials if trial.score is not None}
    best = min(scores, key=lambda trial: (scores[trial], trial), default=None)
    points = []
    for trial in facts.trials:
        if trial.score is not None:
            modules = ", ".join(study.module(name) for name in trial.modules or ()) or "no module"
            label = f"{modules}; {valued(trial.values)}"
            picked = f"winner of phase {number}" if trial.number == best else ""
            points.append(PointView(f"Phase {number}", trial.score, _select_positive(trial.costs), label, picked))
    return points


def _select_positive(costs: Mapping[str, float | None]) -> dict[str, float]:
    return {name: value for name, value in costs.items() if value is not None and value > 0}


def valued(values: Mapping[str, Scalar]) -> str:
    """Return settings as text: ``units 64, loss huber``."""
    return ", ".join(
        f"{name} {value:.3g}" if isinstance(value, float) else f"{name} {value}" for name, value in values.items()
    ).replace("_", " ")


def front(points: Sequence[PointView], cost: str) -> tuple[PointView, ...]:
    """Return the points that no other one betters in score without costing more, in ascending order of cost."""
    front_points: list[PointView] = []
    for point in sorted((p for p in points if cost in p.costs), key=lambda p: (p.costs[cost], p.score)):
        if not front_points or point.score < front_points[-1].score:
            front_points.append(point)
    return tuple(front_points)


@dataclass(frozen=True)
class EffectView:
    """Effect of a module on the score.

    Attributes:
        module: title.
        value: effect, negative is better, in the unit of its forest.
        low, high: interval; None where there is none.
        p, adjusted: one-sided p-values; None where there is none.
        good: whether it passed.
        remark: remark in a word or two.
    """

    module: str
    value: float
    low: float | None
    high: float | None
    p: float | None
    adjusted: float | None
    good: bool
    remark: str


@dataclass(frozen=True)
class Forest:
    """The modules of one phase.

    Attributes:
        key: key for selectors and files.
        title: title in words.
        short: short title for a selector.
        axis: title of the horizontal axis.
        effects: effects of the modules, the best first.
        gate: effect that the practical gate asks for; None for no gate.
    """

    key: str
    title: str
    short: str
    axis: str
    effects: tuple[EffectView, ...]
    gate: float | None = None


def forests(study: StudyFile) -> tuple[Forest, ...]:
    """Return the decided effects of phases 3 and 2; in the thesis's mode phase 3 by metric."""
    candidates = (*_sound(study), *_thesis(study), *_view_screening(study))
    return tuple(forest for forest in candidates if forest.effects)


CHANGE = "Change of the baseline's mean score [%]; left is better"


@require_phase(SoundConfirmation, ())
def _sound(study: StudyFile, facts: SoundConfirmation) -> tuple[Forest, ...]:
    effects = []
    for entry in facts.evidence:
        value, low, high = (None if one is None else 100.0 * one for one in (entry.change, entry.low, entry.high))
        if value is not None:
            dropped = (
                f"dropped after {count_of(entry.dropped_after, 'run')}" if entry.dropped_after else "not confirmed"
            )
            remark = "confirmed" if entry.confirmed else dropped
            tests = (entry.p, entry.adjusted, entry.confirmed, remark)
            effects.append(EffectView(study.module(entry.module), value, low, high, *tests))
    gate = -100.0 * float(study.spec["least_gain"])
    return (Forest("confirmation", "Phase 3: confirmation", "", CHANGE, _sort_effects(effects), gate),)


@require_phase(ThesisConfirmation, ())
def _thesis(study: StudyFile, facts: ThesisConfirmation) -> tuple[Forest, ...]:
    planning = study.facts(ThesisPlanning)
    views: dict[str, list[EffectView]] = {}
    for entry in facts.evidence if planning is not None else ():
        size = finite(entry.d_z)
        bound = math.copysign(math.inf, entry.beta) if size is None else size
        interval = effect_interval(bound, planning.runs if planning is not None else 0)
        value = size if size is not None else math.copysign(99.0, entry.beta)
        remark = "passed" if entry.passed else "not passed"
        tests = (entry.printed_p, entry.adjusted, entry.passed, remark)
        view = EffectView(study.module(entry.module), value, finite(interval.low), finite(interval.high), *tests)
        views.setdefault(entry.metric, []).append(view)
    return tuple(
        Forest(
            f"confirmation_{metric}",
            f"Phase 3: confirmation, {METRICS.get(metric, metric)}",
            METRICS.get(metric, metric),
            "Cohen's d_z of the splits; left is better",
            _sort_effects(own),
            -0.5,
        )
        for metric, own in views.items()
    )


@require_phase(ScreeningFacts, ())
def _view_screening(study: StudyFile, facts: ScreeningFacts) -> tuple[Forest, ...]:
    axis, effects = CHANGE, []
    if isinstance(facts, SoundScreening):
        for name, effect in facts.modules.items():
            value = effect.change
            reach = 1.96 * effect.error * abs(value / effect.effect) if effect.effect else 0.0
            low, high = 100.0 * (value - reach), 100.0 * (value + reach)
            tests = (effect.p, None, name in facts.passed, "goes on" if name in facts.passed else "stops")
            effects.append(EffectView(study.module(name), 100.0 * value, low, high, *tests))
    if isinstance(facts, ThesisScreening):
        axis = append_unit("Best question less the baseline's median, left is better", study.unit)
        for name, row in facts.modules.items():
            if row.gain is not None:
                verdict = "goes on" if name in facts.passed else "stops"
                view = EffectView(study.module(name), -row.gain, None, None, None, None, name in facts.passed, verdict)
                effects.append(view)
    return (Forest("screening", "Phase 2: screening", "", axis, _sort_effects(effects)),)


def _sort_effects(effects: Iterable[EffectView]) -> tuple[EffectView, ...]:
    return tuple(sorted(effects, key=lambda view: (view.value, view.module)))


@dataclass(frozen=True)
class PhaseTrack:
    """Trainings of a phase in order of request; trainings on test sessions are separate.

    Attributes:
        name, heading: name and heading of the track.
        places: numbers of its trainings in the study, from 1.
        scores: NaN where one was pruned or failed.
        labels: description of each training.
        best: lowest score of the phase so far.
        pruned: places whose training was ended at a rung.
    """

    name: str
    heading: str
    places: tuple[int, ...]
    scores: tuple[float, ...]
    labels: tuple[str, ...]
    best: tuple[float, ...]
    pruned: frozenset[int] = frozenset()


def tracks(study: StudyFile) -> tuple[PhaseTrack, ...]:
    """Return the history of the search by phase."""
    tested, titles = study.tested(), {phase.name: phase.title for phase in study.phases}
    rows = [(row, index in tested) for index, row in enumerate(study.history) if row.status != "waiting"]
    views = []
    for name, test in dict.fromkeys((row.phase, on_test) for row, on_test in rows):
        own = [(number, row) for number, (row, on_test) in enumerate(rows, 1) if (row.phase, on_test) == (name, test)]
        scores = [math.nan if row.score is None else row.score for _, row in own]
        heading = f"Phase {NUMBERS[name]}" if name in NUMBERS else titles.get(name, name)
        track = PhaseTrack(
            name=f"{name} test" if test else name,
            heading=f"{heading}, test sessions" if test else heading,
            places=tuple(number for number, _ in own),
            scores=tuple(scores),
            labels=tuple(f"{row.label}, {row.status}" for _, row in own),
            best=tuple(np.fmin.accumulate(np.array(scores)).tolist()),
            pruned=frozenset(number for number, row in own if row.status == "pruned"),
        )
        views.append(track)
    return tuple(views)


def top_of(scores: Iterable[float]) -> float | None:
    """Return the upper end of a score axis; values far above the others are plotted at the edge."""
    values = np.array([score for score in scores if math.isfinite(score)])
    if not values.size:
        return None
    low, most = float(values.min()), float(values.max())
    usual = float(np.quantile(values, 0.9))
    return min(most, usual + 0.6 * (usual - low)) + 0.04 * max(usual - low, 1e-9)
