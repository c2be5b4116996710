"""What numbers are worth: blocks of the logs that agree or differ, and a structure that two lengths fit apart."""

from dataclasses import replace

import numpy as np
import pytest

from edp.testing.twins import sample_series
from edp.training.identification.rows import TOLD, IdentifiedNumber
from edp.training.identification.stability import MAX_BLOCKS, MIN_BLOCKS, divided, spread

RNG = np.random.default_rng(0)


def quadratic(optima, weight=100.0, theta=0.0):
    """Matrices and gradients of blocks ``(length, block)`` whose losses are weight (x - optimum)^2 / 2."""
    lengths, blocks = optima.shape
    matrices = np.zeros((lengths, 2, 1, 1))
    for half in range(2):
        matrices[:, half] = weight * len(range(half, blocks, 2))
    return matrices, weight * (theta - optima)[:, :, None]


def deviation(optima, **of):
    return float(np.sqrt(spread(np.zeros(1), *quadratic(optima, **of))[0, 0]))


def test_blocks_that_agree_leave_what_the_information_leaves():
    assert deviation(np.zeros((2, 8)), weight=100.0) == pytest.approx(1601**-0.5)


@pytest.mark.parametrize("size", [0.1, 0.3])
def test_blocks_that_differ_leave_the_deviation_of_their_mean(size):
    optima = np.repeat(size * RNG.normal(size=(1, 400)), 2, axis=0)
    # Blocks that differ at random: their mean is known to size / sqrt(blocks); halves say the same once more.
    assert size / 20.0 < deviation(optima - optima.mean(), weight=1e4) < 2.0 * size / 20.0


def test_halves_that_contradict_each_other_are_seen():
    optima = np.tile([0.5, -0.5], (1, 4))
    assert deviation(optima, weight=1e4) > 0.5


def test_lengths_that_contradict_each_other_are_seen_though_all_blocks_agree():
    optima = np.repeat([[0.4], [-0.4]], 8, axis=1)
    assert deviation(optima, weight=1e4) == pytest.approx(0.4, rel=0.02)


def test_logs_are_divided_by_recordings_else_by_time():
    _, series = sample_series(3)
    (long,) = series[:1]
    by_recording = divided([replace(long, name=str(k)) for k in range(40)], 100)
    assert len(by_recording) == MAX_BLOCKS
    assert sum(len(block) for block in by_recording) == 40
    by_time = divided(series, 100)
    assert len(by_time) == MIN_BLOCKS
    assert sum(part.samples for block in by_time for part in block) == sum(part.samples for part in series)
    assert all(part.samples >= 100 for block in by_time for part in block)
    assert divided([], 100) == divided([long], long.samples + 1) == []
    assert len(divided([long], long.samples)) == 1


def test_a_rough_number_says_so():
    row = IdentifiedNumber("x", "y", "1", 1.0, 1.0, 1.0 / (1 + TOLD), 1 + TOLD, True, True)
    assert row.interval("kept") == "0.833 to 1.2"
    assert replace(row, is_told=False).interval("kept") == "roughly 0.833 to 1.2"
    assert replace(row, is_told=False, excited=False).interval("kept") == "kept"
