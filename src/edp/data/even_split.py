"""Check that each part of a split has its fraction of samples and motion, and choose blocks otherwise."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from edp.data.splits import ByBlocks, ByRecording, ByTime, Stretch
from edp.errors import DataError
from edp.recording import Recording
from edp.wording import typed

MIN_OF_SHARE = 0.25
"""Minimum weight of a part relative to its fraction of the data. Without it, a draw of whole recordings of 300 s and 4
s trained on the 4 s."""
MOVES = 0.5
"""Fraction of a channel's root-mean-square change above which a sample counts as motion. Steps of an encoder are
smaller."""
BLOCKS, MIN_GAPS = 15, 8
"""Blocks of a recording, three of which test, and gaps that one is long at least."""
EVERY = 5
HISTORY = 32
"""Ticks before a prediction that it reads at least."""
UNLIKE = 2.0
"""Changes of the part that tests over those of the rest, or the inverse, above which conditions differ: divided by time
at most 1.7 in each of seven measured sets and in their recordings, 2.2 and 2.6 in two sets of sweeps of frequency."""

Mask = NDArray[np.bool_]


def moving_ticks(recordings: Sequence[Recording], channels: Sequence[str], span: int) -> list[Mask]:
    """Return a mask of the samples with motion for each recording, ``(time,)`` each.

    Args:
        recordings: the data set.
        channels: channel names. If a recording lacks one, the others are used.
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
    """Return whether each part has at least `MIN_OF_SHARE` of the weight expected from its fraction of the data.

    Args:
        split: division of the recordings.
        recordings: the data set.
        gap: ticks between neighbouring segments of different parts.
        weights: samples of each recording that count.
    """
    try:
        parts = split.split(recordings, gap)
    except DataError:
        return False
    total = sum(int(weight.sum()) for weight in weights)
    return all(
        sum(int(weights[one.recording][one.start : one.stop].sum()) for one in getattr(parts, part))
        >= MIN_OF_SHARE * share * total
        for part, share in _shares(split).items()
    )


def _shares(split: ByRecording | ByTime | ByBlocks) -> dict[str, float]:
    """Return the fraction of the data for training, validation and test."""
    test = 1 / split.every if isinstance(split, ByBlocks) else split.test_fraction
    validation = split.validation_fraction * (1 - test if isinstance(split, ByBlocks) else 1)
    return {"train": 1 - validation - test, "validation": validation, "test": test}


def most_unlike(
    split: ByTime | ByBlocks, recordings: Sequence[Recording], gap: int, channels: Sequence[str], spans: Sequence[int]
) -> tuple[float, str, int]:
    """Return the largest difference in root-mean-square change between the test part and the other parts.

    Args:
        split: division of the recordings.
        recordings: the data set.
        gap: ticks between neighbouring segments of different parts.
        channels: channel names. If a recording lacks one, the others are used.
        spans: ticks over which changes are looked at.

    Returns:
        the ratio that is furthest from 1, its channel and its span; ``(1.0, "", 0)`` where nothing moves.

    Raises:
        DataError: the recordings cannot be divided so.
    """
    parts = split.split(recordings, gap)
    furthest = (1.0, "", 0)
    for name in channels:
        for span in spans:
            rest, test = (
                _mean_change(recordings, stretches, name, span)
                for stretches in ((*parts.train, *parts.validation), parts.test)
            )
            # A channel that never moves in one of them is as unlike as can be.
            ratio = test / rest if rest > 0 else (np.inf if test > 0 else 1.0)
            if _distance(ratio) > _distance(furthest[0]):
                furthest = (float(ratio), name, span)
    return furthest


def _distance(ratio: float) -> float:
    """Return the absolute logarithm of a ratio, so that a ratio and its inverse are equally far from 1."""
    return float(abs(np.log(ratio))) if ratio > 0 else float(np.inf)


def _mean_change(recordings: Sequence[Recording], stretches: Sequence[Stretch], name: str, span: int) -> float:
    """Return the root-mean-square change of a channel over `span` samples, ignoring missing values."""
    squared, count = 0.0, 0
    for one in stretches:
        recording = recordings[one.recording]
        if name in recording.channel_names and one.stop - one.start > span:
            values = recording.values[one.start : one.stop, recording.index(name)].astype(np.float64)
            changes = values[span:] - values[:-span]
            changes = changes[np.isfinite(changes)]
            squared += float(np.square(changes).sum())
            count += len(changes)
    return float(np.sqrt(squared / max(count, 1)))


def blocks_where_time_is_uneven(
    recordings: Sequence[Recording], channels: Sequence[str], horizons: Sequence[int], by_time: ByTime
) -> tuple[ByBlocks, str] | None:
    """Return a split by blocks and its reason if the end of the recordings is not representative, else None.

    The end says nothing where the machine rests there, or moves far less or far more than before (sweeps of frequency,
    a warm-up): a model would be tested by what it was not trained for, or by the easiest of what it was.

    Args:
        recordings: the data set.
        channels: names of the predicted channels.
        horizons: horizons in samples.
        by_time: intended division by time.
    """
    blocks, even_in_blocks, even_in_time = _evenness(recordings, channels, horizons, by_time)
    if not even_in_blocks:
        return None
    if not even_in_time:
        return blocks, "the machine rests in most of what would be tested or validated"
    gap, spans = _gap(horizons), sorted({1, max(1, *horizons)})
    ratio, name, span = most_unlike(by_time, recordings, gap, channels, spans)
    if _distance(ratio) <= np.log(UNLIKE):
        return None
    # Blocks of a machine whose every hour is different are no better.
    if _distance(most_unlike(blocks, recordings, gap, channels, spans)[0]) > _distance(ratio) / 2:
        return None
    ticks = "1 tick" if span == 1 else f"{span} ticks"
    return blocks, (
        f"the end, which would test, moves unlike the rest (changes of {name} in {ticks} are {typed(ratio, 2)} times "
        "as "
        "large)"
    )


def rests_where_it_tests(
    recordings: Sequence[Recording], channels: Sequence[str], horizons: Sequence[int], by_time: ByTime
) -> bool:
    """Return whether the machine does not move in most of the test or validation data of every possible split.

    Args:
        recordings: the data set.
        channels: names of the predicted channels.
        horizons: horizons in samples.
        by_time: intended division by time.
    """
    _, *even = _evenness(recordings, channels, horizons, by_time)
    return not any(even)


def _gap(horizons: Sequence[int]) -> int:
    """Return the number of samples left out around test data."""
    return HISTORY + max(1, *horizons)


def _evenness(
    recordings: Sequence[Recording], channels: Sequence[str], horizons: Sequence[int], by_time: ByTime
) -> tuple[ByBlocks, bool, bool]:
    """Return the blocks of motion, and whether they and the division by time test and validate motion."""
    gap, moving = _gap(horizons), moving_ticks(recordings, channels, max(1, *horizons))
    blocks = blocks_of_motion(recordings, gap)
    return blocks, is_even(blocks, recordings, gap, moving), is_even(by_time, recordings, gap, moving)


def blocks_of_motion(recordings: Sequence[Recording], gap: int) -> ByBlocks:
    """Return a split whose test blocks are spread over the recording, so that standstill at one end is distributed."""
    shortest = min(recording.samples / recording.rate_hz for recording in recordings)
    least = MIN_GAPS * gap / min(recording.rate_hz for recording in recordings)
    return ByBlocks(block_s=max(shortest / BLOCKS, least), every=EVERY)
