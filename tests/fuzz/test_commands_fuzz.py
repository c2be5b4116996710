"""Generated command lines over all commands: only EDP's errors and usage errors come out, never a traceback.

Every command is called with unreadable, foreign, missing, looping and odd places, with full disks and read-only
outputs, and with hostile numbers and names. Twenty inputs are fast, six hundred slow.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from command_lines import close, commands, world
from file_rights import hold_root_to_rights

HERE = Path(__file__).parent
SECONDS = 5.0


@pytest.fixture(scope="module")
def places(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, str]]:
    """A world that an unprivileged process may walk through, and a full disk."""
    top = tmp_path_factory.mktemp("fuzz")
    world(top)
    (top / "out").mkdir()
    disk, mounted = top.parent / "full", False
    if os.geteuid() == 0:
        disk.mkdir()
        mount = ["mount", "-t", "tmpfs", "-o", "size=64k,mode=777", "tmpfs", disk]
        mounted = subprocess.run(mount, capture_output=True, check=False).returncode == 0
    close(top)
    yield top, str(disk) if mounted else "limit"
    if mounted:
        subprocess.run(["umount", disk], check=True)
    for name in ("closed", "read_only", "part_closed/below"):
        (top / name).chmod(0o755)


def run(places: tuple[Path, str], first: int, count: int) -> list[dict[str, object]]:
    words = [str(HERE / "commands_worker.py"), *map(str, (*places, first, count, SECONDS))]
    done = subprocess.run(
        [sys.executable, *words], capture_output=True, text=True, check=False, preexec_fn=hold_root_to_rights
    )
    assert done.returncode == 0, done.stderr[-2000:]
    return [json.loads(line) for line in done.stdout.splitlines()]


def check(found: list[dict[str, object]], count: int) -> None:
    assert len(found) == count
    tracebacks = [case for case in found if case["text"] or case["code"] not in (0, None)]
    assert not tracebacks, "\n".join(f"{case['seed']}: {case['words']}\n{case['text']}" for case in tracebacks)[:6000]


def test_every_command_is_called():
    called = {command.words for command in commands()}
    assert {"train", "monitor", "data", "registry"} <= {words[0] for words in called}
    assert ("data", "store", "build") in called


def test_twenty_command_lines_end_without_a_traceback(places):
    check(run(places, 0, 20), 20)


@pytest.mark.slow
@pytest.mark.parametrize("part", range(10))
def test_six_hundred_command_lines_end_without_a_traceback(places, part):
    check(run(places, 60 * part, 60), 60)
