"""What a monitor finds with its healthy logs: measured by shifts, and repeated where it raises no alarm."""

import importlib
import re
from dataclasses import replace

import numpy as np
import pytest
from small_monitors import fitted_monitor

from edp.logs import write_recording
from edp.logs.source import DataSource
from edp.monitor.detectable import FACTORS, found_sizes, measure_found_sizes, outside_line, unseen_line
from edp.monitor.monitor_file import load_monitor, save_monitor
from edp.report.monitor.facts import headline, verdict
from edp.testing.monitor import rig_sessions
from edp.workflows.monitor import report_monitor, run_monitor


@pytest.fixture(scope="module")
def monitor():
    return fitted_monitor()


def shifted(session, name, size):
    values = session.values.copy()
    values[len(values) // 3 :, session.index(name)] += np.float32(size)
    return replace(session, values=values)


def test_every_channel_has_a_size_with_its_trials_and_minutes(monitor):
    sizes = found_sizes(monitor.provenance)
    assert [size.channel for size in sizes] == list(monitor.inputs)
    assert all(size.trials >= 2 and size.minutes == pytest.approx(4.0) for size in sizes)
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
    assert measure_found_sizes(monitor, loud, 4.0, lambda text: None) == []
    assert unseen_line([]) == ""


def test_work_is_bounded_by_bisection(monitor, monkeypatch):
    calls = []
    watch = type(monitor).watch
    monkeypatch.setattr(type(monitor), "watch", lambda self, *a: calls.append(1) or watch(self, *a))
    segments = rig_sessions(1, 2000, seed=5)
    measure_found_sizes(monitor, segments, 4.0, lambda text: None)
    steps = int(np.ceil(np.log2(len(FACTORS) + 1)))
    assert len(calls) <= 1 + 2 * steps * len(monitor.inputs)


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
