"""A user's mistake ends in one clear message and exit code 1, never in a traceback."""

import errno
import json

import pytest

from edp.logs import write_recording
from edp.storage import write_json

TABLE_HEAD = "time,CylVels_1,CylVels_2\n"


def rows(count=200, step=0.01):
    return "".join(f"{i * step:.3f},{i % 7},{i % 5}\n" for i in range(count))


def refused(ended, *words):
    """The one message of a refusal, which holds all `words`."""
    text = " ".join(ended.err.split())
    assert ended.code == 1, text
    assert ended.out == ""
    assert "Traceback" not in text
    assert text.count("error:") == 1
    for word in words:
        assert word in text, text
    return text


@pytest.fixture
def train_on(edp, tmp_path, small):
    """``edp train`` on a folder, with options of its own."""

    def run(data, *options):
        return edp("train", data, "--out", tmp_path / "run", *small, *options)

    return run


def test_a_misspelt_column_is_answered_with_the_closest(train_on, tmp_path):
    (tmp_path / "a.csv").write_text("time,v_boom_mms\n" + "".join(f"{i / 100},{i}\n" for i in range(99)))
    (tmp_path / "map.toml").write_text('[channels.CylVels_1]\ncolumn = "v_boom_mm"\nunit = "mm/s"\n')
    ended = train_on(tmp_path / "a.csv", "--map", tmp_path / "map.toml")
    refused(ended, "a.csv", "v_boom_mm", "did you mean 'v_boom_mms'?")


def test_a_missing_channel_of_the_features(train_on, tmp_path):
    (tmp_path / "a.csv").write_text(TABLE_HEAD + rows())
    refused(train_on(tmp_path / "a.csv", "--set", "split.kind=time"), "CylVels_3")


def test_a_missing_target(train_on, logs):
    refused(train_on(logs, "--set", 'task.targets=["CylVel_1"]'), "CylVel_1", "CylVels_1")


def test_blocks_that_contradict_the_task(train_on, logs):
    ended = train_on(logs, "--set", 'model.blocks=["velocity_skip"]')
    refused(ended, "velocity_skip", "mode = 'delta' does already", "task.mode = 'absolute'")


def test_a_wrong_unit_in_the_map(train_on, tmp_path):
    (tmp_path / "a.csv").write_text(TABLE_HEAD + rows())
    (tmp_path / "map.toml").write_text('[channels.CylVels_1]\nunit = "bar"\n')
    ended = train_on(tmp_path / "a.csv", "--map", tmp_path / "map.toml")
    refused(ended, "CylVels_1", "'bar'", "velocity", "mm/s")


def test_unknown_keys_of_the_map(train_on, logs, tmp_path):
    (tmp_path / "map.toml").write_text('tme = "t"\n[channels.CylVels_1]\ncolunm = "v"\n')
    ended = train_on(logs, "--map", tmp_path / "map.toml")
    refused(ended, "map.toml", "2 problems", "did you mean 'time'?", "did you mean 'column'?")


def test_mixed_rates(train_on, recording_of, tmp_path):
    write_recording(recording_of("slow", rate_hz=50.0), tmp_path / "slow.parquet")
    write_recording(recording_of("fast", rate_hz=100.0), tmp_path / "fast.parquet")
    refused(train_on(tmp_path), "slow", "fast", "50", "100", "rate_hz")


def test_mixed_rates_of_a_data_set_file(train_on, recording_of, tmp_path):
    write_recording(recording_of("slow", rate_hz=50.0), tmp_path / "slow.parquet")
    write_recording(recording_of("fast", rate_hz=100.0), tmp_path / "fast.parquet")
    (tmp_path / "set.toml").write_text('[[recordings]]\npath = "slow.parquet"\n[[recordings]]\npath = "fast.parquet"\n')
    refused(train_on(tmp_path / "set.toml"), "slow", "fast", "50", "100", "rate_hz")


def test_recordings_shorter_than_the_burn_in(train_on, recording_of, tmp_path):
    for i in range(5):
        write_recording(recording_of(f"short_{i}", seed=i, samples=15), tmp_path / f"short_{i}.parquet")
    refused(train_on(tmp_path), "short_", "15", "longer")


def test_content_that_does_not_fit_the_ending(train_on, tmp_path):
    (tmp_path / "a.parquet").write_text(TABLE_HEAD + rows())
    refused(train_on(tmp_path / "a.parquet"), "a.parquet", "CSV")


@pytest.mark.parametrize("suffix", [".parquet", ".mat"])
@pytest.mark.parametrize("share", [0.3, 0.9])
def test_a_truncated_log(train_on, recording_of, tmp_path, suffix, share):
    path = tmp_path / f"drive{suffix}"
    write_recording(recording_of("drive"), path)
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    refused(train_on(path), path.name)


def test_missing_values_and_their_repair(train_on, recording_of, tmp_path):
    for i in range(4):
        recording = recording_of(f"drive_{i}", seed=i)
        recording.values[100:103, 0] = float("nan")
        write_recording(recording, tmp_path / f"drive_{i}.parquet")
    refused(train_on(tmp_path), "CylVels_1", "row 100", "nan", "hold")
    assert train_on(tmp_path, "--repair", "nan=hold").code == 0


@pytest.mark.parametrize(
    ("repair", "words"),
    [("nan", ("what=how",)), ("nann=hold", ("did you mean 'nan'?",)), ("nan=old", ("'old'", "hold"))],
)
def test_repairs_that_are_not_known(train_on, logs, repair, words):
    refused(train_on(logs, "--repair", repair), "--repair", *words)


def test_all_problems_of_the_settings_at_once(train_on, logs):
    wrong = ("training.epoks=3", "model.backbone.kind=lsmt", "training.clip_norm=true", "split.kind=by_time")
    ended = train_on(logs, *(word for change in wrong for word in ("--set", change)))
    text = refused(ended, "problems", "did you mean 'epochs'?", "did you mean 'lstm'?")
    assert "split.kind" in text


def test_unknown_preset_machine_format_and_paths(edp, logs, tmp_path):
    run = tmp_path / "run"
    refused(edp("train", logs, "--out", run, "--preset", "quik"), "did you mean 'quick'?")
    refused(edp("simulate", run, "--machine", "M23"), "M22")
    refused(edp("simulate", run, "--format", "parket"), "did you mean", "parquet'?")
    refused(edp("simulate", run, "--material", "cly"), "unknown material 'cly'", "did you mean 'clay'?")
    refused(edp("simulate", run, "--material", "none.toml"), "material file none.toml cannot be read")
    refused(edp("simulate", run, "--family", 2, "--set", "masses=ten"), "masses = 'ten'", "write it without quotes")
    refused(edp("simulate", run, "--family", 2, "--set", "masses=[50,10]"), "from 50.0 to 10.0 t", "must not exceed")
    refused(edp("simulate", run, "--set", "masses=[10,20]"), "say how many machines with family")
    refused(edp("simulate", run, "--machine", "C14", "--family", 2), "give one of the two")
    refused(edp("train", tmp_path / "none", "--out", run), "none", "does not exist")
    refused(edp("evaluate", tmp_path), "not a bundle", "edp train")
    refused(edp("report", tmp_path), str(tmp_path))
    refused(edp("compress", "estimate", tmp_path / "none.toml"), "none.toml")
    refused(edp("export", tmp_path, "--to", "c", "--out", run), "not a bundle", "edp train")
    refused(
        edp("export", tmp_path, "--to", "see", "--out", run),
        "unknown export target 'see'; known: c",
        "simulink; `edp export",
    )
    refused(edp("export", tmp_path, "--to", "c", "--set", "opset=9", "--out", run), "'c' has no option 'opset'")
    refused(edp("export", tmp_path, "--to", "onnx", "--set", "opset=10", "--out", run), "opset 10", "9, 11, 13")
    refused(
        edp("export", tmp_path, "--to", "onnx", "--set", "opset=new", "--out", run), "'opset'", "'new'", "an integer"
    )
    refused(edp("export", tmp_path, "--to", "onnx", "--set", "opset", "--out", run), "--set opset", "NAME=VALUE")
    assert not run.exists()


def test_settings_that_are_not_toml(edp, tmp_path):
    (tmp_path / "bad.toml").write_text("[task\n")
    refused(edp("compress", "estimate", tmp_path / "bad.toml"), "bad.toml", "not valid TOML", "line 1")


def test_an_unknown_baseline(edp, trained):
    refused(edp("evaluate", trained, "--baselines", "ridge_arks"), "did you mean 'ridge_arx'?")


def test_a_bundle_of_a_newer_schema(edp, trained):
    header = trained / "bundle" / "bundle.json"
    held = json.loads(header.read_text())
    header.write_text(json.dumps(held | {"schema": held["schema"] + 3}))
    refused(edp("compress", "estimate", trained), f"schema {held['schema'] + 3}", "reads 8 to 10", "newer EDP")


def test_damaged_weights(edp, trained):
    (file,) = (trained / "bundle").glob("weights-*")
    file.write_bytes(file.read_bytes()[:-5])
    refused(edp("compress", "estimate", trained), file.name, "digest")


def test_recordings_that_changed_after_training(edp, trained, recording_of, logs, tmp_path):
    provenance = json.loads((trained / "provenance.json").read_text())
    provenance["data"]["reader"]["path"] = str(tmp_path / "other")
    write_json(trained / "provenance.json", provenance)
    for i in range(5):
        write_recording(recording_of(f"drive_{i}", seed=i + 50), tmp_path / "other" / f"drive_{i}.parquet")
    refused(edp("evaluate", trained), "changed since", "--data")


def test_a_full_disk(train_on, logs, tmp_path, monkeypatch):
    def full(descriptor):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("edp.storage.writing.os.fsync", full)
    refused(train_on(logs), "cannot write", "No space left on device", "free space")
    monkeypatch.undo()
    assert not list(tmp_path.rglob("*.tmp"))
    assert train_on(logs).code == 0


def test_a_folder_that_cannot_be_made(edp, logs, small, tmp_path):
    (tmp_path / "file").write_text("in the way")
    for target in (tmp_path / "file", tmp_path / "file" / "run"):
        refused(edp("train", logs, "--out", target, *small), "cannot create folder", str(target))
    refused(edp("simulate", tmp_path / "file" / "data"), "cannot create folder")


def test_a_folder_that_may_not_be_written(edp, trained, monkeypatch):
    def read_only(*args, **options):
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr("edp.storage.writing._temporary", read_only)
    refused(edp("report", trained), "cannot write", "report.html", "Permission denied", "choose a folder")


def test_a_scenario_file_is_no_data_set_file(edp, tmp_path):
    file = tmp_path / "set.toml"
    file.write_text("recordings = 3")
    refused(edp("data", "check", file), "recordings = 3", "--scenario")
