"""Alarms of a monitor as events of MDF 4 files."""

from dataclasses import replace

import pytest

from edp.logs import read_recording
from edp.monitor.alarms import MonitorAlarm
from edp.testing.monitor import rig_sessions
from edp.workflows.monitor.event_files import write_event_files

pytestmark = pytest.mark.processes

asammdf = pytest.importorskip("asammdf", reason="needs the package asammdf: the extra mdf has it")


def test_every_log_has_its_alarms_and_hostile_names_stay_in_the_folder(tmp_path):
    first, second, third = rig_sessions(3, 300)
    recordings = [replace(first, name="../a b"), replace(second, name="../a b"), replace(third, name="quiet")]
    alarm = MonitorAlarm(
        "../a b", 2.0, 0.5, "cusum 1", 9.0, 8.0, (("virtual:pressure_a.mean", 5.0),), sentence="9 bar high"
    )
    files = write_event_files([alarm], recordings, tmp_path / "events")
    assert [path.name for path in files] == ["__a_b.mf4", "__a_b_1.mf4", "quiet.mf4"]
    assert sorted(path.name for path in tmp_path.rglob("*.mf4")) == sorted(path.name for path in files)
    with asammdf.MDF(files[0]) as log:
        begin, end = log.events
        assert begin.name == "warning: virtual:pressure_a.mean"
        assert (begin.value, end.value) == pytest.approx((0.5, 2.0))
        assert "9 bar high" in begin.comment
    with asammdf.MDF(files[2]) as log:
        assert log.events == []
    assert (read_recording(files[2]).values == recordings[2].values).all()
