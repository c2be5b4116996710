"""What reads large data sets piece by piece says what it says of arrays in memory, and holds no more for more hours."""

import errno
import json
import tracemalloc
from itertools import pairwise

import numpy as np
import pytest
from noted_progress import NotedProgress

from edp.data.chunks import ChunkSampler, ChunkSpec
from edp.data.features import Derived, FeatureSet
from edp.data.gathered import LastMade, make_lazy_array, on_demand, some_columns
from edp.data.moments import Moments
from edp.data.order import RandomOrder
from edp.data.prepared import prepare
from edp.data.scaling import feature_columns, feature_matrix, fit_scaler
from edp.data.screening import ScreeningSpec, screen
from edp.data.series import Series
from edp.data.splits import SPLITS
from edp.data.spread_rows import spread_series
from edp.data.task import TargetMode, Task
from edp.errors import DataError, StorageError
from edp.evaluation.tally import Tally, TallyState
from edp.jobs.packing import pack, unpack
from edp.logs import read_data_set, write_recording
from edp.logs.quality.cross_recording import compare
from edp.logs.quality.quality import inspect
from edp.logs.quality.sketches import Sketches, sketch
from edp.logs.source import DataSource
from edp.logs.store import read_store
from edp.recording import Recording, spread_recordings, spread_stretches
from edp.signals import Channel, Kind
from edp.stats.sketch import QuantileSketch
from edp.storage import write_json

pytestmark = pytest.mark.processes

NAMES = ("a", "b", "c", "d", "e", "f")
CHANNELS = tuple(Channel(name, Kind.VELOCITY if name in "bd" else Kind.GENERIC) for name in NAMES)
SCATTERED = FeatureSet("scattered", ("e", "a", "d"), (Derived("da", "a", "derivative"),))


def recording(name, seed, rows=500):
    values = np.cumsum(np.random.default_rng(seed).normal(size=(rows, len(NAMES))), axis=0).astype(np.float32)
    return Recording(name, CHANNELS, values, 50.0, "sim:test")


def task_of(features=SCATTERED, targets=("d", "b"), derived=(), horizons=(1, 7)):
    mode = TargetMode.ABSOLUTE
    return Task(features, targets, horizons, mode, 50.0, derived_targets=derived)


@pytest.fixture
def logs(tmp_path):
    for number in range(6):
        write_recording(recording(f"run{number}", number, 450 + number), tmp_path / "logs" / f"run{number}.parquet")
    DataSource.from_path(tmp_path / "logs").store(tmp_path / "store")
    return tmp_path / "logs"


@pytest.fixture
def stored(logs):
    return read_store(logs.parent / "store")


def repeated(store, folder, times):
    """A store that lists the recordings of another so many times under other names."""
    folder.mkdir()
    (folder / "rows").symlink_to(store / "rows")
    index = json.loads((store / "store.json").read_text())
    index["recordings"] = [
        {**entry, "name": f"{entry['name']}_{turn}", "log": f"/{turn}{entry['log']}", "log_key": str(turn)}
        for turn in range(times)
        for entry in index["recordings"]
    ]
    write_json(folder / "store.json", index)
    return folder


ROWS = [
    slice(3, 17),
    slice(None),
    slice(-5, None),
    slice(9, 2),
    slice(0, 40, 3),
    slice(30, 2, -4),
    7,
    -1,
    np.array([4, 0, -1, 4]),
    (None, slice(0, 6)),
    (slice(2, 9), 1),
    (slice(2, 9), [2, 0]),
    (slice(2, 9), slice(0, 2)),
    (np.array([3, 1]), slice(1, None)),
]


@pytest.mark.parametrize("key", ROWS, ids=str)
@pytest.mark.parametrize(
    "gains", [(), (Derived("db", "b", "derivative"), Derived("df", "f"))], ids=["columns", "changes"]
)
def test_rows_on_demand_are_those_of_an_array(stored, key, gains):
    names = ("e", "a", "b", *(one.name for one in gains))
    task = task_of(targets=names, derived=gains, features=FeatureSet("one", ("c",)))
    part, plain = (task.series(one, 20, 120).targets for one in (stored[0], recording("run0", 0, 450)))
    assert not isinstance(part, np.ndarray)
    np.testing.assert_array_equal(part[key], plain[key])
    assert (part.shape, len(part), part.dtype, part.ndim) == (plain.shape, len(plain), plain.dtype, plain.ndim)


def test_everything_else_of_an_array_is_there(stored):
    values = on_demand(stored[0].values, [4, 0])
    plain = np.asarray(values)
    np.testing.assert_array_equal(values - 1.0, plain - 1.0)
    np.testing.assert_array_equal(np.abs(values), np.abs(plain))
    np.testing.assert_array_equal(np.concatenate([values, plain], axis=1), np.concatenate([plain, plain], axis=1))
    np.testing.assert_array_equal(values.max(axis=0), plain.max(axis=0))
    np.testing.assert_array_equal(some_columns(values, [1])[5:9], plain[5:9, 1:])
    assert values[2:5].flags.c_contiguous
    with pytest.raises(AttributeError):
        _ = values.__array_interface__


def test_columns_side_by_side_are_views(stored):
    assert np.shares_memory(on_demand(stored[0].values, [1, 2, 3]), stored[0].values)


@pytest.mark.parametrize(
    "derived",
    [(), (Derived("dc", "c"),), (Derived("mc", "c", "trailing_mean", span_s=0.2),)],
    ids=["logged", "difference", "mean"],
)
def test_a_task_reads_from_a_store_what_it_reads_from_logs(logs, stored, derived):
    task = task_of(targets=("d", "b", *(one.name for one in derived)), derived=derived)
    ours, theirs = (prepare(part, task, SPLITS["recordings"](), 16) for part in (stored, read_data_set(logs)))
    assert ours.digest == theirs.digest
    for one, other in zip(ours.train, theirs.train, strict=True):
        np.testing.assert_array_equal(np.asarray(one.inputs), other.inputs)
        np.testing.assert_array_equal(np.asarray(one.targets), other.targets)
        assert not isinstance(one.inputs, np.ndarray)
    for name in ("feature_offset", "feature_scale", "target_offset", "target_scale"):
        np.testing.assert_array_equal(getattr(ours.scaler(), name), getattr(theirs.scaler(), name))
    spec = ChunkSpec(length=16, batch=3, burn_in=4)
    for one, other in zip(
        *(ChunkSampler(d.train, task.horizons, spec, 3).epoch(1) for d in (ours, theirs)), strict=True
    ):
        np.testing.assert_array_equal(one.inputs, other.inputs)
        np.testing.assert_array_equal(one.future, other.future)


def test_a_missing_value_in_a_store_is_refused_by_channel_and_row(tmp_path):
    one = recording("run0", 0)
    one.values[123, 4] = np.nan
    write_recording(one, tmp_path / "run0.parquet")
    DataSource.from_path(tmp_path / "run0.parquet").store(tmp_path / "store")
    # The build refuses it, as every command refuses the log.
    with pytest.raises(DataError, match=r"holds no recording; 1 log\(s\) were refused"):
        read_store(tmp_path / "store")


def test_memory_does_not_grow_with_the_hours_of_a_store(logs, tmp_path):
    """Reading, scaling and drawing batches; scattered columns and targets, which are not views."""

    def peak(times):
        store = repeated(tmp_path / "store", tmp_path / f"store_{times}", times)
        task = task_of()
        tracemalloc.start()
        data = prepare(read_store(store), task, SPLITS["recordings"](), 16)
        data.scaler()
        for _ in zip(
            range(20), ChunkSampler(data.train, task.horizons, ChunkSpec(length=16, batch=4, burn_in=4), 3).epoch(0)
        ):
            pass
        most = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return most

    few, many = peak(5), peak(50)
    samples = 45 * sum(one.samples for one in read_store(tmp_path / "store"))
    # Six columns of these samples would take this much more; names, entries and views take some kilobytes a recording.
    assert many - few < 0.5 * samples * 6 * 4 + 270 * 6_000


def test_features_are_made_when_they_are_read_one_recording_at_a_time(stored):
    task, slot = task_of(), LastMade()
    parts = [task.series(one) for one in stored[:3]]
    places = [3, 0]
    columns = [feature_columns(task, part, places, slot) for part in parts]
    for part, one in zip(parts, columns, strict=True):
        np.testing.assert_array_equal(one[10:20], feature_matrix(task, part)[10:20, places])
    made = []
    values = make_lazy_array((3, 1), lambda: made.append(1) or np.zeros((3, 1), dtype=np.float32), slot)
    for _ in range(4):
        values[0:2]
    assert len(made) == 1
    np.testing.assert_array_equal(columns[0][:5], feature_matrix(task, parts[0])[:5, places])
    values[0:2]
    assert len(made) == 2


def test_moments_of_blocks_are_those_of_all_rows():
    rng = np.random.default_rng(0)
    rows = (3e7 + rng.normal(size=(5_000, 3)) * (1.0, 1e3, 0.0)).astype(np.float32)
    whole, parts = Moments(3), Moments(3)
    whole.update(rows)
    for start in range(0, 5_000, 777):
        part = Moments(3)
        part.update(rows[start : start + 777])
        parts.merge(part)
    parts.merge(Moments(3))
    for moments in (whole, parts):
        assert moments.count == 5_000
        np.testing.assert_array_equal(moments.low, rows.min(axis=0))
        np.testing.assert_array_equal(moments.high, rows.max(axis=0))
        np.testing.assert_allclose(moments.mean, rows.astype(np.float64).mean(axis=0), rtol=1e-12)
        np.testing.assert_allclose(moments.deviation, rows.astype(np.float64).std(axis=0), rtol=1e-9)
        assert moments.deviation[2] == 0.0


def test_a_scaler_takes_one_pass(logs, monkeypatch):
    import edp.data.scaling as module

    task, calls = task_of(), []
    train = [task.series(one) for one in read_data_set(logs)]
    monkeypatch.setattr(
        module, "feature_matrix", lambda task, part: calls.append(part.name) or feature_matrix(task, part)
    )
    fit_scaler(task, train, [Kind.GENERIC] * 4)
    assert calls == [part.name for part in train]


@pytest.mark.parametrize("count", [1, 2, 5, 1000, 1 << 14])
def test_an_order_that_is_not_listed_is_a_permutation(count, monkeypatch):
    monkeypatch.setattr("edp.data.order.MAX_LISTED", 0)
    orders = [RandomOrder(np.random.default_rng(seed), count) for seed in (1, 1, 2)]
    parts = [np.concatenate([one.part(at, at + 13) for at in range(0, count, 13)]) for one in orders]
    assert sorted(parts[0]) == list(range(count))
    np.testing.assert_array_equal(parts[0], parts[1])
    if count >= 1000:
        assert not np.array_equal(parts[0], parts[2])
        # As shuffled as NumPy's: neighbours are far from each other, and early entries are no smaller than late ones.
        assert abs(np.corrcoef(np.arange(count), parts[0])[0, 1]) < 0.15
        assert np.mean(np.abs(np.diff(parts[0])) < count / 10) < 0.3


def test_quantiles_of_many_values_are_right_to_a_thousandth(monkeypatch):
    values = np.random.default_rng(0).lognormal(size=20_000)
    exact, binned = QuantileSketch(), QuantileSketch()
    exact.update(values)
    monkeypatch.setattr("edp.stats.sketch.MAX_EXACT", 1_000)
    for part in np.split(values, 20):
        binned.update(part)
    shares = (0.1, 0.5, 0.95, 0.99)
    assert exact.exact
    assert not binned.exact
    assert exact.quantiles(shares) == list(np.quantile(values, shares))
    np.testing.assert_allclose(binned.quantiles(shares), np.quantile(values, shares), rtol=2e-3)
    zeros = QuantileSketch()
    zeros.update(np.zeros(5_000))
    assert zeros.quantiles([0.5]) == [0.0]


def test_scores_of_many_ticks_are_those_of_all_at_once(monkeypatch):
    rng = np.random.default_rng(1)
    truth = rng.normal(size=(9_000, 2)) * 40.0
    truth[:, 1] = 5.0
    predicted = truth + rng.normal(size=truth.shape)
    exact, summed = Tally(("x", "y")), Tally(("x", "y"))
    exact.update(predicted, truth)
    for name in ("edp.evaluation.tally.MAX_EXACT", "edp.stats.sketch.MAX_EXACT"):
        monkeypatch.setattr(name, 500)
    for start in range(0, 9_000, 400):
        summed.update(predicted[start : start + 400], truth[start : start + 400])
    ours, theirs = summed.scores(), exact.scores()
    assert ours.keys() == theirs.keys()
    for name, values in theirs.items():
        for what, value in values.items():
            expected = value if value is None else pytest.approx(value, rel=1e-3, abs=1e-9)
            assert ours[name][what] == expected, (name, what)
    assert ours["y"]["r2"] is None


@pytest.mark.parametrize("most", [500, 100_000])
def test_scores_of_parts_that_are_added_are_those_of_all_at_once(monkeypatch, most):
    rng = np.random.default_rng(2)
    truth = rng.normal(size=(6_000, 2)) * 40.0
    predicted = truth + rng.normal(size=truth.shape)
    for name in ("edp.evaluation.tally.MAX_EXACT", "edp.stats.sketch.MAX_EXACT"):
        monkeypatch.setattr(name, most)
    whole, added = Tally(("x", "y")), Tally(("x", "y"))
    whole.update(predicted, truth)
    for start, stop in ((0, 300), (300, 300), (300, 2_400), (2_400, 6_000)):  # kept, empty and summed parts
        part = Tally(("x", "y"))
        part.update(predicted[start:stop], truth[start:stop])
        added.add(unpack(pack(part.state()), TallyState))
    for name, values in whole.scores().items():
        exact = most > 6_000
        assert added.scores()[name] == (values if exact else pytest.approx(values, rel=1e-9)), name


@pytest.mark.parametrize(("lengths", "length"), [([100] * 50, 20), ([5_000], 30), ([3, 4_000, 7, 900], 50)])
def test_stretches_are_bounded_spread_and_apart(lengths, length):
    stretches = spread_stretches(lengths, length, most=1_000)
    assert sum(stop - start for _, start, stop in stretches) <= 1_000
    assert stretches == sorted(stretches)
    for (i, _, stop), (j, start, _) in pairwise(stretches):
        assert i != j or stop <= start
    assert all(0 <= start < stop <= lengths[i] for i, start, stop in stretches)
    where = np.array([sum(lengths[:i]) + (start + stop) / 2 for i, start, stop in stretches]) / sum(lengths)
    assert np.diff([0.0, *where, 1.0]).max() < 0.25
    assert spread_stretches(lengths, length, most=sum(lengths)) == [(i, 0, n) for i, n in enumerate(lengths)]


def test_stretches_of_recordings_and_series_are_views():
    one = recording("run", 0, 1_000)
    (first, *_) = spread_recordings([one], seconds=1.0, most=200)
    assert first.samples == 50
    assert np.shares_memory(first.values, one.values)
    part = Series("run", one.values[:, :2], one.values[:, 2:3])
    parts = spread_series([part], 50, 200)
    assert [p.samples for p in parts] == [50] * 4
    assert spread_series([part], 50, 1_000) == [part]


def test_a_large_data_set_is_screened_on_stretches_of_it(monkeypatch):
    monkeypatch.setattr("edp.data.screening.table.MAX_ROWS", 8_000)
    monkeypatch.setattr("edp.recording.spread_stretches.__defaults__", (8_000,))
    rng = np.random.default_rng(0)
    recordings = []
    for number in range(8):
        u = np.cumsum(rng.normal(size=(4_000, 2)), axis=0)
        u -= np.linspace(0, 1, 4_000)[:, None] * u[-1]
        v = np.concatenate([np.zeros(5), u[:-5, 0]]) + rng.normal(size=4_000)
        values = np.column_stack([u, v]).astype(np.float32)
        recordings.append(
            Recording(
                f"r{number}",
                (Channel("u", Kind.RATIO), Channel("w", Kind.RATIO), Channel("v", Kind.VELOCITY)),
                values,
                50.0,
            )
        )
    result = screen(recordings, ScreeningSpec(max_lag=20, horizon=5, segment_samples=200, information_samples=500))
    assert 6_000 <= result.samples <= 8_000
    assert len(result.recordings) == 8
    (curve,) = [one for one in result.lags if (one.channel, one.target) == ("u", "v")]
    assert curve.best == -5 or curve.best == 5


def test_sketches_beyond_their_memory_leave_their_hash_alone():
    recordings = [recording(f"run{i}", i, 2_000) for i in range(3)]
    recordings.append(Recording("again", CHANNELS, recordings[2].values, 50.0))
    size = sketch(recordings[0]).values.nbytes
    kept = Sketches(most=int(2.5 * size))
    for one in recordings:
        kept.add(sketch(one))
    assert [len(one.values) > 0 for one in kept.all] == [True, True, False, False]
    quality = compare([inspect(one) for one in recordings], kept)
    assert [(one.first, one.second, one.seconds) for one in quality.repeats] == [("run2", "again", 40.0)]
    assert any(
        "among the first 2 recordings; the other 2 were compared by the hash" in f.what for f in quality.findings
    )


def test_a_disk_that_fills_while_a_store_is_built_loses_nothing(logs, tmp_path, monkeypatch):
    from edp.logs.store import building

    monkeypatch.setattr(building, "BATCH_LOG_BYTES", 1)
    real, written = building._store_log, []

    def full(log, *rest):
        if len(written) == 3:
            raise OSError(errno.ENOSPC, "No space left on device")
        written.append(log)
        return real(log, *rest)

    monkeypatch.setattr(building, "_store_log", full)
    with pytest.raises(StorageError, match=r"No space left on device; free space"):
        DataSource.from_path(logs).store(tmp_path / "new")
    monkeypatch.setattr(building, "_store_log", real)
    reached = NotedProgress()
    DataSource.from_path(logs).store(tmp_path / "new", progress=reached)
    assert reached.steps[0] == 3
    assert [one.digest for one in read_store(tmp_path / "new")] == [one.digest for one in read_data_set(logs)]


def test_a_store_of_another_schema_is_refused(logs, tmp_path):
    path = tmp_path / "store" / "store.json"
    for schema in (0, 3):
        path.write_text(json.dumps({**json.loads(path.read_text()), "schema": schema}))
        with pytest.raises(DataError, match=rf"schema {schema}, this version of EDP reads 1 and 2; remove the store"):
            read_store(tmp_path / "store")
