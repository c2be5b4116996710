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
"""Pieces of the validation part, whose errors tell how sure a difference is; the training part has more of them."""
FEWEST_BLOCKS = 2
TINY = 1e-12
"""Error in standard deviations below which a prediction is exact; a logarithm needs some number."""
Block = tuple[int, int, int]
"""Number of a stretch, its first row and the row after its last one."""


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

    def last(self, count: int) -> Promise:
        """That of the last `count` blocks alone."""
        return Promise(self.squared[-count:], self.rows[-count:])


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


def blocks_of(data: Prepared, skip: int) -> tuple[list[Block], int]:
    """Blocks of nearly equal size of the training stretches, then of the validation stretches; how many the latter are.

    Raises:
        DataError: fewer than two blocks of the validation part are longer than the largest horizon.
    """
    reach = data.task.max_horizon
    usable = [max(0, part.samples - reach - min(skip, part.samples // 4)) for part in (*data.train, *data.validation)]
    validated = usable[len(data.train) :]
    least = max(reach + 1, 2)
    size = max(least, sum(validated) // BLOCKS)
    blocks = []
    for number, (part, count) in enumerate(zip((*data.train, *data.validation), usable, strict=True)):
        first = part.samples - reach - count
        pieces = max(1, count // size)
        if count >= least:
            edges = first + np.linspace(0, count, pieces + 1).round().astype(int)
            blocks += [(number, int(a), int(b)) for a, b in itertools.pairwise(edges)]
    judged = sum(number >= len(data.train) for number, _, _ in blocks)
    if judged < FEWEST_BLOCKS:
        raise DataError(
            f"automatic choice: the validation part has {sum(validated)} usable ticks, {judged} independent block(s) "
            f"longer than the largest horizon of {reach} ticks; two must hold: give longer or more recordings, a "
            "larger validation share (split.validation_share), or a shorter horizon"
        )
    return blocks, judged


def promise_of(predicted: Sequence[DoubleArray], truth: Sequence[DoubleArray], blocks: Sequence[Block]) -> Promise:
    """Errors of predictions of stretches, both standardised ``(tick, output)`` and of equal length."""
    squared = [np.square(predicted[n][a:b] - truth[n][a:b]).mean(axis=0) for n, a, b in blocks]
    return Promise(np.stack(squared), np.array([b - a for _, a, b in blocks], dtype=np.float64))


def standard_truth(predictor: Predictor, data: Prepared) -> list[DoubleArray]:
    """Change or value to be predicted at each tick of the training stretches, then of the validation stretches.

    Standardised by the predictor's scaling, ``(tick, output)`` each.
    """
    return [standard_targets(predictor, part)[0].flatten(1).numpy() for part in (*data.train, *data.validation)]


def promise_of_validation(predictor: Predictor, data: Prepared, blocks: Sequence[Block], judged: int) -> Promise:
    """Errors of a network that trained on the training part alone: on the last `judged` of the blocks.

    Standardised by the data, as every candidate's: a pretrained network has a scaling of its own.
    """
    scale = np.asarray(data.scaler().target_scale, dtype=np.float64)
    squared = [np.zeros((0, scale.size))] * len(data.train)
    for values, part in zip(stream_predictions(predictor, data.validation), data.validation, strict=True):
        ticks = part.samples - data.task.max_horizon
        future = np.stack([part.targets[k : k + ticks] for k in data.task.horizons], axis=1)
        # In SI units, standardised: the same for values and for changes.
        squared.append(((values[:ticks] - future) / scale).reshape(ticks, -1))
    return promise_of(squared, [np.zeros_like(one) for one in squared], blocks[-judged:])


def choose(promises: Mapping[str, Promise]) -> PortfolioChoice:
    """The simplest candidate whose error is within one standard error of the least (Breiman et al., 1984).

    Compared is the logarithm of the root-mean-square error of each block that every candidate left out, as the mean
    over outputs and over blocks, these weighted by their error: blocks in which the machine rests hardly count, and one
    with an outlier does not decide alone, as it would in the error over all blocks.

    Args:
        promises: by name, the simplest first; blocks of the shorter ones are the last of the longer ones.
    """
    count = min(len(promise.rows) for promise in promises.values())
    errors = {name: np.sqrt(promise.squared[-count:]) for name, promise in promises.items()}
    level = np.mean(list(errors.values()), axis=0)
    # An output that every candidate predicts exactly has no error to weigh by.
    weights = (level + TINY) / (level + TINY).sum(axis=0)
    logarithms = {name: np.log(np.maximum(error, TINY)) for name, error in errors.items()}
    means = {name: (weights * value).sum(axis=0) for name, value in logarithms.items()}
    best = min(means, key=lambda name: float(means[name].mean()))
    excess, doubt = {}, {}
    for name, value in logarithms.items():
        mean = means[name] - means[best]
        excess[name] = float(mean.mean())
        apart = (weights * (value - logarithms[best] - mean)).mean(axis=1)
        doubt[name] = float(np.sqrt(np.square(apart).sum() * count / (count - 1)))
    name = next(name for name in means if excess[name] <= doubt[name])
    return PortfolioChoice(name, best, excess, doubt)


def in_report_units(error: DoubleArray, data: Prepared) -> dict[str, dict[str, float]]:
    """Root-mean-square errors, standardised by the data, by horizon and target in report units."""
    factors = np.array([KINDS[kind].report_factor for kind in data.target_kinds])
    scale = np.asarray(data.scaler().target_scale, dtype=np.float64)
    values = error.reshape(len(data.task.horizons), -1) * scale * factors
    return {
        str(horizon): dict(zip(data.task.targets, map(float, row), strict=True))
        for horizon, row in zip(data.task.horizons, values, strict=True)
    }


def to_json(choice: PortfolioChoice) -> dict[str, Any]:
    """Plain values of a choice."""
    return {"chosen": choice.name, "best": choice.best, "excess": dict(choice.excess), "doubt": dict(choice.doubt)}
