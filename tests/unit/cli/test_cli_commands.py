"""Each command: its help, its JSON, its exit code, and what it leaves on disk."""

import json
import re
import subprocess
import sys

import numpy as np
import pytest
from typer.main import get_command

from edp import __version__
from edp.cli import PANELS, app, demo
from edp.cli import train as train_command
from edp.cli.console import duration
from edp.logs import read_recording
from edp.logs.source import DataSource
from edp.signals import TABLE_A1
from edp.storage import read_json
from edp.training import load_bundle
from edp.workflows.parity import record_case

LIMIT = [w for s in ("moments=4", "branches=4", "horizons=[1,10]") for w in ("--set", f"limit.{s}")]
EXPECTED = {
    *("init", "demo", "doctor", "data check", "data screen", "data animate", "data add-forecasts", "data store build"),
    *("data store verify", "train run", "train finetune", "train pretrain", "twin", "search run", "search status"),
    *("search report", "search export", "evaluate", "compare", "report", "runs", "rollout", "compress distil"),
    *("compress quantise", "compress search", "compress estimate", "export", "verify", "adapt run", "adapt replay"),
    *("simulate", "calibrate", "loop run", "loop tune", "monitor fit", "monitor run", "monitor report", "live"),
    *("fleet report", "fleet network", "registry add", "registry list", "registry show"),
}
DIRECT = ("train", "search", "adapt")
"""Groups that take data directly."""


def leaves(node, words=()):
    below = getattr(node, "commands", None)
    if below is None:
        yield " ".join(words)
    else:
        for name, inner in below.items():
            yield from leaves(inner, (*words, name))


COMMANDS = list(leaves(get_command(app)))


def test_all_commands_are_known_here():
    assert set(COMMANDS) == EXPECTED


@pytest.mark.parametrize("command", COMMANDS)
def test_help_shows_an_example_the_exit_codes_and_the_json_option(edp, command):
    ended = edp(*command.split(), "--help")
    assert ended.code == 0
    words = " ".join(ended.out.split())
    assert "Example: " in words
    group = command.removesuffix(" run")
    assert f"edp {group if group in DIRECT else command}" in words
    assert "Exit codes:" in words
    assert "--json" in words


def test_panels_stand_in_the_order_of_the_work(edp):
    shown = edp("--help").out
    places = [re.search(rf"^\W+ {panel} \W+$", shown, re.MULTILINE).start() for panel, _ in PANELS]
    assert places == sorted(places)


def test_version_and_an_unknown_command(edp):
    assert edp("--version").out.strip() == __version__
    ended = edp("tran")
    assert ended.code == 2
    assert "train" in ended.err


def test_help_needs_no_heavy_packages():
    code = "import sys; from edp.cli import app; print([n for n in ('torch', 'plotly', 'pyarrow') if n in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_whole_path_from_the_simulator_to_the_page(edp, tmp_path, small):
    data, run = tmp_path / "data", tmp_path / "run"
    made = edp("simulate", data, "--duration", "0.8min", "--recordings", 4, "--seed", 3, "--workers", 1, "--json").json
    assert made["recordings"] == 4
    assert len(list(data.glob("*.parquet"))) == 4

    seen = edp("data", "check", data, "--json")
    assert (seen.code, seen.json["errors"], len(seen.json["recordings"])) == (0, 0, 4)

    trained = edp("train", data, "--out", run, *small, "--json").json
    assert trained["run"] == str(run)
    assert trained["validation_mae"] > 0

    scores = edp("evaluate", run, "--baselines", "persistence,ridge_arx", "--json").json
    assert sorted(scores["models"]) == ["network", "persistence", "ridge_arx"]

    page = edp("report", run, "--json").json
    assert (run / "report.html").read_text(encoding="utf-8").lower().startswith("<!doctype html>")
    # Five updates make a network that may lose to a line, which the headline then says.
    assert "ahead" in page["headline"] or "less error than the network" in page["headline"]

    counts = edp("compress", "estimate", run / "bundle", "--json").json
    assert counts["parameters"] == trained["parameters"]

    kept = edp("simulate", data, "--duration", "0.8min", "--recordings", 4, "--seed", 3)
    assert kept.code == 0
    other = edp("simulate", data, "--duration", "0.8min", "--recordings", 4, "--seed", 4)
    assert other.code == 1
    assert "another simulated data set" in other.err


def test_output_for_people_names_the_next_command(edp, logs, trained, tmp_path, small):
    assert f"edp train {logs}" in edp("data", "check", logs, "--no-details").out
    assert "edp evaluate" in edp("train", logs, "--out", tmp_path / "run", *small).out
    judged = edp("evaluate", trained, "--baselines", "persistence").out
    assert "100 ms ahead (k = 10)" in judged
    assert f"edp report {trained}" in judged
    assert "report.html" in edp("report", trained).out
    assert "MACs per tick" in edp("compress", "estimate", trained).out
    assert "read predictor.h first" in edp("export", trained, "--to", "c", "--out", tmp_path / "c").out


def test_export_lists_its_files(edp, trained, tmp_path):
    made = edp("export", trained / "bundle", "--to", "c", "--out", tmp_path / "c", "--name", "arm", "--json").json
    there = {str(file) for file in (tmp_path / "c").iterdir()}
    assert {*made["files"], str(tmp_path / "c" / "export.sha256")} == there
    assert str(tmp_path / "c" / "arm_golden.h") in made["files"]


def test_export_to_onnx_takes_an_opset(edp, trained, tmp_path):
    pytest.importorskip("onnx", reason="needs the extra onnx")
    shown = edp("export", trained, "--to", "onnx", "--set", "opset=11", "--out", tmp_path / "onnx").out
    assert "read predictor.json first" in shown
    described = json.loads((tmp_path / "onnx" / "predictor.json").read_text())
    assert described["graphs"]["step"]["opset"] == 11


def test_json_of_a_process_is_all_of_standard_output(trained):
    command = [sys.executable, "-m", "edp", "report", str(trained), "--json"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert json.loads(done.stdout)["report"] == str(trained / "report.html")
    assert done.stderr == ""


def test_report_states_a_budget_where_one_is_given(edp, trained, tmp_path):
    """Limits of a controller stand on the page of a run once `--budget` names the controller."""
    page = trained / "report.html"
    edp("report", trained)
    assert "loader board" not in page.read_text(encoding="utf-8")
    board = tmp_path / "board.toml"
    board.write_text('name = "loader board"\nram_bytes = 12345\n')
    edp("report", trained, "--budget", board)
    shown = page.read_text(encoding="utf-8")
    assert "loader board" in shown
    assert "12,345" in shown


@pytest.mark.parametrize(
    ("content", "said"),
    [("ram_bytes = -1", "ram_bytes"), ("ram = 3", "ram"), ("[[", "board.toml"), (None, "board.toml")],
)
def test_report_refuses_a_file_that_is_no_budget(edp, trained, tmp_path, content, said):
    board = tmp_path / "board.toml"
    if content is not None:
        board.write_text(content)
    kept = {path.name: path.read_bytes() for path in trained.iterdir() if path.is_file()}
    ended = edp("report", trained, "--budget", board)
    assert ended.code == 2 or ended.code == 1
    assert said in ended.err
    assert "Traceback" not in ended.err
    assert {path.name: path.read_bytes() for path in trained.iterdir() if path.is_file()} == kept


def test_demo_runs_its_four_steps(edp, tmp_path, monkeypatch, small):
    monkeypatch.setattr(demo, "MINUTES", 0.8)
    monkeypatch.setattr(demo, "RECORDINGS", 4)
    whole, fewer = train_command.run, 'evaluation.baselines=["persistence", "ridge_arx"]'

    def shorter(data, run, *, preset, changes, quiet):
        return whole(data, run, preset=preset, changes=[*changes, *small[3::2], fewer], quiet=quiet)

    monkeypatch.setattr(train_command, "run", shorter)
    shown = edp("demo", "--out", tmp_path / "demo", "--json").json
    assert {"network", "persistence", "ridge_arx"} <= set(shown["scores"]["models"])
    assert (tmp_path / "demo" / "run_0" / "report.html").is_file()
    again = edp("demo", "--out", tmp_path / "demo")
    assert again.code == 0
    for step in ("1/4", "2/4", "3/4", "4/4", "open the report"):
        assert step in again.out


def test_inspection_of_a_faulty_log_ends_with_code_3(edp, tmp_path):
    log = tmp_path / "drive.csv"
    log.write_text("time,CylVels_1\n0,1\n0.01,\n0.02,2\n0.03,2\n")
    ended = edp("data", "check", log, "--json")
    assert ended.code == 3
    assert ended.json["errors"] == 1
    assert "--repair" in ended.err


def test_other_recordings_can_be_judged(edp, logs, trained):
    found = edp("evaluate", trained, "--data", logs / "drive_1.parquet", "--baselines", "persistence", "--json").json
    assert found["folder"] == str(trained / "on_drive_1")
    assert (trained / "on_drive_1" / "scores.json").is_file()


def test_several_logs_are_judged_together_in_a_folder_of_their_own(edp, logs, trained):
    two = ("--data", logs / "drive_1.parquet", "--data", logs / "drive_2.parquet")
    found = edp("evaluate", trained, *two, "--baselines", "persistence", "--json").json
    assert found["folder"].startswith(str(trained / "on_drive_1_and_1_more_"))
    assert set(found["models"]["network"]["recordings"]) == {"drive_1", "drive_2"}


def test_the_reference_recording_of_parity_is_a_part_of_each_log(logs, trained):
    bundle, paths = load_bundle(trained), [logs / "drive_1.parquet", logs / "drive_2.parquet"]
    case = record_case(bundle, DataSource.from_path(paths), 61)
    parts = [
        record_case(bundle, DataSource.from_path(path), ticks) for path, ticks in zip(paths, (31, 30), strict=True)
    ]
    assert np.array_equal(case.inputs, np.concatenate([part.inputs for part in parts]))


def test_the_importance_of_channels_is_reported(edp, logs, trained):
    few = ("--baselines", "persistence", "--channel-importance")
    found = edp("evaluate", trained, *few, "--json").json
    assert found["channel_importance"] == {
        k: v for k, v in read_json(trained / "channel_importance.json").items() if k != "schema"
    }
    assert {tuple(row["members"]) for row in found["channel_importance"]["rows"]} >= {(name,) for name in TABLE_A1}
    told = edp("evaluate", trained, *few)
    assert "channel importance: 0/24 removed" in told.err
    assert "without the channel" in told.out
    other = edp("evaluate", trained, *few, "--data", logs / "drive_1.parquet", "--json").json
    assert (trained / "on_drive_1" / "channel_importance.json").is_file()
    assert other["channel_importance"]["recordings"] == ["drive_1"]


@pytest.mark.parametrize(
    ("seconds", "text"), [(0.2, "0 s"), (59.6, "1 min 00 s"), (200, "3 min 20 s"), (3900, "1 h 05 min")]
)
def test_durations_read_well(seconds, text):
    assert duration(seconds) == text


def test_a_scenario_file_and_its_limit_of_predictability(edp, tmp_path):
    file = tmp_path / "set.toml"
    file.write_text('minutes = 5\nrecordings = 2\nseed = 4\n[mix]\nisolated = 1\n[files]\nformat = "csv"\n')
    command = ("simulate", tmp_path / "data", "--scenario", file, "--duration", "0.4min", "--workers", 1)
    asked = ("--limit", *LIMIT)
    made = edp(*command, *asked, "--json").json
    assert (made["minutes"], made["seed"], made["recordings"]) == (0.4, 4, 2)
    assert len(list((tmp_path / "data").glob("*.csv"))) == 2
    assert made["limit"]["horizons"] == [1, 10]
    assert read_json(tmp_path / "data" / "limit.json") == made["limit"]
    shown = edp(*command, *asked).out
    assert "10 (100 ms)" in shown
    assert "commands known" in shown
    assert "write it without quotes" in edp(*command, "--limit", "--set", "limit.horizons=[1,x]").err
    assert "must be even" in edp(*command, "--limit", "--set", "limit.branches=5").err
    assert "unknown key 'limit.branch'" in edp(*command, "--limit", "--set", "limit.branch=5").err


def test_faults_of_the_command_line_take_the_place_of_those_of_the_file(edp, tmp_path):
    file = tmp_path / "set.toml"
    file.write_text('minutes = 0.05\nrecordings = 1\n[[faults]]\nkind = "cooler"\nsize = 50\nunit = "%"\n')
    command = ("simulate", tmp_path / "data", "--scenario", file, "--workers", 1)
    refused = edp(*command, "--fault", "internal_leek:boom:3L/min@1s")
    assert refused.code == 1
    assert "did you mean 'internal_leak'" in refused.err
    assert not (tmp_path / "data").exists()
    asked = ("--fault", "internal_leak:boom:3L/min@1s", "--fault", "velocity_stuck:arm@2s")
    made = edp(*command, *asked, "--json").json
    assert made["faults"] == ["internal_leak:boom:3.0L/min@1.0s", "velocity_stuck:arm@2.0s"]
    (log,) = (tmp_path / "data").glob("*.parquet")
    recording = read_recording(log)
    assert [table["kind"] for table in recording.meta["faults"]] == ["internal_leak", "velocity_stuck"]
    assert recording.select(["Fault_1", "Fault_2"]).sum(axis=0).tolist() == [200.0, 100.0]
    assert "fault: velocity_stuck:arm@2.0s" in edp(*command, *asked).out
    assert edp(*command).code == 1


def test_soil_family_and_format_of_the_command_line_go_before_the_scenario_file(edp, tmp_path):
    file = tmp_path / "set.toml"
    text = 'machine = "C14"\nminutes = 5\nrecordings = 2\n[mix]\ndig = 1\n[materials]\nclay = 1\n'
    file.write_text(text + '[files]\nformat = "mat"\nlayout = "speedgoat"\n')
    options = ("--family", 2, "--set", "masses=[12,20]", "--material", "gravel", "--format", "parquet", "--workers", 1)
    made = edp("simulate", tmp_path / "data", "--scenario", file, "--duration", "0.2min", *options, "--json")
    assert made.json["machine"] == "2 machines"
    assert "note: layout 'speedgoat' is one of MAT files, and format parquet was asked for" in made.err
    names = sorted(path.name for path in (tmp_path / "data").glob("*.parquet"))
    assert names == ["family-0-0-12-20_000_dig_gravel.parquet", "family-0-1-12-20_001_dig_gravel.parquet"]


def test_inspect_shows_and_draws_what_the_data_cover(edp, logs, tmp_path):
    page = tmp_path / "coverage.html"
    shown = edp("data", "check", logs, "--details", "--split", "time", "--page", page)
    assert shown.code == 0
    assert "smallest singular value" in shown.out
    assert "test to train, median" in shown.out
    assert "not met" in shown.out
    assert page.read_text(encoding="utf-8").lower().startswith("<!doctype html>")
    plain = edp("data", "check", logs, "--json").json
    assert plain["coverage"]["recordings"] == len(plain["recordings"])
    assert not all(figure["met"] for figure in plain["coverage"]["wanted"])
    assert edp("data", "check", logs, "--no-coverage", "--json").json["coverage"] is None
    wrong = edp("data", "check", logs, "--inputs", "BmUpp")
    assert wrong.code == 1
    assert "did you mean 'BmUp'" in wrong.err
    assert "did you mean 'time'" in edp("data", "check", logs, "--split", "tme").err


def test_the_report_says_the_limit_of_a_simulated_data_set(edp, tmp_path, small):
    data, run = tmp_path / "data", tmp_path / "run"
    asked = ("--limit", *LIMIT)
    edp("simulate", data, "--duration", "0.8min", "--recordings", 4, "--seed", 3, "--workers", 1, *asked)
    edp("train", data, "--out", run, *small)
    edp("evaluate", run, "--baselines", "persistence")
    assert "limit of predictability here is" in " ".join(edp("report", run).out.split())
    assert "limit of predictability here is" in (run / "report.html").read_text(encoding="utf-8")


def test_parity_holds_every_form_against_pytorch(edp, trained, logs):
    found = json.loads(edp("verify", trained, "--form", "torch_ticks", "--form", "c", "--ticks", 80, "--json").out)
    assert found["failed"] == []
    assert {row["verdict"] for row in found["rows"]} <= {"same", "not run"}
    shown = edp("verify", trained, "--form", "torch_ticks", "--data", logs, "--ticks", 60).out
    assert "60 ticks against PyTorch" in shown


def test_distil_says_how_to_give_the_width_of_the_student(edp, tmp_path):
    refused = edp("compress", "distil", tmp_path, "--out", tmp_path / "small")
    assert refused.code == 1
    assert "the width of the student is missing; give it with --units, such as --units 64" in refused.err
