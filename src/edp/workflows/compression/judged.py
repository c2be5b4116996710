"""One smaller network in one number format, judged."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from edp.data.prepared import Prepared
from edp.evaluation.controller import Budget
from edp.evaluation.judge import score_predictions
from edp.evaluation.scores_file import MEAN, metric
from edp.stats.pareto import pareto
from edp.workflows.compression.bench import CompressionRequest
from edp.workflows.compression.formats.base import FORMATS, Deployed, ResourceUsage


@dataclass(frozen=True, eq=False)
class Judged:
    """A row of the search.

    Attributes:
        name: of the network and its format.
        recipe: how it was made, in words.
        number_format: a name of `FORMATS`.
        resource_usage: what it takes of the controller.
        over: limits that it exceeds: what it takes, and what is granted.
        scores: on the validation part in its format, by horizon: ``mae`` and ``composite``, report units.
        before: the same in float32.
        error: MAE over the teacher's in float32, the mean over horizons.
        run: folder of the network's run.
    """

    name: str
    recipe: str
    number_format: str
    resource_usage: ResourceUsage
    over: Mapping[str, tuple[int, int]]
    scores: Mapping[str, Mapping[str, float]]
    before: Mapping[str, Mapping[str, float]]
    error: float
    run: str

    @property
    def fits(self) -> bool:
        """Whether it fits the budget."""
        return not self.over

    def to_json(self) -> dict[str, Any]:
        """Plain values."""
        label = FORMATS[self.number_format].label
        return vars(self) | {"resource_usage": vars(self.resource_usage), "fits": self.fits, "label": label}


@dataclass(frozen=True, eq=False)
class CompressionResult:
    """What a search came to.

    Attributes:
        teacher: the teacher in float32.
        rows: all networks in all formats, in the order in which they were made.
        front: places of the rows that no other one betters in error, cycles and bytes of parameters.
        chosen: place of the row that fits with the least error; None where none fits.
        held_out_test: scores of teacher and chosen on recordings that took part in no choice, by horizon.
        notes: what was left out, and why.
    """

    teacher: Judged
    rows: list[Judged]
    front: list[int]
    chosen: int | None
    held_out_test: Mapping[str, Any] = field(default_factory=dict)
    notes: Sequence[str] = ()

    @property
    def best(self) -> Judged | None:
        """The chosen row."""
        return None if self.chosen is None else self.rows[self.chosen]


def measure(deployed: Deployed, data: Prepared, skip: int) -> dict[str, dict[str, float]]:
    """Mean absolute error and composite score on ``data.test`` by horizon, the mean over outputs, report units."""
    overall = score_predictions(deployed.predict(data.test), data, skip).overall
    return {
        horizon: {key: metric(by_target[MEAN], key) for key in ("mae", "composite")}
        for horizon, by_target in overall.items()
    }


def on_validation(data: Prepared) -> Prepared:
    """The same data with the validation part in the place of the test part."""
    # Choices rest on the validation part; the test part is opened once, at the end.
    return replace(data, test=data.validation)


def relative(scores: Mapping[str, Mapping[str, float]], teacher: Mapping[str, Mapping[str, float]]) -> float:
    """MAE over that of the teacher, the mean over horizons."""
    # A ratio by horizon: far horizons have larger errors and would decide alone.
    return float(np.mean([scores[horizon]["mae"] / max(row["mae"], 1e-30) for horizon, row in teacher.items()]))


def choose(rows: Sequence[Judged]) -> tuple[list[int], int | None]:
    """The front of error, cycles and bytes, and of what fits the row with the least error (of equals the cheapest)."""
    points = [(row.error, row.resource_usage.cycles[2], row.resource_usage.parameter_bytes) for row in rows]
    fitting = [index for index, row in enumerate(rows) if row.fits]
    # Ties of error go to fewer cycles, then fewer bytes, by the order of the tuple.
    best = min(fitting, key=points.__getitem__, default=None)
    return pareto(points), best


def recipe_text(order: CompressionRequest) -> str:
    """How an order makes its network, in words."""
    levels = "pruned and distilled" if order.pruned else "distilled"
    if order.rounding is None:
        return levels
    begun = "teacher" if order.of is None else recipe_text(order.of)
    return f"{begun}, trained on rounded"


def deployed_row(
    name: str, order: CompressionRequest | None, deployed: Deployed, scores: tuple[Any, Any], budget: Budget, run: str
) -> Judged:
    """A row without its error, which needs the teacher; `scores` are in its format and in float32."""
    recipe = "teacher" if order is None else recipe_text(order)
    over = deployed.resource_usage.over(budget)
    return Judged(
        name, recipe, deployed.number_format, deployed.resource_usage, over, scores[0], scores[1], float("nan"), run
    )
