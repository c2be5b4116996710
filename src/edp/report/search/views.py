"""What the figures of a study show, as plain values; `charts` says how they look."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from edp.errors import count_of
from edp.report.common.chart import with_unit
from edp.report.search.facts import NUMBERS, StudyFacts, known, of_phase, pair, real
from edp.stats.effects import effect_interval

COSTS = {"parameters": "Parameters", "macs_tick": "Multiply-accumulates per tick"}
BACKBONES = {"lstm": "LSTM", "gru": "GRU", "tcn": "TCN", "hybrid": "Hybrid"}
METRICS = {"mae": "MAE", "rmse": "RMSE", "p95": "P95", "p99": "P99"}


@dataclass(frozen=True)
class ArmSpread:
    """Mean and standard deviations of one arm of phase 0; `seed` is None with one seed."""

    mean: float
    split: float
    seed: float | None
    split_interval: tuple[float, float] | None
    seed_interval: tuple[float, float] | None


@dataclass(frozen=True)
class ArmView:
    """An arm of phase 0.

    Attributes:
        backbone, features: of the arm.
        chosen: whether its feature set goes on.
        scores: of each run by seed.
        composite: its spread.
        mae: that of the mean absolute error.
    """

    backbone: str
    features: str
    chosen: bool
    scores: tuple[tuple[float, ...], ...]
    composite: ArmSpread
    mae: ArmSpread


@of_phase("isolation", ())
def arm_views(study: StudyFacts, facts: Mapping[str, Any]) -> tuple[ArmView, ...]:
    """The arms of phase 0 in their order."""
    views = []
    for name, arm in facts["arms"].items():
        backbone, _, features = name.partition(" ")
        scores = tuple(tuple(real(score) for score in seeds) for seeds in arm["by_run"])
        if not all(scores):
            raise ValueError("an arm without a score")
        view = ArmView(
            titled(backbone), features, features == facts["features"], scores, _spread(arm), _spread(arm["mae"])
        )
        views.append(view)
    return tuple(views)


def _spread(arm: Mapping[str, Any]) -> ArmSpread:
    intervals = (pair(arm["split_interval"]), pair(arm["seed_interval"]))
    return ArmSpread(real(arm["mean"]), real(arm["split"]), known(arm["seed"]), *intervals)


def titled(backbone: str) -> str:
    """A backbone as a reader knows it."""
    return BACKBONES.get(backbone, backbone)


@dataclass(frozen=True)
class PointView:
    """A network that was asked about in phase 1, 4 or 5, all judged on the same folds with the same seeds.

    Attributes:
        group: phase and, in phase 1, backbone.
        score: at the horizon.
        costs: by name of `COSTS`, those that are known.
        label: what it is.
        picked: what it was chosen for; empty for most.
    """

    group: str
    score: float
    costs: Mapping[str, float]
    label: str
    picked: str = ""


def point_views(study: StudyFacts) -> tuple[PointView, ...]:
    """Every network with a score and a cost; of a phase that has not decided yet, what the history holds."""
    points = [*_calibrated(study), *_together(study), *_free(study)]
    for name in ("calibration", "synthesis", "exploration"):
        if name not in study.facts:
            points += [
                PointView(f"Phase {NUMBERS[name]}, so far", training.score, costs, training.label)
                for training in study.history
                if training.phase == name and training.score is not None
                if (costs := _known({"parameters": training.parameters, "macs_tick": training.macs_tick}))
            ]
    return tuple(points)


@of_phase("calibration", ())
def _calibrated(study: StudyFacts, facts: Mapping[str, Any]) -> tuple[PointView, ...]:
    points = []
    for backbone, calibration in facts["backbones"].items():
        for trial in calibration["trials"]:
            if trial["score"] is not None:
                took = trial["number"] == calibration["number"]
                what = "baseline" if backbone == facts["backbone"] else f"taken of {titled(backbone)}"
                values = (trial["score"], {name: trial.get(name) for name in COSTS}, valued(trial["values"]))
                points.append(_point(f"Phase 1, {titled(backbone)}", *values, what if took else ""))
    return tuple(points)


@of_phase("synthesis", ())
def _together(study: StudyFacts, facts: Mapping[str, Any]) -> tuple[PointView, ...]:
    return _joint(study, facts, "Phase 4", "winner of phase 4")


@of_phase("exploration", ())
def _free(study: StudyFacts, facts: Mapping[str, Any]) -> tuple[PointView, ...]:
    return _joint(study, facts, "Phase 5", "winner of phase 5")


def _joint(study: StudyFacts, facts: Mapping[str, Any], group: str, winner: str) -> tuple[PointView, ...]:
    done = [trial for trial in facts["trials"] if trial["score"] is not None]
    best = min(done, key=lambda trial: (real(trial["score"]), trial["number"]), default=None)
    points = []
    for trial in done:
        modules = ", ".join(study.module(name) for name in trial["modules"]) or "no module"
        label = f"{modules}; {valued(trial['values'])}"
        costs = {name: trial.get(name) for name in COSTS}
        points.append(_point(group, trial["score"], costs, label, winner if trial is best else ""))
    return tuple(points)


def _point(group: str, score: Any, costs: Mapping[str, Any], label: str, picked: str) -> PointView:
    return PointView(group, real(score), _known(costs), label, picked)


def _known(costs: Mapping[str, Any]) -> dict[str, float]:
    return {name: real(value) for name, value in costs.items() if value is not None and real(value) > 0}


def valued(values: Mapping[str, Any]) -> str:
    """Settings as ``units 64, loss huber``."""
    return ", ".join(
        f"{name} {value:.3g}" if isinstance(value, float) else f"{name} {value}" for name, value in values.items()
    ).replace("_", " ")


def front(points: Sequence[PointView], cost: str) -> tuple[PointView, ...]:
    """Points that no other one betters in score without costing more, in ascending order of cost."""
    front_points: list[PointView] = []
    for point in sorted((p for p in points if cost in p.costs), key=lambda p: (p.costs[cost], p.score)):
        if not front_points or point.score < front_points[-1].score:
            front_points.append(point)
    return tuple(front_points)


@dataclass(frozen=True)
class EffectView:
    """What a module does.

    Attributes:
        module: title.
        value: effect, negative is better, in the unit of its forest.
        low, high: interval; None where there is none.
        p, adjusted: one-sided p-values; None where there is none.
        good: whether it passed.
        remark: in a word or two.
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
        key: for selectors and files.
        title: in words.
        short: for a selector.
        axis: title of the horizontal axis.
        effects: of the modules, the best first.
        gate: effect that the practical gate asks for; None for no gate.
    """

    key: str
    title: str
    short: str
    axis: str
    effects: tuple[EffectView, ...]
    gate: float | None = None


def forests(study: StudyFacts) -> tuple[Forest, ...]:
    """Phase 3 and phase 2, as far as they are decided; in the thesis's mode phase 3 by metric."""
    candidates = (*_confirmed(study), *_screened(study))
    return tuple(forest for forest in candidates if forest.effects)


@of_phase("confirmation", ())
def _confirmed(study: StudyFacts, facts: Mapping[str, Any]) -> tuple[Forest, ...]:
    evidence = facts["evidence"]
    if study.mode == "sound":
        effects = [_sound(study, entry) for entry in evidence if entry["change"] is not None]
        gate = -100.0 * real(study.spec["least_gain"])
        return (Forest("confirmation", "Phase 3: confirmation", "", CHANGE, _ranked(effects), gate),)
    splits = int(study.facts["planning"]["runs"])
    return tuple(
        Forest(
            f"confirmation_{metric}",
            f"Phase 3: confirmation, {METRICS.get(metric, metric)}",
            METRICS.get(metric, metric),
            "Cohen's d_z of the splits; left is better",
            _ranked(_thesis(study, entry, splits) for entry in evidence if entry["metric"] == metric),
            -0.5,
        )
        for metric in dict.fromkeys(str(entry["metric"]) for entry in evidence)
    )


CHANGE = "Change of the baseline's mean score [%]; left is better"


def _sound(study: StudyFacts, entry: Mapping[str, Any]) -> EffectView:
    after = int(entry["dropped_after"])
    remark = (
        "confirmed" if entry["confirmed"] else f"dropped after {count_of(after, 'run')}" if after else "not confirmed"
    )
    value, low, high = (100.0 * real(entry[name]) for name in ("change", "low", "high"))
    p, adjusted = real(entry["p"]), real(entry["adjusted"])
    return EffectView(study.module(entry["module"]), value, low, high, p, adjusted, bool(entry["confirmed"]), remark)


def _thesis(study: StudyFacts, entry: Mapping[str, Any], splits: int) -> EffectView:
    size = known(entry["d_z"])
    interval = effect_interval(math.copysign(math.inf, real(entry["beta"])) if size is None else size, splits)
    low, high = (bound if math.isfinite(bound) else None for bound in (interval.low, interval.high))
    value = size if size is not None else math.copysign(99.0, real(entry["beta"]))
    p, adjusted, good = real(entry["printed_p"]), real(entry["adjusted"]), bool(entry["passed"])
    remark = "passed" if good else "not passed"
    return EffectView(study.module(entry["module"]), value, low, high, p, adjusted, good, remark)


@of_phase("screening", ())
def _screened(study: StudyFacts, facts: Mapping[str, Any]) -> tuple[Forest, ...]:
    passed = set(facts["passed"])
    title = "Phase 2: screening"
    effects = []
    for name, entry in facts["modules"].items():
        good = name in passed
        remark = "goes on" if good else "stops"
        if study.mode == "thesis":
            gain = known(entry["gain"])
            if gain is not None:
                effects.append(EffectView(study.module(name), -gain, None, None, None, None, good, remark))
        else:
            value, effect, error = (real(entry[key]) for key in ("change", "effect", "error"))
            reach = 1.96 * error * abs(value / effect) if effect else 0.0
            ends = (100.0 * (value - reach), 100.0 * (value + reach))
            effects.append(EffectView(study.module(name), 100.0 * value, *ends, real(entry["p"]), None, good, remark))
    axis = with_unit("Best question less the baseline's median, left is better", study.unit)
    return (Forest("screening", title, "", axis if study.mode == "thesis" else CHANGE, _ranked(effects)),)


def _ranked(effects: Iterable[EffectView]) -> tuple[EffectView, ...]:
    return tuple(sorted(effects, key=lambda view: (view.value, view.module)))


@dataclass(frozen=True)
class PhaseTrack:
    """The trainings of one phase in the order in which they were asked for; those on test sessions stand apart.

    Attributes:
        name, heading: of the track.
        places: numbers of its trainings in the study, from 1.
        scores: NaN where one was pruned or failed.
        labels: what each was.
        best: lowest score of the phase so far.
        pruned: those of the places whose training was ended at a rung.
    """

    name: str
    heading: str
    places: tuple[int, ...]
    scores: tuple[float, ...]
    labels: tuple[str, ...]
    best: tuple[float, ...]
    pruned: frozenset[int] = frozenset()


def tracks(study: StudyFacts) -> tuple[PhaseTrack, ...]:
    """The search's history by phase."""
    views = []
    for name, test in dict.fromkeys((training.phase, training.test) for training in study.history):
        own = [(position, h) for position, h in enumerate(study.history, 1) if (h.phase, h.test) == (name, test)]
        scores = [math.nan if training.score is None else training.score for _, training in own]
        best = np.fmin.accumulate(np.array(scores))
        phase = study.phase(name)
        heading = f"Phase {NUMBERS[name]}" if name in NUMBERS else (phase.title if phase else name)
        heading += ", test sessions" if test else ""
        labels = tuple(f"{training.label}, {training.status}" for _, training in own)
        key = f"{name} test" if test else name
        places, pruned = tuple(p for p, _ in own), frozenset(p for p, training in own if training.status == "pruned")
        views.append(PhaseTrack(key, heading, places, tuple(scores), labels, tuple(best.tolist()), pruned))
    return tuple(views)


def top_of(scores: Iterable[float]) -> float | None:
    """Upper end of a score axis that shows nearly all: what lies far above the rest is drawn at the edge."""
    values = np.array([score for score in scores if math.isfinite(score)])
    if not values.size:
        return None
    low, most = float(values.min()), float(values.max())
    usual = float(np.quantile(values, 0.9))
    return min(most, usual + 0.6 * (usual - low)) + 0.04 * max(usual - low, 1e-9)
