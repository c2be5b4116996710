"""Phase 1: rates, width, depth and loss of each backbone, and the baseline of all later phases (thesis 3.3.2)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from edp.errors import DataError
from edp.evaluation.study import Decision
from edp.evaluation.study_facts import CalibratedBackbone, CalibrationFacts, FinalRound, IsolationFacts, TrialRow
from edp.stats.efficiency import SizeScore, most_efficient
from edp.stats.paired import fill_worst
from edp.stats.pareto import pareto
from edp.wording import behind, percent, percent_interval, typed
from edp.workflows.search.arms import Arm
from edp.workflows.search.context import SearchContext
from edp.workflows.search.phases.base import (
    PHASES,
    Course,
    Quest,
    answer_all,
    best,
    new_study,
    possible,
    said_of_pruned,
    scored,
)
from edp.workflows.search.phases.isolation import arm_of, lowest_against_others
from edp.workflows.search.space import Choice, Space, applicable, apply
from edp.workflows.search.study import Trial
from edp.workflows.search.trainings import Outcome


class Calibration:
    """Phase 1."""

    title = "calibration"

    def trainings(self, context: SearchContext) -> int:
        """Count the trainings of all backbones and the final comparison, if no backbone is too costly."""
        spec = context.spec
        final = spec.folds if spec.mode == "sound" and len(spec.backbones) > 1 else 0
        return len(spec.backbones) * (spec.calibration.trials * spec.trial_runs + final)

    def run(self, context: SearchContext) -> Course:
        """Train all backbones in parallel: every size in turn, then the sampler's questions.

        The best of each on all folds.
        """
        features = context.spec.feature_sets[context.facts(IsolationFacts).features]
        arms = {backbone: arm_of(context.base, backbone, features) for backbone in context.spec.backbones}
        # Only values that make a network of this arm are asked for.
        spaces = {name: possible(context, applicable(context.spec.space, arm), arm) for name, arm in arms.items()}
        quests = [_quest(context, name, arm, spaces[name][0]) for name, arm in arms.items()]
        answers = yield from answer_all(context, quests, context.spec.stops)
        notes = [f"{name}: {note}." for name, (_, some) in spaces.items() for note in some]
        asked = dict(zip(arms, answers, strict=True))
        # Of each backbone the efficient size goes on, since later phases multiply its cost.
        chosen = {name: picked for name, own in asked.items() if (picked := _efficient(own)) is not None}
        final: list[Outcome] = []
        # One fold may be easy for one of them; the thesis decides by it.
        if context.spec.mode == "sound" and len(chosen) > 1:
            runs = range(context.spec.folds)
            final = yield [order for picked in chosen.values() for order in context.orders(picked.arm, runs)]
        return self.decide(context, asked, chosen, final, notes)

    def decide(
        self,
        context: SearchContext,
        answers: dict[str, list[Trial]],
        chosen: dict[str, Trial],
        final: Sequence[Outcome],
        notes: list[str],
    ) -> Decision:
        """Choose the smallest size that no larger one repays for each backbone, and the best of them in the final."""
        horizon = context.spec.horizon
        backbones = {}
        sentences = list(notes)
        for backbone, own in answers.items():
            picked = chosen.get(backbone)
            if picked is None:
                sentences.append(f"{backbone}: no training of {len(own)} ended well; it is left out.")
                continue
            trials = tuple(_row(trial, horizon) for trial in own)
            backbones[backbone] = CalibratedBackbone(**vars(_row(picked, horizon)), trials=trials)
            lowest = best(own)
            size = f"{picked.costs['parameters']:,.0f}"
            text = (
                f"{backbone}: {_values(picked)} gives {typed(picked.score, 3)}{behind(context.unit)} with {size} "
                "parameters"
            )
            if lowest is not None and lowest is not picked:
                size = f"{lowest.costs['parameters']:,.0f}"
                text += f"; the lowest, {typed(lowest.score, 3)}, has {size} and does not repay the difference"
            sentences += [f"{text}.", *(f"{backbone}: {sentence}" for sentence in said_of_pruned(context, own))]
        if not chosen:
            raise DataError(
                "phase 1: no training of any backbone ended well; see the messages of the trainings, and lower the "
                "learning rates of the space or loosen the limits"
            )
        scores = {name: picked.score or 0.0 for name, picked in chosen.items()}
        final_round = _final(context, list(chosen), final) if final else None
        if final_round is not None:
            scores = dict(final_round.scores)
            listed = ", ".join(f"{name} {typed(score, 3)}" for name, score in scores.items())
            against = "".join(
                f"; {item.best} against {name} {percent(item.change, signed=True)} "
                f"({percent_interval(item.low, item.high)})"
                for name, item in final_round.against.items()
            )
            sentences.append(f"Each on all {context.spec.folds} folds: {listed}{behind(context.unit)}{against}.")
        winner = min(scores, key=lambda name: scores[name])
        sentences.append(f"The baseline of all later phases is {winner}.")
        front = None
        if context.spec.cost != "none":
            front = {name: _front(context, own) for name, own in answers.items()}
        facts = CalibrationFacts(
            backbones=backbones,
            final=final_round,
            backbone=winner,
            baseline=dict(chosen[winner].values),
            settings=chosen[winner].arm.tables,
            front=front,
        )
        return Decision("calibration", facts, tuple(sentences))


def _quest(context: SearchContext, backbone: str, arm: Arm, space: Space) -> Quest:
    spec = context.spec
    study = new_study(context, f"calibration {backbone}", space)
    sizes = space.get("units")
    # A warm round: every width once, so that no size is left out by chance.
    for _ in range(spec.calibration.warm_rounds):
        for size in sizes.options if isinstance(sizes, Choice) else ():
            study.suggest({"units": size})
    return Quest(study, lambda trial: context.shaped(apply(arm, trial.values)), spec.calibration.trials)


def _final(context: SearchContext, backbones: list[str], outcomes: Sequence[Outcome]) -> FinalRound:
    """Return the mean score of each backbone over the folds, and the lowest against each of the others."""
    mask = context.folds(context.spec.folds)
    parts = np.split(np.arange(len(outcomes)), len(backbones))
    raw = np.stack([context.table([outcomes[index] for index in part]) for part in parts])
    # Failed cells count as the worst of all backbones: a failure must not win by its absence.
    tables = dict(zip(backbones, fill_worst(raw, mask), strict=True))
    scores = {name: float(table[mask].mean()) for name, table in tables.items()}
    return FinalRound(context.spec.folds, scores, lowest_against_others(tables, mask))


def _efficient(trials: list[Trial]) -> Trial | None:
    """Return the best trial of the size that the efficiency rule chooses (`edp.stats.efficiency`)."""
    by_size: dict[float, tuple[float, Trial]] = {}
    # The best trial of each size represents the size.
    for score, trial in sorted(scored(trials), key=lambda pair: pair[0]):
        by_size.setdefault(trial.costs["parameters"], (score, trial))
    if not by_size:
        return None
    candidates = [SizeScore(f"{size:,.0f}", size, score) for size, (score, _) in by_size.items()]
    return by_size[most_efficient(candidates).parameters][1]


def _front(context: SearchContext, trials: list[Trial]) -> tuple[TrialRow, ...]:
    done = scored(trials)
    indices = pareto([(score, trial.costs[context.spec.cost]) for score, trial in done])
    return tuple(_row(done[index][1], context.spec.horizon) for index in indices)


def _row(trial: Trial, horizon: int) -> TrialRow:
    return replace(trial.row(horizon), statuses=tuple(outcome.status for outcome in trial.outcomes))


def _values(trial: Trial) -> str:
    return ", ".join(
        f"{name} {typed(value, 3)}" if isinstance(value, float) else f"{name} {value}"
        for name, value in trial.values.items()
    )


PHASES.register("calibration")(Calibration())
