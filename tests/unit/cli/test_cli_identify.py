"""``edp calibrate``: from logs to a machine file that ``edp simulate`` takes, and what it refuses."""

import re
import shutil
import sys
from importlib import resources

import numpy as np
import pytest

import edp.workflows.identify  # noqa: F401  so that its module is there to be changed
from edp.config.twin import load_twin_experiment
from edp.errors import ConfigError
from edp.jobs import IN_PROCESS
from edp.logs import read_recording, write_recording
from edp.logs.source import DataSource
from edp.sim.data_set import SimulationOrder, simulate_data_set
from edp.sim.machine.machine_files import load_machine
from edp.storage import read_json
from edp.storage.run_listing import list_runs
from edp.workflows.twin import train_twin

SMALL = (
    *("twin.fit.lengths_s=[0.1, 0.3]", "twin.fit.rounds=[1, 1]", "twin.fit.starts=1", "twin.fit.ticks=600"),
    *("twin.fit.final_rounds=1", "twin.fit.final_ticks=600"),
    *("twin.fit.validation_s=1", "twin.fit.validation_runs=2", "twin.inertia_degree=1"),
    *(
        "evaluation.duration_s=2",
        "evaluation.starts=3",
        "evaluation.at_s=[1, 2]",
        "evaluation.calibration_starts=2",
        'evaluation.baselines=["static"]',
    ),
)
WORDS = [word for change in SMALL for word in ("--set", change)]
LINKED = [word for change in SMALL if "degree" not in change for word in ("--set", change)]
"""Without degrees of polynomials, so that bodies of the guess's linkage are the load."""


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("fronts")
    simulate_data_set(folder, SimulationOrder(minutes=5.0, recordings=10, seed=1), workers=IN_PROCESS)
    return folder


def test_a_machine_file_is_written_that_simulates_and_says_what_is_told(edp, logs, tmp_path):
    file = tmp_path / "mine.toml"
    ended = edp("calibrate", logs, "--out", file, *LINKED, "--json")
    # The guess is the machine of these logs, and nothing is nearer to them: it is said, and scripts see it.
    assert (ended.code, ended.json["beaten_by"]) == (6, "machine M22"), ended.err
    machine = load_machine(str(file))
    assert machine.name == "mine"
    assert machine.bodies != load_machine("M22").bodies
    assert machine.bodies.length == load_machine("M22").bodies.length
    base = load_machine("M22")
    assert (machine.cylinders.bore, machine.boom_cylinder) == (base.cylinders.bore, base.boom_cylinder)
    facts = read_json(tmp_path / "mine.json")
    assert set(facts["models"]) == {"identified machine", "machine M22", "grey box", "static map"}
    rows = {row["label"]: row for row in facts["numbers"]}
    assert len(rows) == len(ended.json["numbers"])
    unexcited = [row for row in rows.values() if not row["excited"] and not row["label"].startswith("bodies")]
    # Port reliefs open in no free move of 24 s.
    assert not rows["valves.port_relief_head[bucket]"]["excited"]
    assert all(row["value"] == pytest.approx(row["base"], rel=1e-6) for row in unexcited)
    text = file.read_text()
    assert "kept, not told by the logs" in text
    assert "valves.meter_in_extend" not in text
    # The simulator itself, driven by the commands from measured starts, follows its own recordings.
    own = facts["models"]["machine M22"]
    assert own["velocity_mae"]["mean"] < 1.0
    assert own["stroke_error"][-1]["mean"] < 1.0
    assert edp("simulate", tmp_path / "data", "--machine", file, "--duration", "0.05min", "--recordings", 1).code == 0


def test_a_run_of_a_grey_box_is_taken_and_one_of_another_kind_refused(edp, logs, tmp_path, monkeypatch):
    def refused(nine, guess):
        raise ConfigError("no rigid bodies have this load")

    # As after a fit as short as this one: its load may be one that no bodies have, and the guess's bodies stay.
    monkeypatch.setattr(sys.modules["edp.workflows.identify.identify"], "realise_bodies", refused)
    for kind, file in (("greybox", "grey"), ("static", "map")):
        settings = [f"twin.kind={kind}", *(word for word in SMALL if kind == "greybox" or "twin." not in word)]
        train_twin(DataSource.from_path(logs), load_twin_experiment(None, settings), tmp_path / file)
    ended = edp("calibrate", logs, "--out", tmp_path / "mine.toml", "--run", tmp_path / "grey")
    assert ended.code == 6, ended.err
    assert "machine M22 has" in ended.out.splitlines()[0]
    assert "less error than the machine file" in " ".join(ended.out.split())
    assert re.search(r"\d+ of \d+ numbers are told by the logs", ended.out)
    assert "next: edp simulate" in ended.out
    assert load_machine(str(tmp_path / "mine.toml")).bodies == load_machine("M22").bodies
    facts = read_json(tmp_path / "mine.json")
    assert "bodies are those of machine M22: no rigid bodies have this load" in facts["notes"]
    rows = [row for row in facts["numbers"] if row["label"].startswith("bodies")]
    assert len(rows) == 9
    assert all(row["value"] == row["low"] == row["high"] == row["base"] and not row["excited"] for row in rows)
    ended = edp("calibrate", logs, "--out", tmp_path / "other.toml", "--run", tmp_path / "map")
    assert ended.code == 1
    assert "holds a twin of kind 'static'" in ended.err
    assert not (tmp_path / "other.toml").exists()
    ended = edp("calibrate", logs, "--out", tmp_path / "other.toml", "--run", tmp_path / "grey", *WORDS)
    assert "a run keeps its own" in " ".join(ended.err.split())


def test_logs_and_machines_that_do_not_fit_are_refused_and_nothing_is_written(edp, logs, tmp_path):
    bare = tmp_path / "bare"
    bare.mkdir()
    for path in sorted(logs.glob("*.parquet"))[:4]:
        recording = read_recording(path)
        names = [name for name in recording.channel_names if not name.startswith(("CylPressures", "PumpPressure"))]
        columns = tuple(recording.channels[recording.index(name)] for name in names)
        values = np.ascontiguousarray(recording.select(names))
        write_recording(
            type(recording)(recording.name, columns, values, recording.rate_hz, recording.source), bare / path.name
        )
    cases = [
        ((bare, "--out", tmp_path / "a.toml"), "0 pressures of the boom cylinder"),
        ((logs, "--out", tmp_path / "a.toml", "--machine", "C14"), "goes from"),
        ((logs, "--out", tmp_path / "a.txt"), "a machine file ends in .toml"),
        ((logs, "--out", tmp_path / "a.toml", "--machine", "M23"), "unknown machine 'M23'"),
    ]
    for words, message in cases:
        ended = edp("calibrate", *words, *WORDS)
        assert ended.code == 1
        assert message in " ".join(ended.err.split())
    assert not [path for path in tmp_path.iterdir() if path.suffix]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("twin.kind=residual", "twin.kind = 'residual' came"),
        ('twin.motors=[{name="swing", velocity="rate"}]', "the grey box has motors; a machine of the simulator has"),
        ("twin.linkage=c14", "the linkage is that of --machine (M22): leave twin.linkage out"),
        ('twin.omit=["play"]', "twin.omit = ['play'] leaves out numbers that a machine file has"),
    ],
)
def test_what_is_no_whole_grey_box_is_refused_before_any_fit(edp, logs, tmp_path, change, message):
    kind = () if "kind" in change else ("--set", "twin.kind=greybox")
    ended = edp("calibrate", logs, "--out", tmp_path / "mine.toml", *kind, "--set", change)
    assert ended.code == 1
    assert message in " ".join(ended.err.split())
    assert not list(tmp_path.glob("mine*"))


@pytest.mark.parametrize("there", ["mine.toml", "mine.json"])
def test_no_file_is_written_over(edp, logs, tmp_path, there):
    """Nor the machine file that the guess comes from; said before any fit."""
    (tmp_path / there).write_text("what a tape measure told")
    ended = edp("calibrate", logs, "--out", tmp_path / "mine.toml")
    assert ended.code == 1
    assert "is there already and is not written over" in " ".join(ended.err.split())
    assert (tmp_path / there).read_text() == "what a tape measure told"


def test_a_twin_with_a_linkage_is_another_one_once_its_machine_file_changes(edp, logs, tmp_path):
    file, run = tmp_path / "front.toml", tmp_path / "run"
    text = (resources.files("edp.sim") / "machines" / "m22.toml").read_text()
    file.write_text(text)
    kind = ("--set", "twin.kind=greybox", "--set", f"twin.linkage={file}")
    words = ("twin", logs, "--out", run, *kind, *LINKED)
    ended = edp(*words)
    # 6: on logs as short as these a floor may win.
    assert ended.code in (0, 6), ended.err
    assert "boom_body.mass" in (run / "datasheet.txt").read_text()
    longer = text.replace("rod_radius = 2.484", "rod_radius = 2.494")
    assert longer != text
    file.write_text(longer)
    assert edp(*words).code == 1
    # Lengths of one machine and bodies of another are no machine.
    ended = edp("calibrate", logs, "--out", tmp_path / "mine.toml", "--run", run, "--machine", file)
    assert ended.code == 1
    assert "which is not that of --machine (M22): give the same machine" in " ".join(ended.err.split())
    ended = edp("calibrate", logs, "--out", tmp_path / "mine.toml", "--run", run)
    assert ended.code in (0, 6), ended.err  # the guess is the machine of these logs, and may be nearer
    assert load_machine(str(tmp_path / "mine.toml")).bodies != load_machine("M22").bodies


def test_a_stopped_identification_continues_with_the_stages_that_it_has(logs, tmp_path, monkeypatch):
    module, fits = sys.modules["edp.workflows.identify.identify"], []
    fit, scores = module.fit_grey_box, module._scores

    def counted(*arguments):
        fits.append(arguments)
        return fit(*arguments)

    def stopped(*arguments):
        raise KeyboardInterrupt

    def identified(folder):
        settings = load_twin_experiment(None, ["twin.kind=greybox", *SMALL])
        return module.identify(DataSource.from_path(logs), tmp_path / folder / "mine.toml", experiment=settings)

    monkeypatch.setattr(module, "fit_grey_box", counted)
    monkeypatch.setattr(module, "_scores", stopped)
    with pytest.raises(KeyboardInterrupt):
        identified("first")
    assert not (tmp_path / "first" / "mine.toml").exists()
    (row,) = list_runs(tmp_path)[0]
    assert (row.kind, row.state) == ("identification", "stopped")
    shutil.copytree(tmp_path / "first", tmp_path / "second")
    monkeypatch.setattr(module, "_scores", scores)
    first, second = identified("first"), identified("second")
    # The grey box and the machine were fitted once each, before the stop.
    assert len(fits) == 2
    assert (first.rows, first.scores, first.notes) == (second.rows, second.scores, second.notes)
    assert (tmp_path / "first" / "mine.toml").read_text() == (tmp_path / "second" / "mine.toml").read_text()
    assert {run.state for run in list_runs(tmp_path)[0]} == {"finished"}
