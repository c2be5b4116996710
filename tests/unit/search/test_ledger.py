"""The ledger: one key for one content, and records that are whole or set apart."""

import errno
import json
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from enum import StrEnum
from pathlib import Path

import numpy as np
import pytest

import edp.storage
from edp.errors import BusyError, ConfigError, NotFiniteError, StorageError
from edp.storage.ledger import (
    Ledger,
    Record,
    TrainingIdentity,
    TrainingStatus,
    canonical,
    claim,
    code_version,
    digest_of,
    leave_arrival,
    read_records,
)
from edp.storage.provenance import environment

pytestmark = pytest.mark.processes


class Mode(StrEnum):
    DELTA = "delta"


def test_equal_content_gives_one_key_and_other_content_another(identity_of):
    one = identity_of(lr=1e-3, blocks=("a", "b"), mode=Mode.DELTA)
    assert one.key == identity_of(mode="delta", blocks=["a", "b"], lr=0.001).key
    assert TrainingIdentity(**json.loads(json.dumps(one.to_json()))).key == one.key
    others = [
        replace(one, code="c2"),
        replace(one, data="d2"),
        replace(one, environment={"threads": "2"}),
        replace(one, environment={"threads": "1", "torch": "9"}),
        replace(one, split={"fold": 1}),
        replace(one, seed=1),
        replace(one, epochs=2),
        replace(one, job="m:other"),
        replace(one, config={**one.config, "lr": 1e-4}),
    ]
    assert len({one.key, *(other.key for other in others)}) == 1 + len(others)


def test_types_are_told_apart():
    values = [1, 1.0, True, "1", None, [], {}, "", 0.0, -0.0, [1], ["1"], {"a": 1}, {"a": None}]
    assert len({digest_of(value) for value in values}) == len(values)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -np.inf, np.float64("nan")])
def test_nan_in_a_key_is_refused(identity_of, value):
    with pytest.raises(NotFiniteError, match=r"'config\.loss\[1\]\.delta' is -?(nan|inf); give a finite number"):
        _ = identity_of(loss=[1, {"delta": value}]).key


@pytest.mark.parametrize("value", [np.int64(1), np.zeros(2), {1, 2}, b"x", Path("a"), np.float32(1)])
def test_what_json_would_change_is_refused(identity_of, value):
    with pytest.raises(ConfigError, match=f"'config.x' is of type {type(value).__name__}; give"):
        _ = identity_of(x=value).key
    with pytest.raises(ConfigError, match="has the key 1; keys must be text"):
        canonical({"a": {1: 2}})


def test_the_code_and_threads_are_parts_of_a_key(tmp_path):
    package = tmp_path / "edp"
    shutil.copytree(Path(edp.__file__).parent, package, ignore=shutil.ignore_patterns("__pycache__"))

    def told():
        command = "from edp.storage.ledger import code_version; print(code_version())"
        return subprocess.check_output([sys.executable, "-P", "-c", command], env=os.environ | {"PYTHONPATH": tmp_path})

    before = told()
    assert before.decode().strip() == code_version()
    for place in ("cli/train.py", "workflows/search/space.py", "workflows/train_evaluate.py"):
        (package / place).write_text("# says the same in other words\n")
    assert told() == before
    for place in ("networks/losses/huber.py", "workflows/search/trainings.py", "stats/metrics.py"):
        (package / place).write_text("# another training\n")
        assert told() != before
        before = told()
    assert environment(1) != environment(2)


def test_a_record_comes_back_as_it_was(identity_of, tmp_path):
    done = Record(
        identity_of(lr=0.1), TrainingStatus.DONE, {"score": 0.1 + 0.2, "n": 3, "none": None}, "", {"seconds": 1.5}
    )
    lost = Record(identity_of(1), TrainingStatus.LOST, None, "killed")
    with Ledger(tmp_path) as ledger:
        assert ledger.finished(done.key) is None
        ledger.put(done)
        ledger.put(done)
        ledger.put(lost)
        with pytest.raises(StorageError, match="came again, diverged, with another result"):
            ledger.put(replace(done, status=TrainingStatus.DIVERGED, result=None))
    with Ledger(tmp_path) as ledger:
        assert len(ledger) == 2
        held = ledger.finished(done.key)
        assert held == done
        assert held.result["score"] == 0.1 + 0.2
        assert ledger.finished(lost.key) is None
        assert ledger.get(lost.key) == lost
        ledger.put(Record(lost.identity, TrainingStatus.DONE, {"score": 1.0}))
        assert ledger.finished(lost.key).result == {"score": 1.0}
    assert read_records(tmp_path)[0][lost.key].status is TrainingStatus.DONE


def test_the_hash_leaves_out_what_is_measured(identity_of, tmp_path):
    def hashed(name, seeds, **changed):
        with Ledger(tmp_path / name) as ledger:
            for seed in seeds:
                record = Record(identity_of(seed), TrainingStatus.DONE, {"score": seed}, "", {"seconds": len(name)})
                ledger.put(replace(record, **changed))
            return ledger.digest()

    one = hashed("a", [1, 2, 3])
    assert hashed("bb", [3, 1, 2]) == one
    assert hashed("c", [1, 2]) != one
    assert hashed("d", [1, 2, 3], result={"score": 9}) != one


@pytest.mark.parametrize(
    "damage",
    [
        lambda whole: whole[:-20],
        lambda whole: b"",
        lambda whole: whole.replace(b'"score":0.25', b'"score":0.15'),
        lambda whole: whole[: len(whole) // 2] + b"\0" * 8 + whole[len(whole) // 2 + 8 :],
        lambda whole: b"\0" * len(whole),
    ],
)
def test_a_damaged_record_is_set_apart_and_its_training_is_not_done(identity_of, tmp_path, damage):
    records = [Record(identity_of(seed), TrainingStatus.DONE, {"score": 0.25}) for seed in range(3)]
    with Ledger(tmp_path) as ledger:
        for record in records:
            ledger.put(record)
        digest = ledger.digest()
    file = tmp_path / "records" / f"{records[1].key}.json"
    file.write_bytes(damage(file.read_bytes()))
    assert len(read_records(tmp_path)[1]) == 1
    assert file.exists()
    with Ledger(tmp_path) as ledger:
        assert [one.file for one in ledger.damaged] == [file]
        assert ledger.finished(records[1].key) is None
        assert ledger.finished(records[0].key) == records[0]
        assert not file.exists()
        assert len(list((tmp_path / "quarantine").iterdir())) == 1
        ledger.put(records[1])
        assert ledger.digest() == digest
    file.write_bytes(b"again")
    with Ledger(tmp_path) as ledger:
        assert len(list((tmp_path / "quarantine").iterdir())) == 2
        assert len(ledger) == 2


def test_a_record_under_another_name_or_of_a_later_version(identity_of, tmp_path):
    record = Record(identity_of(), TrainingStatus.DONE, {"score": 1.0})
    with Ledger(tmp_path) as ledger:
        ledger.put(record)
    file = tmp_path / "records" / f"{record.key}.json"
    shutil.copy(file, file.with_name(f"{'0' * 32}.json"))
    with Ledger(tmp_path) as ledger:
        assert len(ledger) == 1
        assert "record of another training" in ledger.damaged[0].why
    body = canonical({"schema": 2})
    file.write_text(f'{{"checksum":"{edp.storage.ledger.record._checksum(body.encode())}","record":{body}}}\n')
    with pytest.raises(StorageError, match="later version"):
        Ledger(tmp_path)
    assert file.exists()
    with pytest.raises(StorageError, match="later version"):
        Ledger(tmp_path)  # and the lock was let go of


FULL = """
import sys
from edp.storage.ledger import *
from edp.errors import StorageError
def record(seed, size):
    identity = TrainingIdentity("m:f", {}, {}, seed, 1, "c", "d", {})
    return Record(identity, TrainingStatus.DONE, {"score": seed, "curve": "x" * size})
with Ledger(sys.argv[1]) as ledger:
    ledger.put(record(0, 100))
    try:
        ledger.put(record(1, 400_000))
    except StorageError as error:
        print(error)
with Ledger(sys.argv[1]) as ledger:
    assert [one.identity.seed for one in ledger] == [0], "earlier records stay"
    ledger.put(record(2, 100))
    assert len(ledger) == 2 and not ledger.damaged
"""


def test_a_full_disk_is_told_and_loses_nothing(tmp_path):
    mounted = ["unshare", "--user", "--map-root-user", "--mount", "sh", "-c"]
    if shutil.which("unshare") is None or subprocess.run([*mounted, "true"], capture_output=True).returncode:
        pytest.skip("no mounts of one's own here")
    (tmp_path / "disk").mkdir()
    script = tmp_path / "full.py"
    script.write_text(FULL)
    steps = 'mount -t tmpfs -o size=128k full "$1" && "$2" "$3" "$1" && find "$1" -name "*.tmp"'
    command = [*mounted, steps, "sh", str(tmp_path / "disk"), sys.executable, str(script)]
    ran = subprocess.run(command, capture_output=True, text=True)
    assert ran.returncode == 0, ran.stderr
    assert "No space left" in ran.stdout
    assert "free space" in ran.stdout
    assert ".tmp" not in ran.stdout


def test_an_error_while_writing_leaves_no_temporary_file(identity_of, tmp_path, monkeypatch):
    def full(handle):
        raise OSError(errno.ENOSPC, "No space left on device")

    with Ledger(tmp_path) as ledger:
        with monkeypatch.context() as patch:
            patch.setattr(edp.storage.writing.os, "fsync", full)
            with pytest.raises(StorageError, match="No space left"):
                ledger.put(Record(identity_of(), TrainingStatus.DONE, {"score": 1.0}))
        assert list((tmp_path / "records").iterdir()) == []
        assert len(ledger) == 0
        ledger.put(Record(identity_of(), TrainingStatus.DONE, {"score": 1.0}))
    (tmp_path / "records" / ".x.json.1.tmp").write_text("of a process that was killed while it wrote")
    with Ledger(tmp_path) as ledger:
        assert len(os.listdir(tmp_path / "records")) == len(ledger) == 1


SECOND = """
import sys
from edp.errors import EdpError
from edp.storage.ledger import Ledger, claim
try:
    Ledger(sys.argv[1]) if len(sys.argv) == 2 else claim(*sys.argv[1:])
except EdpError as error:
    print(error)
    sys.exit(error.exit_code)
"""


FIRST = """
import sys, time
from edp.storage.ledger import claim
held = claim(sys.argv[1], "k")
print("held", flush=True)
time.sleep(60)
"""


def test_a_second_coordinator_is_refused_and_told_who_holds_it(tmp_path):
    command = [sys.executable, "-c", SECOND, str(tmp_path)]
    with Ledger(tmp_path):
        second = subprocess.run(command, capture_output=True, text=True)
        assert second.returncode == 75
        assert f"is coordinated by process {os.getpid()} on {os.uname().nodename} since " in second.stdout
        assert read_records(tmp_path) == ({}, [])
        assert subprocess.run(command, capture_output=True, text=True).stdout == second.stdout
    assert subprocess.run(command).returncode == 0


def test_a_claim_is_refused_to_a_second_and_freed_when_the_first_dies(tmp_path):
    command = [sys.executable, "-c", SECOND, str(tmp_path), "k"]
    with claim(tmp_path, "k"):
        second = subprocess.run(command, capture_output=True, text=True)
        assert second.returncode == 75
        assert f"training k is claimed by process {os.getpid()}" in second.stdout
        with pytest.raises(BusyError), claim(tmp_path, "k"):
            pass
        with claim(tmp_path, "other"):
            pass
    assert os.listdir(tmp_path / "claims") == []
    first = subprocess.Popen([sys.executable, "-c", FIRST, str(tmp_path)], stdout=subprocess.PIPE)
    first.stdout.readline()
    assert subprocess.run(command, capture_output=True).returncode == 75
    first.kill()
    first.wait()
    first.stdout.close()
    assert os.listdir(tmp_path / "claims") == ["k.lock"]
    with Ledger(tmp_path):
        assert os.listdir(tmp_path / "claims") == []
    with claim(tmp_path, "k"):
        pass


def test_what_a_worker_left_is_entered_and_damaged_leavings_are_not(identity_of, tmp_path):
    done, other = (Record(identity_of(seed), TrainingStatus.DONE, {"score": float(seed)}) for seed in range(2))
    leave_arrival(tmp_path, done)
    (tmp_path / "arrived" / f"{other.key}.json").write_bytes(other.to_bytes()[:-5])
    with Ledger(tmp_path) as ledger:
        assert list(ledger) == [done]
        assert os.listdir(tmp_path / "arrived") == []
        assert len(os.listdir(tmp_path / "quarantine")) == 1
        leave_arrival(tmp_path, done)
        ledger.put(done)
        assert os.listdir(tmp_path / "arrived") == []


def test_capped_trainings_are_tried_again_when_asked(identity_of, tmp_path):
    with Ledger(tmp_path) as ledger:
        for seed, status in enumerate([TrainingStatus.DONE, TrainingStatus.TIMEOUT, TrainingStatus.OOM]):
            ledger.put(Record(identity_of(seed), status))
        assert ledger.set_aside({TrainingStatus.TIMEOUT}) == 1
        assert [ledger.finished(identity_of(seed).key) is None for seed in range(3)] == [False, True, False]
    with Ledger(tmp_path) as ledger:
        assert len(ledger) == 2


def test_a_ledger_belongs_to_one_data_set_and_search_space(tmp_path):
    about = {"data": "d", "space": {"lr": [1e-4, 1e-2], "blocks": ("a",)}}
    with Ledger(tmp_path) as ledger:
        assert not ledger.bind(about)
        assert ledger.bind(about)
        with pytest.raises(ConfigError, match="was begun with other data; nothing was changed"):
            ledger.bind(about | {"data": "e"})
        with pytest.raises(ConfigError, match="with other data and space"):
            ledger.bind({"data": "e", "space": {}})
        assert ledger.bind(about)
        with pytest.raises(NotFiniteError):
            ledger.bind({"data": float("nan")})


def test_every_opening_of_a_lock_box_is_recorded(tmp_path):
    with Ledger(tmp_path) as ledger:
        first = ledger.open_test_set("test", ["a", "b"], "final comparison")
        assert ledger.open_test_set("test", ["a", "b"], "final comparison") == first
        with pytest.raises(
            ConfigError, match=r"sealed test set 'test' was opened on .* \(final comparison\) for other models"
        ):
            ledger.open_test_set("test", ["c"], "a better idea")
        ledger.open_test_set("compression", ["c"], "students")
        second = ledger.open_test_set("test", ["c"], "a better idea", again=True)
    with Ledger(tmp_path) as ledger:
        assert ledger.openings("test") == [first, second]
        assert [one.test_set for one in ledger.openings()] == ["test", "compression", "test"]
