"""Files are whole or absent, whatever happens while they are written."""

import errno
import os

import pytest

from edp.errors import StorageError
from edp.storage import make_folder, read_json, replacing, write_bytes, write_json


def test_write_replaces_and_leaves_nothing_else(tmp_path):
    path = tmp_path / "deep" / "file.bin"
    write_bytes(path, b"old")
    write_bytes(path, b"new")
    assert path.read_bytes() == b"new"
    assert os.listdir(path.parent) == ["file.bin"]
    assert path.stat().st_mode & 0o777 == 0o644


def test_a_failure_half_way_leaves_the_old_file(tmp_path):
    path = tmp_path / "file.bin"
    write_bytes(path, b"old")

    def stopped():
        with replacing(path) as temporary:
            temporary.write_bytes(b"ne")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        stopped()
    assert path.read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["file.bin"]


def test_a_full_disk_is_told_with_its_path(tmp_path):
    path = tmp_path / "file.bin"
    with pytest.raises(StorageError, match=r"file\.bin.*No space left.*free space"), replacing(path):
        raise OSError(errno.ENOSPC, "No space left on device")
    assert os.listdir(tmp_path) == []


def test_a_file_in_the_way_of_a_folder(tmp_path):
    (tmp_path / "file").write_text("x")
    for target in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(StorageError, match="cannot create folder"):
            make_folder(target)
    assert make_folder(tmp_path / "a" / "b") == make_folder(tmp_path / "a" / "b")


def test_json_round_trip_and_refusals(tmp_path):
    path = tmp_path / "facts.json"
    write_json(path, {"a": [1, 2.5, None, "é"]})
    assert read_json(path) == {"a": [1, 2.5, None, "é"]}
    with pytest.raises(ValueError, match="JSON compliant"):
        write_json(path, {"a": float("nan")})
    assert read_json(path) == {"a": [1, 2.5, None, "é"]}
    path.write_text('{"a": [1, ')
    with pytest.raises(StorageError, match="not valid JSON"):
        read_json(path)
    with pytest.raises(StorageError, match="cannot be read"):
        read_json(tmp_path / "none.json")
