"""``edp loop run`` and ``edp loop tune``: run folders, pages, plants exchanged by one option, and what is refused."""

import json

import pytest

from edp.config.control import load_control_experiment
from edp.logs import read_recording
from edp.networks.twin import TWINS
from edp.settings.provenance import Provenance
from edp.testing.control import sample_excavator_twin, sample_grey_box
from edp.training.twin_bundle import TwinBundle, save_twin

pytestmark = pytest.mark.long
LINE = ("--set", "task.length_m=[0.4,0.5]", "--set", "task.hold_s=0.2", "--set", "task.lead_s=0.2")


@pytest.fixture(scope="module")
def twin_run(tmp_path_factory):
    run = tmp_path_factory.mktemp("twins") / "run"
    save_twin(TwinBundle(TWINS["static"](), sample_excavator_twin()), run / "twin")
    return run


def test_a_run_says_its_score_first_and_leaves_results_recordings_and_a_page(edp, tmp_path):
    run = tmp_path / "run"
    ended = edp("loop", "run", run, "--task", "grade", "--machine", "M22", "--controller", "pi", "--seeds", 2, *LINE)
    assert ended.code == 0
    first = ended.out.splitlines()[0]
    assert first.startswith("pi keeps the bucket tip")
    assert "in 2 loops of task 'grade'" in first
    results = json.loads((run / "results.json").read_text())
    assert results["sentence"] == first
    assert [loop["seed"] for loop in results["loops"]] == [0, 1]
    score = results["loops"][0]["score"]
    assert score["path_rms_mm"] <= score["position_rms_mm"]
    recording = read_recording(run / "loops" / "grade_1.parquet")
    assert {"Lever_1", "Reference_TipX", "TipX_true", "CylVels_1"} <= set(recording.channel_names)
    page = (run / "control.html").read_text()
    assert first.split(" from")[0] in " ".join(page.split())
    assert json.loads((run / "status.json").read_text())["status"] == "finished"


def test_a_twin_is_the_plant_with_one_option(edp, tmp_path, twin_run):
    ended = edp("loop", "run", tmp_path / "run", "--seeds", 1, "--plant", twin_run, *LINE, "--json")
    assert ended.code == 0
    assert ended.json["plant"] == "the twin"
    assert ended.json["summary"]["energy_kj"] is None


def test_the_controller_may_use_a_twin(edp, tmp_path, twin_run):
    ended = edp(
        "control", tmp_path / "run", "--controller", "inversion", "--twin", twin_run, "--seeds", 1, *LINE, "--json"
    )
    assert ended.code == 0
    assert ended.json["controller"]["kind"] == "inversion"


def test_a_controller_that_was_run_is_exported(edp, tmp_path, twin_run):
    run = tmp_path / "run"
    assert edp("loop", "run", run, "--seeds", 1, *LINE).code == 0
    ended = edp("export", run, "--to", "controller", "--out", tmp_path / "c")
    assert ended.code == 0
    assert "read machine_control.h first" in ended.out
    assert "next: cmake" in ended.out
    assert (tmp_path / "c" / "machine_control_golden.h").is_file()
    named = edp("export", run, "--to", "controller", "--out", tmp_path / "d", "--name", "grader", "--json")
    assert any(file.endswith("grader_control.c") for file in named.json["files"])
    assert "controller: C99" in edp("export", run, "--to", "c", "--out", run, "--forms").out
    for words, text in (
        ((run, "--w8a16", run), "only twins are brought into W8A16"),
        ((run, "--set", "tangent=true"), "no such option"),
        ((twin_run,), "give a folder that edp loop run wrote"),
    ):
        refused = edp("export", *words, "--to", "controller", "--out", tmp_path / "e")
        assert refused.code
        assert text in " ".join(refused.err.split())
    assert not (tmp_path / "e").exists()


def test_gains_are_tuned_on_a_twin_and_judged_on_the_simulator(edp, tmp_path, twin_run):
    run = tmp_path / "tuned"
    words = ("--on", twin_run, "--trials", 3, "--loops", 1, "--seeds", 3)
    ended = edp("loop", "tune", run, "--controller", "pi", *words, *LINE, "--json")
    assert ended.code in (0, 6)
    judged = ended.json["judged_mm"]
    assert len(judged["by_reference"]) == 3
    for when in ("before", "after"):
        assert judged[when] == pytest.approx(sum(pair[when] for pair in judged["by_reference"].values()) / 3)
    assert "change over 3 references" in ended.json["verdict_sentence"] or ended.code == 6
    costs = [trial["cost_mm"] for trial in ended.json["trials"]]
    assert len(costs) == 3
    assert ended.json["tuned_cost_mm"] == min(costs)
    best = ended.json["trials"][costs.index(min(costs))]["gains"]
    tuned = load_control_experiment(run / "tuned.toml")
    assert tuned.controller.proportional == pytest.approx(best["proportional"], abs=1e-6)
    # The present gains are the first ones that are tried.
    assert ended.json["trials"][0]["gains"]["proportional"] == load_control_experiment().controller.proportional
    again = edp("loop", "run", tmp_path / "run", "--config", run / "tuned.toml", "--json")
    assert again.json["summary"]["position_rms_mm"] == pytest.approx(ended.json["judged_mm"]["after"])


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--task", "grad"), "unknown task 'grad'; did you mean 'grade'?"),
        (("--controller", "pid"), "unknown controller 'pid'"),
        (("--machine", "M2"), "M2"),
        (("--controller", "inversion"), "needs a look-ahead predictor or a twin"),
        (("--controller", "inversion", "--predictor", "nowhere"), "there is no such folder"),
        (("--set", "task.slope=3"), "unknown key 'task.slope'"),
        (("--set", "task.limits.lever_low=[0,0,0]", "--set", "task.limits.lever_high=[0,1,1]"), "boom are both 0"),
        (("--set", "task.limits.stroke_margin=0.4"), "margin >= stroke_margin must hold"),
        (("--set", "task.limits.lever_high=[1,0.1,1]"), "limits: lever_high = 0.1 of the arm gives 0.000 m/s"),
        (("--set", "task.limits.pressure_pa=1e5"), "but the machine rests with CylPressures_1 at"),
        (("--set", "controller.proportional=-1"), "0 <= proportional <= 100 must hold"),
        (("--set", "task.length_m=[20,30]"), "none of 200 draws can be done"),
        (("--set", "deadline_ms=12"), "a tick has 10 ms at rate_hz = 100; give a deadline within it"),
        (("--controller", "nmpc"), "name its run folder with --twin"),
        (("--plant", "nowhere"), "nowhere"),
        (("--plant", "nowhere.fmu"), "there is no file"),
    ],
)
def test_mistakes_end_in_one_message(edp, tmp_path, words, message):
    ended = edp("loop", "run", tmp_path / "run", "--seeds", 1, *words)
    assert ended.code == 1
    assert ended.err.count("error:") == 1
    assert message in " ".join(ended.err.split())


def test_a_twin_of_another_rate_or_a_soil_is_refused(edp, tmp_path, twin_run):
    ended = edp("loop", "run", tmp_path / "a", "--plant", twin_run, "--seeds", 1, "--set", "rate_hz=50")
    assert "100 Hz" in ended.err
    ended = edp("loop", "run", tmp_path / "b", "--plant", twin_run, "--seeds", 1, "--task", "dig")
    assert "a twin knows no soil" in " ".join(ended.err.split())


def test_a_twin_of_another_machine_is_refused(edp, tmp_path):
    bundle = TwinBundle(
        TWINS["static"](), sample_excavator_twin(), Provenance(more={"full_strokes_m": [1.0, 1.0, 0.915]})
    )
    save_twin(bundle, tmp_path / "c14" / "twin")
    for words in (("--controller", "inversion", "--twin"), ("--plant",)):
        ended = edp("loop", "run", tmp_path / "run", "--seeds", 1, *LINE, *words, tmp_path / "c14")
        assert ended.code == 1
        said = " ".join(ended.err.split())
        assert "strokes of 1.000, 1.000, 0.915 m, those of M22 have 1.260, 1.504, 1.104 m" in said
        assert not (tmp_path / "run").exists()


def test_a_plan_shorter_than_the_machine_takes_to_answer_is_refused_before_anything_is_written(edp, tmp_path):
    pytest.importorskip("daqp", reason="the solver is an optional package")
    save_twin(sample_grey_box(), tmp_path / "grey" / "twin")
    words = ("--controller", "nmpc", "--twin", tmp_path / "grey", "--set", "controller.blocks=[3,2]")
    ended = edp("loop", "run", tmp_path / "run", "--seeds", 1, *LINE, *words)
    assert ended.code == 1
    assert "controller.blocks = [3, 2] plans 50 ms ahead" in " ".join(ended.err.split())
    assert not (tmp_path / "run").exists()


def test_a_folder_of_other_settings_is_left_as_it_is(edp, tmp_path):
    run = tmp_path / "run"
    assert edp("loop", "run", run, "--seeds", 1, *LINE).code == 0
    before = (run / "results.json").read_bytes()
    ended = edp("loop", "run", run, "--seeds", 2, *LINE)
    assert ended.code == 1
    assert "another run" in ended.err
    assert (run / "results.json").read_bytes() == before


@pytest.mark.parametrize("command", ["control", "tune"])
def test_a_folder_with_other_files_is_left_as_it_is(edp, tmp_path, command):
    kept = tmp_path / "thesis.txt"
    kept.write_text("mine")
    ended = edp(command, tmp_path, "--seeds", 1, *LINE)
    assert ended.code == 1
    assert "is not empty and holds no run ('thesis.txt'); nothing was changed" in " ".join(ended.err.split())
    assert [file.name for file in tmp_path.iterdir()] == [kept.name]
    assert "is a file" in " ".join(edp(command, kept, "--seeds", 1, *LINE).err.split())


@pytest.mark.parametrize(
    "words",
    [
        ("--set", "task.length_m=[30,40]"),
        ("--plant", "nowhere"),
        ("--plant", "nowhere.fmu", "--yes"),
        ("--controller", "inversion"),
        ("--machine", "C15"),
    ],
)
@pytest.mark.parametrize("command", ["control", "tune"])
def test_what_was_refused_does_not_keep_the_corrected_command_out_of_its_folder(edp, tmp_path, command, words):
    run = tmp_path / "run"
    assert edp(command, run, "--seeds", 1, *words).code == 1
    assert not run.exists()


def test_a_table_of_scores_fits_into_a_usual_terminal(edp, tmp_path, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    ended = edp("loop", "run", tmp_path / "run", "--seeds", 1, *LINE)
    assert "\u2026" not in ended.out
    assert "path, mm" in ended.out
