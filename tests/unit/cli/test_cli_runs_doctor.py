"""`edp runs` lists what is on disk, `edp doctor` what is installed; neither trusts what it finds."""

import json
import re
from pathlib import Path

import pytest

from edp.cli import doctor as doctor_command
from edp.storage import run_listing, write_bytes, write_json
from edp.storage.locks import hold
from edp.storage.seals import HASH, content_digest, digest_of_bytes


def run(folder, **files):
    folder.mkdir(parents=True)
    for name, content in files.items():
        text = content if isinstance(content, str) else json.dumps(content)
        (folder / f"{name}.json").write_text(text)
    return folder


def bundle(folder):
    """What a finished training leaves, as far as a listing looks."""
    write_bytes(folder / "bundle" / "weights.safetensors", b"weights")
    header = {"schema": 8, "weights": {"file": "weights.safetensors", HASH: digest_of_bytes(b"weights")}}
    write_json(folder / "bundle" / "bundle.json", header | {HASH: content_digest(header)})
    (folder / "config.toml").write_text("[task]\n")


def scores(*targets, error=1.5):
    return {
        "task": {"horizons": [1, 10]},
        "targets": [{"name": name, "unit": unit} for name, unit in targets],
        "models": {"network": {"overall": {"10": {key: {"rmse": error} for key in ("mean", *dict(targets))}}}},
    }


@pytest.fixture
def folder(tmp_path):
    status = {"status": "finished", "time": "2026-01-02T03:04:05+0000"}
    later = {"status": "running", "time": "2026-02-02T03:04:05+0000"}
    data = {"data": {"source": "/logs/a"}}
    run(tmp_path / "one", run={}, status=status, provenance=data, scores=scores(("v", "mm/s"), ("w", "mm/s")))
    bundle(tmp_path / "one")
    run(tmp_path / "one" / "parts" / "0", run={}, status=status)  # of the run, not one of its own
    run(tmp_path / "deep" / "er" / "two", run={}, status=later, scores=scores(("v", "1"), ("x", "1")), auto={})
    run(tmp_path / "study", study={})
    (tmp_path / "nothing").mkdir()
    return tmp_path


def test_runs_are_listed_with_kind_state_and_score(edp, folder):
    rows = {row["folder"]: row for row in edp("runs", folder, "--json").json["runs"]}
    assert {path.removeprefix(f"{folder}/") for path in rows} == {"one", "deep/er/two", "study"}
    one, two = rows[f"{folder}/one"], rows[f"{folder}/deep/er/two"]
    assert (one["kind"], one["state"], one["data"]) == ("network", "finished", "/logs/a")
    assert one["score"] == "1.5 mm/s at k = 10"
    # Nobody holds it: it was stopped. Outputs without a unit have no mean.
    assert (two["kind"], two["state"], two["score"]) == ("auto", "stopped", "1.5 at k = 10 (v; 2 outputs)")
    assert rows[f"{folder}/study"]["kind"] == "search"
    shown = edp("runs", folder).out
    assert "2026-01-02 03:04" in shown
    assert "data /logs/a: one" in shown
    with hold(folder / "deep" / "er" / "two" / ".lock"):
        assert "running" in edp("runs", folder).out
    assert "and 2 older ones" in edp("runs", folder, "--most", 1).out


def test_one_log_by_two_paths_is_listed_once(edp, tmp_path):
    for name, source in (("a", "logs/x"), ("b", str(Path("logs/x").absolute()))):
        run(tmp_path / name, run={}, status={}, provenance={"data": {"source": source}})
    together = [line for line in edp("runs", tmp_path).out.splitlines() if line.startswith("  data ")]
    assert len(together) == 1
    assert "a" in together[0].rpartition(":")[2]
    assert "b" in together[0].rpartition(":")[2]


def test_hostile_runs_are_damaged_and_bounded(edp, folder, monkeypatch):
    run(folder / "bad_json", run={}, scores="{", provenance="[1]")
    run(folder / "bad_score", run={}, scores={"task": {"horizons": ["x"]}}, status={"status": 3})
    run(folder / "odd\x1b[31m", run={}, provenance={"data": {"source": "\x1b[2J" + "a" * 10_000}})
    run(folder / "huge", run={}, scores=" " * 30_000)
    (folder / "loop").symlink_to(folder)
    monkeypatch.setattr(run_listing, "_BYTES", 20_000)
    ended = edp("runs", folder, "--json")
    rows = {row["folder"].removeprefix(f"{folder}/"): row for row in ended.json["runs"]}
    assert {name for name, row in rows.items() if row["state"] == "damaged"} == {"bad_json", "bad_score", "huge"}
    assert max(len(row["data"]) for row in rows.values()) == 200
    assert not any(name.startswith("loop") for name in rows)
    assert "\x1b" not in edp("runs", folder).out
    monkeypatch.setattr(run_listing, "MAX_FOLDERS", 2)
    assert not edp("runs", folder, "--json").json["complete"]


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("bundle/bundle.json", b"{"),
        ("bundle/bundle.json", b'{"schema": 8, "blake2b": "0"}'),
        ("bundle/bundle.json", None),
        ("bundle/weights.safetensors", b"weight"),
        ("bundle/weights.safetensors", None),
        ("config.toml", b"[task"),
    ],
)
def test_a_finished_run_of_which_a_part_is_damaged_or_gone_is_damaged(edp, folder, name, content):
    file = folder / "one" / name
    file.unlink()
    if content is not None:
        file.write_bytes(content)
    rows = {row["folder"]: row["state"] for row in edp("runs", folder, "--json").json["runs"]}
    assert rows[f"{folder}/one"] == "damaged"


def test_a_header_leads_to_no_file_outside_of_its_folder(edp, folder):
    (folder / "secret").write_bytes(b"weights")
    header = {"weights": {"file": "../../secret", HASH: digest_of_bytes(b"weights")}}
    write_json(folder / "one" / "bundle" / "bundle.json", header | {HASH: content_digest(header)})
    rows = {row["folder"]: row["state"] for row in edp("runs", folder, "--json").json["runs"]}
    assert rows[f"{folder}/one"] == "damaged"


def test_no_runs_and_no_folder(edp, tmp_path):
    assert "no runs below" in edp("runs", tmp_path).out
    ended = edp("runs", tmp_path / "absent")
    assert ended.code == 1
    assert "no folder at" in ended.err


def test_doctor_says_what_is_there_and_what_for(edp, tmp_path):
    facts = edp("doctor", tmp_path, "--json").json
    checks = {check["what"]: check for check in facts["checks"]}
    assert {"edp", "Python", "threads", "memory", "disk", "reading of logs", "[fmu]", "gcc"} <= set(checks)
    assert checks["reading of logs"]["state"] == "ok"
    assert all(check["needed_for"] for check in checks.values())
    shown = edp("doctor", tmp_path / "not" / "there").out
    assert re.search(r"optional parts? missing", shown)


def test_doctor_compiles_only_on_request(edp, tmp_path, monkeypatch):
    calls = []
    monkeypatch.setattr("edp.workflows.compile_ahead.compile_ahead", lambda progress: calls.append(progress))
    assert edp("doctor", tmp_path).code == 0
    assert not calls
    assert edp("doctor", tmp_path, "--compile").code == 0
    assert len(calls) == 1


def test_doctor_names_what_is_missing_and_ends_with_3_where_edp_needs_it(edp, tmp_path, monkeypatch):
    monkeypatch.setattr(doctor_command.shutil, "which", lambda name: None)
    monkeypatch.setattr(doctor_command.importlib.util, "find_spec", lambda name: None)
    facts = edp("doctor", tmp_path, "--json")
    missing = {check["what"]: check for check in facts.json["checks"] if check["state"] == "missing"}
    assert {"gcc", "ffmpeg", "[onnx]"} <= set(missing)
    assert "pip install" in missing["[onnx]"]["value"]

    def broken(*_, **__):
        raise OSError("no processes left")

    monkeypatch.setattr("edp.logs.read_recording", broken)
    ended = edp("doctor", tmp_path)
    assert ended.code == 3
    assert "no processes left" in ended.out


def test_the_shell_completes_names_of_commands(monkeypatch, capsys):
    from edp.cli import app
    from edp.cli.console import run_app

    for name, value in {"_EDP_COMPLETE": "complete_bash", "COMP_WORDS": "edp comp", "COMP_CWORD": "1"}.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr("sys.argv", ["edp"])
    with pytest.raises(SystemExit) as done:  # the library ends the process
        run_app(app)
    assert done.value.code in (0, None)
    assert {"compare", "compress"} <= set(capsys.readouterr().out.split())
