"""How much memory and processor time the reader of one log may take, as functions of the file and its headers.

Memory beyond what the process has when it begins: `START_BYTES` + `COPIES` x the file's size + the largest need that
its checked headers announced (`edp.storage.memory.announce`), and never more than the machine has free. Processor time
of one
request: `START_S` + what the size, the announced work and the wanted values take at speeds well below those of a slow
computer.
"""

from __future__ import annotations

import contextlib
import os
import re
import signal
from collections.abc import Iterator
from pathlib import Path

from edp.errors import DataError
from edp.storage import memory as limits
from edp.storage.memory import gigabytes

try:
    import resource
except ImportError:  # not POSIX
    resource = None  # type: ignore[assignment]

START_BYTES = 512 << 20
"""Memory for any file, bytes: libraries and the initial size of their memory pools."""
COPIES = 16
"""Memory factor of text. A cell of two bytes becomes a value of eight, of which libraries hold two copies."""
RESERVED_BYTES = 4 << 30
"""Address space in addition to memory, bytes. Thread arenas and allocator pools reserve it, mostly without using it."""
START_S = 5.0
"""Processor time for any request, s."""
BYTES_PER_S = 1e6
"""Assumed reading speed, bytes/s. It is below that of a slow computer, because refusing a valid log is worse than a
late refusal.
"""
WORK_PER_S = 2e6
VALUES_PER_S = 1e6
PART_S = 0.01
"""Processor time per object of a file, s. An object of MAT v7.3 takes about 1.3 ms on a busy machine (journal)."""
WALL = 12
"""Wall-clock limit as a multiple of the allowed processor time, because a process may wait forever."""
MAX_S = 1e6
"""Maximum time limit in seconds, so that sizes in a hostile header stay within the range of a timer."""
_EXHAUSTED = re.compile(
    r"(?:out of|not enough|insufficient) memory|memory allocation|bad_alloc|malloc|alloc\w* failed|"
    r"(?:cannot|unable to) alloc",
    re.IGNORECASE,
)


class Allowance:
    """The limits of this process while it reads one log."""

    def __init__(self, path: Path, size: int) -> None:
        self.path = path
        self.size = size
        self.memory = 0
        self.work_s = 0.0
        self.bound = START_BYTES + COPIES * size
        # Before the limits are set, which `free_bytes` would count as the machine's.
        self.free = max(int(limits.SHARE * limits.free_bytes()), 0)
        self.start = _measure_memory()
        self._limit_files()
        self._limit_memory()
        limits.listen(self.announce)

    def announce(self, memory: int, work: int, parts: int) -> None:
        """Raise the limits to the sizes found in checked headers; see `edp.storage.memory.announce`."""
        self.work_s += work / WORK_PER_S + parts * PART_S
        if memory > self.memory:
            self.memory = memory
            self._limit_memory()
        if work or parts:
            self._rearm(work / WORK_PER_S + parts * PART_S)

    def seconds(self, values: int = 0) -> float:
        """Return the processor time of a request that wants some values."""
        return min(START_S + self.size / BYTES_PER_S + self.work_s + values / VALUES_PER_S, MAX_S)

    @contextlib.contextmanager
    def running(self, seconds: float) -> Iterator[list[float]]:
        """Limit the run time of the block; the remaining time is in the list afterwards."""
        left = [seconds]
        # Windows: neither timers nor forks.
        if not hasattr(signal, "setitimer"):
            yield left
            return
        # By the clock as well: a process that sleeps for ever uses no processor time.
        signal.setitimer(signal.ITIMER_REAL, WALL * seconds)
        signal.setitimer(signal.ITIMER_PROF, seconds)
        try:
            yield left
        finally:
            # Never 0, which would turn a timer off instead of ending at once.
            left[0] = max(signal.setitimer(signal.ITIMER_PROF, 0)[0], 1e-3)
            signal.setitimer(signal.ITIMER_REAL, 0)

    def _rearm(self, more: float) -> None:
        if hasattr(signal, "setitimer"):
            for timer, times in ((signal.ITIMER_PROF, 1), (signal.ITIMER_REAL, WALL)):
                left = signal.getitimer(timer)[0]
                # A timer that is not running stays so: nothing is being read.
                if left:
                    signal.setitimer(timer, min(left + times * more, WALL * MAX_S))

    def _limit_memory(self) -> None:
        """Set the soft limits. Hard limits stay at the machine's capacity; later headers may raise the soft ones."""
        if resource is None:
            return
        with contextlib.suppress(OSError, ValueError):
            more = min(self.bound + self.memory, self.free)
            for kind, used, extra in (
                # Data counts what is used; address space also what allocators reserve and never touch.
                (resource.RLIMIT_DATA, self.start[1], 0),
                (resource.RLIMIT_AS, self.start[0], RESERVED_BYTES),
            ):
                hard = resource.getrlimit(kind)[1]
                # A hard limit can only be lowered, so that of the system is kept where it is less.
                most = [used + self.free + extra] + ([hard] if hard != resource.RLIM_INFINITY else [])
                resource.setrlimit(kind, (min([used + more + extra, *most]), min(most)))

    @staticmethod
    def _limit_files() -> None:
        if resource is None:
            return
        with contextlib.suppress(OSError, ValueError):
            # A core file would hold parts of a stranger's log, and fill the disk.
            resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
            resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))

    def exhausted(self) -> DataError:
        """Return the error for exhausted memory, of the machine or of the allowance for this file."""
        if self.bound + self.memory >= self.free:
            return DataError(
                f"'{self.path}': reading it takes more memory than this machine has free ({gigabytes(self.free)} may "
                "be taken); free some memory, raise the limit, or read fewer channels or a part of it"
            )
        return DataError(
            f"'{self.path}': reading it takes more than {gigabytes(self.bound + self.memory)} of memory, the limit for "
            f"a file of {self.size} bytes with its headers; it may be damaged or made to exhaust memory: copy or "
            "export it again, or save fewer channels in a file"
        )


def is_exhausted(error: BaseException | None) -> bool:
    """Return whether an exception comes from a lack of memory, however a library calls it."""
    depth = 0
    # Chains of exceptions may be circular.
    while error is not None and depth < 20:
        if isinstance(error, MemoryError) or (not isinstance(error, DataError) and _EXHAUSTED.search(str(error))):
            return True
        error, depth = error.__cause__ or error.__context__, depth + 1
    return False


def _measure_memory() -> tuple[int, int]:
    """Return address space and data of this process, in bytes."""
    try:
        pages = [int(part) for part in Path("/proc/self/statm").read_text(encoding="ascii").split()]
        return pages[0] * os.sysconf("SC_PAGE_SIZE"), pages[5] * os.sysconf("SC_PAGE_SIZE")
    except (OSError, ValueError, IndexError):
        return 0, 0
