"""Run command lines in this process's children and print how each ended, a JSON line each.

Called with a folder of `command_lines.world`, the folder of a full disk or "", the first seed, how many, and seconds
for each. A child that is still at work when its seconds are over has ended without a traceback.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import resource
import signal
import sys
import time
import traceback
from pathlib import Path
from types import FrameType
from typing import Any

import typer

sys.path.insert(0, str(Path(__file__).parents[1] / "plugins"))
from command_lines import commands, drawn

from edp.cli import app
from edp.cli.console import refuse_empty
from edp.errors import EdpError

FILE_BYTES = 20_000
"""Largest file that a case of a "full disk" may write, where no small disk can be mounted."""


class Late(BaseException):
    """The seconds of a case are over."""


def late(number: int, frame: FrameType | None) -> None:
    raise Late


def ended(words: list[str]) -> str:
    """Run one command line; an empty text if it ended as commands may, else what came out."""
    sys.argv = ["edp", *words]
    command: Any = typer.main.get_command(app)
    try:
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            refuse_empty(words)
            command(words, standalone_mode=False, prog_name="edp")
    except (EdpError, typer.Exit, typer.Abort, Late, MemoryError, KeyboardInterrupt, SystemExit):
        return ""
    except Exception as error:
        return "" if hasattr(error, "format_message") else traceback.format_exc(limit=-6)
    return ""


def child(words: list[str], seconds: float, full: str, pipe: int) -> None:
    """Run one command line in a child and write how it ended into a pipe."""
    os.setsid()
    quiet = os.open(os.devnull, os.O_RDWR)
    for stream in (0, 1, 2):
        os.dup2(quiet, stream)
    if full == "limit":
        resource.setrlimit(resource.RLIMIT_FSIZE, (FILE_BYTES, FILE_BYTES))
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    signal.signal(signal.SIGALRM, late)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    text = ended(words)
    signal.setitimer(signal.ITIMER_REAL, 0)
    os.write(pipe, text.encode(errors="backslashreplace")[:60_000])
    os.close(pipe)
    os._exit(0)


def run_case(words: list[str], seconds: float, full: str) -> dict[str, Any]:
    """Run one command line in a child of its own."""
    reading, writing = os.pipe()
    began = time.monotonic()
    process = os.fork()
    if process == 0:
        os.close(reading)
        try:
            child(words, seconds, full, writing)
        finally:
            os._exit(3)
    os.close(writing)
    code = None
    while code is None and time.monotonic() - began < seconds + 10.0:
        done, status = os.waitpid(process, os.WNOHANG)
        code = os.waitstatus_to_exitcode(status) if done else None
        time.sleep(0.005)
    with contextlib.suppress(ProcessLookupError):  # and what it started
        os.killpg(process, signal.SIGKILL)
    if code is None:
        os.waitpid(process, 0)
    with os.fdopen(reading, "rb") as stream:
        text = stream.read().decode()
    return {"words": words, "text": text, "code": code, "seconds": round(time.monotonic() - began, 2)}


def main() -> None:
    """Run the cases."""
    top, full, first, count, seconds = Path(sys.argv[1]), sys.argv[2], *map(int, sys.argv[3:5]), float(sys.argv[5])
    # Imported once; children inherit them.
    import edp.jobs
    import edp.workflows.api
    import edp.workflows.monitor
    import edp.workflows.search  # noqa: F401

    os.environ["HOME"] = str(top)
    os.chdir(top)
    every = commands()
    for seed in range(first, first + count):
        words = drawn(seed, top, every)
        words = [word.replace("\0", "") for word in words]
        disk = ""
        if full and seed % 5 == 0:
            disk = "limit" if full == "limit" else "mount"
            if disk == "mount":
                words = [word.replace(f"{top}/out", full) for word in words]
        found = run_case(words, seconds, disk)
        print(json.dumps(found | {"seed": seed, "disk": disk}), flush=True)


if __name__ == "__main__":
    main()
