"""Whether every part of a split holds its share of the recordings' ticks and of their motion, and blocks that do."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from edp.data.splits import ByBlocks, ByRecording, ByTime
from edp.errors import DataError
from edp.recording import Recording

LEAST_OF_SHARE = 0.25
"""Of what the share of a part stands for: of 300 s and 4 s a draw of whole recordings let the 4 s train."""
MOVES = 0.5
"""Of the root-mean-square change of a channel, from which a tick counts as motion: steps of an encoder are less."""
BLOCKS, LEAST_GAPS = 15, 8
"""Blocks of a recording, three of which test, and gaps that one is long at least."""
EVERY = 5
HISTORY = 32
"""Ticks before a prediction that it reads at least."""

Mask = NDArray[np.bool_]


def moving_ticks(recordings: Sequence[Recording], channels: Sequence[str], span: int) -> list[Mask]:
    """At which ticks of each recording some channel moves, ``(time,)`` each.

    Args:
        recordings: the data set.
        channels: by name; a recording that lacks one is asked for the others.
        span: ticks over which a change is looked at, forward.
    """
    changes = []
    for recording in recordings:
        columns = [recording.channel_names.index(name) for name in channels if name in recording.channel_names]
        values = recording.values[:, columns].astype(np.float64)
        change = np.zeros_like(values)
        change[: max(0, len(values) - span)] = np.abs(values[span:] - values[: max(0, len(values) - span)])
        changes.append(np.nan_to_num(change))
    if len({change.shape[1] for change in changes}) > 1:
        return [np.ones(len(change), dtype=bool) for change in changes]
    size = np.sqrt(np.concatenate([np.square(change) for change in changes]).mean(axis=0))
    return [(change > MOVES * size).any(axis=1) for change in changes]


def is_even(
    split: ByRecording | ByTime | ByBlocks,
    recordings: Sequence[Recording],
    gap: int,
    weights: Sequence[NDArray[np.bool_]],
) -> bool:
    """Whether each part has at least `LEAST_OF_SHARE` of the weight that its share of the data stands for.

    Args:
        split: how to divide.
        recordings: the data set.
        gap: ticks between neighbouring stretches of different parts.
        weights: which ticks of each recording count.
    """
    try:
        parts = split.split(recordings, gap)
    except DataError:
        return False
    total = sum(int(weight.sum()) for weight in weights)
    return all(
        sum(int(weights[one.recording][one.start : one.stop].sum()) for one in getattr(parts, part))
        >= LEAST_OF_SHARE * share * total
        for part, share in _shares(split).items()
    )


def _shares(split: ByRecording | ByTime | ByBlocks) -> dict[str, float]:
    """Of the data that each part is to have."""
    test = 1 / split.every if isinstance(split, ByBlocks) else split.test_share
    validation = split.validation_share * (1 - test if isinstance(split, ByBlocks) else 1)
    return {"train": 1 - validation - test, "validation": validation, "test": test}


def blocks_at_rest(recording: Recording, horizon: int) -> ByBlocks | None:
    """Blocks for a recording of which time alone would validate or test rest; None where time will do.

    Args:
        recording: all of its channels are to be predicted.
        horizon: largest horizon in ticks.
    """
    gap = HISTORY + horizon
    moving = moving_ticks([recording], recording.channel_names, max(1, horizon))
    blocks = blocks_of_motion([recording], gap)
    rests = not is_even(ByTime(), [recording], gap, moving) and is_even(blocks, [recording], gap, moving)
    return blocks if rests else None


def blocks_of_motion(recordings: Sequence[Recording], gap: int) -> ByBlocks:
    """Blocks that test in turn, so that rest at one end of a recording is shared out."""
    shortest = min(recording.samples / recording.rate_hz for recording in recordings)
    least = LEAST_GAPS * gap / min(recording.rate_hz for recording in recordings)
    return ByBlocks(block_s=max(shortest / BLOCKS, least), every=EVERY)
