"""Paths that cannot be looked at: one message, or a row of a listing; no other code looks at paths."""

from __future__ import annotations

import ast
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from file_rights import hold_root_to_rights

from edp.errors import StorageError
from edp.storage.paths import entries_of, files_below, full_path, is_file_at, is_folder_at, is_there, status_of

SOURCE = Path(__file__).parents[2] / "src" / "edp"
LOOKS = {
    "exists",
    "is_file",
    "is_dir",
    "is_symlink",
    "iterdir",
    "glob",
    "rglob",
    "stat",
    "lstat",
    "resolve",
    "samefile",
}
OF_OS = {"exists", "isfile", "isdir", "islink", "lexists", "getsize", "getmtime", "stat", "lstat", "scandir", "listdir"}
ALLOWED = {
    "storage/paths.py": "the one place",
    "storage/reading.py": "looks before it opens, and names the file itself",
    "storage/locks.py": "compares the entry with the open file",
    "storage/machine_code.py": "files of the package itself",
    "storage/ledger/record.py": "files of the package itself",
    "sim/machine/machine_files.py": "names the machine file itself; files of the package",
    "sim/physics/material.py": "files of the package",
    "logs/detect.py": "names the log itself",
    "logs/store/opening.py": "names the rows itself",
    "control/fmu/archive.py": "names the archive itself, and looks at entries of a ZIP file",
    "export/casadi/runtime.py": "runs without EDP",
    "export/casadi/horizon.py": "runs without EDP",
    "export/ros2/package/core.py": "runs without EDP",
}
ROOMS = {
    "logs/formats": "reads in the sandbox, whose errors are told by the process outside",
    "sandbox": "looks at places of the system",
    "testing": "looks at what a test wrote",
}
"""Why a file may look at paths by itself."""


def looks(text: str) -> list[tuple[int, str]]:
    """Return lines and names of calls that look at a path."""
    found = []
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
            owner, name = ast.unparse(node.func.value), node.func.attr
            of_os = owner in ("os", "os.path") and name in OF_OS
            # `task.resolve(...)` and the like have arguments that no path takes.
            of_path = name in LOOKS and owner not in ("os", "os.path") and (name in ("glob", "rglob") or not node.args)
            if of_os or of_path:
                found.append((node.lineno, f"{owner}.{name}"))
    return found


def test_paths_are_looked_at_by_one_module():
    wrong, needed = [], set()
    for file in sorted(SOURCE.rglob("*.py")):
        name = file.relative_to(SOURCE).as_posix()
        found = looks(file.read_text())
        reason = next((key for key in (*ALLOWED, *ROOMS) if name == key or name.startswith(f"{key}/")), None)
        if found and reason is None:
            wrong += [f"{name}:{line} {call}: use edp.storage.paths" for line, call in found]
        needed |= {reason} if found else set()
    assert wrong == []
    assert needed >= {*ALLOWED, *ROOMS} - {"storage/paths.py"}, "an exception that nothing needs"


@pytest.mark.parametrize(
    "line", ["p.exists()", "p.is_file()", "os.path.isdir(p)", "p.glob('*')", "os.stat(p)", "p.resolve()", "p.stat()"]
)
def test_the_lint_sees_a_look(line):
    assert looks(line)


ODD = {"too long a name": "n" * 300, "a NUL": "a\0b", "a loop": "loop/below"}


@pytest.mark.parametrize("look", [is_file_at, is_folder_at, is_there, status_of, entries_of])
@pytest.mark.parametrize("odd", ODD)
def test_a_path_that_cannot_be_looked_at_is_one_message(look, odd, tmp_path):
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    with pytest.raises(StorageError, match="cannot be l") as caught:
        look(f"{tmp_path}/{ODD[odd]}")
    assert len(str(caught.value)) < 400


def test_what_is_not_there_is_no_error(tmp_path):
    (tmp_path / "file").write_text("")
    for absent in (tmp_path / "no", tmp_path / "file" / "below", tmp_path / "no" / "no"):
        assert not is_file_at(absent)
        assert not is_folder_at(absent)
        assert entries_of(absent) == []
    with pytest.raises(StorageError, match="not there"):
        status_of(tmp_path / "no")
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    with pytest.raises(StorageError, match="loop of links"):
        full_path(tmp_path / "loop")
    assert list(files_below(tmp_path)) == [tmp_path / "file"]


COMMANDS = [
    *(["runs"], ["compare", "closed/other"], ["report"], ["evaluate"], ["registry", "list"], ["store", "check"]),
    *(["monitor", "report"], ["search", "status"], ["inspect"], ["train", "--out", "new"], ["init", "--yes"]),
]


@pytest.mark.parametrize("words", COMMANDS, ids=" ".join)
def test_a_folder_without_rights_is_one_message(words, tmp_path):
    for name in ("open", "closed"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "run.json").write_text("{}")
    (tmp_path / "closed").chmod(0)
    try:
        done = subprocess.run(
            [sys.executable, "-m", "edp", *words, "closed/below"],
            cwd=tmp_path,
            capture_output=True,
            text=True,
            preexec_fn=hold_root_to_rights,
            check=False,
            env=os.environ | {"COLUMNS": "200"},
        )
    finally:
        (tmp_path / "closed").chmod(0o755)
    assert "Traceback" not in done.stderr
    assert done.returncode == 1
    assert "Permission denied" in done.stderr
    assert done.stderr.count("error:") == 1


def test_a_listing_goes_on_beyond_a_folder_without_rights(tmp_path):
    for name in ("a", "b", "c"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "run.json").write_text("{}")
    (tmp_path / "b").chmod(0)
    words = [sys.executable, "-m", "edp", "runs", str(tmp_path), "--json"]
    done = subprocess.run(words, capture_output=True, text=True, check=False, preexec_fn=hold_root_to_rights)
    (tmp_path / "b").chmod(0o755)
    rows = {Path(run["folder"]).name: run["state"] for run in json.loads(done.stdout)["runs"]}
    assert rows == {"a": "stopped", "b": "cannot be read: permission denied", "c": "stopped"}
