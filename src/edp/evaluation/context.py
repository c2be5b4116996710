"""Value of memory: the error at the same samples as a function of the time since the last reset."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from edp.data.series import Series
from edp.errors import ConfigError, DataError
from edp.evaluation.foundation_file import ContextError, UnseenErrors
from edp.networks.predictor import Predictor
from edp.networks.running import stream_predictions
from edp.signals import KINDS, Kind
from edp.wording import figure

# From shorter than a move of the operator to longer than any memory found (docs/journal, carried for a minute).
CONTEXTS_S = (0.5, 2.0, 5.0, 10.0, 30.0, 60.0)
BLOCK_S, EVERY_S = 0.5, 5.0
LANES = 64


@dataclass(frozen=True, eq=False)
class Contexts:
    """Errors by the time since reset, at the same ticks for all.

    Attributes:
        seconds: time from the reset to the first scored sample of a block.
        machines: names; recordings that do not say theirs are a machine each.
        errors: mean absolute error ``(context, machine, horizon, target)``, report units.
        ticks: scored ticks of all machines.
        dropped: contexts that were asked for and are longer than all series.
    """

    seconds: tuple[float, ...]
    machines: tuple[str, ...]
    errors: NDArray[np.float64]
    ticks: int
    dropped: tuple[float, ...] = ()

    def mean(self, horizon: int = 0) -> NDArray[np.float64]:
        """Return the mean over targets and machines, ``(context,)``."""
        errors: NDArray[np.float64] = self.errors[:, :, horizon].mean(axis=(1, 2))
        return errors

    def gain(self, horizon: int = 0) -> NDArray[np.float64]:
        """Change of the error from the shortest context: mean over machines and standard error, ``(context, 2)``."""
        each = self.errors[:, :, horizon].mean(axis=2)
        change = each / each[:1] - 1.0
        count = change.shape[1]
        error = change.std(axis=1, ddof=1) / np.sqrt(count) if count > 1 else np.full(len(change), np.nan)
        return np.stack([change.mean(axis=1), error], axis=1)

    def unseen_errors(self) -> UnseenErrors:
        """Return means over targets at the first horizon."""
        gains, means = self.gain(), self.mean()
        rows = tuple(
            ContextError(
                seconds=seconds,
                mae=float(means[i]),
                change=float(gains[i, 0]),
                change_error=None if np.isnan(gains[i, 1]) else float(gains[i, 1]),
            )
            for i, seconds in enumerate(self.seconds)
        )
        each = {name: float(self.errors[-1, i, 0].mean()) for i, name in enumerate(self.machines)}
        return UnseenErrors(contexts=rows, machines=each, ticks=self.ticks, dropped=self.dropped)


def context_errors(
    predictor: Predictor,
    series: Sequence[Series],
    kinds: Sequence[Kind],
    seconds: Sequence[float] = CONTEXTS_S,
    on_done: Callable[[float], None] | None = None,
) -> Contexts:
    """Return the errors of a network on blocks of half a second, by how long before them its state was reset.

    A block begins every five seconds of a series, where the longest context fits before it.

    Args:
        predictor: the network.
        series: evaluated series. Series shorter than the longest context are omitted.
        kinds: kinds of the targets, for report units.
        seconds: contexts; those longer than all series are dropped.
        on_done: called with each context once it is measured.

    Raises:
        ConfigError: no context, or one that is not positive.
        DataError: no series is long enough for the shortest.
    """
    rate = predictor.task.rate_hz
    asked_seconds = sorted(set(seconds))
    if not asked_seconds or asked_seconds[0] <= 0:
        raise ConfigError(f"contexts of {list(seconds)} s; at least one, all positive, must hold")
    block, step, reach = round(BLOCK_S * rate), round(EVERY_S * rate), predictor.task.max_horizon
    longest = max((part.samples for part in series), default=0) - block - reach
    measurable = [s for s in asked_seconds if round(s * rate) <= longest]
    if not measurable:
        raise DataError(
            f"the longest recording allows a context of {figure(max(0, longest) / rate)} s before a block of "
            f"{figure(BLOCK_S)} s; "
            f"the shortest that was asked for is {figure(asked_seconds[0])} s: give longer recordings"
        )
    first = max(1, round(measurable[-1] * rate))
    # All contexts share their blocks: the longest one decides where the first block may be.
    blocks = [(part, at) for part in series for at in range(first, part.samples - block - reach + 1, step)]
    factors = np.array([KINDS[kind].report_factor for kind in kinds])
    owners = [part.machine or part.name for part, _ in blocks]
    machines = tuple(dict.fromkeys(owners))
    machine_index = np.array([machines.index(owner) for owner in owners])
    errors = []
    for context in measurable:
        block_errors = _block_errors(predictor, blocks, max(1, round(context * rate)), block) * factors
        # Means within a machine first: machines weigh alike, however long they were recorded.
        errors.append(np.stack([block_errors[machine_index == i].mean(axis=(0, 1)) for i in range(len(machines))]))
        if on_done is not None:
            on_done(context)
    ticks = len(blocks) * block
    return Contexts(
        tuple(measurable), machines, np.stack(errors), ticks, tuple(s for s in asked_seconds if s not in measurable)
    )


def _block_errors(
    predictor: Predictor, blocks: Sequence[tuple[Series, int]], context: int, size: int
) -> NDArray[np.float64]:
    """Return absolute errors ``(block, tick, horizon, target)``, SI units.

    After a reset `context` ticks before each block.
    """
    pieces = [
        replace(
            part,
            inputs=part.inputs[at - context : at + size],
            targets=part.targets[at - context : at + size],
            strategy_columns=None,
        )
        for part, at in blocks
    ]
    predictions = stream_predictions(predictor, pieces, LANES)
    # Blocks of equal length fill the lanes without gaps.
    horizons = predictor.task.horizons
    return np.stack(
        [
            np.abs(
                values[context:].astype(np.float64)
                - np.stack([part.targets[at + k : at + k + size] for k in horizons], axis=1)
            )
            for values, (part, at) in zip(predictions, blocks, strict=True)
        ]
    )
