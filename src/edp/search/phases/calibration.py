"""Phase 1: rates, width, depth and loss of each backbone, and the baseline of all later phases (thesis 3.3.2)."""

from __future__ import annotations

from typing import Any

from edp.config import Table
from edp.errors import DataError
from edp.search.ground import Decision, Ground
from edp.search.phases.base import PHASES, Answer, Course, Quest, answer_all, best, mean_of, new_study, possible
from edp.search.phases.isolation import arm_settings
from edp.search.space import Choice, Space, applicable, apply
from edp.search.study import pareto
from edp.stats.efficiency import Candidate, most_efficient


class Calibration:
    """Phase 1."""

    title = "calibration"

    def trainings(self, ground: Ground) -> int:
        """Every question of every backbone, were none too costly."""
        return len(ground.spec.backbones) * ground.spec.trials * ground.spec.trial_runs

    def run(self, ground: Ground) -> Course:
        """All backbones side by side; first every size in turn, then what the sampler asks."""
        features = ground.spec.feature_sets[ground.decided["isolation"].facts["features"]]
        arms = {backbone: arm_settings(ground.base, backbone, features) for backbone in ground.spec.backbones}
        spaces = {name: possible(ground, applicable(ground.spec.space, arm), arm) for name, arm in arms.items()}
        quests = [_quest(ground, name, arm, spaces[name][0]) for name, arm in arms.items()]
        answers = yield from answer_all(ground, quests)
        notes = [f"{name}: {note}." for name, (_, some) in spaces.items() for note in some]
        return self.decide(ground, dict(zip(arms, answers, strict=True)), notes)

    def decide(self, ground: Ground, answers: dict[str, list[Answer]], notes: list[str]) -> Decision:
        """Of each backbone the smallest size that no larger one repays; of these the lowest score."""
        facts: dict[str, Any] = {"backbones": {}}
        chosen: dict[str, Answer] = {}
        sentences = list(notes)
        for backbone, own in answers.items():
            picked = _efficient(own)
            if picked is None:
                sentences.append(f"{backbone}: no training of {len(own)} ended well; it is left out.")
                continue
            chosen[backbone] = picked
            facts["backbones"][backbone] = _plain(ground, picked) | {"trials": [_plain(ground, held) for held in own]}
            lowest = best(own)
            size = f"{picked.costs['parameters']:,.0f}"
            text = f"{backbone}: {_values(picked)} gives {picked.score:.3g} {ground.unit} with {size} parameters"
            if lowest is not None and lowest is not picked:
                size = f"{lowest.costs['parameters']:,.0f}"
                text += f"; the lowest, {lowest.score:.3g}, has {size} and does not repay the difference"
            sentences.append(f"{text}.")
        if not chosen:
            raise DataError(
                "phase 1: no training of any backbone ended well; see the messages of the trainings, and lower the "
                "learning rates of the space or loosen the limits"
            )
        winner = min(chosen, key=lambda name: chosen[name].score or 0.0)
        facts |= {"backbone": winner, "baseline": dict(chosen[winner].trial.values)}
        facts["settings"] = chosen[winner].settings
        sentences.append(f"The baseline of all later phases is {winner}.")
        if ground.spec.cost != "none":
            facts["front"] = {name: _front(ground, own) for name, own in answers.items()}
        return Decision("calibration", facts, tuple(sentences))


def _quest(ground: Ground, backbone: str, arm: Table, space: Space) -> Quest:
    spec = ground.spec
    study = new_study(ground, f"calibration {backbone}", space)
    sizes = space.get("units")
    for _ in range(spec.warm_rounds):
        for size in sizes.options if isinstance(sizes, Choice) else ():
            study.suggest({"units": size})
    return Quest(study, lambda trial: apply(arm, trial.values), spec.trials)


def _efficient(answers: list[Answer]) -> Answer | None:
    """The best answer of the size that the efficiency rule chooses (`edp.stats.efficiency`)."""
    by_size: dict[float, Answer] = {}
    for answer in answers:
        if answer.score is None:
            continue
        held = by_size.get(answer.costs["parameters"])
        if held is None or held.score is None or answer.score < held.score:
            by_size[answer.costs["parameters"]] = answer
    if not by_size:
        return None
    candidates = [Candidate(f"{size:,.0f}", size, answer.score or 0.0) for size, answer in by_size.items()]
    return by_size[most_efficient(candidates).parameters]


def _front(ground: Ground, answers: list[Answer]) -> list[dict[str, Any]]:
    done = [answer for answer in answers if answer.score is not None]
    kept = pareto([(answer.score or 0.0, answer.costs[ground.spec.cost]) for answer in done])
    return [_plain(ground, done[place]) for place in kept]


def _plain(ground: Ground, answer: Answer) -> dict[str, Any]:
    return {
        "number": answer.trial.number,
        "values": dict(answer.trial.values),
        "score": answer.score,
        "mae": mean_of(ground, answer.outcomes, "mae"),
        **answer.costs,
        "statuses": [outcome.status for outcome in answer.outcomes],
    }


def _values(answer: Answer) -> str:
    return ", ".join(
        f"{name} {value:.3g}" if isinstance(value, float) else f"{name} {value}"
        for name, value in answer.trial.values.items()
    )


PHASES.register("calibration")(Calibration())
