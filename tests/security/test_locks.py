"""A lock is a file of its own: nothing else is ever written to in its name, and one holder at a time works."""

import os
import subprocess
import sys

import pytest

from edp.errors import BusyError, StorageError
from edp.storage import check_held, check_writable, find_holder, hold, release, replacing, write_bytes
from edp.storage.ledger import Ledger, Record, TrainingIdentity, TrainingStatus, claim
from edp.storage.runs import Run

PRECIOUS = "the only copy"


def claim_of(folder):
    return claim(folder, "key")


HOLDERS = {"run": (Run, ".lock"), "ledger": (Ledger, ".lock"), "claim": (claim_of, "claims/key.lock")}


@pytest.fixture
def precious(tmp_path):
    file = tmp_path / "precious"
    file.write_text(PRECIOUS)
    return file


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "folder" / "claims").mkdir(parents=True)
    return tmp_path / "folder"


@pytest.mark.parametrize("kind", HOLDERS)
@pytest.mark.parametrize("make", [os.symlink, os.link], ids=["symbolic", "hard"])
def test_a_link_is_not_written_through(folder, precious, kind, make):
    open_it, name = HOLDERS[kind]
    make(precious, folder / name)
    with pytest.raises(StorageError, match="nothing was changed: remove it"):
        open_it(folder)
    assert precious.read_text() == PRECIOUS


@pytest.mark.parametrize("kind", HOLDERS)
def test_a_link_to_nothing_makes_no_file(folder, tmp_path, kind):
    open_it, name = HOLDERS[kind]
    (folder / name).symlink_to(tmp_path / "elsewhere")
    with pytest.raises(StorageError, match="symbolic link"):
        open_it(folder)
    assert not (tmp_path / "elsewhere").exists()


@pytest.mark.parametrize("kind", HOLDERS)
@pytest.mark.parametrize("make", [os.mkfifo, os.mkdir], ids=["pipe", "folder"])
def test_what_is_no_file_is_one_message(folder, kind, make):
    open_it, name = HOLDERS[kind]
    make(folder / name)
    with pytest.raises(StorageError, match="not a lock file but a"):
        open_it(folder)
    assert find_holder(folder / name) is None


def test_a_file_of_the_user_keeps_its_content(folder):
    (folder / ".lock").write_text(PRECIOUS)
    with pytest.raises(StorageError, match="holds something else"):
        Run(folder)
    assert (folder / ".lock").read_text() == PRECIOUS


def test_locks_of_killed_holders_and_of_lost_power_are_taken(folder):
    for left in ("", "\0" * 60, "17 on some-host since 2026-01-31 23:59:59"):
        (folder / ".lock").write_text(left)
        with Run(folder):
            assert find_holder(folder / ".lock").startswith(f"{os.getpid()} on ")


def test_a_second_holder_is_told_who_holds(folder):
    with Run(folder), pytest.raises(BusyError, match=f"in use by process {os.getpid()} on"):
        Run(folder)


def test_a_holder_whose_lock_was_removed_stops(folder):
    with Run(folder) as first:
        (folder / ".lock").unlink()
        with pytest.raises(StorageError, match="removed or replaced"):
            first.write_status("running")
        with Run(folder) as second:
            second.write_status("finished")
            with pytest.raises(StorageError, match="removed or replaced"):
                first.write_history([])
        assert not (folder / "history.jsonl").exists()


def test_a_coordinator_whose_lock_was_removed_enters_nothing(folder):
    identity = TrainingIdentity("job", {}, {}, 0, 1, "code", "data", {})
    with Ledger(folder) as first:
        (folder / ".lock").unlink()
        with Ledger(folder) as second, pytest.raises(StorageError, match="removed or replaced"):
            first.put(Record(identity, TrainingStatus.DONE, {"score": 1.0}))
        assert len(second) == 0


def test_release_leaves_the_lock_of_another_alone(tmp_path):
    file = tmp_path / ".lock"
    mine = hold(file)
    file.unlink()
    theirs = hold(file)
    release(file, mine)
    check_held(file, theirs)
    release(file, theirs)
    assert not file.exists()


def test_files_follow_the_umask(tmp_path):
    code = "import os, sys; os.umask(0o077); from edp.storage import write_bytes, hold; "
    code += "write_bytes(sys.argv[1] + '/a', b''); hold(sys.argv[1] + '/.lock')"
    subprocess.run([sys.executable, "-c", code, str(tmp_path)], check=True)
    assert {name: (tmp_path / name).stat().st_mode & 0o777 for name in ("a", ".lock")} == {"a": 0o600, ".lock": 0o600}


def test_a_folder_in_the_way_is_told_as_that(tmp_path):
    (tmp_path / "a").mkdir()
    with pytest.raises(StorageError, match="a folder of this name is in the way"):
        write_bytes(tmp_path / "a", b"x")
    assert os.listdir(tmp_path) == ["a"]


def test_the_next_holder_removes_what_a_kill_left(folder):
    with replacing(folder / ("a" * 100)) as temporary:
        (folder / f"{temporary.name[:-10]}abcdef.tmp").write_bytes(b"half")
    (folder / ("a" * 100)).unlink()
    (folder / ".mine.tmp").mkdir()
    with Run(folder):
        assert sorted(os.listdir(folder)) == [".lock", ".mine.tmp", "claims"]


def test_a_long_name_is_written(tmp_path):
    write_bytes(tmp_path / ("n" * 250), b"x")
    assert os.listdir(tmp_path) == ["n" * 250]


def test_writability_is_seen_at_once(tmp_path, monkeypatch):
    check_writable(tmp_path / "new")
    assert os.listdir(tmp_path / "new") == []

    def read_only(target):
        raise OSError(30, "Read-only file system")

    monkeypatch.setattr("edp.storage.writing._temporary", read_only)
    with pytest.raises(StorageError, match=r"cannot write into .*Read-only file system"):
        check_writable(tmp_path)
