"""Twin in a live session: measured for a prefix, free on the commands, and measured again."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import numpy as np

from edp.errors import DataError
from edp.live.layout import Forecast, label
from edp.networks.twin import TwinState
from edp.signals import KINDS, Channel
from edp.training.twin_bundle import TwinBundle
from edp.workflows.live.parts import LivePart, Note, Row, columns_of

FREE_S = 60.0
"""Length of a free run, as `edp rollout` has it."""


class LiveTwin(LivePart):
    """Free runs of a twin, one behind the other.

    Args:
        bundle: the twin.
        channels: channels of the source.
        note: takes events.
        free_s: length of a run.

    Raises:
        ConfigError: the source lacks a channel of the twin.
    """

    def __init__(self, bundle: TwinBundle, channels: Sequence[Channel], note: Note, free_s: float = FREE_S) -> None:
        twin = bundle.twin
        self._bundle, self._twin, self._note = bundle, twin, note
        parts = (twin.channels.commands, twin.channels.answers)
        self._commands, self._answers = (columns_of([c.name for c in part], channels, "the twin") for part in parts)
        limits = np.array([KINDS[channel.kind].plausible for channel in twin.channels.commands])
        self._low, self._high = limits[:, 0], limits[:, 1]
        self._most = max(1, round(free_s * twin.channels.rate_hz))
        self._prefix: deque[Row] = deque(maxlen=twin.prefix_ticks)
        answers = len(twin.channels.answers)
        self.width = answers * (1 if bundle.intervals is None else 3)
        # All at once: a knot is looked up for each tick otherwise.
        self._half = None if bundle.intervals is None else bundle.intervals.at(np.arange(1, self._most + 1))
        self._state: TwinState | None = None
        self._ticks = 0

    def step(self, row: Row, missed: int) -> Row:
        """Return the twin's output for the next tick, lower bounds, upper bounds; see `LivePart`."""
        commands = row[self._commands]
        possible = bool(((commands >= self._low) & (commands <= self._high)).all())
        if missed or not possible:
            # A twin has no other source for a command, and no time without one.
            self.reset()
            if not possible:
                return np.full(self.width, np.nan, np.float32)
        if self._state is None or self._ticks >= self._most:
            self._begin()
        answer = np.full(self.width, np.nan, np.float32)
        if self._state is not None:
            answers, self._state = self._twin.step(row[None, self._commands], self._state)
            if not np.isfinite(answers).all():
                # A state that is not finite never becomes finite again.
                self.reset()
                self._note("warning", "the twin's outputs are not finite: it begins anew", "not finite")
                return answer
            parts = [answers[0]]
            if self._half is not None:
                parts += [answers[0] - self._half[self._ticks], answers[0] + self._half[self._ticks]]
            answer = np.concatenate(parts).astype(np.float32)
            self._ticks += 1
        self._prefix.append(row)
        return answer

    def reset(self) -> None:
        """See `LivePart`."""
        self._state, self._ticks = None, 0
        self._prefix.clear()

    def forecasts(self, first: int) -> Sequence[Forecast]:
        """See `LivePart`."""
        intervals, count = self._bundle.intervals, len(self._answers)
        entries = []
        for n, channel in enumerate(self._twin.channels.answers):
            facts = KINDS[channel.kind]
            lower, upper = (None, None) if intervals is None else (first + count + n, first + 2 * count + n)
            coverage = None if intervals is None else intervals.coverage
            entries.append(
                Forecast(
                    label(channel.description or channel.name), facts.report_unit, facts.report_factor, 1,
                    first + n, lower, upper, coverage, int(self._answers[n]), "twin, free run",
                )
            )  # fmt: skip
        return entries

    def _begin(self) -> None:
        """Start a new run from the last measured ticks, if they are complete."""
        self._state, self._ticks = None, 0
        rows = np.array(self._prefix)
        if len(rows) < self._twin.prefix_ticks or not np.isfinite(rows[:, self._answers]).all():
            return
        try:
            self._state = self._twin.reset(rows[None, :, self._commands], rows[None, :, self._answers])
        except DataError as error:
            # Beyond an end stop of the twin, for example: a whole prefix later the machine may be elsewhere.
            self._prefix.clear()
            self._note("warning", f"the twin cannot begin here: {error}", "begin")
            return
        self._note("note", "the twin runs free from here", "free")
