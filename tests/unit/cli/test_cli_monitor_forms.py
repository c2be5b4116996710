"""What is made of a monitor from the command line: C, a footprint, MDF files with its alarms."""

import json
from dataclasses import replace

import pytest
from small_monitors import fitted_monitor

from edp.logs import write_recording
from edp.monitor.monitor_file import save_monitor
from edp.signals import VOCABULARY
from edp.testing.monitor import rig_sessions

pytestmark = pytest.mark.long
NAMES = ("BmUp", "CylVels_1", "CylStroke_1", "CylPressures_1", "CylPressures_5")
"""Of the rig's channels, so that logs need no map."""


def logs(count, first=0):
    channels = tuple(VOCABULARY[name] for name in NAMES)
    return [replace(session, channels=channels) for session in rig_sessions(count, 2000, seed=4, first=first)]


@pytest.fixture(scope="module")
def monitor(tmp_path_factory):
    return save_monitor(fitted_monitor(logs(12)), tmp_path_factory.mktemp("monitors") / "rig")


def test_export_tells_a_monitor_by_its_folder(edp, monitor, tmp_path):
    ended = edp("export", monitor, "--to", "c", "--out", tmp_path / "c")
    assert ended.code == 0, ended.err
    assert "read monitor.h first" in ended.out
    assert (tmp_path / "c" / "host_test.c").is_file()
    ended = edp("export", monitor, "--to", "ros2", "--out", tmp_path / "ros2", "--name", "watch", "--json")
    assert ended.code == 0, ended.err
    assert json.loads(ended.out)["name"] == "watch"
    for form, options, text in (
        ("onnx", (), "a monitor has no form 'onnx'"),
        ("c", ("--set", "tangent=true"), "no such option"),
        ("c", ("--w8a16", monitor), "only twins"),
    ):
        ended = edp("export", monitor, "--to", form, "--out", tmp_path / "no", *options)
        assert (ended.code, text in ended.err) == (1, True), ended.err
    assert not (tmp_path / "no").exists()


def test_footprint_counts_networks_and_what_stands_behind_them(edp, monitor):
    ended = edp("compress", "estimate", monitor, "--json")
    assert ended.code == 0, ended.err
    facts = json.loads(ended.out)
    assert len(facts["networks"]) >= 2
    assert facts["chain"]["most"] > facts["chain"]["mean"] > 0
    assert {row["what"] for row in facts["verdict"]} == {"cycles per tick", "parameters", "RAM", "flash"}
    shown = edp("compress", "estimate", monitor)
    assert "behind the residuals, in double precision" in shown.out


def test_logs_are_written_with_their_alarms_as_events(edp, monitor, tmp_path):
    asammdf = pytest.importorskip("asammdf", reason="needs the package asammdf: the extra mdf has it")
    (session,) = logs(1, first=20)
    values = session.values.copy()
    values[1000:, NAMES.index("CylPressures_1")] += 2e6
    write_recording(replace(session, values=values), tmp_path / "faulty.parquet")
    ended = edp("monitor", "run", monitor, tmp_path / "faulty.parquet", "--mdf", tmp_path / "events")
    assert ended.code == 5, ended.err
    assert "alarms as events" in ended.out
    (file,) = (tmp_path / "events").glob("*.mf4")
    with asammdf.MDF(file) as log:
        assert len(log.events) >= 2
        # Detectors see the fault within two seconds of its onset at 10 s.
        assert any(9.0 < event.value < 12.0 for event in log.events)
