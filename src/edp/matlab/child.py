"""The process in which MAT files are unpacked: it forks once a file, so what one file breaks no other file meets.

An order is a line of JSON on standard input; the answer goes to standard output (`edp.matlab.wire`). A forked process
has limits on memory and on processor time, and ends as soon as it has answered. This one has a single thread, so
forking is safe here, which it is not in a process that trains.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import sys
import traceback
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import scipy.io

from edp.errors import DataError, EdpError
from edp.matlab.check import check_size
from edp.matlab.found import INFO, MAGIC, Found, is_v4
from edp.matlab.library import matio
from edp.matlab.objects import collect
from edp.matlab.wire import pack, refuse, send

IDLE_S = 60.0
"""After so long without an order the process ends; the next file starts another."""
START_BYTES = 512 << 20
"""Address space that walking through a structure may take."""
COPIES = 8
"""Address space a byte of unpacked variables: the libraries copy them several times."""
OBJECT_BYTES = 8192
START_S = 2.0
"""Processor time that any file may take; the limits below are several times what sound files take."""
WALK_BYTES_PER_S = 2e5
BYTES_PER_S = 2e6
OBJECT_S = 0.01
WALL = 30
"""Longest time by the clock, in allowed processor times: a process may also wait for ever."""
Limit = Callable[[float, int], None]
SIGNAL_CODE = 128
"""Exit code of this process where a signal ended a forked one, less the number of the signal."""


def main() -> None:
    """Take orders until standard input ends, nothing comes, or a forked process dies."""
    answers = os.dup(1)
    os.dup2(2, 1)
    if not hasattr(os, "fork"):
        line = sys.stdin.buffer.readline()
        if line:
            _answer(line, answers)
        return
    import select

    while select.select([0], [], [], IDLE_S)[0] and (line := _line()):
        child = os.fork()
        if child == 0:
            code = 1
            try:
                _answer(line, answers)
                code = 0
            except BaseException:
                traceback.print_exc()
            finally:
                os._exit(code)
        code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        if code:
            raise SystemExit(SIGNAL_CODE - code if code < 0 else code)


def _line() -> bytes:
    """One order. They come one at a time, so nothing may stay behind in a buffer."""
    line = b""
    while not line.endswith(b"\n"):
        part = os.read(0, 65536)
        if not part:
            return b""
        line += part
    return line


def _answer(line: bytes, answers: int) -> None:
    order = json.loads(line)

    def write(data: Any) -> None:
        view = memoryview(data)
        while view:
            view = view[os.write(answers, view) :]

    os.chdir(order["folder"])
    try:
        found = open_file(Path(order["path"]), order["variable"], _limit)
        ready = pack(found)
    except EdpError as error:
        refuse(str(error), write)
    except MemoryError:
        refuse(
            f"'{order['path']}' takes more memory than a MAT file of its size may; it may be damaged: copy or export "
            "it again, or save fewer variables in a file",
            write,
        )
    else:
        send(ready, write)


def _limit(seconds: float, more: int) -> None:
    """Limit processor time and further memory from here on."""
    _limit_memory(more)
    if hasattr(signal, "setitimer"):
        signal.setitimer(signal.ITIMER_PROF, seconds)
        signal.setitimer(signal.ITIMER_REAL, WALL * seconds)


def _limit_memory(more: int) -> None:
    """Let this process take some bytes more than it has; where the system does not tell or obey, do nothing."""
    with contextlib.suppress(ImportError, OSError, ValueError):
        import resource

        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
        wanted = pages * os.sysconf("SC_PAGE_SIZE") + more
        bounds = [bound for bound in resource.getrlimit(resource.RLIMIT_AS) if bound != resource.RLIM_INFINITY]
        resource.setrlimit(resource.RLIMIT_AS, (min([wanted, *bounds[1:]]), resource.getrlimit(resource.RLIMIT_AS)[1]))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def open_file(path: Path, variable: str | None, limit: Limit = lambda *_: None) -> Found:
    """Everything in a file, or in one variable of it.

    Args:
        path: the file.
        variable: read this one only.
        limit: called with the processor time in s and the bytes that may be taken from then on.

    Raises:
        DataError: the file is damaged or holds more than this machine's memory.
    """
    variables = _load(path, limit)
    info = variables.pop(INFO, None)
    names = list(variables)
    if variable is not None:
        variables = {name: value for name, value in variables.items() if name == variable}
    found = collect(variables)
    found.names = names
    if info is not None:
        array = np.asarray(info)
        found.info = str(array.ravel()[0]) if array.size else ""
    return found


def _load(path: Path, limit: Limit) -> dict[str, Any]:
    with path.open("rb") as stream:
        head = stream.read(128)
    if any(magic.startswith(head[: len(magic)]) for magic in MAGIC) and len(head) < 128:
        raise DataError(f"'{path}' is a MAT file that ends inside its header (truncated); copy or export it again")
    size = path.stat().st_size
    limit(START_S + size / WALK_BYTES_PER_S, START_BYTES)
    held, objects = (size, 1) if is_v4(head) else check_size(path)
    limit(START_S + held / BYTES_PER_S + objects * OBJECT_S, START_BYTES + COPIES * held + objects * OBJECT_BYTES)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            if is_v4(head):
                variables = scipy.io.loadmat(str(path))
            else:
                variables = matio.load_from_mat(str(path), add_table_attrs=True)
        except Exception as error:
            # The parsers meet damaged bytes with any exception there is; every one means the same to the user.
            raise DataError(
                f"'{path}' cannot be read as a MAT file ({type(error).__name__}: {error}); it may be truncated or "
                "damaged: copy or export it again"
            ) from error
    failed = [str(item.message) for item in caught if "Failed to load" in str(item.message)]
    if failed:
        raise DataError(f"'{path}': an object in this MAT file is damaged ({failed[0]}); copy or export it again")
    nameless = [name for name in variables if not isinstance(name, str)]
    if nameless:
        raise DataError(
            f"'{path}' holds a variable whose name is no text ({nameless[0]!r}); it is damaged: copy or export it again"
        )
    return {name: value for name, value in variables.items() if not name.startswith("__")}


if __name__ == "__main__":
    main()
