"""Phase 1: rates, width, depth and loss of each backbone, and the baseline of all later phases (thesis 3.3.2)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from edp.config.experiment import Table
from edp.errors import DataError
from edp.stats.efficiency import SizeScore, most_efficient
from edp.stats.paired import fill_worst
from edp.stats.pareto import pareto
from edp.wording import behind, percent, percent_interval, typed
from edp.workflows.search.context import Decision, Outcome, SearchContext
from edp.workflows.search.phases.base import (
    PHASES,
    AnsweredQuestion,
    Course,
    Quest,
    answer_all,
    best,
    mean_of,
    new_study,
    possible,
    said_of_pruned,
)
from edp.workflows.search.phases.isolation import arm_settings, lowest_against_others
from edp.workflows.search.space import Choice, Space, applicable, apply


class Calibration:
    """Phase 1."""

    title = "calibration"

    def trainings(self, context: SearchContext) -> int:
        """Every question of every backbone, were none too costly, and the final between them."""
        spec = context.spec
        final = spec.folds if spec.mode == "sound" and len(spec.backbones) > 1 else 0
        return len(spec.backbones) * (spec.trials * spec.trial_runs + final)

    def run(self, context: SearchContext) -> Course:
        """All backbones side by side: every size in turn, then what the sampler asks; the best of each on all folds."""
        features = context.spec.feature_sets[context.decided["isolation"].facts["features"]]
        arms = {backbone: arm_settings(context.base, backbone, features) for backbone in context.spec.backbones}
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
            final = yield [order for picked in chosen.values() for order in context.orders(picked.settings, runs)]
        return self.decide(context, asked, chosen, final, notes)

    def decide(
        self,
        context: SearchContext,
        answers: dict[str, list[AnsweredQuestion]],
        chosen: dict[str, AnsweredQuestion],
        final: Sequence[Outcome],
        notes: list[str],
    ) -> Decision:
        """Of each backbone the smallest size that no larger one repays; of these the lowest score in the final."""
        facts: dict[str, Any] = {"backbones": {}}
        sentences = list(notes)
        for backbone, own in answers.items():
            picked = chosen.get(backbone)
            if picked is None:
                sentences.append(f"{backbone}: no training of {len(own)} ended well; it is left out.")
                continue
            facts["backbones"][backbone] = _plain(context, picked) | {"trials": [_plain(context, item) for item in own]}
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
        if final:
            facts["final"] = _final(context, list(chosen), final)
            scores = facts["final"]["scores"]
            listed = ", ".join(f"{name} {typed(score, 3)}" for name, score in scores.items())
            against = "".join(
                f"; {item['best']} against {name} {percent(item['change'], signed=True)} "
                f"({percent_interval(item['low'], item['high'])})"
                for name, item in facts["final"]["against"].items()
            )
            sentences.append(f"Each on all {context.spec.folds} folds: {listed}{behind(context.unit)}{against}.")
        winner = min(scores, key=lambda name: scores[name])
        facts |= {"backbone": winner, "baseline": dict(chosen[winner].trial.values)}
        facts["settings"] = chosen[winner].settings
        sentences.append(f"The baseline of all later phases is {winner}.")
        if context.spec.cost != "none":
            facts["front"] = {name: _front(context, own) for name, own in answers.items()}
        return Decision("calibration", facts, tuple(sentences))


def _quest(context: SearchContext, backbone: str, arm: Table, space: Space) -> Quest:
    spec = context.spec
    study = new_study(context, f"calibration {backbone}", space)
    sizes = space.get("units")
    # A warm round: every width once, so that no size is left out by chance.
    for _ in range(spec.warm_rounds):
        for size in sizes.options if isinstance(sizes, Choice) else ():
            study.suggest({"units": size})
    return Quest(study, lambda trial: context.shaped(apply(arm, trial.values)), spec.trials)


def _final(context: SearchContext, backbones: list[str], outcomes: Sequence[Outcome]) -> dict[str, Any]:
    """Mean score of each backbone over the folds, and the lowest against each of the others."""
    mask = context.folds(context.spec.folds)
    parts = np.split(np.arange(len(outcomes)), len(backbones))
    raw = np.stack([context.table([outcomes[index] for index in part]) for part in parts])
    # Failed cells count as the worst of all backbones: a failure must not win by its absence.
    tables = dict(zip(backbones, fill_worst(raw, mask), strict=True))
    scores = {name: float(table[mask].mean()) for name, table in tables.items()}
    return {"runs": context.spec.folds, "scores": scores, "against": lowest_against_others(tables, mask)}


def _efficient(answers: list[AnsweredQuestion]) -> AnsweredQuestion | None:
    """The best answer of the size that the efficiency rule chooses (`edp.stats.efficiency`)."""
    by_size: dict[float, AnsweredQuestion] = {}
    for answer in answers:
        if answer.score is None:
            continue
        # Of each size its best question stands for it.
        best_of_size = by_size.get(answer.costs["parameters"])
        if best_of_size is None or best_of_size.score is None or answer.score < best_of_size.score:
            by_size[answer.costs["parameters"]] = answer
    if not by_size:
        return None
    candidates = [SizeScore(f"{size:,.0f}", size, answer.score or 0.0) for size, answer in by_size.items()]
    return by_size[most_efficient(candidates).parameters]


def _front(context: SearchContext, answers: list[AnsweredQuestion]) -> list[dict[str, Any]]:
    done = [answer for answer in answers if answer.score is not None]
    front_indices = pareto([(answer.score or 0.0, answer.costs[context.spec.cost]) for answer in done])
    return [_plain(context, done[index]) for index in front_indices]


def _plain(context: SearchContext, answer: AnsweredQuestion) -> dict[str, Any]:
    return {
        "number": answer.trial.number,
        "values": dict(answer.trial.values),
        "score": answer.score,
        "mae": None if answer.pruned else mean_of(context, answer.outcomes, "mae"),
        **answer.costs,
        "statuses": [outcome.status for outcome in answer.outcomes],
        **answer.course(),
    }


def _values(answer: AnsweredQuestion) -> str:
    return ", ".join(
        f"{name} {typed(value, 3)}" if isinstance(value, float) else f"{name} {value}"
        for name, value in answer.trial.values.items()
    )


PHASES.register("calibration")(Calibration())
