"""Pipeline of `edp compress search` and of phase 6: train candidates, evaluate their formats, select one.

The two differ in who trains and where results are kept: runs in a folder, or records of a ledger.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from edp.config.experiment import build, plain_tree
from edp.data.prepared import Prepared
from edp.errors import ExportError
from edp.evaluation.compression import CompressedRow, Scores
from edp.evaluation.controller import Budget, ResourceUsage
from edp.evaluation.judge import score_predictions
from edp.evaluation.scores_file import MEAN, ByHorizon, ModelScores, metric
from edp.networks.predictor import Predictor
from edp.networks.running import stream_predictions
from edp.stats.pareto import pareto
from edp.workflows.compression.bench import CompressionRequest
from edp.workflows.compression.formats import FORMATS, deploy

TEACHER = "teacher"


@dataclass(frozen=True, eq=False)
class FormatResult:
    """Scores of a network in one number format, its memory and time on a controller, and the exceeded limits."""

    scores: Scores
    resource_usage: ResourceUsage
    over: Mapping[str, tuple[int, int]]


@dataclass(frozen=True, eq=False)
class NetworkResult:
    """Evaluation of a network.

    Attributes:
        plain: scores in float32.
        formats: result in each number format that the network can be in.
        left_out: reason for a missing result, by number format.
        recordings: scores of each recording, by number format; not stored in records.
    """

    plain: Scores
    formats: Mapping[str, FormatResult]
    left_out: Mapping[str, str]
    recordings: Mapping[str, Mapping[str, ByHorizon]] = field(default_factory=dict)

    def to_json(self) -> dict[str, object]:
        """Return plain values with lists, equal to those that are read from a record."""
        formats = {name: plain_tree(result) for name, result in self.formats.items()}
        for table in formats.values():
            table["over"] = {limit: list(pair) for limit, pair in table["over"].items()}
        return {"plain": self.plain, "formats": formats, "left_out": self.left_out}

    @staticmethod
    def from_json(record: Mapping[str, object]) -> NetworkResult:
        """Return the evaluation in the result of a record.

        Raises:
            ConfigError: a part is missing or of another kind.
        """
        parts = {name: record[name] for name in ("plain", "formats", "left_out") if name in record}
        return build(NetworkResult, parts, "of a record")


class Evaluator:
    """Evaluation of networks in number formats on ``data.test``.

    Args:
        data: series; those of ``data.train`` give the ranges of activations.
        budget: limits of the controller.
    """

    def __init__(self, data: Prepared, budget: Budget) -> None:
        self.data, self.budget = data, budget
        self._plain: dict[int, ModelScores] = {}

    def evaluate(self, network: Predictor, formats: Sequence[str], parameter_bytes: int | None = None) -> NetworkResult:
        """Evaluate a network in number formats.

        Args:
            network: the network, in float32.
            formats: names of `FORMATS`.
            parameter_bytes: memory for parameters, if the format does not say it.
        """
        # A network that several variants share is run in float32 once.
        if id(network) not in self._plain:
            self._plain[id(network)] = self._score(stream_predictions(network, self.data.test), network)
        scored = {"float32": self._plain[id(network)]}
        results, left_out = {}, {}
        for name in formats:
            try:
                deployed = deploy(network, name, self.data.train, self.budget, parameter_bytes)
            except ExportError as error:
                left_out[name] = str(error)
                continue
            if name not in scored:
                scored[name] = self._score(deployed.predict(self.data.test), network)
            usage = deployed.resource_usage
            results[name] = FormatResult(_overall(scored[name]), usage, usage.over(self.budget))
        recordings = {name: scores.recordings for name, scores in scored.items()}
        return NetworkResult(_overall(scored["float32"]), results, left_out, recordings)

    def _score(self, predictions: list[np.ndarray], network: Predictor) -> ModelScores:
        return score_predictions(predictions, self.data, network.spec.window)


def _overall(scored: ModelScores) -> Scores:
    return {
        horizon: {score: metric(by_target[MEAN], score) for score in ("mae", "composite")}
        for horizon, by_target in scored.overall.items()
    }


def on_validation(data: Prepared) -> Prepared:
    """Return the data with the validation part in place of the test part."""
    # Choices rest on the validation part; the test part is opened once, at the end.
    return replace(data, test=data.validation)


def relative_error(scores: Scores, teacher: Scores) -> float:
    """Return the MAE relative to the teacher's MAE, mean over horizons."""
    # A ratio by horizon: far horizons have larger errors and would decide alone.
    return float(np.mean([scores[horizon]["mae"] / max(row["mae"], 1e-30) for horizon, row in teacher.items()]))


def formats_of(order: CompressionRequest | None, formats: Sequence[str]) -> list[str]:
    """Return the formats to evaluate a network in: one trained for rounding only in those that round."""
    rounded = order is not None and order.rounding is not None
    return [name for name in formats if not rounded or FORMATS[name].rounded]


def rows_of(
    order: CompressionRequest | None, result: NetworkResult, teacher: Scores, run: str = ""
) -> list[CompressedRow]:
    """Return a row for each number format of a network.

    Args:
        order: request that produced the network; None for the teacher.
        result: its evaluation.
        teacher: scores of the teacher in float32.
        run: folder of the network's run.
    """
    return [
        CompressedRow(
            name=f"{TEACHER if order is None else order.name} {FORMATS[name].label}",
            recipe=TEACHER if order is None else _recipe_text(order),
            number_format=name,
            label=FORMATS[name].label,
            resource_usage=in_format.resource_usage,
            over=in_format.over,
            fits=not in_format.over,
            scores=in_format.scores,
            before=result.plain,
            error=relative_error(in_format.scores, teacher),
            run=run,
        )
        for name, in_format in result.formats.items()
    ]


def _recipe_text(order: CompressionRequest) -> str:
    if order.rounding is None:
        return "pruned and distilled" if order.pruned else "distilled"
    return f"{TEACHER if order.of is None else _recipe_text(order.of)}, trained on rounded"


def choose(rows: Sequence[CompressedRow]) -> tuple[list[int], int | None]:
    """Return the front of error, cycles and bytes, and the row within the budget with the least error, if any."""
    fitting = [index for index, row in enumerate(rows) if row.fits]
    # Ties of error go to fewer cycles, then fewer bytes, by the order of the tuple.
    return pareto([row.costs for row in rows]), min(fitting, key=lambda index: rows[index].costs, default=None)
