"""An FMU of a monitor: measurements in; alarm, statistics and counts out."""

from __future__ import annotations

import zipfile

import numpy as np
import pytest

from edp.export.monitor import write_monitor_fmu
from edp.workflows.monitor.export_monitor import monitor_parts

fmpy = pytest.importorskip("fmpy", reason="needs FMPy: pip install 'excavator-dynamics-predictor[fmu]'")
from fmpy.validation import validate_fmu  # noqa: E402

BUILD = ("-std=c99", "-O1", "-ffp-contract=off", "-fvisibility=hidden", "-fPIC", "-shared")


@pytest.fixture(scope="module", params=["2", "3"])
def made(request, c, fmi, rig_monitor, tmp_path_factory):
    c.need("gcc")
    folder, version = tmp_path_factory.mktemp("watch"), request.param
    parts = monitor_parts(rig_monitor, golden=False)
    (path,) = write_monitor_fmu(parts, "watch", folder, {"version": version, "binaries": "none"})
    assert validate_fmu(str(path)) == []
    with zipfile.ZipFile(path) as archive:
        archive.extractall(folder)
    target = folder / "binaries" / fmi.folders[int(version)]
    target.mkdir(parents=True)
    listed = fmi.sources(folder, int(version))
    c.run("gcc", *BUILD, *listed, "-lm", "-o", target / "watch.so", folder=folder / "sources")
    return fmi.Unit(folder, int(version)).start()


def test_it_finds_what_python_finds(made, rig_monitor, rig_fault):
    verdicts, _ = rig_monitor.advance(rig_fault, rig_monitor.initial_state())
    alarms = [verdict.block for verdict in verdicts if verdict.alarm is not None]
    limit, block = rig_monitor.chain.limit, rig_monitor.chain.summaries.block
    names = [f"statistic_{i}" for i in range(len(rig_monitor.chain.watches))]
    counted, largest = [], []
    for row in rig_fault:
        made.set(row)
        assert made.go() == 0
        counted.append(made.get([made.refs["alarms"]])[0])
        largest.append(made.get([made.refs[name] for name in names]).max())
    raised = int(np.argmax(np.array(counted) > 0))
    assert raised // block == alarms[0]
    assert max(largest[: raised - 1]) <= 1.0 < largest[raised]
    expected = max(verdicts[alarms[0] - 1].statistics) / limit
    assert largest[raised] == pytest.approx(expected, rel=1e-2)
    assert made.get([made.refs["alarm"]])[0] in (0.0, 1.0)
    assert made.get([made.refs["since_s"]])[0] >= 0.0


def test_an_input_that_is_missing_is_said_and_silences_its_residuals(made, rig_fault):
    row = rig_fault[0].copy()
    row[2] = np.nan
    before = made.whole("rejected")
    made.set(row)
    assert made.go() == 1
    assert any("is nan" in text for _, text in made.told)
    assert made.whole("status") == 2
    assert not made.valid
    assert made.whole("rejected") == before + 1
    assert made.get([made.refs["silent"]])[0] > 0
    made.set(rig_fault[0])
    assert made.go() == 0
    assert made.get([made.refs["silent"]])[0] == 0


def test_its_page_tells_its_own_rules(made):
    page = (made.folder / "documentation" / "index.html").read_text()
    assert "After an alarm the detectors begin anew" in page
    assert "last accepted inputs" not in page
