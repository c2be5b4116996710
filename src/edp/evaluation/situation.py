"""Comparison of the evaluation recordings with the training recordings."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from edp.data.prepared import Prepared
from edp.data.series import Series
from edp.evaluation.scores_file import DataSituation, OutsideRange, TargetChange

MARGIN = 0.01
"""Fraction of the training range by which a value must leave it, because of sensor noise."""
MIN_SHARE = 0.05
"""Minimum fraction of samples outside the training range for a warning. Two of seven measured data sets have 1 and 3 %
of such samples, and their expected errors were as accurate as the others."""
MIN_BEYOND = 0.005
"""Minimum fraction of changes larger than any training change for a warning: a few decide a root-mean-square error."""
MIN_RATIO = 2.0
"""Minimum ratio between the changes of the targets and their changes in training (or its inverse) for a remark."""


def situation_of(data: Prepared) -> DataSituation:
    """Return the unusual properties of ``data.test`` compared with the training and validation parts."""
    trained = [part for part in (*data.train, *data.validation) if part.samples]
    if not trained:
        return DataSituation(outside=(), changes=())  # a bundle alone does not know what trained it
    outside = _outside(trained, data.test, [channel.name for channel in data.inputs], list(data.task.targets))
    changes = []
    for horizon in (k for k in data.task.horizons if k > 0):
        usual, largest = _changes(trained, horizon)
        size, beyond = _changes(data.test, horizon, largest)
        for target, before, now, share in zip(data.task.targets, usual, size, beyond, strict=True):
            # Of a target that never moved in training, or rests now, the ratio would say nothing.
            ratio = float(now / before) if before > 0 and now > 0 else 1.0
            if share >= MIN_BEYOND or not 1 / MIN_RATIO <= ratio <= MIN_RATIO:
                changes.append(TargetChange(target=target, horizon=int(horizon), ratio=ratio, beyond=float(share)))
    return DataSituation(outside=outside, changes=tuple(changes))


def _outside(
    trained: Iterable[Series], tested: Iterable[Series], inputs: list[str], targets: list[str]
) -> tuple[OutsideRange, ...]:
    # Targets that no input shows, too: of the others the inputs say the same.
    hidden = [number for number, name in enumerate(targets) if name not in inputs]
    names = [*inputs, *(targets[number] for number in hidden)]

    def values(parts: Iterable[Series]) -> Iterator[NDArray[np.floating]]:
        return (np.concatenate([part.inputs, part.targets[:, hidden]], axis=1) for part in parts)

    bounds = [(part.min(axis=0), part.max(axis=0)) for part in values(trained)]
    low = np.min([one for one, _ in bounds], axis=0)
    high = np.max([one for _, one in bounds], axis=0)
    margin = MARGIN * (high - low)
    count, ticks = np.zeros(len(names)), 0
    for part in values(tested):
        count += ((part < low - margin) | (part > high + margin)).sum(axis=0)
        ticks += len(part)
    shares = count / max(ticks, 1)
    order = sorted(range(len(names)), key=lambda i: -shares[i])
    return tuple(OutsideRange(channel=names[i], share=float(shares[i])) for i in order if shares[i] >= MIN_SHARE)


def _changes(
    parts: Sequence[Series], horizon: int, bound: NDArray[np.floating] | None = None
) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
    """Return the root-mean-square and largest change of each target; with a bound, the fraction above it."""
    squares = np.zeros(parts[0].targets.shape[1])
    largest, above, count = np.zeros_like(squares), np.zeros_like(squares), 0
    for part in parts:
        change = np.abs(part.targets[horizon:].astype(np.float64) - part.targets[:-horizon])
        if len(change):
            squares += np.square(change).sum(axis=0)
            largest = np.maximum(largest, change.max(axis=0))
            above += 0.0 if bound is None else (change > bound).sum(axis=0)
            count += len(change)
    size = np.sqrt(squares / max(count, 1))
    return size, largest if bound is None else above / max(count, 1)
