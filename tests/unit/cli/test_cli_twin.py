"""``edp twin`` and ``edp rollout``, from logs of two actuators to a free run beside what was measured."""

import json
import re
import shutil
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from edp.cli.progress import StageDisplay
from edp.data.features import FeatureSet
from edp.data.prepared import prepare
from edp.data.splits import ByRecording
from edp.data.task import TargetMode, Task
from edp.errors import DataError
from edp.logs import write_recording
from edp.logs.source import DataSource
from edp.networks.backbones import HybridSpec
from edp.networks.predictor import ModelSpec, build_model
from edp.networks.twin import TWINS
from edp.networks.twin.n4sid import N4sid
from edp.settings.provenance import DataOrigin, DataPart, Provenance
from edp.signals import Kind
from edp.storage import read_object, write_json
from edp.testing.twins import sample_actuators
from edp.training.bundle import make_bundle, save_bundle
from edp.training.twin_bundle import load_twin

SMALL = (
    *("twin.kind=recurrent", "twin.units=6", "twin.prefix_ticks=20", "training.batch=4", "training.lengths_s=[0.2]"),
    *(
        "training.updates=[6]",
        "training.validate_every=3",
        "evaluation.duration_s=4",
        "evaluation.starts=2",
        "evaluation.at_s=[1, 4]",
    ),
)
WORDS = [word for change in SMALL for word in ("--set", change)]


def candidate(label):
    return {"label": label, "error": 1.0, "seconds": 1.0, "chosen": True, "why": label}


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("actuators")
    for seed in range(6):
        write_recording(sample_actuators(seed=seed), folder / f"log_{seed}.parquet")
    return folder


@pytest.fixture(scope="module")
def trained(tmp_path_factory, logs):
    from edp.config.twin import load_twin_experiment
    from edp.workflows.twin import train_twin

    run = tmp_path_factory.mktemp("twins") / "run"
    train_twin(DataSource.from_path(logs), load_twin_experiment(None, SMALL), run)
    return run


def test_a_run_holds_a_twin_its_settings_and_scores_beside_the_floors(edp, logs, trained, tmp_path):
    run = shutil.copytree(trained, tmp_path / "run")
    before = (run / "twin" / "twin.json").read_bytes()
    ended = edp("twin", logs, "--out", run, *WORDS, "--json")
    # After a training of seconds a floor may be better on the test part: scripts see it by the code.
    assert ended.code == (0 if ended.json["beaten_by"] is None else 6)
    assert set(ended.json["models"]) == {"twin", "static", "arx", "n4sid"}
    assert [row["at_s"] for row in ended.json["models"]["twin"]["stroke_error"]] == [1.0, 4.0]
    assert (run / "twin" / "twin.json").read_bytes() == before
    shown = edp("twin", logs, "--out", run, *WORDS).out
    assert "velocity, mm/s" in shown
    assert f"next: edp report {run}, or edp rollout {run}" in shown.replace("\n", " ")
    history = (run / "history.jsonl").read_text().splitlines()
    assert len(history) == 2
    assert "units = 6" in (run / "config.toml").read_text()
    other = edp("twin", logs, "--out", run, *WORDS, "--set", "twin.units=7")
    assert other.code == 1
    assert "holds another run" in other.err


def test_a_stopped_training_goes_on(edp, logs, trained, tmp_path, monkeypatch):
    def stop(self, done, **values):
        if done == 3:
            raise KeyboardInterrupt

    run = tmp_path / "run"
    with monkeypatch.context() as patch:
        patch.setattr(StageDisplay, "step", stop)
        assert edp("twin", logs, "--out", run, *WORDS).code == 130
    assert not (run / "twin").exists()
    assert edp("twin", logs, "--out", run, *WORDS).code in (0, 6)  # as above
    resumed, whole = (load_twin(folder).twin.arrays() for folder in (run, trained))
    assert all(np.array_equal(resumed[name], whole[name]) for name in whole)


def test_without_a_formulation_the_best_of_several_is_chosen_and_told(edp, logs, tmp_path):
    run, page = tmp_path / "run", tmp_path / "page.html"
    words = ["--set", "twin.candidates=['static','n4sid','recurrent']", *WORDS[4:]]
    printed = edp("twin", logs, "--out", run, *words, "--workers", "1").out
    shown = " ".join(printed.split())
    assert not (run / "parts").exists()
    prose = ("chosen: ", "was left out: ")
    lines = [line for line in printed.splitlines() if not any(words in line for words in prose)]
    tables = [line for line in lines if "recurrent (" in line or line.startswith(("velocity", "stroke"))]
    assert len(tables) > 3
    assert max(len(line.rstrip()) for line in tables) <= 80
    assert "chosen: " in shown
    ended = edp("twin", logs, "--out", run, *words, "--json").json
    rows = ended["candidates"]
    assert [row["label"] for row in rows[:2]] == ["static", "n4sid"]
    assert all("updates" in row["label"] for row in rows[2:])
    (kept,) = (row for row in rows if row["chosen"])
    assert f"chosen: {kept['label']}: on free runs that its fits had not seen" in shown
    bundle = load_twin(run)
    assert bundle.provenance.more["chosen"] == kept["label"]
    assert TWINS.name_of(bundle.spec) == kept["label"].split()[0]
    assert edp("report", run, "--out", page).code == 0
    text = page.read_text()
    for part in ("It is ", 'id="candidates"', "n4sid", "as good as the best"):
        assert part in text
    before = (run / "candidates.json").read_text()
    assert edp("evaluate", run).code in (0, 6)  # after a training of seconds a floor may be better on the test part
    assert (run / "candidates.json").read_text() == before
    content = read_object(run / "candidates.json")
    changed = [row | {"chosen": "yes"} if row["chosen"] else row for row in content["candidates"]]
    write_json(run / "candidates.json", content | {"candidates": changed})
    assert "chosen = 'yes': write true or false" in " ".join(edp("report", run).err.split())


def test_a_budget_is_that_of_a_choice(edp, logs, tmp_path):
    assert "--time-budget: it has no effect without a choice among formulations" in " ".join(
        edp("twin", logs, "--out", tmp_path / "run", *WORDS, "--time-budget", "1min").err.split()
    )
    assert "--time-budget: got -1" in " ".join(
        edp("twin", logs, "--out", tmp_path / "run", "--time-budget", "-1min").err.split()
    )
    words = ["--set", "twin.candidates=['static','recurrent']", *WORDS[4:], "--time-budget", "6ms"]
    ended = edp("twin", logs, "--out", tmp_path / "run", *words, "--json").json
    assert [row["label"] for row in ended["candidates"] if row["chosen"]] == ["static"]
    assert "counted time" in ended["candidates"][1]["why"]


def test_any_number_of_workers_trains_the_same_twin(edp, logs, tmp_path):
    words = ["--set", "twin.candidates=['recurrent']", "--set", "twin.folds=2", *WORDS[4:]]
    rows, arrays = [], []
    for workers in (1, 64):  # as many as there is something to do for
        ended = edp("twin", logs, "--out", tmp_path / f"run_{workers}", *words, "--workers", workers, "--json")
        rows.append([row | {"seconds": 0.0} for row in ended.json["candidates"]])
        arrays.append(load_twin(tmp_path / f"run_{workers}").twin.arrays())
    assert rows[0] == rows[1]
    assert all(np.array_equal(values, arrays[1][name]) for name, values in arrays[0].items())
    assert edp("twin", logs, "--out", tmp_path / "run_3", *words, "--workers", -1).code == 2


HOSTILE = "</table><script>alert(1)</script>{{7*7}}[red]\x1b[31m"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ('{"schema": 1, "candidates": [{"label": "x"}]}', "error' is missing"),
        ('{"schema": 1, "candidates": {}}', "a list must hold"),
        ('{"schema": 1, "candidates": [{"label": "x", "error": NaN}]}', "the number NaN is not finite"),
        (f'{{"schema": 1, "candidates": {"[" * 5000}{"]" * 5000}}}', "nested deeper than"),
        (json.dumps({"schema": 1, "candidates": [candidate("x" * 3000)]}), "longer than 2,000 characters"),
    ],
)
def test_candidates_that_cannot_be_are_refused(edp, trained, tmp_path, content, message):
    run = shutil.copytree(trained, tmp_path / "run")
    (run / "candidates.json").write_text(content)
    ended = edp("report", run)
    assert ended.code == 1
    assert message in " ".join(ended.err.split())


def test_candidates_of_a_stranger_are_text_and_few(edp, logs, trained, tmp_path):
    run, page = shutil.copytree(trained, tmp_path / "run"), tmp_path / "page.html"
    rows = [candidate(HOSTILE), *(candidate(f"row {i}") for i in range(1000))]
    (run / "candidates.json").write_text(json.dumps({"schema": 1, "candidates": rows}))
    assert edp("report", run, "--out", page).code == 0
    text = page.read_text()
    assert "<script>alert(1)" not in text
    assert "&lt;script&gt;alert(1)" in text
    assert "row 98" in text
    assert "row 99" not in text
    shown = edp("twin", logs, "--out", run, *WORDS).out
    assert "\x1b[31m" not in shown
    assert "[red]" in shown


def test_floors_are_formulations_of_their_own(edp, logs, tmp_path):
    ended = edp("twin", logs, "--out", tmp_path / "run", "--set", "twin.kind=arx", *WORDS[6:], "--json")
    models = ended.json["models"]
    assert models["twin"]["stroke_error"] == models["arx"]["stroke_error"]
    assert load_twin(tmp_path / "run").spec.lags == 25
    assert ended.code == 6
    assert ended.json["beaten_by"] == "static"  # which knows the dead bands of these actuators


def test_a_floor_that_does_not_suit_the_logs_is_left_out(edp, logs, tmp_path, monkeypatch):
    def start(self, channels, scales, train, seed):
        raise DataError("n4sid: 60 windows of 40 ticks came")

    monkeypatch.setattr(N4sid, "start", start)
    words = ("--set", "twin.kind=static", *WORDS[6:])
    ended = edp("twin", logs, "--out", tmp_path / "run", *words)
    assert ended.code == 0
    assert set(read_object(tmp_path / "run" / "free_run.json")["models"]) == {"twin", "static", "arx"}
    assert "the floor n4sid is left out: n4sid: 60 windows of 40 ticks came" in " ".join(ended.err.split())


def test_a_rollout_writes_measured_and_free_values_row_by_row(edp, logs, trained, tmp_path):
    log, file = logs / "log_1.parquet", tmp_path / "free.parquet"
    ended = edp("rollout", trained, log, "--rollout-seconds", 3, "--from", 2, "--out", file, "--json")
    assert ended.code == 0
    assert ended.json["start_s"] == 2.0
    assert [row["at_s"] for row in ended.json["stroke_error"]] == [1.0, 3.0]
    (written,), (recording,) = DataSource.from_path(file).read(), DataSource.from_path(log).read()
    twin = load_twin(trained).twin
    series = twin.channels.task().series(recording)
    state = twin.reset(series.inputs[None, 80:100], series.targets[None, 80:100])
    answers, _ = twin.rollout(series.inputs[None, 100:250], state)
    names = [channel.name for channel in twin.channels.answers]
    assert written.samples == 150
    np.testing.assert_allclose(written.select([f"{name}_twin" for name in names]), answers[0], rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(written.select(names), series.targets[101:251], rtol=1e-5, atol=1e-6)
    error = 1e3 * np.abs(answers[0] - series.targets[101:251])[:, :2].mean()
    half = load_twin(trained).intervals.at(np.arange(1, 151))
    for end, sign in (("low", -1), ("high", 1)):
        values = written.select([f"{name}_twin_{end}" for name in names])
        np.testing.assert_allclose((values - answers[0]) / half, sign, rtol=1e-3)
    assert ended.json["calibrated_s"] == 4.0
    assert ended.json["velocity_mae"]["mean"] == pytest.approx(error, rel=1e-4)


def numbers(value: Any, path: str = "") -> dict[str, float]:
    """Return the numbers of a nested JSON value by their path."""
    if isinstance(value, dict | list):
        entries = value.items() if isinstance(value, dict) else enumerate(value)
        return {key: leaf for name, part in entries for key, leaf in numbers(part, f"{path}/{name}").items()}
    return {path: value} if isinstance(value, int | float) else {}


def test_a_twin_is_judged_anew_and_on_other_recordings_beside_a_predictor(edp, logs, trained, tmp_path):
    run, other = shutil.copytree(trained, tmp_path / "run"), tmp_path / "other"
    write_recording(sample_actuators(seed=9, ticks=500), other / "later.parquet")
    (recording,) = DataSource.from_path(other).read()
    speeds = ("speed_1", "speed_2")
    task = Task(FeatureSet("speeds", (*speeds, "lever_1", "lever_2")), speeds, (1, 5), TargetMode.DELTA, 50.0)
    model = ModelSpec(backbone=HybridSpec(channels=(4,), kernel=3, units=4, dropout=0.0), window=20)
    data = prepare([recording] * 3, task, ByRecording(), 20)
    names = Provenance(data=DataOrigin(train=DataPart(names=(recording.name,))))
    save_bundle(make_bundle(build_model(task, model, data.scaler(), 0).eval(), data, names), tmp_path / "predictor")
    before = read_object(run / "free_run.json")
    again = edp("evaluate", run, "--json").json
    assert again["models"]["twin"] == before["models"]["twin"]
    # Floors are fitted again, by products whose rounding follows the alignment of arrays in memory.
    assert numbers(again["models"]) == pytest.approx(numbers(before["models"]), rel=1e-3, abs=1e-9)
    judged = edp("evaluate", run, "--data", other, "--predictor", tmp_path / "predictor", "--json").json
    assert judged["folder"] == str(run / "on_other")
    twin = judged["models"]["twin"]
    assert twin["recordings"] == 1
    assert [row["at_s"] for row in twin["intervals"]["at"]] == [0.1, 1.0]
    beside = twin["beside"]
    assert (beside["ticks"], beside["trained_on"]) == (5, [recording.name])
    assert beside["errors"]["velocities"]["twin"]["mean"] > 0
    shown = edp("evaluate", run, "--data", other, "--predictor", tmp_path / "predictor").out
    for text in ("share of free runs in intervals", "at rest", "in motion", "told the commands", "it is flattered"):
        assert text.removeprefix("at ").removeprefix("in ") in " ".join(shown.split())
    refused = edp("evaluate", run, "--baselines", "none").err
    assert "--baselines: it has no effect without the run of a network" in refused


def test_a_rollout_prints_the_error_of_each_channel_by_time(edp, logs, trained):
    shown = edp("rollout", trained, logs / "log_1.parquet", "--rollout-seconds", 3).out
    lines = shown.splitlines()
    assert "error after, mm" in lines[0]
    assert lines[1].split() == ["stroke_1", "stroke_2"]
    assert [line.split()[:2] for line in lines[2:4]] == [["1", "s"], ["3", "s"]]
    assert re.search(r"MAE, mm/s: speed_1 [\d.]+, speed_2 [\d.]+", shown)
    assert re.search(r"NRMSE: pressure_1 [\d.]+, pressure_2 [\d.]+", shown)


def test_plots_of_a_rollout(edp, logs, trained, tmp_path):
    folder = tmp_path / "plots"
    words = ["rollout", trained, logs / "log_1.parquet", "--rollout-seconds", 3, "--from", 2, "--plots", folder]
    assert f"plots in {folder}" in edp(*words).out.replace("\n", "")
    stems = ("velocities", "strokes", "pressures")
    assert sorted(path.name for path in folder.iterdir()) == sorted(f"{s}.{e}" for s in stems for e in ("svg", "png"))
    drawing = (folder / "velocities.svg").read_text()
    for text in ("speed_1", "speed_2", "[mm/s]", "answered by the twin", "interval", "Time in the log [s]"):
        assert text in drawing
    assert "pressure_1" not in drawing


def test_the_page_of_a_twin_and_that_of_one_run(edp, logs, trained, tmp_path):
    file = tmp_path / "page.html"
    assert edp("report", trained, "--out", file, "--json").json["report"] == str(file)
    page = file.read_text()
    for text in (
        "free runs",
        "less error than the twin",
        "By recording, the worst first",
        "at rest (idling)",
        "actuators_",
        "90 %",
    ):
        assert text in page
    for part in ("velocities", "strokes", "pressures"):
        assert f'id="figure-runs_{part}"' in page
    assert 'id="figure-horizon"' in page
    assert "told the commands in between" in page
    words = ["rollout", trained, logs / "log_1.parquet", "--rollout-seconds", 3, "--from", 2, "--page", file]
    assert f"page: {file}" in edp(*words).out.replace("\n", "")
    assert "actuators_1 from 2 s" in file.read_text()
    assert "--limit" in edp("report", trained, "--limit", file).err
    (broken := shutil.copytree(trained, tmp_path / "broken") / "free_run.json").write_text('{"schema": 1}')
    refused = " ".join(edp("report", broken.parent).err.split())
    assert "of another version of EDP: schema 1, expected 2; run edp evaluate" in refused


def test_channels_that_stay_measured(edp, logs, trained, tmp_path):
    log = logs / "log_1.parquet"
    free, mixed = (
        edp("rollout", trained, log, "--rollout-seconds", 3, *words, "--json").json["velocity_mae"]["mean"]
        for words in ([], ["--measured", "speed_1", "--measured", "speed_2"])
    )
    assert mixed < 0.5 * free


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            ["--from", 0.1],
            r"has 5 measured ticks before it; the twin needs a prefix of 20 \(0\.4 s\): begin at --from",
        ),
        (
            ["--from", 11, "--rollout-seconds", 5],
            "goes beyond the end of 'actuators_1' at 12 s; at most --rollout-seconds 0.98 from there",
        ),
        (["--from", 50], "goes beyond the end.*begin earlier"),
        (["--rollout-seconds", -1], "--rollout-seconds: got -1.0, expected 0 < rollout_seconds"),
        (["--measured", "speed_3"], "the twin does not answer this channel; did you mean 'speed_2'"),
    ],
)
def test_a_rollout_that_cannot_be_is_refused(edp, logs, trained, words, message):
    ended = edp("rollout", trained, logs / "log_1.parquet", *words)
    assert ended.code == 1
    assert re.search(message, " ".join(ended.err.split()))


def test_several_logs_another_rate_and_no_twin_are_refused(edp, logs, trained, tmp_path):
    assert "6 recordings came" in edp("rollout", trained, logs).err
    slow = write_recording(sample_actuators(), tmp_path / "slow.parquet")
    (recording,) = DataSource.from_path(slow).read()
    short = write_recording(replace(recording, values=recording.values[:15]), tmp_path / "short.parquet")
    assert "has 15 ticks (0.3 s); the twin needs a prefix of 20" in " ".join(edp("rollout", trained, short).err.split())
    write_recording(replace(recording, rate_hz=25.0), slow)
    assert "has 25 Hz, the task 50 Hz" in " ".join(edp("rollout", trained, slow).err.split())
    assert "is not a twin: it has no twin.json" in " ".join(edp("rollout", logs, logs / "log_1.parquet").err.split())
    assert "holds a twin, not a network" in " ".join(edp("compress", "estimate", trained).err.split())


def test_a_log_of_positions_alone_of_two_kinds_has_a_table_an_actuator(edp, tmp_path):
    """No velocity is recorded, and a slew angle has no unit in common with a stroke."""
    names = ("stroke_1", "stroke_2")
    (tmp_path / "logs").mkdir()
    for seed in range(6):
        log = sample_actuators(seed=seed, pressures=False)
        chosen = [log.index(name) for name in ("lever_1", "lever_2", *names)]
        channels = [log.channels[index] for index in chosen]
        channels[-1] = replace(channels[-1], kind=Kind.ANGLE)
        write_recording(
            replace(log, channels=tuple(channels), values=log.values[:, chosen]),
            tmp_path / "logs" / f"log_{seed}.parquet",
        )
    run = tmp_path / "run"
    result = edp("twin", tmp_path / "logs", "--out", run, *WORDS)
    assert result.code == 6, result.out  # a twin of six updates
    assert "less error than the twin" in result.out.splitlines()[0]
    for name in names:
        assert f"{name}_velocity: its MAE, and the error of {name} by time" in result.out
    assert "deg/s" in result.out
    log = tmp_path / "logs" / "log_0.parquet"
    judged = edp("evaluate", run, "--data", log)
    assert judged.code == 6
    assert "less error than the twin" in judged.out
    assert f"{names[0]}_velocity: its MAE" in judged.out
    assert edp("rollout", run, log, "--rollout-seconds", 2).code == 0


def test_a_twin_goes_on_with_other_logs_and_shows_what_was_tried(edp, logs, trained, tmp_path):
    training = [word for change in SMALL if not change.startswith("twin.") for word in ("--set", change)]
    ended = edp("twin", logs, "--start", trained, "--out", tmp_path / "run", *training, "--json")
    assert ended.code == (0 if ended.json["beaten_by"] is None else 6)
    assert ended.json["candidates"][0]["label"] == "the twin as it is"
    provenance = read_object(tmp_path / "run" / "twin" / "twin.json")["provenance"]
    assert provenance["from"]["hash"] == json.loads((trained / "twin" / "twin.json").read_text())["blake2b"]
