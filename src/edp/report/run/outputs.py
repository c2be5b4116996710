"""Sentences on a run's scores by output, and on the evidence of its test logs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

from edp.data.splits import kind_of_name
from edp.errors import count_of
from edp.evaluation.guard import MEASURE, MEASURE_NAME, NETWORK, find_lost_outputs
from edp.evaluation.scores_file import DataSituation, ScoresFile, TargetChange, error_at
from edp.settings.provenance import Provenance
from edp.storage import read_object
from edp.storage.paths import is_file_at
from edp.wording import behind, listed, number, percent

SHOWN = 4
"""Maximum number of outputs or logs named in a sentence."""
NOTED = 2.0
"""Ratio between the changes in test and training data from which the ratio is reported."""
FEW = 3
"""Minimum number of test logs. With fewer logs, one unusual log determines the result."""


def losses_line(scores: ScoresFile) -> str:
    """Name the outputs on which a baseline has less error at some horizon, worst first; empty without any."""
    losses = find_lost_outputs(scores)
    if not losses:
        return ""
    several = len(scores.task.horizons) > 1
    parts = [
        f"{loss.target}{f' at k = {loss.horizon}' if several else ''} "
        f"({loss.label}: {percent(loss.less)} less {MEASURE_NAME})"
        for loss in losses[:SHOWN]
    ]
    more = f" and {len(losses) - SHOWN} more" if len(losses) > SHOWN else ""
    outputs = count_of(len(scores.targets), "output")
    return f"At some time ahead a baseline has less error on {len(losses)} of {outputs}: {listed(parts)}{more}."


def describe_evaluation(scores: ScoresFile, provenance: Provenance | None) -> str:
    """Name the evaluated logs, with a warning for few logs or a single kind; empty without named logs.

    Args:
        scores: the content of ``scores.json``.
        provenance: provenance of the run; None if the training data are unknown.
    """
    judged = list(scores.models[NETWORK].recordings) if NETWORK in scores.models else []
    if not judged:
        return ""
    shown = listed(judged[:SHOWN]) if len(judged) <= SHOWN else f"{', '.join(judged[:SHOWN])} and others"
    line = f"Judged on {count_of(len(judged), 'test log')}: {shown}."
    trained = set() if provenance is None else provenance.recording_names("train")
    kinds = {kind_of_name(name) for name in judged}
    others = {kind_of_name(name) for name in trained} - kinds
    if len(judged) < FEW:
        line += " So few that one odd log decides the figure: judge on more (edp evaluate RUN --data LOGS)."
    elif len(kinds) == 1 and others and "" not in kinds:
        line += f" All are of one kind; the figure says nothing of {listed(sorted(others)[:SHOWN])}."
    return line


def minutes_of(folder: Path) -> float | None:
    """Return the minutes that the preset auto was given; None for another training."""
    path = folder / "auto.json"
    minutes = read_object(path).get("minutes") if is_file_at(path) else None
    return float(minutes) if isinstance(minutes, int | float) else None


def situation_line(scores: ScoresFile) -> str:
    """State how the situation of the evaluated recordings differs from training; empty without a difference."""
    situation = scores.situation or DataSituation(outside=(), changes=())
    most = sorted(situation.changes, key=lambda row: abs(math.log(row.ratio)))
    changes = {row.target: row for row in most}  # of each target the horizon that differs most
    parts = [
        f"{row.channel} is outside of its range in training in {percent(row.share)} of the ticks"
        for row in situation.outside
    ]
    parts += [_describe_change(row) for row in changes.values()]
    if not parts:
        return ""
    more = f" and {len(parts) - SHOWN} more" if len(parts) > SHOWN else ""
    return (
        f"The test recordings differ from the training: {'; '.join(parts[:SHOWN])}{more}. What left-out data of the "
        "training promise may not hold there: record more like it, and train on it."
    )


def _describe_change(row: TargetChange) -> str:
    """Describe a target whose changes differ from the training data."""
    ahead = f"{row.target} in {count_of(row.horizon, 'tick')}"
    if 1 / NOTED <= row.ratio <= NOTED:
        return f"{percent(row.beyond)} of the changes of {ahead} are larger than any in training"
    return f"changes of {ahead} are {row.ratio:.2g} times as large as in training"


def by_output(scores: ScoresFile, horizon: int, targets: Sequence[tuple[str, str, str]], ahead: str) -> str:
    """Return the headline for outputs without a common unit: their errors and the errors of the best baseline.

    Args:
        scores: the content of ``scores.json``.
        horizon: samples ahead.
        targets: name, description and unit of each output.
        ahead: the horizon in words.
    """
    parts = []
    for name, description, unit in targets[:SHOWN]:
        errors = {
            model.label: error_at(model.overall, horizon, name, MEASURE)
            for key, model in scores.models.items()
            if key != NETWORK
        }
        ours = error_at(scores.models[NETWORK].overall, horizon, name, MEASURE)
        if ours is None:
            continue
        finite = {label: error for label, error in errors.items() if error is not None}
        best = min(finite, key=lambda label: finite[label], default=None)
        beside = "" if best is None else f" ({best} {number(finite[best], _places(finite[best]))})"
        of_unit = behind(unit)
        parts.append(f"{number(ours, _places(ours))}{of_unit} in {description[:1].lower()}{description[1:]}{beside}")
    more = f"; {count_of(len(targets) - SHOWN, 'more output')} below" if len(targets) > SHOWN else ""
    return f"At {ahead} ahead the network is off by ({MEASURE_NAME}) {', '.join(parts)}{more}."


def _places(value: float) -> int:
    """Return the number of decimals that shows three digits of a value."""
    return 4 if not value else int(min(max(2 - math.floor(math.log10(abs(value))), 0), 8))
