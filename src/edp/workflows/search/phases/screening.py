"""Phase 2: which modules go to confirmation (thesis 3.3.3)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edp.errors import count_of
from edp.evaluation.study import Decision
from edp.evaluation.study_facts import CalibrationFacts, ModuleEffect, ModuleGain, SoundScreening, ThesisScreening
from edp.stats.factorial import Factorial, least_runs, two_level_design
from edp.stats.importance import main_effects
from edp.wording import behind, typed
from edp.workflows.search.arms import Arm
from edp.workflows.search.context import SearchContext
from edp.workflows.search.modules import MODULES, contradicting, fitting
from edp.workflows.search.phases.base import PHASES, Course, Quest, answer_all, new_study, scored
from edp.workflows.search.space import Candidate, Choice, Space, apply, elastic, names
from edp.workflows.search.study import Trial
from edp.workflows.search.trainings import Outcome


class ModuleScreening:
    """Phase 2. Sound: a two-level design over all modules at once; thesis: each module tuned by itself."""

    title = "screening"

    def trainings(self, context: SearchContext) -> int:
        """Count the trainings of the design, or the questions of all modules with the baseline's seeds."""
        spec = context.spec
        if spec.mode == "thesis":
            return spec.run_seeds + len(spec.modules or MODULES) * spec.screening.trials * spec.trial_runs
        return max(spec.screening.runs, least_runs(len(spec.modules or MODULES))) * spec.screening.repeats

    def run(self, context: SearchContext) -> Course:
        """Request the trainings of the screening, and select the modules that pass."""
        return (yield from (_thesis(context) if context.spec.mode == "thesis" else _sound(context)))


class TunedBaseline(NamedTuple):
    """Winner of phase 1, its values, and the window around them for the tuning of candidates."""

    arm: Arm
    values: Candidate
    window: Space


def baseline_of(context: SearchContext) -> TunedBaseline:
    """Return the baseline of the later phases."""
    facts = context.facts(CalibrationFacts)
    space = {name: dimension for name, dimension in context.spec.space.items() if name in context.spec.elastic}
    beyond = context.spec.mode == "thesis"
    window = elastic(space, facts.baseline, context.spec.elastic, beyond)
    return TunedBaseline(Arm(facts.settings), facts.baseline, window)


def _sound(context: SearchContext) -> Course:
    spec = context.spec
    base, _, window = baseline_of(context)
    free = fitting(base, context.channels, spec.modules)
    barred = [sorted(pair) for pair in contradicting(base, free, context.channels)]
    # A design needs more runs than effects.
    design = two_level_design(free, max(spec.screening.runs, least_runs(len(free))), sorted(barred))
    drawn = _draw_values(context, window, spec.screening.repeats * len(design.levels))
    orders, rows = [], []
    for repeat in range(spec.screening.repeats):
        for row, levels in enumerate(design.levels):
            values = drawn[repeat * len(design.levels) + row]
            # Values are drawn anew for each row: main effects are then averages over the window.
            chosen = [name for name, on in zip(free, levels, strict=True) if on]
            orders += context.orders(context.network(apply(base, values), chosen), [repeat])
            rows.append(_DesignRow(levels, values, repeat))
    outcomes = yield orders
    return _estimate_effects(context, design, rows, outcomes)


def _draw_values(context: SearchContext, window: Space, count: int) -> list[dict[str, float]]:
    """Return the values inside the window by chance, so that effects are averages over it."""
    rng = np.random.default_rng(context.seed("screening"))
    candidates = []
    for _ in range(count):
        values = {}
        for name in names(window):
            dimension = window[name]
            if isinstance(dimension, Choice):
                continue
            # Rates act by their order of magnitude.
            low, high = (
                (np.log10([dimension.low, dimension.high])) if dimension.log else (dimension.low, dimension.high)
            )
            value = float(rng.uniform(low, high))
            values[name] = 10.0**value if dimension.log else value
        candidates.append(values)
    return candidates


@dataclass(frozen=True)
class _DesignRow:
    """Training of the design: its active modules, random values, and fold."""

    levels: NDArray[np.bool_]
    values: Mapping[str, float]
    repeat: int


def _estimate_effects(
    context: SearchContext,
    design: Factorial,
    rows: Sequence[_DesignRow],
    outcomes: Sequence[Outcome],
) -> Decision:
    """Estimate main effects by least squares, with random values and fold as covariates; modules with a sign pass."""
    scores = np.array([outcome.mean(context.spec.horizon) for outcome in outcomes])
    failed = int((~np.isfinite(scores)).sum())
    # A failed training counts as the worst that was seen, not as missing.
    if failed < len(scores):
        scores = np.where(np.isfinite(scores), scores, np.nanmax(scores))
    # Logarithms of rates are the covariates, since they were drawn so.
    drawn = [[np.log10(v) if v > 0 and name != "dropout" else v for name, v in row.values.items()] for row in rows]
    folds = [[float(row.repeat == repeat) for repeat in range(1, context.spec.screening.repeats)] for row in rows]
    covariates = np.hstack([np.array(drawn), np.array(folds).reshape(len(rows), -1)])
    # A column that never changes would make the regression singular.
    covariates = covariates[:, covariates.std(axis=0) > 0]
    levels = np.stack([row.levels for row in rows])
    effects = main_effects(levels, design.factors, scores, covariates if covariates.size else None)
    mean = float(scores.mean())
    passed = [effect.factor for effect in effects if effect.passed]
    table = {effect.factor: ModuleEffect(**vars(effect), change=effect.effect / mean) for effect in effects}
    sentences = [
        f"{len(passed)} of {len(effects)} modules show a sign of an improvement and go on: "
        f"{', '.join(MODULES[name].title for name in passed) or 'none'}; {count_of(len(rows), 'training')}, "
        f"{failed} failed."
    ]
    facts = SoundScreening(passed=tuple(passed), registered=tuple(design.factors), modules=table, alias=design.alias)
    return Decision("screening", facts, tuple(sentences))


def _thesis(context: SearchContext) -> Course:
    """Compare the best of some questions of each module with the baseline's median over seeds, as in the thesis."""
    spec = context.spec
    base, _, window = baseline_of(context)
    free = fitting(base, context.channels, spec.modules)
    median = yield [order for seed in range(spec.run_seeds) for order in context.orders(base, [0], seed=seed)]
    # A median over seeds, as in the thesis: the bar must not be that of one lucky seed.
    reference = float(np.median([outcome.mean(spec.horizon) for outcome in median]))
    quests = [_quest(context, base, name, window) for name in free]
    answers = yield from answer_all(context, quests)
    table = {name: _gain(own, reference) for name, own in zip(free, answers, strict=True)}
    passed = tuple(name for name, row in table.items() if row.gain is not None and row.gain > 0)
    sentences = (
        f"{len(passed)} of {len(free)} modules have a trial below the baseline's median of {typed(reference, 3)}"
        f"{behind(context.unit)} and go on; by chance alone most do, since the best of {spec.screening.trials} is "
        "compared with a "
        "median.",
    )
    facts = ThesisScreening(passed=passed, registered=tuple(free), modules=table)
    return Decision("screening", facts, sentences)


def _quest(context: SearchContext, base: Arm, module: str, window: Space) -> Quest:
    arm = context.network(base, [module])
    study = new_study(context, f"screening {module}", window)
    return Quest(study, lambda trial: apply(arm, trial.values), context.spec.screening.trials)


def _gain(trials: list[Trial], reference: float) -> ModuleGain:
    scores = [score for score, _ in scored(trials)]
    return ModuleGain(min(scores), reference - min(scores)) if scores else ModuleGain(None, None)


PHASES.register("screening")(ModuleScreening())
