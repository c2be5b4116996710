"""Unfinished files and folders of killed writers: the next writer beside them removes them, and no others."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from edp.errors import StorageError
from edp.storage import replacing, replacing_folder, write_bytes, writing

OLD_S = 2 * writing.LEFT_AFTER_S


def left(path, content=b"half"):
    """Lay out what a killed process left a while ago."""
    path.write_bytes(content)
    os.utime(path, (path.stat().st_atime - OLD_S, path.stat().st_mtime - OLD_S))
    return path


@pytest.fixture(autouse=True)
def another_process(monkeypatch):
    monkeypatch.setattr(writing, "_cleaned", set())


def test_what_a_killed_process_left_goes_with_the_next_writing(tmp_path):
    file = left(tmp_path / ".page.html.0123456789ab.tmp")
    folder = tmp_path / ".store.0123456789ab.tmp"
    folder.mkdir()
    (folder / "part").write_text("")
    os.utime(folder, (0, 0))
    write_bytes(tmp_path / "other.json", b"1")
    assert not file.exists()
    assert not folder.exists()
    assert [path.name for path in tmp_path.iterdir()] == ["other.json"]


@pytest.mark.parametrize("name", ["notes.tmp", ".notes.tmp", ".a.0123456789zz.tmp", ".a.0123456789ab.tmp.txt"])
def test_files_of_others_stay(tmp_path, name):
    file = left(tmp_path / name)
    write_bytes(tmp_path / "other.json", b"1")
    assert file.read_bytes() == b"half"


def test_a_link_and_a_young_file_stay(tmp_path):
    young = tmp_path / ".a.0123456789ab.tmp"
    young.write_bytes(b"half")
    mine = left(tmp_path / "mine")
    (tmp_path / ".b.0123456789ab.tmp").symlink_to(mine)
    write_bytes(tmp_path / "other.json", b"1")
    assert young.exists()
    assert mine.exists()
    assert (tmp_path / ".b.0123456789ab.tmp").is_symlink()


@pytest.mark.parametrize("writer", [replacing, replacing_folder])
def test_what_somebody_still_writes_stays_however_old_it_is(tmp_path, writer):
    program = "import sys; from edp.storage import write_bytes; write_bytes(sys.argv[1], b'1')"
    with writer(tmp_path / "long") as temporary:
        os.utime(temporary, (0, 0))
        subprocess.run([sys.executable, "-c", program, str(tmp_path / "other.json")], check=True)
        assert (tmp_path / "other.json").exists()
        assert temporary.exists()
        if writer is replacing:
            temporary.write_bytes(b"whole")
    assert (tmp_path / "long").exists()
    assert not list(tmp_path.glob(".*.tmp"))


def test_a_folder_that_is_lost_while_a_file_is_written_is_one_message(tmp_path):
    def write():
        with replacing(tmp_path / "out" / "a") as temporary:
            temporary.unlink()
            (tmp_path / "out").rmdir()

    with pytest.raises(StorageError, match="cannot write"):
        write()


def test_the_names_of_unfinished_files_are_known(tmp_path):
    for name in ("a", "x" * 200, "a\nb", "ü" * 60):
        with replacing(tmp_path / name) as temporary:
            assert writing.TEMPORARY.fullmatch(temporary.name)
