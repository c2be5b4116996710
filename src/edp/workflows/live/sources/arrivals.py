"""Rows that arrive by themselves: their time, gaps, rate and silence, the same for every source of that kind."""

from __future__ import annotations

import math
import statistics
import time
from collections import deque
from dataclasses import dataclass

from edp.errors import DataError
from edp.wording import setting_text, typed
from edp.workflows.live.sources.base import Row, Sink

SILENT_S = 0.5
"""Time without a row after which the source counts as silent."""
WINDOW = 100
"""Steps between rows whose median is the rate."""
OFF_RATE = 0.05
"""Fraction by which the rate may differ from the models' before they predict nothing."""
MAX_TIME_S = 1e11
"""Largest time stamp: the year 5138 in seconds since 1970."""
MAX_JUMP_S = 60.0
"""Step between two rows above which the second one begins a new session: no clock of a machine skips so far."""
SAME_TIME = 1e-3
"""Fraction of a time step below which two time stamps are the same."""


@dataclass(frozen=True)
class Step:
    """Class of a time stamp.

    Attributes:
        missed: rows that are missing before this one.
        restart: why the row begins a new session; empty where it continues the session.
    """

    missed: int = 0
    restart: str = ""


class RowClock:
    """Check of row time stamps against the sampling rate of the models.

    Args:
        rate_hz: expected rate.

    Attributes:
        trusted: whether rows come at the expected rate.
    """

    def __init__(self, rate_hz: float) -> None:
        self.rate_hz, self.trusted = rate_hz, True
        self._last: float | None = None
        self._stamped = True
        self._steps: deque[float] = deque(maxlen=WINDOW)

    @property
    def measured_hz(self) -> float | None:
        """Rate of the last rows, None where there are too few."""
        if len(self._steps) < WINDOW // 2:
            return None
        middle = statistics.median(self._steps)
        return 1.0 / middle if middle > 0.0 else None

    def tick(self, seconds: float, stamped: bool = True) -> Step:
        """Take the time of a row.

        Args:
            seconds: time of the row.
            stamped: whether the sender stated the time; otherwise `seconds` is the time of arrival.

        Raises:
            DataError: the time is not a number within `MAX_TIME_S`, or that of the row before.
        """
        if not abs(seconds) <= MAX_TIME_S:
            raise DataError(f"its time is {typed(seconds)} s; a number up to {typed(MAX_TIME_S)} is expected")
        last, changed = self._last, stamped != self._stamped
        step = 0.0 if last is None else seconds - last
        if last is not None and stamped and not changed and abs(step) < SAME_TIME / self.rate_hz:
            raise DataError(f"it has the time of the row before ({setting_text(seconds)} s)")
        self._last, self._stamped = seconds, stamped
        restart = ""
        if last is not None:
            if changed:
                restart = "rows have a time of their own from here" if stamped else "rows have no time any more"
            elif step < 0.0:
                restart = "time went back"
            elif stamped and step > MAX_JUMP_S:
                restart = f"time jumped by {typed(step)} s"
        if last is None or restart:
            self._steps.clear()
            return Step(restart=restart)
        # A gap is not a rate.
        if step <= SILENT_S:
            self._steps.append(step)
        rate = self.measured_hz
        if rate is not None:
            self.trusted = abs(rate - self.rate_hz) <= OFF_RATE * self.rate_hz
        # At another rate every step would count as a gap.
        return Step(max(0, round(step * self.rate_hz) - 1) if self.trusted else 0)


class Arrivals:
    """Forwarding of arriving rows to a session, with notes about gaps, silence and a changed rate.

    Args:
        sink: session.
        rate_hz: expected rate.
    """

    def __init__(self, sink: Sink, rate_hz: float) -> None:
        self._sink, self._clock = sink, RowClock(rate_hz)
        self._heard, self._silent, self._trusted = time.monotonic(), False, True

    def wait(self) -> None:
        """Tell the session that no row came, once the source counts as silent."""
        self._sink.show()
        if not self._silent and time.monotonic() - self._heard > SILENT_S:
            self._silent = True
            self._sink.note(
                "warning", f"no row for {typed(SILENT_S)} s: nothing is predicted until rows come again", "silent"
            )

    def take(self, row: Row, seconds: float | None = None, more: bool = False) -> None:
        """Pass a row to the session, or omit a row with an impossible time.

        Args:
            row: values of the source's channels, shape (channels,), SI units.
            seconds: time that the sender states; None takes the time of arrival.
            more: whether a further row waits already.

        Raises:
            SourceStopped: the session is over.
        """
        sink, now = self._sink, time.monotonic()
        if self._silent:
            sink.note("note", f"rows come again, after {now - self._heard:.1f} s", "again")
        self._heard, self._silent = now, False
        try:
            step = self._clock.tick(now if seconds is None else seconds, seconds is not None)
        except DataError as error:
            sink.leave_out(str(error))
            return
        if step.restart:
            sink.note("warning", f"{step.restart}: what follows is taken for a new session", "back")
            sink.begin_anew()
        if self._clock.trusted != self._trusted:
            self._trusted = self._clock.trusted
            self._tell_rate()
        sink.take(row, step.missed, self._trusted, more)

    def _tell_rate(self) -> None:
        clock, rate = self._clock, self._clock.measured_hz or math.nan
        if clock.trusted:
            self._sink.note("note", f"rows come at {typed(rate)} Hz again: models begin anew", "rate right")
            self._sink.begin_anew()
        else:
            self._sink.note(
                "warning",
                f"rows come at {typed(rate)} Hz, the models know {typed(clock.rate_hz)} Hz: nothing is predicted",
                "rate wrong",
            )
