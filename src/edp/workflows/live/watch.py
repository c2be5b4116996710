"""Monitor in a live session: its statistics as columns, its alarms as events."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from edp.errors import ConfigError
from edp.monitor.alarms import MonitorAlarm
from edp.monitor.diagnosis.causes import NONE_OF_THESE
from edp.monitor.monitor import Monitor, MonitorStream
from edp.recording import Recording
from edp.signals import Channel
from edp.wording import typed
from edp.workflows.live.parts import LivePart, Note, Row

MOST_TICKS = 100
"""Maximum number of samples that a monitor processes at once. It evaluates nothing before the end of a block, and its
networks cost as much for a block as for one sample. Parts of longer blocks suffice."""


class _Chunks(MonitorStream):
    """Monitor over chunks of samples, with the same results as sample by sample."""

    @property
    def statistics(self) -> tuple[float, ...]:
        """Return the statistic of each watch at the end of the last block, relative to its scale."""
        return self._statistics

    def chunk(self, rows: NDArray[np.float32]) -> list[MonitorAlarm]:
        """Return alarms that some ticks raise; `rows` in the monitor's order, shape (ticks, inputs)."""
        verdicts, self.state = self.monitor.advance(rows, self.state)
        alarms = []
        for verdict in verdicts:
            self._statistics = verdict.statistics
            self._rows.append(verdict.row)
            if verdict.alarm is not None:
                alarms.append(self._alarm(verdict))
        return alarms


class LiveMonitor(LivePart):
    """Only source of alarms: a value outside its interval does not raise an alarm.

    Args:
        monitor: running monitor.
        channels: channels of the source.
        rate_hz: rate of the source.
        note: takes events.
        recording: played recording, whose machine and units are checked; None without one.

    Raises:
        EdpError: another rate, another machine, or none of the monitor's channels.
    """

    def __init__(
        self,
        monitor: Monitor,
        channels: Sequence[Channel],
        rate_hz: float,
        note: Note,
        recording: Recording | None = None,
    ) -> None:
        names = [channel.name for channel in channels]
        if abs(rate_hz - monitor.rate_hz) > 1e-3 * monitor.rate_hz:
            raise ConfigError(
                f"the source has {typed(rate_hz)} Hz, the monitor {typed(monitor.rate_hz)} Hz; set rate_hz in the "
                "signal map"
            )
        lacking = [name for name in monitor.inputs if name not in names]
        if len(lacking) == len(monitor.inputs):
            raise ConfigError(f"the source has none of the monitor's channels, such as {monitor.inputs[0]}")
        if recording is not None:
            monitor.check(recording)
        if lacking:
            note("warning", f"the source lacks {', '.join(lacking)}: what judges or reads these channels is silent", "")
        self._stream, self._note = _Chunks(monitor), note
        self._rows: list[Row] = []
        # One behind the last: NaN for a channel that is not there.
        self._columns = [names.index(name) if name in names else len(names) for name in monitor.inputs]
        self._limit, self.width = monitor.chain.limit, len(monitor.chain.watches)
        note("note", f"monitor: {monitor.limit.sentence()}", "")

    def step(self, row: Row, missed: int) -> Row:
        """Return the statistics of the last block, each divided by its limit; see `LivePart`."""
        block = self._stream.monitor.chain.summaries.block
        if missed > block:
            self.reset()
        self._rows.append(np.append(row, np.float32(np.nan))[self._columns])
        if (self._stream.state.ticks + len(self._rows)) % block == 0 or len(self._rows) >= MOST_TICKS:
            for alarm in self._stream.chunk(np.array(self._rows)):
                self._note("alarm", alarm.sentence, group_of(alarm))
            self._rows.clear()
        return np.array(self._stream.statistics, np.float32) / np.float32(self._limit)

    def reset(self) -> None:
        """See `LivePart`."""
        self._stream.reset()
        self._rows.clear()

    def statistics(self, first: int) -> Mapping[str, int]:
        """Return the columns of the statistics by name."""
        watches = self._stream.monitor.chain.watches
        return {
            f"{type(watch.detector).__name__.removesuffix('Spec').lower()} {n + 1}": first + n
            for n, watch in enumerate(watches)
        }


def group_of(alarm: MonitorAlarm) -> str:
    """Return the group of an alarm, as `edp.monitor.alarms.episodes` merges alarms."""
    cause = alarm.causes[0] if alarm.causes else None
    if cause is not None and cause.kind != NONE_OF_THESE:
        return f"alarm of {cause.component}"
    return f"alarm of {alarm.evidence[0][0].rpartition('.')[0]}" if alarm.evidence else ""
