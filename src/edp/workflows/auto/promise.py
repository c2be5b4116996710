"""The error to expect: predictions of rows that did not train, by block, and the rule that chooses by them."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

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
GROUPS, DRAWS, COVERAGE = 20, 1000, 0.9
"""Contiguous groups of blocks that an interval draws from (10 and 40 held as many test errors of 38 on seven measured
sets, 28 and 27), how often, and the share of tests that it is meant to hold."""
Block = tuple[int, int, int]
"""Number of a segment, its first row and the row after its last one."""


@dataclass(frozen=True, eq=False)
class Promise:
    """Squared errors on left-out rows.

    Attributes:
        squared: mean squared error of each block, ``(block, output)``, standardised.
        rows: rows of each block, ``(block,)``.
        reference: mean squared errors that errors are told relative to, ``(block, output)``; None for none.
    """

    squared: DoubleArray
    rows: DoubleArray
    reference: DoubleArray | None = None

    def error(self) -> DoubleArray:
        """Return the RMS error of each output ``(output,)``: standardised, or relative to the reference."""
        return np.asarray(self._error(np.arange(len(self.rows))[None])[0])

    def last(self, count: int) -> Promise:
        """Return the expected error on the last `count` blocks."""
        reference = None if self.reference is None else self.reference[-count:]
        return Promise(self.squared[-count:], self.rows[-count:], reference)

    def relative_to(self, other: Promise) -> Promise:
        """Return this expected error relative to the errors of another one, on the blocks that both left out."""
        count = min(len(self.rows), len(other.rows))
        return replace(self.last(count), reference=other.last(count).squared)

    def interval(self, rows: int) -> dict[str, DoubleArray]:
        """Return the interval of the error on `rows` test rows: ``low`` and ``high``, ``(output,)`` each.

        Left-out rows and test are drawn from the same groups of neighbouring blocks (block bootstrap: Kuensch, 1989);
        so both are uncertain, a short test more than a long one. A test that is another situation is not foreseen.

        Args:
            rows: number of test rows.
        """
        groups = np.array_split(np.arange(len(self.rows)), min(GROUPS, len(self.rows)))
        part = self._group_blocks(groups)
        drawn = min(max(1, round(len(groups) * rows / float(self.rows.sum()))), 10 * len(groups))
        rng = np.random.default_rng(0)
        promised = part._error(rng.integers(len(groups), size=(DRAWS, len(groups))))
        tested = part._error(rng.integers(len(groups), size=(DRAWS, drawn)))
        ratios = np.maximum(tested, TINY) / np.maximum(promised, TINY)
        low, high = np.quantile(ratios, [(1 - COVERAGE) / 2, (1 + COVERAGE) / 2], axis=0)
        return {"low": self.error() * low, "high": self.error() * high}

    def _error(self, chosen: NDArray[np.int64]) -> DoubleArray:
        """Return errors over resampled blocks ``(draw, block)``, ``(draw, output)``."""
        shares = self.rows[chosen] / self.rows[chosen].sum(axis=1, keepdims=True)

        def mean(squared: DoubleArray) -> DoubleArray:
            return np.asarray((squared[chosen] * shares[:, :, None]).sum(axis=1))

        below = 1.0 if self.reference is None else np.maximum(mean(self.reference), TINY**2)
        return np.asarray(np.sqrt(mean(self.squared) / below))

    def _group_blocks(self, groups: Sequence[NDArray[np.int64]]) -> Promise:
        """Return the expected error with groups of blocks as one block each."""
        rows = np.array([self.rows[group].sum() for group in groups])

        def mean(squared: DoubleArray) -> DoubleArray:
            return np.asarray(np.stack([self.rows[group] @ squared[group] for group in groups]) / rows[:, None])

        return Promise(mean(self.squared), rows, None if self.reference is None else mean(self.reference))


@dataclass(frozen=True)
class PortfolioChoice:
    """Choice of a candidate with its reason.

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
    """Return blocks of nearly equal size, training segments before validation segments, and the number of the latter.

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
            "larger validation share (split.validation_fraction), or a shorter horizon"
        )
    return blocks, judged


def promise_of(predicted: Sequence[DoubleArray], truth: Sequence[DoubleArray], blocks: Sequence[Block]) -> Promise:
    """Return the errors of predictions of segments, both standardised ``(tick, output)`` and of equal length."""
    squared = [np.square(predicted[n][a:b] - truth[n][a:b]).mean(axis=0) for n, a, b in blocks]
    return Promise(np.stack(squared), np.array([b - a for _, a, b in blocks], dtype=np.float64))


def standard_truth(predictor: Predictor, data: Prepared) -> list[DoubleArray]:
    """Return the true change or value at each tick of the training segments, followed by the validation segments.

    Standardised by the predictor's scaling, ``(tick, output)`` each.
    """
    return [standard_targets(predictor, part)[0].flatten(1).numpy() for part in (*data.train, *data.validation)]


def promise_of_validation(predictor: Predictor, data: Prepared, blocks: Sequence[Block], judged: int) -> Promise:
    """Return the errors of a network trained on the training part, on the last `judged` blocks.

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
    """Choose the simplest candidate whose error is within one standard error of the least (Breiman et al., 1984).

    Compared is the logarithm of the root-mean-square error of each block that every candidate left out, as the mean
    over outputs and over blocks, these weighted by their error: blocks in which the machine rests hardly count, and one
    with an outlier does not decide alone, as it would in the error over all blocks.

    Args:
        promises: expected errors by name, the simplest first; the blocks of shorter ones are the last of longer ones.
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


def to_report_units(error: DoubleArray, data: Prepared) -> dict[str, dict[str, float]]:
    """Return the root-mean-square errors, standardised by the data, by horizon and target in report units."""
    factors = np.array([KINDS[kind].report_factor for kind in data.target_kinds])
    scale = np.asarray(data.scaler().target_scale, dtype=np.float64)
    return by_output((error.reshape(len(data.task.horizons), -1) * scale * factors).ravel(), data)


def by_output(values: DoubleArray, data: Prepared) -> dict[str, dict[str, float]]:
    """Return the errors ``(output,)`` by horizon and target."""
    return {
        str(horizon): dict(zip(data.task.targets, map(float, row), strict=True))
        for horizon, row in zip(data.task.horizons, values.reshape(len(data.task.horizons), -1), strict=True)
    }
