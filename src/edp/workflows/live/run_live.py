"""A live session: a source and its models in a thread of their own, page and viewers beside it."""

from __future__ import annotations

import asyncio
import contextlib
import signal
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from edp.errors import ConfigError, EdpError
from edp.live.layout import Forecast, LiveLayout, LiveTrace, label, sentence
from edp.live.pace import Pace
from edp.live.saved import write_session_page
from edp.live.server import LOOPBACK, LiveServer
from edp.live.session import HISTORY_BYTES, LiveSession
from edp.monitor.monitor_file import load_monitor
from edp.signals import Channel, Kind
from edp.training.bundle import Bundle, load_bundle
from edp.training.twin_bundle import TwinBundle, holds_twin, load_twin
from edp.workflows.live.free_run import FREE_S, LiveTwin
from edp.workflows.live.look_ahead import LiveNetwork
from edp.workflows.live.parts import LiveFront, LivePart, Row
from edp.workflows.live.record import McapRecorder
from edp.workflows.live.sources import SOURCES, LiveSource, Needs, SourceOptions, SourceStopped
from edp.workflows.live.watch import LiveMonitor

MOST_LEVERS = 12
LEVER = "Lever_"
STOP_S = 5.0
"""To wait for the thread of a source, which may be within a tick."""


@dataclass(frozen=True)
class LiveOrder:
    """What to show.

    Attributes:
        source: name of a registered source.
        options: of the source.
        run: run folder of a network or twin; None shows what is measured alone.
        monitor: folder of the monitor that raises alarms.
        speed: factor on real time of a source that can be steered.
        free_s: length of a twin's free runs.
        host: address to listen on; `port` likewise, 0 for a free one.
        port: see `host`.
        save: page to write at the end.
        record: MCAP file to write.
        until_end: whether to end with the source; a session stays open for viewers otherwise.
        history_bytes: of rows that can be looked back at.
    """

    source: str
    options: SourceOptions
    run: Path | None = None
    monitor: Path | None = None
    speed: float = 1.0
    free_s: float = FREE_S
    host: str = LOOPBACK
    port: int = 0
    save: Path | None = None
    record: Path | None = None
    until_end: bool = False
    history_bytes: int = HISTORY_BYTES


@dataclass
class LiveResult:
    """What came of a session.

    Attributes:
        ticks: streamed.
        alarms: events of a monitor.
        ended: why no more came, in words.
        late: how often the source fell behind real time.
        saved: page that was written; `recorded` likewise.
        recorded: see `saved`.
    """

    ticks: int
    alarms: int
    ended: str
    late: int
    saved: Path | None = None
    recorded: Path | None = None


class LiveRun:
    """A source with its models, and the session that they fill; usable without a server.

    Args:
        order: what to show.
        on_event: called with kind and text of each event.
        source: of the rows, in place of the order's.

    Attributes:
        source: of the rows.
        session: that is filled.
        pace: of the source.
        failure: of the source or a model, None while there is none.

    Raises:
        EdpError: source, models or files do not fit together.
    """

    def __init__(
        self,
        order: LiveOrder,
        on_event: Callable[[str, str], None] | None = None,
        source: LiveSource | None = None,
    ) -> None:
        if order.save is not None and order.save.suffix.lower() not in (".html", ".htm"):
            raise ConfigError(f"--save {order.save}: the page of a session ends in .html")
        self.order, self._on_event = order, on_event or (lambda kind, text: None)
        self.failure: EdpError | None = None
        self._waiting: list[tuple[str, str, str]] = []
        self._recorder: McapRecorder | None = None
        models = _models(order)
        self.source = source or SOURCES[order.source].of(order.options, _needs(models, order))
        try:
            self._parts, layout = self._assembled(models)
            self.pace = Pace(self.source.rate_hz, order.speed)
            self.session = LiveSession(layout, order.history_bytes)
            if order.record is not None:
                self._recorder = McapRecorder(order.record, self.source.channels, layout)
        except BaseException:
            self.source.close()
            raise
        for kind, text, group in self._waiting:
            self.note(kind, text, group)
        self.alarms = 0

    @property
    def stopped(self) -> bool:
        """See `edp.workflows.live.sources.Sink`; the others below likewise."""
        return self.pace.stopped

    def take(self, row: Row, missed: int = 0, trusted: bool = True) -> None:
        """A row of the source: wait until it is due, ask the models, keep it."""
        if self.pace.stopped or (self.source.steered and not self.pace.wait(self.session.ticks)):
            raise SourceStopped
        columns = [row]
        for part in self._parts:
            asked = trusted or isinstance(part, LiveFront)
            columns.append(part.step(row, missed) if asked else np.full(part.width, np.nan, np.float32))
        full = np.concatenate(columns).astype(np.float32, copy=False)
        self.session.append(full)
        if self._recorder is not None:
            self._recorder.row(self.session.ticks - 1, full)

    def begin_anew(self) -> None:
        """What follows does not continue what came."""
        for part in self._parts:
            part.reset()
        self.session.break_off()

    def note(self, kind: str, text: str, group: str = "") -> None:
        """An event."""
        if not hasattr(self, "session"):
            self._waiting.append((kind, text, group))
            return
        shown_text = sentence(text)
        self.session.event(kind, shown_text, group)
        if kind == "alarm":
            self.alarms += 1
        if self._recorder is not None:
            self._recorder.event(self.session.ticks, kind, shown_text)
        self._on_event(kind, shown_text)

    def play(self) -> None:
        """Give all rows of the source; returns when there are no more, or the session is over."""
        try:
            self.source.run(self)
            self.note("note", self.source.ending)
            self.session.end(self.source.ending)
        except SourceStopped:
            self.session.end("the session was ended")
        except EdpError as error:
            self.failure = error
            self.note("warning", f"the source has stopped: {error}")
            self.session.end(f"the source has stopped: {error}")

    def close(self) -> LiveResult:
        """End the session, and write what is to be written.

        Raises:
            StorageError: a file cannot be written.
        """
        self.pace.stop()
        self.source.close()
        result = LiveResult(self.session.ticks, self.alarms, self.session.ended, self.pace.late)
        if self._recorder is not None:
            self._recorder.close()
            result.recorded = self._recorder.path
        if self.order.save is not None:
            result.saved = write_session_page(self.session, self.order.save)
        return result

    def _assembled(self, models: _Models) -> tuple[list[LivePart], LiveLayout]:
        """The parts of a row behind the source's own, and the columns of all."""
        source, order = self.source, self.order
        parts: list[LivePart] = []
        forecasts: list[Forecast] = []
        statistics: dict[str, int] = {}
        width = len(source.channels)
        _check_rate(source, models)

        def add(part: LivePart) -> int:
            nonlocal width
            first = width
            parts.append(part)
            width += part.width
            return first

        if models.bundle is not None:
            network = LiveNetwork(models.bundle, source.channels, self.note)
            forecasts += network.forecasts(add(network))
        if models.twin is not None:
            free = LiveTwin(models.twin, source.channels, self.note, order.free_s)
            forecasts += free.forecasts(add(free))
        if order.monitor is not None:
            watch = LiveMonitor(
                load_monitor(order.monitor), source.channels, source.rate_hz, self.note, source.recording
            )
            statistics |= watch.statistics(add(watch))
        geometry, angles = None, range(0)
        if source.machine is not None and LiveFront.possible(source.channels):
            from edp.sim import load_machine

            front = LiveFront(load_machine(source.machine), source.channels)
            geometry, angles = front.geometry, range(width, width + LiveFront.width)
            add(front)
        return parts, LiveLayout(
            title=label(order.run.resolve().name if order.run is not None else source.text.split(",")[0]),
            source=label(source.text),
            rate_hz=source.rate_hz,
            width=width,
            traces=[LiveTrace.of(channel) for channel in source.channels],
            forecasts=forecasts,
            geometry=geometry,
            angles=list(angles),
            levers=_levers(source.channels, models.twin),
            statistics=statistics,
            steered=source.steered,
            ticks=source.ticks,
        )


def run_live(
    order: LiveOrder,
    on_ready: Callable[[LiveServer], None] | None = None,
    on_event: Callable[[str, str], None] | None = None,
    source: LiveSource | None = None,
) -> LiveResult:
    """Serve a session until Ctrl-C, a request to end, or with `LiveOrder.until_end` the end of the source.

    Args:
        order: what to show.
        on_ready: called once the page can be opened.
        on_event: called with kind and text of each event.
        source: of the rows, in place of the order's.

    Raises:
        EdpError: source, models, port or files cannot be used.
    """
    live = LiveRun(order, on_event, source)
    playing = threading.Thread(target=live.play, name="edp-live-source", daemon=True)
    try:
        asyncio.run(_served(live, playing, on_ready))
    finally:
        live.pace.stop()
        if playing.ident is not None:
            playing.join(STOP_S)
        result = live.close()
    if live.failure is not None:
        raise live.failure
    return result


async def _served(live: LiveRun, playing: threading.Thread, on_ready: Callable[[LiveServer], None] | None) -> None:
    stop, order = asyncio.Event(), live.order
    server = LiveServer(live.session, live.pace if live.source.steered else None, order.host, order.port)

    def ready(one: LiveServer) -> None:
        if on_ready is not None:
            on_ready(one)
        # Once the port is open: a port in use is refused before anything is played or recorded.
        playing.start()

    async def watch_end() -> None:
        while not stop.is_set():
            await asyncio.sleep(0.1)
            if playing.ident is not None and not playing.is_alive():
                stop.set()

    with _interrupts(stop):
        ending = asyncio.create_task(watch_end()) if order.until_end else None
        try:
            await server.run(stop, ready)
        finally:
            if ending is not None:
                ending.cancel()


@contextlib.contextmanager
def _interrupts(stop: asyncio.Event) -> Iterator[None]:
    """Ctrl-C and the system's request end the session, and files are finished; only the main thread hears them."""
    loop = asyncio.get_running_loop()
    signals = (signal.SIGINT, signal.SIGTERM) if threading.current_thread() is threading.main_thread() else ()
    for number in signals:
        loop.add_signal_handler(number, stop.set)
    try:
        yield
    finally:
        for number in signals:
            loop.remove_signal_handler(number)


@dataclass(frozen=True)
class _Models:
    """What a run folder holds."""

    bundle: Bundle | None = None
    twin: TwinBundle | None = None
    channels: tuple[Channel, ...] = field(default=())
    rate_hz: float | None = None


def _models(order: LiveOrder) -> _Models:
    if order.run is None:
        return _Models()
    if holds_twin(order.run):
        twin = load_twin(order.run)
        channels = twin.twin.channels
        return _Models(twin=twin, channels=(*channels.commands, *channels.answers), rate_hz=channels.rate_hz)
    bundle = load_bundle(order.run)
    targets = [
        Channel(name, kind, text)
        for name, kind, text in zip(bundle.task.targets, bundle.target_kinds, bundle.descriptions, strict=True)
        if name not in bundle.task.inputs
    ]
    return _Models(bundle=bundle, channels=(*bundle.inputs, *targets), rate_hz=bundle.task.rate_hz)


def _needs(models: _Models, order: LiveOrder) -> Needs:
    channels = list(models.channels)
    rate = models.rate_hz
    if order.monitor is not None:
        monitor = load_monitor(order.monitor)
        channels += [channel for channel in monitor.channels if channel not in channels]
        rate = rate or monitor.rate_hz
    return Needs(channels, rate, None if models.twin is None else models.twin.twin.channels)


def _check_rate(source: LiveSource, models: _Models) -> None:
    rate = models.rate_hz
    # A thousandth: loggers state the same rate with different digits.
    if rate is not None and abs(source.rate_hz - rate) > 1e-3 * rate:
        raise ConfigError(
            f"{source.text} has {source.rate_hz:g} Hz, the run {rate:g} Hz; set rate_hz in the signal map, or choose "
            "a run of this rate"
        )


def _levers(channels: tuple[Channel, ...], twin: TwinBundle | None) -> list[int]:
    """Columns of what is commanded: levers, else the twin's commands, else pilot pressures but for conflux ones."""
    commanded = {c.name for c in twin.twin.channels.commands} if twin is not None else set()
    pilots = [c.name for c in channels if c.kind is Kind.PILOT_PRESSURE and not c.name.endswith("Conf")]
    levers = [c.name for c in channels if c.name.startswith(LEVER)]
    chosen = levers or [c.name for c in channels if c.name in commanded] or pilots
    return [n for n, channel in enumerate(channels) if channel.name in chosen][:MOST_LEVERS]
