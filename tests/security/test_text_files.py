"""Settings, manifests, scores and headers of a stranger: read within bounds, or one message."""

import json
import os
import socket
import time
from pathlib import Path

import pytest

from edp import storage
from edp.config.experiment import load_experiment, override
from edp.data.feature_files import read_set_table
from edp.errors import ConfigError, DataError, EdpError, StorageError
from edp.evaluation.compression import read_compression
from edp.evaluation.controller import load_budget
from edp.evaluation.study import read_study
from edp.logs.source import load_data_set, load_signal_map
from edp.report import read_facts
from edp.report.run.facts import read_limit
from edp.report.transfer.facts import read_transfer
from edp.settings.provenance import read_provenance
from edp.sim.machine.machine_files import load_machine
from edp.sim.physics.material import load_material
from edp.sim.scenario_file import read_scenario_file
from edp.storage.ledger import Ledger, read_records
from edp.storage.runs import Run
from edp.training import load_bundle
from edp.workflows.search.plan import load_plan

DEEP = 100_000
TOML = {
    "lists": "a = " + "[" * DEEP + "]" * DEEP,
    "tables": "a = " + "{a=" * DEEP + "1" + "}" * DEEP,
    "dotted key": ".".join("a" * DEEP) + " = 1",
    "dotted quoted key": ".".join(['"a b"', "'c'"] * (DEEP // 2)) + " = 1",
    "dotted key in a table": "b = {" + " . ".join("a" * DEEP) + " = 1}",
    "dotted header": "[" + ".".join("a" * DEEP) + "]",
    "6,000 digits": "a = " + "9" * 6000,
    "6,000 hexadecimal digits": "a = 0x" + "f" * 6000,
    "no UTF-8": b"a = '\xff'",
    "mark": b"\xef\xbb\xbfa = 1",
    "NUL": b"a = 1\0",
    "cut off": "a = ",
    "twice": "a = 1\na = 2",
}
JSON = {
    "lists": "[" * DEEP + "]" * DEEP,
    "tables": '{"a":' * DEEP + "1" + "}" * DEEP,
    "deeper than ours": "[" * 900 + "]" * 900,
    "6,000 digits": '{"a": ' + "9" * 6000 + "}",
    "4,000 digits": '{"a": ' + "9" * 4000 + "}",
    "infinite": '{"a": 1e999}',
    "NaN": '{"a": NaN}',
    "no UTF-8": b'{"a": "\xff"}',
    "mark": b"\xef\xbb\xbf{}",
    "cut off": '{"a": 1',
    "twice": '{"a": 1, "a": 2}',
    "half a pair": b'{"a": "\xed\xa0\x80"}',
}


def listening(path):
    with socket.socket(socket.AF_UNIX) as one:
        one.bind(str(path))


def bundle(file):
    load_bundle(file.parent)


def run_of(file):
    with Run(file.parent) as run:
        run.claim("key", "")


def status_of(file):
    with Run(file.parent) as run:
        run.status()


def ledger_of(file):
    with Ledger(file.parent) as ledger:
        ledger.bind({})


def openings_of(file):
    folder = file.parent / "openings"
    folder.mkdir(exist_ok=True)
    file.replace(folder / "0001.json")
    with Ledger(file.parent) as ledger:
        ledger.openings()


def facts_of(file):
    read_facts(file.parent)


SETTINGS = {
    "settings": ("a.toml", load_experiment),
    "search": ("a.toml", load_plan),
    "feature set": ("a.toml", read_set_table),
    "budget": ("a.toml", load_budget),
    "machine": ("a.toml", lambda file: load_machine(str(file))),
    "material": ("a.toml", lambda file: load_material(str(file))),
    "scenario": ("a.toml", read_scenario_file),
    "signal map": ("a.toml", load_signal_map),
    "data set": ("a.toml", load_data_set),
}
OBJECTS = {
    "bundle": ("bundle.json", bundle),
    "run": ("run.json", run_of),
    "status": ("status.json", status_of),
    "scores": ("scores.json", facts_of),
    "provenance": ("provenance.json", lambda file: read_provenance(file.parent)),
    "provenance of a report": ("provenance.json", facts_of),
    "foundation": ("foundation.json", facts_of),
    "study": ("study.json", lambda file: read_study(file.parent)),
    "compression": ("compression.json", lambda file: read_compression(file.parent)),
    "transfer": ("transfer.json", lambda file: read_transfer(file.parent)),
    "limit": ("limit.json", lambda file: read_limit(file, None)),
    "ledger": ("about.json", ledger_of),
    "openings": ("openings.json", openings_of),
}


def written(path, content):
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    (path.parent / "scores.json").touch() if path.name == "foundation.json" else None
    return path


@pytest.mark.parametrize("attack", TOML)
@pytest.mark.parametrize("kind", SETTINGS)
def test_a_hostile_settings_file_is_one_message(tmp_path, kind, attack):
    name, read = SETTINGS[kind]
    file = written(tmp_path / name, TOML[attack])
    with pytest.raises(EdpError, match=r"a\.toml.*(is not valid TOML|cannot be read)") as caught:
        read(file)
    assert len(str(caught.value).replace(str(tmp_path), "")) < 500


@pytest.mark.parametrize("attack", JSON)
@pytest.mark.parametrize("kind", OBJECTS)
def test_a_hostile_json_file_is_one_message(tmp_path, kind, attack):
    name, read = OBJECTS[kind]
    file = written(tmp_path / name, JSON[attack])
    if kind in ("scores", "provenance of a report", "foundation"):
        written(tmp_path / "config.toml", "")
    with pytest.raises(EdpError, match=r"json.*(is not valid JSON|cannot be read)") as caught:
        read(file)
    assert len(str(caught.value).replace(str(tmp_path), "")) < 500


@pytest.mark.parametrize("content", ["null", "[]", "7", '"text"'])
@pytest.mark.parametrize("kind", sorted(OBJECTS))
def test_what_is_no_object_is_one_message(tmp_path, kind, content):
    name, read = OBJECTS[kind]
    file = written(tmp_path / name, content)
    if kind == "foundation":
        written(tmp_path / "scores.json", "{}")
    with pytest.raises(EdpError, match=r"json|schema|limit of predictability"):
        read(file)


@pytest.mark.parametrize("kind", sorted(SETTINGS))
def test_a_pipe_is_not_waited_for(tmp_path, kind):
    name, read = SETTINGS[kind]
    os.mkfifo(tmp_path / name)
    with pytest.raises(EdpError, match="pipe, socket or device"):
        read(tmp_path / name)


@pytest.mark.parametrize(
    "make",
    [
        os.mkfifo,
        os.mkdir,
        lambda path: path.symlink_to("/dev/zero"),
        lambda path: path.symlink_to(path),
        lambda path: path.symlink_to("/dev/tty"),
        listening,
    ],
    ids=["pipe", "folder", "endless device", "loop", "terminal", "socket"],
)
def test_only_regular_files_are_read(tmp_path, monkeypatch, make):
    monkeypatch.chdir(tmp_path)
    make(Path("x.json"))
    with pytest.raises(StorageError, match=r"x\.json' cannot be read"):
        storage.read_json("x.json")


def test_a_link_to_a_file_and_a_file_are_read(tmp_path):
    (tmp_path / "real.toml").write_text("a = 1")
    (tmp_path / "link.toml").symlink_to("real.toml")
    assert storage.read_toml(tmp_path / "link.toml") == {"a": 1}


def test_sizes_are_bounded_before_reading(tmp_path):
    for name, bound in (("a.json", storage.JSON_BYTES), ("a.toml", storage.SETTINGS_BYTES)):
        with (tmp_path / name).open("wb") as stream:
            stream.truncate(bound + 1)
    with pytest.raises(StorageError, match="at most 67,108,864"):
        storage.read_json(tmp_path / "a.json")
    with pytest.raises(StorageError, match="at most 4,194,304"):
        storage.read_toml(tmp_path / "a.toml")


def test_a_file_that_says_it_is_empty_and_grows_is_bounded():
    with pytest.raises(StorageError, match="at most 10"):
        storage.read_bytes("/proc/self/maps", 10)


def test_a_path_with_a_nul_is_one_message():
    with pytest.raises(StorageError, match="cannot be read"):
        storage.read_json("a\0b.json")


@pytest.mark.parametrize("text", ["\n" * 2**21, "a" * 2**21, "[" * 2**21, "a." * 2**20, ("a" * 60 + ".") * 2**15])
def test_looking_for_deep_keys_takes_linear_time(text):
    began = time.process_time()
    with pytest.raises(ConfigError):
        storage.parse_toml(text + "=", "it", ConfigError)
    assert time.process_time() - began < 5


def test_what_edp_writes_is_read(tmp_path):
    tree = value = {}
    for _ in range(50):
        value["a"] = [{}]
        value = value["a"][0] if len(json.dumps(tree)) < 200 else {}
    held = {"tree": tree, "state": 2**128 - 1, "text": "\u2028é", "small": 1e-320}
    storage.write_json(tmp_path / "a.json", held)
    assert storage.read_json(tmp_path / "a.json") == held
    assert storage.parse_json('{"score": Infinity}', "it", finite=False) == {"score": float("inf")}


def test_numbers_beyond_all_use_are_named():
    with pytest.raises(DataError, match="a number of 6000 digits; at most 40"):
        storage.parse_json("1" * 6000, "it", DataError)
    with pytest.raises(ConfigError, match="'a' stands twice"):
        storage.parse_json('{"b": {"a": 1, "a": 1}}', "it", ConfigError)


def test_a_hostile_change_on_the_command_line_is_one_message():
    with pytest.raises(ConfigError, match="--set"):
        override(".".join("a" * DEEP) + "=1")
    assert override("a.b=[[1]]") == {"a": {"b": [[1]]}}


def test_provenance_of_another_kind_is_one_message(tmp_path):
    data = {"source": "x", "reader": {"path": "x"}, "digest": "d"}
    for wrong in ({}, {"data": 5, "seconds": 1}, {"data": data | {"reader": 7}, "seconds": 1}, {"data": data}):
        storage.write_json(tmp_path / "provenance.json", wrong)
        with pytest.raises(StorageError, match=r"provenance\.json"):
            read_provenance(tmp_path)
    storage.write_json(tmp_path / "provenance.json", {"data": data | {"digest": []}, "seconds": "long"})
    with pytest.raises(StorageError, match=r"(?s)data\.digest.*seconds"):
        read_provenance(tmp_path)


@pytest.mark.parametrize("make", [os.mkfifo, os.mkdir], ids=["pipe", "folder"])
def test_what_stands_in_place_of_a_record_is_set_apart(tmp_path, make):
    with Ledger(tmp_path):
        pass
    make(tmp_path / "records" / f"{'0' * 32}.json")
    whole, damaged = read_records(tmp_path)
    assert not whole
    assert "a regular file must be there" in damaged[0].why
    with Ledger(tmp_path) as ledger:
        assert len(ledger.damaged) == 1
        assert len(ledger) == 0
    assert os.listdir(tmp_path / "quarantine") == [f"{'0' * 32}.0.json"]
    with Ledger(tmp_path) as ledger:
        assert not ledger.damaged
