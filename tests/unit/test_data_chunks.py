from collections import Counter
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from edp.data.augment import AUGMENTATIONS, Jitter, TimeWarp
from edp.data.chunks import ChunkSampler, ChunkSpec
from edp.data.series import Series
from edp.errors import ConfigError, DataError


def series(number, samples):
    """Inputs name their row: column 0 is the series, column 1 the row; the targets are functions of both."""
    rows = np.arange(samples, dtype=np.float32)
    inputs = np.stack([np.full(samples, number, np.float32), rows], axis=1)
    return Series(f"s{number}", inputs, np.stack([1000.0 * number + rows, -rows], axis=1).astype(np.float32))


def rows_with_a_loss(batches, parts, horizons):
    """Counts (series, row) over the valid ticks, checking each one's future on the way."""
    counts = Counter()
    for batch in batches:
        for b, t in np.argwhere(batch.valid):
            number, row = (int(value) for value in batch.inputs[b, t])
            counts[number, row] += 1
            assert row + max(horizons) < parts[number].samples
            for k, horizon in enumerate(horizons):
                np.testing.assert_array_equal(batch.future[b, t, k], parts[number].targets[row + horizon])
    return counts


CASES = st.tuples(
    st.lists(st.integers(120, 900), min_size=1, max_size=4),
    st.integers(5, 60),  # chunk length
    st.integers(1, 6),  # lanes
    st.integers(0, 40),  # burn-in
    st.lists(st.integers(0, 30), min_size=1, max_size=3, unique=True).map(sorted),
    st.integers(0, 3),  # epoch
)


@pytest.mark.long
@settings(max_examples=40, deadline=None)
@given(case=CASES)
@example(case=([300], 5, 2, 40, [0], 0))  # a burn-in of eight chunks
@example(case=([900, 120], 5, 3, 110, [3], 1))
def test_chunks_give_each_sample_one_loss_but_for_the_burn_in_at_the_start(case):
    samples, length, lanes, burn_in, horizons, epoch = case
    parts = [series(i, n) for i, n in enumerate(samples)]
    spec = ChunkSpec(length=length, batch=lanes, burn_in=burn_in)
    batches = list(ChunkSampler(parts, horizons, spec, seed=1).epoch(epoch))
    counts = rows_with_a_loss(batches, parts, horizons)
    assert set(counts.values()) <= {1}
    for number, n in enumerate(samples):
        seen = sorted(row for owner, row in counts if owner == number)
        # The walk starts at a random offset below a chunk and an eighth of the recording; then nothing is left out.
        assert burn_in <= seen[0] < burn_in + min(length, max(1, n // 8))
        assert seen == list(range(seen[0], n - max(horizons)))


@pytest.mark.parametrize(("samples", "lanes"), [(300, 8), (5000, 4)])
def test_streams_start_anew_as_often_as_asked_and_short_data_fill_all_lanes(samples, lanes):
    parts = [series(0, samples)]
    spec = ChunkSpec(length=40, batch=lanes, burn_in=5, reset_after_chunks=2)
    batches = list(ChunkSampler(parts, [0], spec, seed=1).epoch(0))
    counts = rows_with_a_loss(batches, parts, [0])
    assert {row for _, row in counts} >= set(range(45, samples))
    assert batches[0].reset.all()
    assert batches[0].valid.any(axis=1).all()  # no lane idles
    for before, after in pairwise(batches):
        assert not (before.reset & after.reset & after.valid.any(axis=1) & before.valid.all(axis=1)).any()
    ages = np.zeros(lanes)
    for batch in batches:
        ages = np.where(batch.reset, 1, ages + 1)
        assert ages.max() <= 2


@settings(max_examples=25, deadline=None)
@given(case=CASES)
def test_lanes_are_unbroken_between_resets_and_losses_wait_for_the_burn_in(case):
    samples, length, lanes, burn_in, horizons, epoch = case
    parts = [series(i, n) for i, n in enumerate(samples)]
    sampler = ChunkSampler(parts, horizons, ChunkSpec(length=length, batch=lanes, burn_in=burn_in), seed=1)
    before, age, number = [None] * lanes, [0] * lanes, 0
    for batch in sampler.epoch(epoch):
        number += 1
        assert batch.inputs.shape == (lanes, length, 2)
        assert batch.future.shape == (lanes, length, len(horizons), 2)
        for lane in range(lanes):
            valid, first = batch.valid[lane], tuple(batch.inputs[lane, 0])
            if batch.reset[lane]:
                age[lane] = 0
            elif valid.any():
                assert first == before[lane]
            if valid.any():
                rows = batch.inputs[lane, valid, 1]
                assert age[lane] + int(np.argmax(valid)) >= burn_in
                np.testing.assert_array_equal(np.diff(rows), 1)
            age[lane] += length
            last = batch.inputs[lane, -1]
            before[lane] = (last[0], last[1] + 1)
    assert number == sampler.updates(epoch)


@settings(max_examples=25, deadline=None)
@given(
    samples=st.lists(st.integers(60, 200), min_size=1, max_size=3),
    length=st.integers(1, 40),
    batch=st.integers(1, 50),
    horizons=st.lists(st.integers(0, 15), min_size=1, max_size=2, unique=True).map(sorted),
)
def test_windows_come_exactly_once_with_one_target_each(samples, length, batch, horizons):
    parts = [series(i, n) for i, n in enumerate(samples)]
    sampler = ChunkSampler(parts, horizons, ChunkSpec(regime="window", length=length, batch=batch), seed=4)
    batches = list(sampler.epoch(2))
    assert len(batches) == sampler.updates(2)
    for made in batches:
        assert made.reset.all()
        assert made.valid[:, -1].all()
        assert not made.valid[:, :-1].any()
        np.testing.assert_array_equal(np.diff(made.inputs[..., 1], axis=1), 1)
    counts = rows_with_a_loss(batches, parts, horizons)
    wanted = {(i, row) for i, n in enumerate(samples) for row in range(length - 1, n - max(horizons))}
    assert set(counts) == wanted
    assert set(counts.values()) == {1}


@pytest.mark.parametrize("regime", ["chunk", "window"])
def test_batches_are_a_function_of_seed_and_epoch(regime):
    parts = [series(0, 400), series(1, 300)]
    spec = ChunkSpec(regime=regime, length=20, batch=4, burn_in=10)

    def epoch(seed, number):
        return [batch.inputs for batch in ChunkSampler(parts, (1, 3), spec, seed).epoch(number)]

    first = epoch(5, 2)
    for again, once in zip(epoch(5, 2), first, strict=True):
        np.testing.assert_array_equal(again, once)
    for seed, number in ((5, 3), (6, 2)):
        other = epoch(seed, number)
        assert len(other) != len(first) or any(not np.array_equal(a, b) for a, b in zip(first, other, strict=True))


@pytest.mark.parametrize(("regime", "lead"), [("chunk", 10), ("window", 19)])
def test_a_recording_without_a_single_target_is_refused(regime, lead):
    spec = ChunkSpec(regime=regime, length=20, batch=4, burn_in=10)
    ChunkSampler([series(0, lead + 4)], (3,), spec, 0)
    with pytest.raises(DataError, match=rf"'s1' has {lead + 3} samples, shorter than the burn-in of {lead}"):
        ChunkSampler([series(0, 400), series(1, lead + 3)], (3,), spec, 0)


@pytest.mark.parametrize("options", [{"regime": "lane"}, {"length": 0}, {"batch": 0}, {"burn_in": -1}])
def test_options_out_of_range_are_refused(options):
    with pytest.raises(ConfigError, match="must hold"):
        ChunkSpec(**options)


@pytest.mark.parametrize("together", [2, 3, 5])
def test_windows_drawn_together_end_at_consecutive_samples_and_each_is_seen_once(together):
    parts = [series(0, 100), series(1, 83)]
    spec = ChunkSpec(regime="window", length=20, batch=6 * together, consecutive=together)
    sampler = ChunkSampler(parts, (1, 7), spec, seed=2)
    firsts = set()
    for epoch in range(4):
        batches = list(sampler.epoch(epoch))
        counts = rows_with_a_loss(batches, parts, (1, 7))
        assert set(counts.values()) == {1}
        for batch in batches:
            ends = batch.inputs[:, -1].reshape(-1, together, 2)
            assert (np.diff(ends[..., 0], axis=1) == 0).all()
            assert (np.diff(ends[..., 1], axis=1) == 1).all()
            assert batch.reset.all()
        for number, samples in enumerate((100, 83)):
            rows = sorted(row for owner, row in counts if owner == number)
            # Groups begin at another row in each epoch; at most a group is left out at each end.
            assert rows == list(range(rows[0], rows[0] + len(rows)))
            assert len(rows) > samples - 19 - 7 - 2 * together
            firsts.add(rows[0])
        assert len(batches) <= sampler.updates()
    assert len(firsts) > 1


@pytest.mark.parametrize("name", list(AUGMENTATIONS))
@pytest.mark.parametrize("regime", ["chunk", "window"])
def test_augmented_epochs_are_functions_of_seed_and_number_and_leave_the_series_alone(name, regime):
    rng = np.random.default_rng(0)
    parts = [Series("s", *rng.normal(size=(2, 400, 2)).cumsum(axis=1).astype(np.float32))]
    kept = parts[0].inputs.copy()
    spec = ChunkSpec(regime=regime, length=40, batch=3, burn_in=10)

    augmentation = AUGMENTATIONS[name]()

    def epoch(number, seed=1, augmentations=(augmentation,)):
        batches = list(ChunkSampler(parts, (4,), spec, seed, augmentations).epoch(number))
        return np.concatenate([batch.inputs for batch in batches]), [batch.valid for batch in batches]

    inputs, valid = epoch(0)
    np.testing.assert_array_equal(inputs, epoch(0)[0])
    plain, same = epoch(0, augmentations=())
    assert plain.shape == inputs.shape
    assert not np.array_equal(plain, inputs)
    for mine, theirs in zip(valid, same, strict=True):
        np.testing.assert_array_equal(mine, theirs)
    assert not np.array_equal(inputs, epoch(0, seed=2)[0])
    np.testing.assert_array_equal(parts[0].inputs, kept)


def test_an_augmented_stretch_goes_on_from_chunk_to_chunk():
    clock = np.arange(3000, dtype=np.float32)[:, None]
    spec = ChunkSpec(length=50, batch=2, burn_in=0)
    batches = list(ChunkSampler([Series("clock", clock, clock)], (3,), spec, 0, (TimeWarp(strength=0.3),)).epoch(0))
    moved = 0.0
    for before, after in pairwise(batches):
        for lane in range(2):
            if not after.reset[lane] and after.valid[lane].all():
                step = after.inputs[lane, 0, 0] - before.inputs[lane, -1, 0]
                assert 0.4 < step < 1.8
                ahead = after.future[lane, :, 0, 0] - after.inputs[lane, :, 0]
                assert (ahead > 1.2).all()
                assert (ahead < 5.4).all()
                moved = max(moved, np.abs(ahead - 3).max())
    assert moved > 0.2


def test_a_lane_that_has_run_out_gives_nothing_with_augmentations_too():
    parts = [series(0, 700)]
    spec = ChunkSpec(length=60, batch=5, burn_in=20)
    plain = list(ChunkSampler(parts, (2,), spec, 0).epoch(0))
    noisy = list(ChunkSampler(parts, (2,), spec, 0, (Jitter(),)).epoch(0))
    assert [batch.targets_seen for batch in plain] == [batch.targets_seen for batch in noisy]
    assert [batch.reset.tolist() for batch in plain] == [batch.reset.tolist() for batch in noisy]
