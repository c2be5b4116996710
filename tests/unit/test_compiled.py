"""The cache of compiled programs: what a compiler reads decides, not where it lies."""

import sys
from pathlib import Path

import compiled
import process_guard
import pytest

OPTIONS = {"capture_output": True}


@pytest.fixture
def key(tmp_path, monkeypatch):
    """The key of a call in a folder with a program of two files."""
    monkeypatch.setattr(compiled.shutil, "which", lambda _: sys.executable)

    def make(folder, *words, header="#define A 0", output="program"):
        place = tmp_path / folder
        place.mkdir(exist_ok=True)
        (place / "a.c").write_text('#include "a.h"\nint main(void) { return A; }\n')
        (place / "a.h").write_text(header)
        command = ["gcc", *(words or ("-O1",)), "a.c", "-o", output]
        return compiled.call_of(command, {**OPTIONS, "cwd": place}).key

    return make


def test_the_folder_does_not_count_but_flags_and_headers_do(key, tmp_path):
    assert key("one") == key("two")
    (tmp_path / "one" / "program").write_bytes(b"of an earlier call")
    assert key("one") == key("two")
    assert len({key("one"), key("one", "-O2"), key("one", header="#define A 1"), key("one", output="other")}) == 4


def test_a_compiler_may_be_called_by_its_whole_path(key, tmp_path):
    key("one")
    command = ["/usr/bin/gcc", "-O1", "a.c", "-o", "program"]
    assert compiled.call_of(command, {**OPTIONS, "cwd": tmp_path / "one"}) is not None


@pytest.mark.parametrize(
    ("command", "options"),
    [
        (["gcc", "-fsyntax-only", "a.c"], OPTIONS),
        (["python", "-c", "0", "-o", "a"], OPTIONS),
        ("gcc a.c -o a", OPTIONS),
        (["gcc", "a.c", "-o", "a"], {}),
    ],
)
def test_other_programs_are_run(command, options):
    assert compiled.call_of(command, options) is None


def test_a_program_is_kept_and_comes_back(tmp_path, monkeypatch):
    calls = []

    def compiler(command, **options):
        if "-E" in command:
            return compiled.subprocess.CompletedProcess(command, 1, b"", b"")  # cannot be divided
        calls.append(command)
        (Path(options["cwd"]) / command[-1]).write_text(f"made {len(calls)}")
        return compiled.subprocess.CompletedProcess(command, 0, b"", b"")

    monkeypatch.setattr(compiled.shutil, "which", lambda _: sys.executable)
    monkeypatch.setattr(compiled, "_plain", compiler)
    monkeypatch.setattr(compiled.subprocess, "run", None)
    compiled.install(tmp_path / "cache")
    texts = []
    for folder, anew in (("one", False), ("two", False), ("three", True)):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "a.c").write_text("int a;")
        if anew:
            with compiled.fresh():
                compiled.subprocess.run(["gcc", "a.c", "-o", "a"], cwd=tmp_path / folder, capture_output=True)
        else:
            compiled.subprocess.run(["gcc", "a.c", "-o", "a"], cwd=tmp_path / folder, capture_output=True)
        texts.append((tmp_path / folder / "a").read_text())
    assert texts == ["made 1", "made 1", "made 2"]


def test_a_file_that_two_folders_have_is_compiled_once(tmp_path, monkeypatch):
    done = []

    def compiler(command, **options):
        folder, way = Path(options["cwd"]), next((word for word in command if word in ("-E", "-c")), "link")
        if way == "-E":
            return compiled.subprocess.CompletedProcess(command, 0, (folder / command[-1]).read_bytes(), b"")
        parts = [folder / word for word in command if word.endswith((".c", ".o"))]
        read = parts if way == "link" else parts[:1]
        done.append((way, *(path.read_text() for path in read), *(word for word in command[1:] if word[0] == "-")))
        (folder / command[command.index("-o") + 1]).write_text("+".join(path.read_text() for path in read))
        return compiled.subprocess.CompletedProcess(command, 0, b"", b"")

    monkeypatch.setattr(compiled.shutil, "which", lambda _: sys.executable)
    monkeypatch.setattr(compiled, "_plain", compiler)
    monkeypatch.setattr(compiled.subprocess, "run", None)
    compiled.install(tmp_path / "cache")
    for folder, level in (("one", "-O1"), ("two", "-O1"), ("two", "-O2")):
        (tmp_path / folder).mkdir(exist_ok=True)
        (tmp_path / folder / "a.c").write_text(f"own {folder}")
        (tmp_path / folder / "runtime.c").write_text("shared")
        command = ["gcc", level, "-I", folder, "a.c", "runtime.c", "-lm", "-o", "a"]
        compiled.subprocess.run(command, cwd=tmp_path / folder, capture_output=True)
        assert (tmp_path / folder / "a").read_text() == f"own {folder}+shared"
    assert [call[1] for call in done if call[0] == "-c"] == ["own one", "shared", "own two", "own two", "shared"]
    assert all("-lm" not in call for call in done if call[0] == "-c")
    assert all("-lm" in call for call in done if call[0] == "link")


def test_the_guard_refuses_processes():
    process_guard.install()
    with process_guard.watching(), pytest.raises(process_guard.ProcessStartedError, match="starts no process"):
        compiled.subprocess.Popen([sys.executable, "-c", "0"])
