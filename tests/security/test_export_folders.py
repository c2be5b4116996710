"""Folders of exports: one process writes them, they hold one export, and a list of its files says that it is whole."""

from __future__ import annotations

import hashlib
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from edp.errors import BusyError, ExportError, StorageError
from edp.export import folder as room
from edp.export.c.model import _check
from edp.export.folder import LIST, UNFINISHED, write_export
from edp.export.sizes import MAX_COLUMNS, check_numbers, check_sizes
from edp.ir import Graph, layers
from edp.ir.base import INPUT
from edp.storage import hold

FIRST = {"a.h": b"first", "core/b.c": b"b of the first", "core/c.c": b"same"}
SECOND = {"a.h": b"second", "core/c.c": b"same", "d.m": b"d"}


def content(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def whole(folder: Path, files: dict[str, bytes]) -> bool:
    """Whether a folder holds these files of an export, and its list says so."""
    listed = dict(reversed(line.split("  ")) for line in (folder / LIST).read_text().splitlines())
    found = content(folder)
    return listed == {file: hashlib.sha256(data).hexdigest() for file, data in files.items()} and all(
        found[file] == data for file, data in files.items()
    )


def test_a_second_export_replaces_the_first_wholly_and_leaves_other_files(tmp_path):
    written = write_export(tmp_path, FIRST)
    assert written == [tmp_path / file for file in FIRST]
    assert whole(tmp_path, FIRST)
    (tmp_path / "own.txt").write_bytes(b"of the user")
    write_export(tmp_path, SECOND)
    assert whole(tmp_path, SECOND)
    assert set(content(tmp_path)) == {*SECOND, LIST, "own.txt"}  # no lock, no part, nothing of the first
    write_export(tmp_path, {"x.h": b"x"})
    assert not (tmp_path / "core").exists()


def test_the_list_is_one_that_sha256sum_checks(tmp_path):
    write_export(tmp_path, FIRST)
    done = subprocess.run(["sha256sum", "-c", LIST], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0
    assert done.stdout.count(": OK") == len(FIRST)


def test_a_folder_that_another_process_writes_is_left_alone(tmp_path):
    write_export(tmp_path, FIRST)
    held = hold(tmp_path / ".lock")
    program = "import sys; from edp.export.folder import write_export; write_export(sys.argv[1], {'a.h': b'other'})"
    done = subprocess.run([sys.executable, "-c", program, str(tmp_path)], capture_output=True, text=True)
    assert "BusyError" in done.stderr
    assert "is being written by process" in done.stderr
    with pytest.raises(BusyError, match="nothing was changed"):
        write_export(tmp_path, SECOND)
    held.close()
    assert whole(tmp_path, FIRST)
    write_export(tmp_path, SECOND)
    assert whole(tmp_path, SECOND)


@pytest.mark.parametrize("killed", range(1, 7))
def test_an_export_that_ends_anywhere_is_absent_and_the_next_one_mends_it(killed, tmp_path, monkeypatch):
    """Every write in turn is the last one of the process; what lies there is then replaced wholly."""
    write_export(tmp_path, FIRST)
    plain, count = room.write_bytes, 0

    def stops(path, data):
        nonlocal count
        count += 1
        if count == killed:
            (path.parent / f".{path.name}.0123456789ab.tmp").write_bytes(data[:2])  # as a kill leaves it
            raise KeyboardInterrupt
        plain(path, data)

    monkeypatch.setattr(room, "write_bytes", stops)
    try:
        write_export(tmp_path, SECOND)
    except KeyboardInterrupt:
        assert killed <= 5
        assert not (tmp_path / LIST).exists() or whole(tmp_path, FIRST)
    else:
        assert killed == 6
    monkeypatch.undo()
    third = {"a.h": b"third", "e.c": b"e"}
    write_export(tmp_path, third)
    assert whole(tmp_path, third)
    assert set(content(tmp_path)) == {*third, LIST}


def test_a_changed_file_that_would_be_removed_is_the_users(tmp_path):
    write_export(tmp_path, FIRST)
    (tmp_path / "core/b.c").write_bytes(b"changed by hand")
    before = content(tmp_path)
    with pytest.raises(StorageError, match=r"b\.c.*changed since"):
        write_export(tmp_path, SECOND)
    assert content(tmp_path) == before


@pytest.mark.parametrize("entry", ["../outside.txt", "/etc/outside.txt", "core/../../outside.txt", "link/outside.txt"])
def test_a_hostile_list_removes_nothing_outside(entry, tmp_path):
    outside, folder = tmp_path / "outside.txt", tmp_path / "folder"
    outside.write_bytes(b"mine")
    folder.mkdir()
    (folder / "link").symlink_to(tmp_path)
    digest = hashlib.sha256(b"mine").hexdigest()
    (folder / LIST).write_text(f"{digest}  {entry}\nnonsense\n\n{'0' * 64}  \n")
    write_export(folder, SECOND)
    assert outside.read_bytes() == b"mine"
    assert whole(folder, SECOND)


def test_files_are_not_written_through_a_link(tmp_path):
    outside, folder = tmp_path / "outside", tmp_path / "folder"
    outside.mkdir()
    folder.mkdir()
    (folder / "core").symlink_to(outside)
    with pytest.raises(StorageError, match="symbolic link"):
        write_export(folder, FIRST)
    assert not list(outside.iterdir())
    assert not (folder / LIST).exists()


def test_rests_of_killed_exports_go_and_other_hidden_files_stay(tmp_path):
    (tmp_path / "core").mkdir()
    rests = [tmp_path / ".predictor_tangent.h.k3_9abcd.tmp", tmp_path / "core" / ".b.c.zzzzzzzz.tmp"]
    others = [tmp_path / ".notes.tmp", tmp_path / ".gitignore", tmp_path / "a.12345678.tmp"]
    for path in (*rests, *others):
        path.write_bytes(b"x")
    write_export(tmp_path, FIRST)
    assert not [path for path in rests if path.exists()]
    assert all(path.exists() for path in others)
    assert not (tmp_path / UNFINISHED).exists()


def test_an_unwritable_folder_is_told(tmp_path):
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(StorageError):
        write_export(tmp_path / "file" / "folder", FIRST)


def bundle_with(rate=100.0, horizons=(1,), coverages=()):
    output = SimpleNamespace(coverages=coverages)
    task = SimpleNamespace(rate_hz=rate, horizons=horizons)
    return SimpleNamespace(task=task, predictor=SimpleNamespace(output=output), adaptation=None)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"rate": float("nan")}, "rate"),
        ({"rate": float("inf")}, "rate"),
        ({"rate": 0.0}, "rate"),
        ({"rate": -1.0}, "rate"),
        ({"rate": "100; system('x')"}, "rate"),
        ({"horizons": (1, 2**31)}, "2147483648 ticks"),
        ({"coverages": (0.5, 1.0)}, "cover"),
        ({"coverages": (float("nan"),)}, "cover"),
    ],
)
def test_numbers_that_code_cannot_state_are_refused(given, said):
    check_numbers(bundle_with())
    with pytest.raises(ExportError, match=said):
        check_numbers(bundle_with(**given))


def test_sizes_beyond_an_index_of_the_code_are_refused():
    check_sizes({"window": 2**31 - 1})
    with pytest.raises(ExportError, match="window: 2,147,483,648"):
        check_sizes({"window": 2**31})
    columns = tuple(range(0, 40, 2))
    for inputs, last in ((MAX_COLUMNS, MAX_COLUMNS - 1), (MAX_COLUMNS + 1, MAX_COLUMNS)):
        chosen = layers.Gather(name="chosen", inputs=(INPUT,), columns=(*columns, last))
        graph = Graph(inputs, (chosen,), {"prediction": "chosen"})
        model = SimpleNamespace(graph=graph, bundle=bundle_with(), plan=None, adapts=False, state_bytes=lambda: 0)
        if last < MAX_COLUMNS:
            _check(model)
        else:
            with pytest.raises(ExportError, match="chooses from: 65,537"):
                _check(model)
    assert np.uint16(MAX_COLUMNS - 1) == MAX_COLUMNS - 1


def test_a_killed_export_leaves_nothing_behind_the_next_one(tmp_path):
    # The process is killed while it writes the first file; its name is the one that the writer gives.
    script = (
        "import os, signal, sys\n"
        "from edp.storage import writing\n"
        "from edp.export.folder import write_export\n"
        "real = writing.os.fsync\n"
        "def kill(handle):\n"
        "    if any('a.h' in name for name in os.listdir(sys.argv[1])):\n"
        "        os.kill(os.getpid(), signal.SIGKILL)\n"
        "    real(handle)\n"
        "writing.os.fsync = kill\n"
        "write_export(sys.argv[1], {'a.h': b'1'})\n"
    )
    done = subprocess.run([sys.executable, "-c", script, str(tmp_path)], check=False)
    assert done.returncode == -signal.SIGKILL
    assert [path.name for path in tmp_path.iterdir() if path.suffix == ".tmp"]
    write_export(tmp_path, {"a.h": b"2"})
    assert {path.name for path in tmp_path.iterdir()} == {"a.h", "export.sha256"}
