"""The error to expect: predictions of rows that did not train, by block, and the rule that chooses by them."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from edp.data.lags import DoubleArray
from edp.data.prepared import Prepared
from edp.errors import DataError
from edp.networks.predictor import Predictor
from edp.networks.running import stream_predictions
from edp.signals import KINDS
from edp.training.validation import standard_targets

BLOCKS = 10
"""Pieces of the judged rows at least, whose errors tell how sure a difference is."""
FEWEST_BLOCKS = 2
TINY = 1e-12


@dataclass(frozen=True, eq=False)
class Promise:
    """Squared errors on left-out rows.

    Attributes:
        squared: mean squared error of each block, ``(block, output)``, standardised.
        rows: rows of each block, ``(block,)``.
    """

    squared: DoubleArray
    rows: DoubleArray

    def error(self) -> DoubleArray:
        """Root-mean-square error of each output, standardised, ``(output,)``."""
        share = self.rows / self.rows.sum()
        return np.asarray(np.sqrt((self.squared * share[:, None]).sum(axis=0)))

    def logarithms(self, scale: DoubleArray) -> DoubleArray:
        """Mean over outputs of the logarithm of each block's error relative to `scale` ``(output,)``; ``(block,)``."""
        relative = np.sqrt(self.squared) / np.maximum(scale, TINY)
        return np.asarray(np.log(np.maximum(relative, TINY)).mean(axis=1))


@dataclass(frozen=True)
class PortfolioChoice:
    """Which candidate is kept, and why.

    Attributes:
        name: the one that is kept.
        best: the one with the least error.
        excess: mean logarithm of each candidate's error over that of the best, over blocks and outputs.
        doubt: standard error of that mean.
    """

    name: str
    best: str
    excess: Mapping[str, float]
    doubt: Mapping[str, float]


def blocks_of(data: Prepared, skip: int) -> list[tuple[int, int, int]]:
    """Stretch, first and last row of each block of the validation part.

    Raises:
        DataError: fewer than two blocks longer than the largest horizon.
    """
    reach = data.task.max_horizon
    usable = [max(0, part.samples - reach - min(skip, part.samples // 4)) for part in data.validation]
    least = max(reach + 1, 2)
    size = max(least, sum(usable) // BLOCKS)
    blocks = []
    for number, (part, count) in enumerate(zip(data.validation, usable, strict=True)):
        first = part.samples - reach - count
        pieces = max(1, count // size)
        if count >= least:
            edges = first + np.linspace(0, count, pieces + 1).round().astype(int)
            blocks += [(number, int(a), int(b)) for a, b in itertools.pairwise(edges)]
    if len(blocks) < FEWEST_BLOCKS:
        raise DataError(
            f"automatic choice: the validation part has {sum(usable)} usable ticks, {len(blocks)} independent block(s) "
            f"longer than the largest horizon of {reach} ticks; two must hold: give longer or more recordings, a "
            "larger validation share (split.validation_share), or a shorter horizon"
        )
    return blocks


def promise_of(
    predicted: Sequence[DoubleArray], truth: Sequence[DoubleArray], blocks: Sequence[tuple[int, int, int]]
) -> Promise:
    """Errors of predictions of the validation stretches, both standardised ``(tick, output)`` and of equal length."""
    squared = [np.square(predicted[n][a:b] - truth[n][a:b]).mean(axis=0) for n, a, b in blocks]
    return Promise(np.stack(squared), np.array([b - a for _, a, b in blocks], dtype=np.float64))


def standard_truth(predictor: Predictor, data: Prepared) -> list[DoubleArray]:
    """Change or value to be predicted at each tick of the validation stretches, standardised ``(tick, output)``."""
    return [standard_targets(predictor, part)[0].flatten(1).numpy() for part in data.validation]


def streamed(predictor: Predictor, data: Prepared) -> list[DoubleArray]:
    """What a network predicts of the validation stretches, standardised as `standard_truth`."""
    scale = predictor.code.width.double().numpy()
    truth = standard_truth(predictor, data)
    standard = []
    predictions = stream_predictions(predictor, data.validation)
    for values, part, target in zip(predictions, data.validation, truth, strict=True):
        ticks = len(target)
        future = np.stack([part.targets[k : k + ticks] for k in data.task.horizons], axis=1)
        # The error in SI units, standardised, on top of the truth: the same for values and for changes.
        standard.append(target + ((values[:ticks] - future) / scale).reshape(ticks, -1))
    return standard


def choose(promises: Mapping[str, Promise]) -> PortfolioChoice:
    """The simplest candidate whose error is within one standard error of the least (Breiman et al., 1984).

    Args:
        promises: by name, the simplest first; all of the same blocks.
    """
    scale = np.min([promise.error() for promise in promises.values()], axis=0)
    values = {name: promise.logarithms(scale) for name, promise in promises.items()}
    # Blocks of equal rows but for rounding: their plain mean.
    best = min(values, key=lambda name: float(values[name].mean()))
    excess, doubt = {}, {}
    for name, value in values.items():
        difference = value - values[best]
        excess[name] = float(difference.mean())
        doubt[name] = float(difference.std(ddof=1) / np.sqrt(len(difference))) if name != best else 0.0
    name = next(name for name in values if excess[name] <= doubt[name])
    return PortfolioChoice(name, best, excess, doubt)


def in_report_units(error: DoubleArray, predictor: Predictor, data: Prepared) -> dict[str, dict[str, float]]:
    """Root-mean-square errors by horizon and target, in report units."""
    factors = np.array([KINDS[kind].report_factor for kind in data.target_kinds])
    values = (error.reshape(len(data.task.horizons), -1) * predictor.code.width.double().numpy()) * factors
    return {
        str(horizon): dict(zip(data.task.targets, map(float, row), strict=True))
        for horizon, row in zip(data.task.horizons, values, strict=True)
    }


def to_json(choice: PortfolioChoice) -> dict[str, Any]:
    """Plain values of a choice."""
    return {"chosen": choice.name, "best": choice.best, "excess": dict(choice.excess), "doubt": dict(choice.doubt)}
