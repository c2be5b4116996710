"""A live session without its page: a source, its models, and the rows and events that they give."""

from __future__ import annotations

import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from edp.errors import ConfigError, EdpError, brief
from edp.live.addresses import LOOPBACK, resolve_bind
from edp.live.layout import Forecast, LiveLayout, LiveTrace, label, sentence
from edp.live.pace import Pace, check_speed
from edp.live.saved import write_session_page
from edp.live.session import HISTORY_BYTES, MOST_TEXT, LiveSession
from edp.monitor.monitor_file import load_monitor
from edp.settings.bounds import check_bounds, span
from edp.storage.paths import full_path
from edp.workflows.live.bounded import Repetition, RowBounds, bound_missed
from edp.workflows.live.free_run import FREE_S, LiveTwin
from edp.workflows.live.look_ahead import LiveNetwork
from edp.workflows.live.models import LiveModels, check_rate, levers_of, models_of, needs_of
from edp.workflows.live.parts import LiveFront, LivePart, Row
from edp.workflows.live.record import McapRecorder
from edp.workflows.live.sources import SOURCES, LiveSource, SourceOptions, SourceStopped
from edp.workflows.live.watch import LiveMonitor

AT_ONCE = 25
"""Rows that models are asked for at once where the source is behind: they cost a network little more than one."""
MAX_FREE_S = 86_400.0


@dataclass(frozen=True)
class LiveOrder:
    """Options of a live session.

    Attributes:
        source: name of a registered source.
        options: options of the source.
        run: run folder of a network or twin; None shows what is measured alone.
        monitor: folder of the monitor that raises alarms.
        speed: factor on real time of a source that can be steered.
        free_s: length of a twin's free runs (s); None takes `FREE_S`.
        host: address to listen on; `port` likewise, 0 for a free one.
        port: see `host`.
        save: page to write at the end.
        record: MCAP file to write.
        rerun: whether to show the session in Rerun as well.
        until_end: whether to end with the source; a session stays open for viewers otherwise.
        history_bytes: maximum size of the stored rows in bytes.
    """

    source: str
    options: SourceOptions
    run: Path | None = None
    monitor: Path | None = None
    speed: float = 1.0
    free_s: float | None = None
    host: str = LOOPBACK
    port: int = 0
    save: Path | None = None
    record: Path | None = None
    rerun: bool = False
    until_end: bool = False
    history_bytes: int = HISTORY_BYTES

    def __post_init__(self) -> None:
        check_bounds("the live view", self, free_s=span(0.1, MAX_FREE_S))
        check_speed(self.speed)
        resolve_bind(self.host, "--bind")


@dataclass
class LiveResult:
    """Result of a live session.

    Attributes:
        ticks: streamed.
        alarms: events of a monitor.
        ended: why no more came, in words.
        late: number of times that the source fell behind real time.
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
        order: options of the session.
        on_event: called with kind and text of each event.
        source: source that replaces the one in `order`.

    Attributes:
        source: source of the rows.
        session: session to fill.
        pace: clock of the source.
        failure: error that ended the source or a model; None while there is none.

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
        self._repetition, self._left_out = Repetition(), 0
        self._waiting: list[tuple[str, str, str]] = []
        self._recorder: McapRecorder | None = None
        self._due: list[Row] = []
        self._trusted, self._ahead = True, 0
        models = models_of(order.run)
        if models.twin is None and order.free_s is not None:
            raise ConfigError(
                "--rollout-seconds belongs to a twin, and no run folder of edp twin was given; leave the option "
                "out, or give one"
            )
        preparing = (source or SOURCES[order.source]).preparing
        if preparing:
            self._on_event("preparing", preparing)
        self.source = source or SOURCES[order.source].from_options(order.options, needs_of(models, order.monitor))
        try:
            self._parts, layout = self._assemble_parts(models)
            self.pace = Pace(self.source.rate_hz, order.speed)
            self.session = LiveSession(layout, order.history_bytes, preparing)
            self._bounds = RowBounds(self.source.channels)
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

    def take(self, row: Row, missed: int = 0, trusted: bool = True, more: bool = False) -> None:
        """Process a row of the source: wait until it is due, run the models, and store row and predictions.

        Raises:
            DataError: the row has another shape, or is not of numbers.
        """
        if self.pace.stopped:
            raise SourceStopped
        row, impossible = self._bounds.check(row)
        for name in impossible:
            self.note("warning", f"{name}: its value is impossible and counts as missing", f"impossible {name}")
        missed = bound_missed(missed)
        following = self.session.ticks + len(self._due) + 1
        if self.source.steered:
            if not self.pace.wait(following - 1):
                raise SourceStopped
            more = self.pace.is_due(following)
        if missed or trusted != self._trusted:
            self.show()
            self._trusted = trusted
        self._due.append(row)
        if missed or not more or len(self._due) >= AT_ONCE:
            self.show(missed)

    def show(self, missed: int = 0) -> None:
        """Ask the models for the rows that are due, and keep them; `missed` ticks went by before the first one."""
        if not self._due:
            return
        rows, self._due = np.array(self._due), []
        columns = [rows, *(self._compute_part(part, rows, missed) for part in self._parts)]
        self._ahead = 0
        for full in np.concatenate(columns, axis=1).astype(np.float32, copy=False):
            self.session.append(full)
            if self._recorder is not None:
                self._recorder.row(self.session.ticks - 1, full)

    def _compute_part(self, part: LivePart, rows: Row, missed: int) -> Row:
        """Return the columns of a part for rows, shape (ticks, width).

        By one call of its model where that gives the same.
        """
        if not self._trusted and not isinstance(part, LiveFront):
            return np.full((len(rows), part.width), np.nan, np.float32)
        self._ahead = 0
        at_once = None if missed or len(rows) == 1 else part.at_once(rows)
        if at_once is not None:
            return at_once
        answers = np.empty((len(rows), part.width), np.float32)
        for self._ahead, row in enumerate(rows):
            answers[self._ahead] = part.step(row, missed if self._ahead == 0 else 0)
        return answers

    def begin_anew(self) -> None:
        """Start again: the next row does not continue the last one."""
        self.show()
        for part in self._parts:
            part.reset()
        self.session.break_off()

    def leave_out(self, reason: str) -> None:
        """See `edp.workflows.live.sources.Sink`."""
        self._left_out += 1
        self.note("warning", f"row {self._left_out} that cannot be used and is left out: {reason}", "left out")

    def note(self, kind: str, text: str, group: str = "") -> None:
        """Record an event; messages of one group are shown at the rate set by `Repetition`, alarms always."""
        if not hasattr(self, "session"):
            self._waiting.append((kind, text, group))
            return
        shown_text, at = sentence(text[:MOST_TEXT]), self.session.ticks + self._ahead
        if kind != "alarm" and not self._repetition.is_due(group, at):
            return
        self.session.event(kind, shown_text, group, at)
        if kind == "alarm":
            self.alarms += 1
        if self._recorder is not None:
            self._recorder.event(at, kind, shown_text)
        self._on_event(kind, shown_text)

    def play(self) -> None:
        """Give all rows of the source; returns when there are no more, the session is over, or something failed."""
        try:
            ending = self._play_source()
        except EdpError as error:
            self._fail(error)
        except Exception as error:  # a fault of a source or a model: nobody would see what its thread raises
            self._fail(EdpError(f"{where_raised(error)}; start the session again, and report this if it comes again"))
        else:
            self.session.end(ending)

    def _play_source(self) -> str:
        """Give all rows of the source; return why there are no more."""
        try:
            self.source.prepare()
            self.source.run(self)
        except SourceStopped:
            return "the session was ended"
        finally:
            self.show()
        self.note("note", self.source.ending)
        return self.source.ending

    def _fail(self, error: EdpError) -> None:
        self.failure = error
        text = f"the source has stopped: {error}"
        self.note("warning", text)
        self.session.end(sentence(text))

    def close(self) -> LiveResult:
        """End the session, and write its files.

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

    def _assemble_parts(self, models: LiveModels) -> tuple[list[LivePart], LiveLayout]:
        """Return the parts of a row after the source's own, and all columns."""
        source, order = self.source, self.order
        parts: list[LivePart] = []
        forecasts: list[Forecast] = []
        statistics: dict[str, int] = {}
        width = len(source.channels)
        check_rate(source, models)

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
            free = LiveTwin(models.twin, source.channels, self.note, order.free_s or FREE_S)
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
            title=label(full_path(order.run).name if order.run is not None else source.text.split(",")[0]),
            source=label(source.text),
            rate_hz=source.rate_hz,
            width=width,
            traces=[LiveTrace.from_channel(channel) for channel in source.channels],
            forecasts=forecasts,
            geometry=geometry,
            angles=list(angles),
            levers=levers_of(source.channels, models.twin),
            statistics=statistics,
            steered=source.steered,
            ticks=source.ticks,
        )


def where_raised(error: Exception) -> str:
    """Return kind, text and place of an unexpected error, on one line."""
    frame = traceback.extract_tb(error.__traceback__)[-1]
    return f"unexpected {type(error).__name__} in {Path(frame.filename).name}, line {frame.lineno}: {brief(error)}"
