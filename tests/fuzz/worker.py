"""Reads damaged copies of logs, one after the other, in a process with bounded memory and time a file.

Usage: ``python worker.py FOLDER CASE[,CASE] FIRST COUNT``. The last line is JSON: how many were read, refused, and what
went wrong. The damaged copy in work lies in FOLDER, so that a crash leaves its cause behind.
"""

from __future__ import annotations

import faulthandler
import json
import logging
import resource
import signal
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from edp.errors import EdpError
from edp.logs import read_recording
from edp.recording import Recording
from edp.sandbox import end

MEMORY_BYTES = 6 << 30
# By the clock, so that a busy machine has time; how long a damaged file may take the processor is bounded by EDP.
SECONDS = 60


def damaged(whole: bytes, rng: np.random.Generator) -> bytes:
    """One of the ways in which files are damaged: flipped bytes, cut off, zeros at the end, parts lost, wild sizes."""
    data = bytearray(whole)
    size = len(data)
    way = int(rng.integers(8))
    if way <= 1:
        for place in rng.integers(0, size, int(rng.integers(1, 9))):
            data[place] ^= int(rng.integers(1, 256))
    elif way == 2:
        # Where formats keep their structure: near the ends.
        for place in rng.integers(0, min(size, 2048), int(rng.integers(1, 5))):
            data[place if rng.integers(2) else size - 1 - place] ^= 1 << int(rng.integers(8))
    elif way == 3:
        del data[int(rng.integers(1, size)) :]
    elif way == 4:
        start = int(rng.integers(0, size))
        data[start:] = bytes(size - start)
    elif way == 5:
        start = int(rng.integers(0, size))
        part = data[start : start + int(rng.integers(1, 512))]
        if rng.integers(2):
            del data[start : start + len(part)]
        else:
            data[start:start] = part
    elif way == 6:
        wide = int(rng.choice([1, 2, 4, 8]))
        place = int(rng.integers(0, max(size - wide, 1)))
        wild = [b"\xff" * wide, b"\0" * wide, (b"\xff" * wide)[:-1] + b"\x7f", rng.bytes(wide)]
        data[place : place + wide] = wild[int(rng.integers(len(wild)))]
    else:
        start, stop = sorted(rng.integers(0, size, 2).tolist())
        part = min(stop - start, 256)
        data[start : start + part] = data[stop - part : stop]
    return bytes(data)


def same_where_stated(read: Recording, original: Recording) -> bool:
    """Whether a log that states to be EDP's holds EDP's values."""
    return read.source != original.source or read.digest == original.digest


class _TooSlow(Exception):
    pass


def _alarm(*_: object) -> None:
    raise _TooSlow


def read_damaged(folder: Path, case: str, first: int, count: int) -> dict[str, Any]:
    """Read damaged copies of one log; what was found."""
    path, target = folder / case, folder / f"damaged_{case}"
    whole = path.read_bytes()
    original = read_recording(path)
    found: dict[str, Any] = {"read": 0, "refused": 0, "slowest_s": 0.0, "faults": []}
    for number in range(first, first + count):
        target.write_bytes(damaged(whole, np.random.default_rng([number, *case.encode()])))
        start = time.monotonic()
        fault = ""
        signal.alarm(SECONDS)
        # A library that hangs does not answer to a signal; this ends the process with a trace.
        faulthandler.dump_traceback_later(2 * SECONDS, exit=True)
        try:
            read = read_recording(target)
            found["read"] += 1
            if not same_where_stated(read, original):
                fault = "wrong numbers"
        except EdpError as error:
            found["refused"] += 1
            if target.name not in str(error):
                fault = f"message without the file: {error}"
        except _TooSlow:
            fault = f"longer than {SECONDS} s"
        except BaseException as error:
            fault = f"{type(error).__name__}: {error}"
        finally:
            signal.alarm(0)
            faulthandler.cancel_dump_traceback_later()
        found["slowest_s"] = max(found["slowest_s"], time.monotonic() - start)
        if fault:
            found["faults"].append([number, fault[:300]])
    return found


def peak_mb() -> float:
    """Most memory that this process or one of its children held, MB."""
    # Not `ru_maxrss` of the process itself: Linux hands on what its parent, the test runner, held before the start.
    status = Path("/proc/self/status").read_text()
    own = next(int(line.split()[1]) for line in status.splitlines() if line.startswith("VmHWM:"))
    return max(own, resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss) / 1024


def main() -> None:
    folder, cases, first, count = Path(sys.argv[1]), sys.argv[2].split(","), int(sys.argv[3]), int(sys.argv[4])
    faulthandler.enable()
    logging.disable(logging.CRITICAL)
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))
    signal.signal(signal.SIGALRM, _alarm)
    results = {}
    for case in cases:
        results[case] = read_damaged(folder, case, first, count)
        print(case, file=sys.stderr)
    end()
    # Logs are read in processes of their own.
    results["peak_mb"] = peak_mb()
    print(json.dumps(results))


if __name__ == "__main__":
    main()
