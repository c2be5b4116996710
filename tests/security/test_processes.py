"""No process outlives the command that started it, however that ends; a request to end is taken as Ctrl-C is."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch

from edp.cli import process
from edp.cli.console import run_app

LINUX = pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")
# Two jobs that last for ever in a pool of two; the process says who works for it once both have begun.
FOREVER = """
import os, sys, time
from pathlib import Path
from edp.jobs.workers import WorkUnit, Workers

def forever(identity, where):
    Path(where["folder"], identity.config["name"]).write_text(str(os.getpid()))
    while True:
        time.sleep(0.01)

if __name__ == "__main__":
    sys.path.insert(0, "FOLDER")
    from edp.cli import process
    process.stop_on_request()
    try:
        units = [WorkUnit("forever:forever", name, {"name": name}, where={"folder": "FOLDER"}) for name in "abc"]
        list(Workers(count=2).map(units))
    except KeyboardInterrupt:
        sys.exit(process.exit_code_of_stop(130))
"""


def alive(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except OSError:
        return False


def until(condition, seconds=240.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.02)


def descendants(pid):
    children = {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                parent = int((entry / "stat").read_text().rpartition(")")[2].split()[1])
            except OSError:
                continue
            children.setdefault(parent, []).append(int(entry.name))
    found, ahead = [], [pid]
    while ahead:
        below = children.get(ahead.pop(), [])
        found += below
        ahead += below
    return found


def heeds_interrupts() -> None:
    """In a new process: a shell starts what runs in its background with Ctrl-C ignored, and children inherit that."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


@LINUX
@pytest.mark.parametrize(
    ("number", "code"),
    [(signal.SIGKILL, -signal.SIGKILL), (signal.SIGTERM, 128 + signal.SIGTERM), (signal.SIGINT, 130)],
    ids=["kill", "terminate", "Ctrl-C"],
)
def test_helpers_of_a_simulation_end_with_it(tmp_path, number, code):
    script = tmp_path / "forever.py"
    script.write_text(FOREVER.replace("FOLDER", str(tmp_path)))
    command = [sys.executable, str(script)]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, preexec_fn=heeds_interrupts) as parent:
        until(lambda: (tmp_path / "a").exists() and (tmp_path / "b").exists())
        helpers = descendants(parent.pid)
        assert len(helpers) >= 2
        parent.send_signal(number)
        assert parent.wait(60) == code
        until(lambda: not any(map(alive, helpers)))
        assert "Traceback" not in parent.stderr.read()


@LINUX
def test_a_helper_whose_parent_is_gone_before_it_asks_ends_too():
    code = "from edp.sandbox.processes import die_with_parent; die_with_parent(1); print('lives')"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (1, "")


def test_without_the_systems_help_a_helper_looks(monkeypatch):
    from edp.sandbox import processes

    ended, parents = [], iter([7, 7, 1])
    monkeypatch.setattr(processes.os, "getppid", lambda: next(parents))
    monkeypatch.setattr(processes.os, "_exit", ended.append)
    monkeypatch.setattr(processes.time, "sleep", lambda seconds: None)
    processes._watch(7)
    assert ended == [1]


def test_a_request_to_end_is_one_message_and_its_code(capsys, monkeypatch):
    before = signal.getsignal(signal.SIGTERM)
    monkeypatch.setattr(process, "_stopped_by", [])
    try:
        process.stop_on_request()

        def app(standalone_mode):
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(60)

        assert run_app(app) == 143
    finally:
        signal.signal(signal.SIGTERM, before)
    assert "give the same command again" in capsys.readouterr().err


def allocate_numpy():
    np.empty(1 << 60, np.uint8)


def allocate_torch():
    torch.empty(1 << 60, dtype=torch.uint8)


def allocate_python():
    raise MemoryError


@pytest.mark.parametrize("allocate", [allocate_python, allocate_numpy, allocate_torch])
@pytest.mark.parametrize("command", ["train", "simulate", "screen", "report", "search", "inspect"])
def test_memory_that_is_gone_is_one_message(capsys, monkeypatch, allocate, command):
    monkeypatch.setattr(sys, "argv", ["edp", command, "x"])
    assert run_app(lambda standalone_mode: allocate()) == 1
    said = capsys.readouterr().err
    assert f"edp {command}: not enough memory" in " ".join(said.split())
    assert "Take" in said
    assert "Traceback" not in said


def test_other_errors_are_not_taken_for_want_of_memory():
    def app(standalone_mode):
        raise RuntimeError("mat1 and mat2 shapes cannot be multiplied")

    with pytest.raises(RuntimeError, match="shapes"):
        run_app(app)
