"""Properties of the time rule: causal, exact on uniform rows, in range."""

from __future__ import annotations

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from edp.errors import DataError
from edp.logs import FORMATS, Repair, read_recording, write_recording
from edp.logs.timebase import common_grid, hold_rows, judge
from edp.recording import Recording
from edp.signals import TABLE_A1, SignalMap

FEW = settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
steps = st.lists(st.floats(0.001, 0.2), min_size=4, max_size=60)
rates = st.sampled_from([None, 5.0, 37.0, 100.0, 400.0])


def read(folder, time, values, rate):
    path = folder / "a.parquet"
    pq.write_table(pa.table({"time": time, "CylVels_1": values}), path)
    return read_recording(path, SignalMap(rate_hz=rate), repair=Repair(gaps="hold"))


@FEW
@given(steps=steps, rate=rates, seed=st.integers(0, 99), data=st.data())
def test_a_future_sample_never_changes_a_past_tick(tmp_path, steps, rate, seed, data):
    time = np.concatenate([[0.0], np.cumsum(steps)])
    values = np.random.default_rng(seed).standard_normal(len(time))
    place = data.draw(st.integers(1, len(time) - 1))
    before = read(tmp_path, time, values, rate)
    changed = values.copy()
    changed[place:] += 1000.0
    after = read(tmp_path, time, changed, rate)
    ticks = np.arange(before.samples) / before.rate_hz
    if "resampled_from_hz" in before.meta:
        # Where stamps jitter about a straight line, a row's time is that of the line, whose start is the first tick.
        stamps = judge(time, "x").stamps
        past = stamps[0] + ticks < stamps[place] - 1e-3 / before.rate_hz
    else:
        past = np.arange(before.samples) < place
    np.testing.assert_array_equal(before.values[past], after.values[past])


@FEW
@given(steps=steps, rate=st.sampled_from([5.0, 37.0, 100.0, 400.0]))
def test_each_tick_holds_the_latest_sample(steps, rate):
    time = np.concatenate([[0.0], np.cumsum(steps)])
    clock = judge(time, "x")
    grid = common_grid([clock], rate, "x")
    rows, _ = hold_rows(clock, grid)
    rows = np.arange(grid.count) if rows is None else rows
    slack = 2e-6 / rate
    assert np.all(clock.stamps[rows] <= grid.ticks + slack)
    later = np.minimum(rows + 1, len(time) - 1)
    assert np.all((clock.stamps[later] > grid.ticks - slack) | (later == rows))
    assert np.all(np.diff(rows) >= 0)
    # The grid ends with the log: the next tick would lie after the last stamp.
    assert grid.ticks[-1] <= clock.stamps[-1] + slack < grid.ticks[-1] + 1.01 / rate


@FEW
@given(
    rate=st.sampled_from([1.0, 10.0, 50.0, 100.0, 128.0, 333.0, 1000.0]),
    start=st.floats(-10, 1e6),
    rows=st.integers(10, 2000),
    seed=st.integers(0, 99),
)
def test_nearly_uniform_rows_stay_as_they_are(rate, start, rows, seed):
    jitter = np.random.default_rng(seed).uniform(-0.04, 0.04, rows) / rate
    clock = judge(start + np.arange(rows) / rate + jitter, "x")
    assert clock.uniform
    assert clock.rate_hz == pytest.approx(rate, rel=0.2 / rows)


@FEW
@given(rows=st.integers(50, 3000), lost=st.data(), rate=st.sampled_from([50.0, 100.0, 1000.0]))
def test_a_lost_row_never_shifts_the_rest(rows, lost, rate):
    gone = lost.draw(st.integers(1, rows - 2))
    clock = judge(np.delete(np.arange(rows) / rate, gone), "x")
    assert not clock.uniform


@FEW
@given(
    suffix=st.sampled_from([part.suffixes[0] for part in FORMATS.values()]),
    values=st.lists(st.floats(width=32, allow_nan=False, allow_infinity=False), min_size=2, max_size=40),
    rate=st.sampled_from([1.0, 20.0, 100.0, 1000.0]),
)
def test_any_numbers_round_trip(tmp_path, suffix, values, rate):
    recording = Recording("a", (TABLE_A1["BmUp"],), np.float32(values).reshape(-1, 1), rate)
    back = read_recording(write_recording(recording, tmp_path / f"a{suffix}"))
    assert back.digest == recording.digest


@FEW
@given(text=st.text(max_size=300))
def test_any_text_gives_a_recording_or_a_data_error(tmp_path, text):
    path = tmp_path / "a.csv"
    path.write_text(text, encoding="utf-8", errors="surrogatepass")
    with pytest.raises(DataError):
        read_recording(path)
