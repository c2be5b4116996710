"""Tables of a run for its page and the command line: error by situation, and machines of a foundation run."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from edp.evaluation.guard import NETWORK
from edp.evaluation.scores_file import ModelScores, ScoresFile, error_at
from edp.table import Column, Table, Value, figures, plainly
from edp.wording import figure, percent

WORDS = {
    "rest": "at rest, now and then",
    "starting": "starting",
    "stopping": "stopping",
    "reversing": "reversing",
    "fast": "faster than half of the fastest",
    "dead_band": "moving, command in its dead band",
    "end_stop": "near an end stop",
    "other": "none of these",
}
"""How a table calls what `edp.evaluation.by_situation` tells apart."""


def situation_table(scores: ScoresFile, horizon: int) -> Table | None:
    """The network's error by situation beside the best baseline's, most of the error first; None without such scores.

    Args:
        scores: the content of ``scores.json``.
        horizon: samples ahead.
    """
    models = scores.models
    ours = models[NETWORK].by_situation.get(str(horizon), ()) if NETWORK in models else ()
    if not ours:
        return None
    shown = [t for t in scores.targets if any(row.mae.get(t.name) is not None for row in ours)]
    best = _best_baseline(models, horizon, [t.name for t in shown])
    baseline = {row.situation: row.mae for row in models[best].by_situation.get(str(horizon), ())} if best else {}
    rows = []
    for row in sorted(ours, key=lambda row: -row.of_error):
        errors = [row.mae.get(t.name) for t in shown]
        ratio = _ratio(errors, [baseline.get(row.situation, {}).get(t.name) for t in shown])
        cells = [WORDS.get(row.situation, row.situation), percent(row.share), percent(row.of_error), *errors]
        rows.append((*cells, *((percent(ratio),) if best else ())))
    errors_of = [Column(t.name, t.unit, figures(r[3 + i] for r in rows)) for i, t in enumerate(shown)]
    label = models[best].label or best if best else ""
    relative = (Column("Relative to", label),) if best else ()
    columns = (Column("Situation"), Column("Of the time"), Column("Of the error"), *errors_of, *relative)
    return Table("Mean absolute error by what the axis does", columns, tuple(rows), name="situations")


def _best_baseline(models: Mapping[str, ModelScores], horizon: int, targets: list[str]) -> str:
    """The baseline with the least sum of errors, each in those of the network; empty where there is none."""
    network, sums = models[NETWORK], dict[str, float]()
    for name, model in models.items():
        if name != NETWORK and model.by_situation:
            errors = [[error_at(one.overall, horizon, t, "mae") for t in targets] for one in (model, network)]
            ratios = [a / b for a, b in zip(*errors, strict=True) if a is not None and b]
            if len(ratios) == len(targets):
                sums[name] = sum(ratios)
    return min(sums, key=lambda name: sums[name], default="")


def _ratio(ours: list[float | None], theirs: list[float | None]) -> float | None:
    """Geometric mean of the ratios of both, over the targets of which both have an error."""
    logs = [math.log(a / b) for a, b in zip(ours, theirs) if a and b]
    return math.exp(sum(logs) / len(logs)) if logs else None


def parts_table(foundation: Mapping[str, Any]) -> Table:
    """Machines, recordings and minutes of each part."""
    heads = ("machines", "recordings", "minutes")
    rows = tuple((part, *(facts[key] for key in heads)) for part, facts in foundation["data"].items())
    columns = (Column("Part"), *(Column(head.capitalize(), show=_short) for head in heads))
    return Table(f"{foundation['label']} over many machines", columns, rows, name="parts")


def contexts_table(foundation: Mapping[str, Any], unit: str = "report units") -> Table:
    """Error by the time since the state was reset, always on the same ticks."""
    unseen = foundation["unseen"]
    rows: list[tuple[Value, ...]] = []
    for row in unseen["contexts"]:
        spread = row["change_error"]
        half_width = None if spread is None else 196 * spread
        rows.append((row["seconds"], row["mae"], 100 * row["change"], half_width))
    columns = (
        Column("Since reset", "s", _short),
        Column("MAE", unit, figures([row[1] for row in rows], decimals=3)),
        Column("Change", "%", figures([row[2] for row in rows], signed=True, decimals=1)),
        Column("95 %", "+- %", figures([row[3] for row in rows], decimals=1)),
    )
    caption = (
        f"Machines that were never seen ({len(unseen['machines'])}), k = {foundation['horizon']}: error by the time "
        f"since the state was reset, {unseen['ticks']} ticks"
    )
    return Table(caption, columns, tuple(rows), name="contexts")


def _short(value: Value) -> str:
    return figure(value) if isinstance(value, int | float) else plainly(value)


def machines_table(foundation: Mapping[str, Any], unit: str = "report units") -> Table:
    """Each machine that tests, the hardest first."""
    each = sorted(foundation["unseen"]["machines"].items(), key=lambda entry: -entry[1])
    columns = (Column("Machine"), Column("MAE", unit, figures([mae for _, mae in each])))
    return Table("Machines that were never seen, the hardest first", columns, tuple(each), name="machines")
