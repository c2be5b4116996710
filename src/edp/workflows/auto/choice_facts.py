"""What an automatic training writes down of its choice: the sentence, each candidate's promise, intervals and skill."""

from __future__ import annotations

from typing import Any

import numpy as np

from edp.data.prepared import Prepared
from edp.networks.predictor import build_model
from edp.report.run.choice import FLOOR, PERSISTENCE
from edp.wording import percent
from edp.workflows.auto.candidates import CANDIDATES, Amount
from edp.workflows.auto.promise import (
    PortfolioChoice,
    Promise,
    blocks_of,
    by_output,
    in_report_units,
    promise_of,
    standard_truth,
    to_json,
)
from edp.workflows.auto.settings import AutoSettings
from edp.workflows.auto.train_candidates import TrainedCandidate


def choice_facts(
    choice: PortfolioChoice,
    trained: dict[str, TrainedCandidate],
    failed: dict[str, str],
    data: Prepared,
    settings: AutoSettings,
    amount: Amount,
) -> dict[str, Any]:
    """The content of ``auto.json`` but its key.

    Args:
        choice: which candidate is kept.
        trained: all that were trained, by name.
        failed: messages of those that diverged.
        data: prepared series.
        settings: of the run.
        amount: what there was to learn from.
    """
    candidates = {
        name: {
            "label": CANDIDATES[name].label,
            "seconds": round(one.fitted.seconds, 2),
            "parameters": sum(parameter.numel() for parameter in one.fitted.predictor.parameters()),
            "promise": in_report_units(one.promise.error(), data),
        }
        for name, one in trained.items()
    }
    promise, floor = trained[choice.name].promise, trained.get(FLOOR)
    still = _persistence(settings, data, amount)
    unchanged = in_report_units(still.last(len(promise.rows)).error(), data)
    tested = sum(max(0, part.samples - data.task.max_horizon) for part in data.test)
    against = still if floor is None or choice.name == FLOOR else floor.promise
    skill = promise.relative_to(against)
    return {
        "schema": 1,
        "minutes": settings.auto.minutes,
        "rows": amount.rows,
        **to_json(choice),
        "sentence": sentence(choice, trained, amount, data),
        "candidates": candidates,
        "persistence": unchanged,
        "interval": {side: in_report_units(bound, data) for side, bound in promise.interval(tested).items()},
        "skill": {
            "against": PERSISTENCE if against is still else FLOOR,
            "promise": by_output(skill.error(), data),
            "interval": {side: by_output(bound, data) for side, bound in skill.interval(tested).items()},
        },
        "failed": failed,
    }


def _persistence(settings: AutoSettings, data: Prepared, amount: Amount) -> Promise:
    """Errors of the present value, or of the mean in absolute mode."""
    # Any network with the scaling of the data: the kept one may have that of other machines.
    model = settings.experiment(CANDIDATES["linear"].tables(amount) or {}).model
    net = build_model(data.task, model, data.scaler(), 0)
    truth = standard_truth(net, data)  # zero is no change, or in absolute mode the mean
    blocks, _ = blocks_of(data, amount.window)
    return promise_of([np.zeros_like(one) for one in truth], truth, blocks)


def sentence(choice: PortfolioChoice, trained: dict[str, TrainedCandidate], amount: Amount, data: Prepared) -> str:
    """What was chosen and why, for a person."""
    label = CANDIDATES[choice.name].label
    minutes = amount.rows / data.task.rate_hz / 60
    start = f"Of {len(trained)} models on {minutes:.1f} min of recordings, {label} is kept"
    others = [name for name in trained if name != choice.name]
    if not others:
        return f"{start}: no other one was tried, or all others diverged."
    if choice.name != choice.best:
        gain = percent(-float(np.expm1(-choice.excess[choice.name])))
        best = CANDIDATES[choice.best].label
        return (
            f"{start}: {best} had {gain} less error on left-out data, but that is within one standard error, and "
            "the simpler model wins a tie."
        )
    second = min(others, key=lambda name: choice.excess[name])
    gain = percent(-float(np.expm1(-choice.excess[second])))
    return f"{start}: on left-out data its error is {gain} less than that of the next best, {CANDIDATES[second].label}."
