"""The live view under load: lag, pictures a second, lost ticks, processor time, and a day without growth.

A source of 40 channels at 100 Hz with a clock of its own runs in a process with the server. Eight viewers look on: a
page in headless Chromium that draws by software, six readers of the socket, and one that never reads. The lag is from
the moment a tick is there until the page has drawn it. What the server takes is the processor time of its process less
that of the source's thread. The day is run as fast as it goes, with a viewer that reads and one that does not.
"""

from __future__ import annotations

import asyncio
import contextlib
import multiprocessing
import os
import socket
import sys
import threading
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "plugins"))

from browser import chromium, opened
from websockets.asyncio.client import ClientConnection, connect

from common import Bench, Skipped, benchmark, option, table
from edp.live.protocol import HEAD, ROWS
from edp.live.server import LiveServer
from edp.logs.source import DataSource, read_with_truth
from edp.signals import Channel, Kind
from edp.workflows.live.run_live import LiveOrder, LiveRun
from edp.workflows.live.sources import LiveSource, Needs, Sink, SourceOptions, SourceStopped
from edp.workflows.live.sources.log import LogSource

CHANNELS, RATE_HZ, READERS = 40, 100.0, 6
SETTLE_S = 5.0
DAY = 8_640_000
"""Ticks of a day."""


class Waves(LiveSource):
    """Waves with a clock of their own: a tick is late where the session did not come back in time.

    Args:
        ticks: how many; None goes on.
        paced: whether it keeps to the clock, or runs as fast as it can.
    """

    ending = "the waves have ended"

    def __init__(self, ticks: int | None, paced: bool) -> None:
        self.channels = tuple(Channel(f"channel_{n}", Kind.VELOCITY) for n in range(CHANNELS))
        self.rate_hz, self.text, self._most, self._paced = RATE_HZ, "waves", ticks, paced
        self.given = self.late = 0
        self.longest_s = self.cpu_s = 0.0

    @classmethod
    def from_options(cls, options: SourceOptions, needs: Needs) -> Waves:
        """Create a source that never ends."""
        return cls(None, True)

    def run(self, sink: Sink) -> None:
        """See `LiveSource`."""
        began, phases = time.perf_counter(), np.linspace(0.0, 6.0, CHANNELS)
        rows = np.sin(0.02 * np.arange(4096)[:, None] + phases).astype(np.float32)
        while self._most is None or self.given < self._most:
            if self._paced:
                due = began + self.given / RATE_HZ
                time.sleep(max(0.0, due - time.perf_counter()))
            before = time.perf_counter()
            try:
                sink.take(rows[self.given % 4096])
            finally:
                self.cpu_s = time.thread_time()
            took = time.perf_counter() - before
            self.given += 1
            self.longest_s = max(self.longest_s, took)
            self.late += took > 1.0 / RATE_HZ


Waves.steered = False


class Played(LogSource):
    """A log again and again, with the figures of `Waves`."""

    given = late = 0
    longest_s = cpu_s = 0.0

    def run(self, sink: Sink) -> None:
        """See `LiveSource`."""
        while True:
            for row in self.recording.values:
                sink.take(row)
                self.given += 1
                self.cpu_s = time.thread_time()
            sink.begin_anew()


def serve(pipe: Connection, ticks: int | None, paced: bool, models: tuple[str, ...] = ()) -> None:
    """Run source and server until told to stop; figures go through the pipe.

    Args:
        pipe: for words and figures.
        ticks: of the waves.
        paced: see `Waves`.
        models: log, run folder and monitor folder in place of the waves.
    """
    order, source = LiveOrder("", SourceOptions("")), Waves(ticks, paced)
    if models:
        log, run_folder, monitor = models
        source = Played(read_with_truth(DataSource(Path(log))))
        source.ticks = None
        order = LiveOrder("", SourceOptions(""), run=Path(run_folder), monitor=Path(monitor))
    live = LiveRun(order, source=source)
    playing = threading.Thread(target=live.play, daemon=True)

    def facts() -> dict[str, float]:
        return {
            "ticks": live.session.ticks,
            "given": source.given,
            "late": source.late + live.pace.late,
            "longest_ms": 1e3 * source.longest_s,
            "cpu_s": time.process_time(),
            "source_cpu_s": source.cpu_s,
            "rss_mb": rss_mb(),
            "dropped": max((one.dropped for one in server.viewers), default=0),
            "viewers": len(server.viewers),
        }

    server = LiveServer(live.session, live.pace if source.steered else None)

    async def run() -> None:
        stop, loop = asyncio.Event(), asyncio.get_running_loop()

        def answer() -> None:
            while True:
                word = pipe.recv()
                if word == "go":
                    playing.start()
                elif word == "facts":
                    pipe.send(facts())
                else:
                    loop.call_soon_threadsafe(stop.set)
                    return

        threading.Thread(target=answer, daemon=True).start()
        await server.run(stop, lambda one: pipe.send(one.address))

    asyncio.run(run())
    with contextlib.suppress(SourceStopped):
        live.close()
    pipe.send(facts())


def rss_mb() -> float:
    """Resident memory of this process."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


class Readers:
    """Viewers without a page, in a thread of their own.

    Args:
        address: of the page.
        good: that read all; `stalled` never read.
        stalled: see `good`.

    Attributes:
        gaps: ticks that a good reader did not get.
        ticks: that the first one got.
    """

    def __init__(self, address: str, good: int, stalled: int) -> None:
        self.gaps, self.ticks = [0] * good, [0] * good
        self._address, self._good, self._stalled = address, good, stalled
        self._ready, self._stop = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=lambda: asyncio.run(self._run()), daemon=True)
        self._thread.start()
        self._ready.wait(60)

    async def _run(self) -> None:
        address, origin = self._address.replace("http", "ws", 1) + "socket", self._address.split("/", 3)
        async with contextlib.AsyncExitStack() as stack:
            sockets = []
            for _ in range(self._good + self._stalled):
                options: dict[str, Any] = {"max_size": None, "max_queue": 1, "compression": None, "close_timeout": 0.1}
                if len(sockets) >= self._good:
                    options |= {"sock": narrow(origin[2]), "ping_interval": None}
                one = connect(address, origin=f"http://{origin[2]}", **options)
                sockets.append(await stack.enter_async_context(one))
            reading = [asyncio.create_task(self._read(n, one)) for n, one in enumerate(sockets[: self._good])]
            self._ready.set()
            while not self._stop.is_set():
                await asyncio.sleep(0.1)
            for task in reading:
                task.cancel()

    async def _read(self, number: int, one: ClientConnection) -> None:
        following = None
        async for message in one:
            if isinstance(message, bytes):
                kind, first, count, *_ = HEAD.unpack_from(message)
                if kind == ROWS:
                    self.gaps[number] += 0 if following is None else first - following
                    self.ticks[number] += count
                    following = first + count

    def close(self) -> None:
        """Leave."""
        self._stop.set()
        self._thread.join(20)


def narrow(host: str) -> socket.socket:
    """Open a connection with a small receive buffer, so that a reader that stops is noticed."""
    one = socket.socket()
    one.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 14)
    name, port = host.split(":")
    one.connect((name, int(port)))
    return one


def served(ticks: int | None, paced: bool, models: tuple[str, ...] = ()) -> tuple[Any, Connection, str]:
    """Start a process with source and server; return the process, its pipe and its address."""
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=serve, args=(theirs, ticks, paced, models), daemon=True)
    process.start()
    return process, ours, ours.recv()


def asked(pipe: Connection) -> dict[str, float]:
    """Figures of the server's process now."""
    pipe.send("facts")
    answer: dict[str, float] = pipe.recv()
    return answer


def watched(seconds: float, models: tuple[str, ...] = ()) -> dict[str, float]:
    """Eight viewers of a source for some time; see `serve`."""
    process, pipe, address = served(None, True, models)
    with opened(chromium() or "chromium") as page:
        page.open(address)
        page.wait("Boolean(window.edpLive)")
        readers = Readers(address, READERS, 1)
        pipe.send("go")
        page.wait("edpLive.frames > 5")
        time.sleep(SETTLE_S)
        page.run("edpLive.lags.length = 0")
        before, began = asked(pipe), time.monotonic()
        frames = page.run("edpLive.frames")
        time.sleep(seconds)
        after, wall = asked(pipe), time.monotonic() - began
        frames = page.run("edpLive.frames") - frames
        lags = np.array(page.run("edpLive.lags"))
        dropped = page.run("edpLive.dropped")
        readers.close()
    pipe.send("stop")
    process.join(30)
    busy = after["cpu_s"] - before["cpu_s"]
    source = after["source_cpu_s"] - before["source_cpu_s"]
    return {
        "seconds": wall,
        "load": os.getloadavg()[0],
        "lag_median_ms": float(np.median(lags)),
        "lag_p95_ms": float(np.quantile(lags, 0.95)),
        "pictures_per_s": frames / wall,
        "due": round(wall * RATE_HZ),
        "came": after["ticks"] - before["ticks"],
        "lost": after["given"] - after["ticks"],
        "late": after["late"] - before["late"],
        "longest_take_ms": after["longest_ms"],
        "gaps_of_readers": float(sum(readers.gaps)),
        "dropped_of_stalled": after["dropped"],
        "dropped_of_page": dropped,
        "viewers": after["viewers"],
        "server_share": (busy - source) / wall,
        "source_share": source / wall,
    }


def day(ticks: int, note: Callable[[str], None]) -> dict[str, float]:
    """Measure one day of data at full speed."""
    process, pipe, address = served(ticks, False)
    readers = Readers(address, 1, 1)
    pipe.send("go")
    sizes = []
    while True:
        time.sleep(1.0)
        facts = asked(pipe)
        sizes.append((facts["ticks"], facts["rss_mb"]))
        if facts["ticks"] >= ticks:
            break
    readers.close()
    pipe.send("stop")
    process.join(30)
    # The ring of rows is full after 64 MB; what grows from there on grows for ever.
    full = (64 << 20) / (4 * CHANNELS)
    filled = [size for at, size in sizes if at > full] or [sizes[-1][1]]
    third = max(1, len(filled) // 3)
    note(f"{len(sizes)} looks, {facts['cpu_s']:.0f} s of processor time")
    return {
        "ticks": facts["ticks"],
        "first_third_mb": float(np.median(filled[:third])),
        "last_third_mb": float(np.median(filled[-third:])),
        "largest_mb": max(size for _, size in sizes),
        "cpu_us_a_tick": 1e6 * facts["cpu_s"] / facts["ticks"],
    }


@benchmark(
    option("--seconds", type=float, default=60.0, help="of the eight viewers"),
    option(
        "--models", nargs=3, metavar=("LOG", "RUN", "MONITOR"), help="only a log with a network and a monitor beside it"
    ),
)
def main(bench: Bench) -> object:
    if chromium() is None:
        raise Skipped("live_view.py looks at the page in Chromium, which is not here: make system-packages")
    quick = bench.quick
    seconds = 10.0 if quick else bench.options.seconds
    if bench.options.models:
        look = watched(seconds, tuple(bench.options.models))
        table(["eight viewers, with models", "figure"], [[name, float(value)] for name, value in look.items()])
        bench.check("lag with models, 95th percentile", look["lag_p95_ms"], 100.0, "<= 1", "ms")
        bench.check("samples shown with models", look["came"], look["due"], ">= 0.99", "ticks")
        bench.name = "live_view_models"
        return {"viewers": look}
    look = watched(seconds)
    table(["eight viewers", "figure"], [[name, float(value)] for name, value in look.items()])
    long = day(DAY // 24 if quick else DAY, print)
    table(["a day", "figure"], [[name, float(value)] for name, value in long.items()])
    bench.check("lag of the page, 95th percentile", look["lag_p95_ms"], 100.0, "<= 1", "ms")
    bench.check("frames per second", look["pictures_per_s"], 10.0, ">= 1", "1/s")
    bench.check("samples shown", look["came"], look["due"], ">= 0.999", "ticks")
    bench.check("processor time of the server", look["server_share"], 0.05, "<= 1", "cores")
    first, last = long["first_third_mb"], long["last_third_mb"]
    bench.check("memory in the last third of a day against the first", last, first, "<= 1.02", "MB")
    return {"viewers": look, "day": long}


if __name__ == "__main__":
    main()
