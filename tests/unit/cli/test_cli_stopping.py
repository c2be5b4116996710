"""Stopping and going on: a second call, Ctrl-C, a kill, a folder in use."""

import os
import signal

from safetensors.numpy import load_file

from edp.storage.runs import Run


def weights_of(run):
    (file,) = (run / "bundle").glob("weights-*.safetensors")
    return load_file(file)


def test_a_second_call_finds_the_run_finished(edp, logs, tmp_path, small):
    run = tmp_path / "run"
    first = edp("train", logs, "--out", run, *small, "--json").json
    history = (run / "history.jsonl").read_bytes()
    second = edp("train", logs, "--out", run, *small, "--json").json
    assert second["seconds"] == first["seconds"]
    assert (run / "history.jsonl").read_bytes() == history


def test_stopped_and_killed_training_ends_with_the_same_bits(edp, logs, tmp_path, small, start, stop_once):
    run, options = tmp_path / "run", [*small, "--set", "training.epochs=30", "--set", "training.updates=8"]
    command = ("train", logs, "--out", run, *options)
    checkpoint = run / "checkpoint.safetensors"

    code, err = stop_once(start(*command), checkpoint.exists, signal.SIGINT)
    assert code == 130
    assert "same command" in err
    assert "Traceback" not in err
    assert not (run / "bundle").exists()

    at = checkpoint.stat().st_mtime_ns
    code, _ = stop_once(start(*command), lambda: checkpoint.stat().st_mtime_ns != at, signal.SIGKILL)
    assert code == -signal.SIGKILL
    assert not (run / "bundle").exists()

    assert edp(*command).code == 0
    assert edp("train", logs, "--out", tmp_path / "whole", *options).code == 0
    stopped, whole = weights_of(run), weights_of(tmp_path / "whole")
    assert all((stopped[name] == whole[name]).all() for name in whole)
    assert len((run / "history.jsonl").read_text().splitlines()) == 30
    assert not list(run.rglob("*.tmp"))


def test_stopped_simulation_keeps_whole_logs_and_goes_on(edp, tmp_path, start, stop_once):
    data = tmp_path / "data"
    command = ("simulate", data, "--duration", "24min", "--recordings", 12, "--workers", 1)

    def some():
        return any(data.glob("*.parquet"))

    code, err = stop_once(start(*command), some, signal.SIGINT)
    kept = {path: path.read_bytes() for path in data.glob("*.parquet")}
    assert code == 130, err
    assert "Traceback" not in err
    assert 0 < len(kept) < 12
    assert edp(*command).code == 0
    assert len(list(data.glob("*.parquet"))) == 12
    assert all(path.read_bytes() == held for path, held in kept.items())


def test_run_folder_in_use(edp, logs, tmp_path, small):
    with Run(tmp_path / "run"):
        ended = edp("train", logs, "--out", tmp_path / "run", *small)
    assert ended.code == 75
    assert f"in use by process {os.getpid()}" in ended.err
    assert edp("train", logs, "--out", tmp_path / "run", *small).code == 0


def test_run_folder_of_another_run_is_left_alone(edp, logs, trained, small):
    before = {path: path.read_bytes() for path in trained.rglob("*") if path.is_file() and path.name != ".lock"}
    ended = edp("train", logs, "--out", trained, *small, "--set", "training.seed=9")
    assert ended.code == 1
    assert "holds another run" in ended.err
    assert "Choose another folder" in ended.err
    assert all(path.read_bytes() == held for path, held in before.items())
