"""Stretches divided for cross-validation: nothing lost, nothing on both sides, each part unbroken and named by rows."""

import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from edp.data.series import Series
from edp.data.stretch_folds import stretch_folds
from edp.errors import DataError


def stretches(lengths, first_row=None):
    """Stretches whose values say which tick of which stretch they are."""
    made = []
    for which, length in enumerate(lengths):
        values = np.stack([np.full(length, which), np.arange(length)], axis=1).astype(np.float32)
        name = f"log_{which}" if first_row is None else f"log_{which}[{first_row}:{first_row + length}]"
        made.append(Series(name, values, values, values))
    return made


def ticks(parts):
    return [(int(which), int(tick)) for part in parts for which, tick in part.inputs]


@pytest.mark.long
@given(st.lists(st.integers(30, 200), min_size=1, max_size=9), st.integers(2, 5), st.integers(0, 9), st.integers(0, 99))
def test_each_tick_is_left_out_once_and_learned_from_by_the_others(lengths, count, gap, seed):
    series = stretches(lengths)
    try:
        divided = stretch_folds(series, count, gap, 1, seed)
    except DataError:
        assert sum(lengths) < 20 * count + 2 * count * gap + 20
        return
    left_out = [tick for fold in divided for tick in ticks(fold.validation)]
    assert sorted(left_out) == sorted(ticks(series))
    for fold in divided:
        own, learned = ticks(fold.validation), set(ticks(fold.train))
        assert learned.isdisjoint(own)
        assert all((which, tick + step) not in learned for which, tick in own for step in (-gap, gap))
        # A fold is one stretch of those laid end to end, so that no more than two gaps are lost.
        assert 2 * gap >= sum(lengths) - len(own) - len(learned) >= 0


@pytest.mark.parametrize("first_row", [None, 40])
def test_parts_are_unbroken_and_named_by_the_rows_of_their_recording(first_row):
    series = stretches([90, 130, 70], first_row)
    for fold in stretch_folds(series, 3, 5, 1, 0):
        for part in (*fold.train, *fold.validation):
            which, start, stop = re.fullmatch(r"log_(\d+)(?:\[(\d+):(\d+)\])?", part.name).groups()
            first = first_row or 0
            rows = np.arange(int(start or 0) - first, int(stop or part.samples) - first)
            np.testing.assert_array_equal(part.targets, series[int(which)].targets[rows])
            np.testing.assert_array_equal(part.strategy_columns, part.targets)


def test_the_seed_deals_the_stretches():
    def left_out(seed):
        folds = stretch_folds(stretches([100] * 6), 3, 0, 1, seed)
        return [{which for which, _ in ticks(fold.validation)} for fold in folds]

    assert left_out(0) == left_out(0)
    assert left_out(0) != left_out(1)
    assert all(len(of) == 2 for of in left_out(0))


def test_parts_cut_too_short_are_in_neither_part():
    whole, cut = (stretch_folds(stretches([100, 110]), 5, 0, shortest, 0) for shortest in (1, 30))
    assert min(part.samples for fold in whole for part in fold.validation) < 30
    assert min(part.samples for fold in cut for part in (*fold.train, *fold.validation)) >= 30


@pytest.mark.parametrize(
    "name", ["log[²:5]", "log[3:]", "log[:", "[]", "]", "log[-3:4]", "log[3:9].csv", "x[" + "9" * 240 + ":5]"]
)
def test_any_file_name_is_a_name(name):
    (series,) = stretches([100])
    parts = [part for fold in stretch_folds([replace(series, name=name)], 2, 0, 1, 0) for part in fold.validation]
    assert len({part.name for part in parts}) == len(parts) == 2


def test_too_few_ticks_are_refused():
    with pytest.raises(DataError, match="cross-validation: 40 rows for 5 folds"):
        stretch_folds(stretches([40]), 5, 0, 1, 0)
