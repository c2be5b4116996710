"""Processor time of a coordinator and of each of its workers, read from the system while they work."""

from __future__ import annotations

import contextlib
import os
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

WORKER = b"edp.jobs.worker"
"""In the command line of a worker."""
TICK_S = 0.1
CLOCK = os.sysconf("SC_CLK_TCK")
"""Ticks a second in which the system counts processor time."""


def spent_s(process: int) -> float:
    """Processor time of a process so far, in s; 0 once it is gone."""
    with contextlib.suppress(OSError, IndexError):
        fields = Path(f"/proc/{process}/stat").read_bytes().rpartition(b")")[2].split()
        return (int(fields[11]) + int(fields[12])) / CLOCK
    return 0.0


def children(process: int) -> list[int]:
    """Processes that a process started, in any thread."""
    found = []
    with contextlib.suppress(OSError):
        for thread in Path(f"/proc/{process}/task").iterdir():
            found += [int(word) for word in (thread / "children").read_text().split()]
    return found


def tree_s(process: int) -> dict[int, float]:
    """Processor time of a process and of all below it, by process."""
    spent = {process: spent_s(process)}
    for child in children(process):
        spent |= tree_s(child)
    return spent


def is_worker(process: int) -> bool:
    with contextlib.suppress(OSError):
        return WORKER in Path(f"/proc/{process}/cmdline").read_bytes()
    return False


@dataclass
class Meter:
    """Processor time of this process with its readers, and of each worker with its own, looked at now and then."""

    begun: dict[int, float] = field(default_factory=lambda: tree_s(os.getpid()))
    seen: dict[int, dict[int, float]] = field(default_factory=dict)
    workers: set[int] = field(default_factory=set)
    done: threading.Event = field(default_factory=threading.Event)
    marked: dict[int, float] = field(default_factory=dict)
    own: list[float] = field(default_factory=lambda: [0.0, 0.0])
    """Processor time of the looking itself, in a thread of this process: in all, and until it was marked."""

    def look(self) -> None:
        own = os.getpid()
        for child in children(own):
            # A worker looks like this process until it runs its own program, and like nothing once it was ended.
            if is_worker(child):
                self.workers.add(child)
                self.seen.setdefault(own, {}).pop(child, None)
            place = self.seen.setdefault(child if child in self.workers else own, {})
            for process, spent in tree_s(child).items():
                place[process] = max(place.get(process, 0.0), spent)
        self.seen.setdefault(own, {})[own] = spent_s(own)

    def watch(self) -> None:
        while not self.done.wait(TICK_S):
            self.look()
            self.own[0] = time.thread_time()

    def mark(self) -> None:
        """What was spent until now counts no more."""
        self.look()
        self.own[1] = self.own[0]
        self.marked = {process: spent for place in self.seen.values() for process, spent in place.items()}

    def here(self) -> float:
        """Of this process and what is no worker, since the meter began or was marked; looking does not count."""
        return self._since(self.seen.get(os.getpid(), {})) - (self.own[0] - self.own[1])

    def busiest(self) -> float:
        """Of the worker that took most, likewise."""
        return max(self.each(), default=0.0)

    def each(self) -> list[float]:
        """Of each worker, likewise."""
        return [self._since(spent) for process, spent in self.seen.items() if process != os.getpid()]

    def _since(self, place: dict[int, float]) -> float:
        before = self.begun | self.marked
        return sum(spent - before.get(process, 0.0) for process, spent in place.items())


@contextlib.contextmanager
def metered() -> Iterator[Meter]:
    meter = Meter()
    looking = threading.Thread(target=meter.watch, daemon=True)
    looking.start()
    yield meter
    meter.look()
    meter.done.set()
    looking.join()
