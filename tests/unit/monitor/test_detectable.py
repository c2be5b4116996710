"""What a monitor finds with its healthy logs: measured by shifts, and repeated where it raises no alarm."""

import importlib
import re
from dataclasses import replace

import numpy as np
import pytest
from small_monitors import fitted_monitor

from edp.errors import StorageError
from edp.logs import write_recording
from edp.logs.source import DataSource
from edp.monitor.detectable import (
    INJECTIONS,
    Change,
    effort_line,
    found_sizes,
    measure_found_sizes,
    outside_line,
    promise_lines,
    unseen_line,
)
from edp.monitor.monitor_file import load_monitor, save_monitor
from edp.recording import Recording
from edp.report.monitor.facts import headline, verdict
from edp.signals import Channel, Kind
from edp.testing.monitor import rig_sessions
from edp.workflows.monitor import report_monitor, run_monitor

pytestmark = pytest.mark.processes


@pytest.fixture(scope="module")
def monitor():
    return fitted_monitor()


def shifted(session, name, size):
    values = session.values.copy()
    values[len(values) // 3 :, session.index(name)] += np.float32(size)
    return replace(session, values=values)


def test_every_channel_has_a_size_with_its_trials_and_minutes(monitor):
    sizes = found_sizes(monitor.provenance)
    assert [(size.change, size.channel) for size in sizes] == [(c, n) for c in INJECTIONS for n in monitor.inputs]
    assert all(size.trials >= 1 and size.minutes == pytest.approx(4.0) for size in sizes)
    assert all(size.share >= 0.8 and size.within_s > 0 for size in sizes if size.size is not None)


def test_a_size_that_is_promised_is_found_on_other_sessions_and_a_small_part_of_it_is_not(monitor):
    size = next(one for one in found_sizes(monitor.provenance) if one.channel == "stroke")
    others = rig_sessions(6, 2000, seed=9)
    found = [bool(monitor.watch(shifted(one, "stroke", 2 * size.size / 1000)).alarms) for one in others]
    assert np.mean(found) >= 0.8
    missed = [bool(monitor.watch(shifted(one, "stroke", 0.01 * size.size / 1000)).alarms) for one in others]
    assert np.mean(missed) < np.mean(found)


def test_segments_with_alarms_of_their_own_measure_nothing(monitor):
    loud = [shifted(session, "stroke", 0.2) for session in rig_sessions(2, 2000, seed=3)]
    assert measure_found_sizes(monitor, loud, 4.0, 0.0).sizes == ()
    assert unseen_line([]) == ""


def test_work_is_bounded_by_bisection(monitor, monkeypatch):
    calls = []
    watch = type(monitor).watch
    monkeypatch.setattr(type(monitor), "watch", lambda self, *a: calls.append(1) or watch(self, *a))
    segments = rig_sessions(1, 2000, seed=5)
    measure_found_sizes(monitor, segments, 4.0, 0.0)
    most = sum(len(one.signs) * int(np.ceil(np.log2(len(one.factors) + 1))) for one in INJECTIONS.values())
    assert len(calls) <= 1 + most * len(monitor.inputs)


def test_the_trials_end_at_a_share_of_the_fit_and_say_so(monitor, monkeypatch):
    module = importlib.import_module("edp.monitor.detectable")
    clock = iter(range(10_000))
    # One second for each look at the clock: what is tried depends on the share alone.
    monkeypatch.setattr(module.time, "process_time", lambda: float(next(clock)))
    segments = rig_sessions(1, 2000, seed=5)
    results = [measure_found_sizes(monitor, segments, 4.0, fit_s) for fit_s in (0.0, 1e6)]
    assert [one.allowed_s for one in results] == [module.MIN_EFFORT_S, module.EFFORT_SHARE * 1e6]
    short, whole = results
    assert 0 < len(short.sizes) < short.planned == len(whole.sizes)
    assert short.sizes == whole.sizes[: len(short.sizes)]
    line = effort_line({"found_effort": short.effort()})
    assert f"{len(short.sizes)} of {short.planned} changes" in line
    assert effort_line({"found_effort": whole.effort()}) == effort_line({}) == ""
    with pytest.raises(StorageError, match="found_effort is damaged"):
        effort_line({"found_effort": {"measured": "x"}})


@pytest.mark.parametrize("change", list(Change))
def test_a_change_begins_at_the_onset_and_has_its_size(change):
    values = np.arange(1.0, 201.0, dtype=np.float32)
    changed = INJECTIONS[change].apply(values, 60, 0.1, 100.0)
    assert np.array_equal(changed[:60], values[:60])
    expected = {Change.SHIFT: values + 0.1, Change.SCALE: values * 1.1, Change.DELAY: values - 10}[change]
    assert changed[60:] == pytest.approx(expected[60:], rel=1e-5)
    assert changed.dtype == np.float32
    assert len(changed) == len(values)


def test_a_scale_of_a_temperature_acts_on_degrees_celsius(monkeypatch):
    module = importlib.import_module("edp.monitor.detectable")
    seen = []
    monkeypatch.setattr(module, "_alarms", lambda monitor, recording: seen.append(recording.values.copy()) or [])
    channels = (Channel("oil", Kind.TEMPERATURE), Channel("p", Kind.PRESSURE))
    values = np.tile(np.array([273.15 + 40.0, 2e7], np.float32), (100, 1))
    segment = Recording("log", channels, values, 100.0)
    for name in ("oil", "p"):
        module._delays(None, [segment], name, INJECTIONS[Change.SCALE], 0.1)
    after = [table[-1] for table in seen]
    # Up and down by a tenth: 44 and 36 degC, as the logger would show them, not 344 and 282 K.
    assert [row[0] - 273.15 for row in after[:2]] == pytest.approx([44.0, 36.0], abs=1e-3)
    assert [row[1] for row in after[2:]] == pytest.approx([2.2e7, 1.8e7])


def test_each_change_has_its_line_and_older_monitors_are_shifts(monitor):
    sizes = found_sizes(monitor.provenance)
    lines = promise_lines(sizes)
    assert [line.split(" of ")[0].rsplit(" ", 1)[1] for line in lines] == list(INJECTIONS)
    rows = [{k: v for k, v in row.items() if k != "change"} for row in monitor.provenance["found_sizes"]]
    assert {size.change for size in found_sizes({"found_sizes": rows})} == {Change.SHIFT}


def test_no_alarm_repeats_what_would_not_have_been_found(monitor, tmp_path):
    save_monitor(monitor, tmp_path / "monitor")
    assert found_sizes(load_monitor(tmp_path / "monitor").provenance) == found_sizes(monitor.provenance)
    (tmp_path / "logs").mkdir()
    write_recording(rig_sessions(1, 2000, seed=11)[0], tmp_path / "logs/quiet.parquet")
    run = run_monitor(tmp_path / "monitor", DataSource(tmp_path / "logs"), tmp_path / "run")
    assert not run.alarms
    assert re.search(r"with 4 healthy minutes a shift of .* would not have been found", run.silence[-1])
    page, facts = report_monitor(tmp_path / "run")
    assert any(line.startswith("What silence does not exclude: with 4 healthy minutes") for line in verdict(facts))
    assert "would not have been found" in page.read_text(encoding="utf-8")


def test_a_residual_outside_of_its_range_is_named_without_an_alarm(monitor):
    reach = monitor.provenance["healthy_range"]
    healthy = np.array(reach["means"])
    rows = np.tile(healthy, (5, 1))
    assert outside_line(monitor, rows) == ""
    place = int(healthy.argmax())
    rows[:, place] *= 1.1 * reach["limit"]
    assert f"{monitor.summary_names[place]} lies outside of its healthy range" in outside_line(monitor, rows)
    assert outside_line(replace(monitor, provenance={}), rows) == ""
    quiet = [monitor.watch(session).rows for session in rig_sessions(6, 2000, seed=21)]
    assert sum(bool(outside_line(monitor, session.astype(float))) for session in quiet) <= 1


def test_the_headline_does_not_hide_it(monitor, tmp_path, monkeypatch):
    save_monitor(monitor, tmp_path / "monitor")
    (tmp_path / "logs").mkdir()
    write_recording(rig_sessions(1, 2000, seed=11)[0], tmp_path / "logs/quiet.parquet")
    module = importlib.import_module("edp.workflows.monitor.run_monitor")
    monkeypatch.setattr(module, "outside_line", lambda *_: "x lies outside")
    run = run_monitor(tmp_path / "monitor", DataSource(tmp_path / "logs"), tmp_path / "run")
    assert "no alarm, but x lies outside" in run.silence[0]
    assert headline(report_monitor(tmp_path / "run")[1]).endswith("but residuals lie outside of their healthy range")
