"""JSON files of EDP's own: one reader and one writer, and any change in a file is refused with one message."""

from __future__ import annotations

import ast
import json
import re
from contextlib import suppress
from importlib import import_module
from pathlib import Path

import pytest
from browser import long_numbers

from edp.errors import StorageError
from edp.report.run.facts import HistoryRow, read_history
from edp.storage import read_json, write_bytes, write_json
from edp.storage.headers import check_files, digests_of
from edp.storage.runs import Run
from edp.storage.seals import HASH, files_without_seal

SOURCE = Path(__file__).parents[2] / "src" / "edp"
PARSERS = {
    "json.load",
    "json.loads",
    "tomllib.load",
    "tomllib.loads",
    "load_file",
    "pickle.load",
    "pickle.loads",
    "np.load",
}
READERS = {
    "storage/reading.py": "the reader",
    "storage/seals.py": "a round through JSON before hashing",
    "storage/ledger/store.py": "a round through JSON before a comparison",
    "sim/data_set.py": "a round through JSON before a comparison",
    "testing/networks.py": "a round through JSON before a comparison",
    "sandbox/broker.py": "messages between processes",
    "sandbox/protocol.py": "messages between processes",
    "sandbox/sandbox.py": "messages between processes",
    "sandbox/sandbox_worker.py": "messages between processes",
    "live/protocol.py": "messages of viewers",
    "jobs/packing.py": "results of workers",
    "workflows/search/trainings.py": "settings within a job",
    "workflows/train_evaluate.py": "settings within a unit of work",
    "jobs/worker.py": "jobs of the process that started it",
    "workflows/fleet/machines.py": "facts of an index that was read",
    "workflows/parity/forms/onnx_runtime.py": "answers of a program that was started",
    "workflows/parity/forms/ros2.py": "answers of a program that was started",
    "workflows/parity/forms/casadi.py": "answers of a program that was started",
    "report/common/interactive.py": "text of a figure of this process",
    "report/notebook/display.py": "text of a figure of this process",
    "report/run/facts.py": "arrays whose hash scores.json states",
    "report/twin/facts.py": "arrays whose hash free_run.json states",
    "report/transfer/facts.py": "arrays whose hash transfer.json states",
    "logs/formats/edp_metadata.py": "facts in a log",
    "export/c/program.py": "a file of the package",
    "export/casadi/runtime.py": "runs without EDP",
    "export/ros2/package/core.py": "runs without EDP",
}
"""Who parses by itself, and why."""


def test_files_are_parsed_by_the_declared_reader():
    found = set()
    for file in SOURCE.rglob("*.py"):
        calls = [node for node in ast.walk(ast.parse(file.read_text())) if isinstance(node, ast.Call)]
        if any(ast.unparse(call.func) in PARSERS for call in calls):
            found.add(file.relative_to(SOURCE).as_posix())
    assert sorted(found - READERS.keys()) == [], "read it by edp.storage.read_json, or say here why not"
    assert sorted(READERS.keys() - found) == [], "an exception that nothing needs"


CONTENT = {"schema": 1, "name": "m22", "rates": [100.0, 50.0], "on": True, "none": None, "deep": {"a": [1, {"b": "c"}]}}


def changes(value, path=()):
    """Yield every change of one number, text, truth value, list or key of a tree, as the changed tree."""
    if isinstance(value, dict):
        for key in value:
            yield {name: other for name, other in value.items() if name != key}
            yield from ({**value, key: changed} for changed in changes(value[key], (*path, key)))
    elif isinstance(value, list):
        yield value[:-1]
        yield value[::-1]
        for place, entry in enumerate(value):
            yield from ([*value[:place], changed, *value[place + 1 :]] for changed in changes(entry, (*path, place)))
    else:
        yield "" if isinstance(value, str) and value else 17


def test_every_change_of_a_value_is_refused_with_one_message(tmp_path):
    file = tmp_path / "facts.json"
    write_json(file, CONTENT)
    assert read_json(file) == CONTENT
    whole = json.loads(file.read_text())
    tried = 0
    for changed in changes(CONTENT):
        if changed == CONTENT:
            continue
        file.write_text(json.dumps(changed | {HASH: whole[HASH]}))
        with pytest.raises(StorageError, match=r"facts\.json' was changed since EDP wrote it.* restore it"):
            read_json(file)
        tried += 1
    assert tried > 15
    for digest in ("", None, 0, [], "0" * 32):
        file.write_text(json.dumps(CONTENT | {HASH: digest}))
        with pytest.raises(StorageError, match="was changed since"):
            read_json(file)


def test_every_flipped_bit_is_refused_or_changes_nothing(tmp_path):
    file = tmp_path / "facts.json"
    write_json(file, CONTENT)
    whole = file.read_bytes()
    for place in range(len(whole)):
        file.write_bytes(whole[:place] + bytes([whole[place] ^ 1]) + whole[place + 1 :])
        files_without_seal()
        with suppress(StorageError):  # white space may change; without the name of the hash, a file is told as unsealed
            assert read_json(file) == CONTENT or files_without_seal()


def test_a_file_without_a_hash_is_read_and_told(tmp_path):
    files_without_seal()
    (tmp_path / "old.json").write_text(json.dumps(CONTENT))
    assert read_json(tmp_path / "old.json") == CONTENT
    assert len(files_without_seal()) == 1
    assert files_without_seal() == []


EPOCHS = [{"epoch": 1, "train_loss": 0.5, "best": True}, {"epoch": 2, "train_loss": float("nan"), "best": False}]
ROWS = (HistoryRow(epoch=1, train_loss=0.5, best=True), HistoryRow(epoch=2))


@pytest.fixture
def history(tmp_path):
    with Run(tmp_path / "run") as folder:
        folder.write_history(EPOCHS)
    return tmp_path / "run" / "history.jsonl"


def test_every_flipped_bit_of_a_history_is_refused_with_its_line(history):
    assert read_history(history) == ROWS
    whole = history.read_bytes()
    for place in range(len(whole)):
        history.write_bytes(whole[:place] + bytes([whole[place] ^ 1]) + whole[place + 1 :])
        if whole[place : place + 1] == b"\n":
            assert read_history(history) == ROWS  # another kind of line end
            continue
        with pytest.raises(StorageError, match=r"history\.jsonl' line \d was changed"):
            read_history(history)


def test_a_history_of_an_earlier_version_is_read(history):
    history.write_text("".join(json.dumps(row) + "\n" for row in EPOCHS))
    assert read_history(history) == ROWS


def test_arrays_beside_a_result_are_bound_to_it(tmp_path):
    write_bytes(tmp_path / "arrays.bin", b"12345678")
    content = digests_of(tmp_path, "arrays.bin")
    check_files(content, tmp_path, "again")
    write_bytes(tmp_path / "arrays.bin", b"12345679")
    with pytest.raises(StorageError, match="changed since it was written with the result beside it; again"):
        check_files(content, tmp_path, "again")
    check_files({}, tmp_path, "again")  # of an earlier version


TWIN = ("--set", "twin.kind=arx", "--set", "judge={seconds=2,starts=2,at_s=[1,2]}")
READ_BY = {
    "trained/bundle/bundle.json": ("evaluate", "trained"),
    "trained/footprint.json": ("report", "trained"),
    "trained/scores.json": ("report", "trained"),
    "trained/history.jsonl": ("report", "trained"),
    "trained/provenance.json": ("report", "trained"),
    "trained/run.json": ("train",),
    "trained/status.json": ("train",),
    "twin/twin/twin.json": ("evaluate", "twin"),
    "twin/free_run.json": ("report", "twin"),
    "twin/step_response.json": ("report", "twin"),
    "twin/run.json": ("twin",),
    "twin/status.json": ("twin",),
    "store/store.json": ("inspect", "store"),
    "simulated/data_set.json": ("simulate",),
}
"""A command that reads each kind of file again."""
CHANGED = re.compile("was changed since EDP wrote it|does not match its hash")
NOT_READ = {
    "onnx/predictor.json": "for programs without EDP; export.sha256 beside it holds its hash",
    "twin/history.jsonl": "empty: this twin is solved at once, without epochs",
}
"""Files that no command reads again, and why."""


def test_every_kind_of_file_that_a_command_leaves_is_refused_once_changed(edp, tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(Path(__file__).parent))
    small = import_module("full_disk_commands")
    logs = small.write_logs(tmp_path / "logs")
    again = {
        "train": ("train", logs, *small.SMALL, "--out", tmp_path / "trained"),
        "twin": ("twin", logs, *TWIN, "--out", tmp_path / "twin"),
        "simulate": ("simulate", tmp_path / "simulated", "--minutes", 0.1, "--recordings", 1, "--workers", 1),
    }
    for command in (
        *again.values(),
        ("evaluate", tmp_path / "trained", "--baselines", "persistence"),
        ("footprint", tmp_path / "trained"),
        ("store", "build", logs, "--workers", 1, "--out", tmp_path / "store"),
        ("export", tmp_path / "trained", "--to", "onnx", "--out", tmp_path / "onnx"),
    ):
        ended = edp(*command)
        assert ended.code in (0, 6), ended.said  # 6: a judgement of so small a network
        told = [line for line in ended.said.splitlines() if str(tmp_path) not in line]
        assert long_numbers(told) == [], "figures in the terminal have at most four digits"
    files = {path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*.json*") if path.is_file()}
    assert sorted(files) == sorted({*READ_BY, *NOT_READ}), "name its reader, or say why nothing reads it"
    problems = []
    for name, (verb, *places) in READ_BY.items():
        file = tmp_path / name
        whole = file.read_text()
        first, *rest = whole.splitlines(keepends=True) if file.suffix == ".jsonl" else [whole]
        content = json.loads(first)
        same_keys = (tree for tree in changes(content) if tree != content and tree.keys() == content.keys())
        # Another schema or kind is refused as such, before the hash is looked at.
        changed = next(
            tree for tree in same_keys if all(tree.get(key) == content.get(key) for key in ("schema", "kind"))
        )
        file.write_text("".join([json.dumps(changed) + "\n", *rest]))
        ended = edp(verb, *(tmp_path / place for place in places)) if places else edp(*again[verb])
        if ended.code == 0 or ended.said.count("error: ") != 1 or not CHANGED.search(ended.said):
            problems.append(f"{name}: {ended.code} {ended.said[-300:]}")
        elif str(file.parent) not in ended.said:
            problems.append(f"{name} is not named: {ended.said[-300:]}")
        file.write_text(whole)
    assert not problems, "\n".join(problems)
