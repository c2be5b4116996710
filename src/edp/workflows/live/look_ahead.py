"""Predictions of a trained network sample by sample, equal to the predictions of `edp evaluate`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from edp.live.layout import Forecast, label
from edp.networks.stream import Stream, StreamStatus, StreamTick
from edp.signals import KINDS, Channel
from edp.training.bundle import Bundle
from edp.workflows.live.parts import LivePart, Note, Row, columns_of

MAX_HORIZONS = 6
"""Maximum number of horizons on a page. Of more horizons the first, the last and some between are shown."""


class LiveNetwork(LivePart):
    """A network as a stream, under the rules of the exported C: see `edp.networks.stream.Stream`.

    Args:
        bundle: the network.
        channels: channels of the source.
        note: takes events.

    Raises:
        ConfigError: the source lacks a channel that the network reads.
    """

    def __init__(self, bundle: Bundle, channels: Sequence[Channel], note: Note) -> None:
        task = bundle.task
        self._stream, self._bundle, self._note = Stream(bundle.predictor), bundle, note
        self._columns = columns_of(task.inputs, channels, "the network")
        names = [channel.name for channel in channels]
        self._measured = [names.index(target) if target in names else None for target in task.targets]
        self._horizons = spread(len(task.horizons))
        self._coverages = bundle.predictor.output.coverages
        # The widest: it is the one whose misses mean something.
        self._interval = int(np.argmax(self._coverages)) if self._coverages else None
        self._each = len(self._horizons) * len(task.targets)
        self.width = self._each * (1 if self._interval is None else 3)
        self._held = False

    def step(self, row: Row, missed: int) -> Row:
        """See `LivePart`: predictions by horizon and target, then lower and upper bounds."""
        if missed:
            self._stream.missed(missed)
        tick = self._stream.step(row[self._columns])
        self._tell(tick.status)
        return self._make_row(tick)

    def at_once(self, rows: Row) -> Row | None:
        """Return predictions, see `LivePart`; rejected and held values are reported tick by tick."""
        inputs = rows[:, self._columns]
        if self._held or not self._stream.accepts(inputs):
            return None
        ticks = self._stream.steps(inputs)
        self._tell(ticks[-1].status)
        return np.array([self._make_row(tick) for tick in ticks])

    def _make_row(self, tick: StreamTick) -> Row:
        """Return the predictions by horizon and target, then lower and upper bounds."""
        if not tick.valid:
            return np.full(self.width, np.nan, np.float32)
        parts = [tick.prediction]
        if self._interval is not None:
            parts += [tick.lower[self._interval], tick.upper[self._interval]]
        chosen: NDArray[np.float32] = np.concatenate([part[self._horizons].ravel() for part in parts])
        return chosen

    def reset(self) -> None:
        """See `LivePart`."""
        self._stream.reset()

    def forecasts(self, first: int) -> Sequence[Forecast]:
        """See `LivePart`."""
        task, each = self._bundle.task, self._each
        coverage = None if self._interval is None else float(self._coverages[self._interval])
        entries = []
        for h, horizon in enumerate(self._horizons):
            for t, target in enumerate(task.targets):
                facts = KINDS[self._bundle.target_kinds[t]]
                at = first + h * len(task.targets) + t
                lower, upper = (None, None) if coverage is None else (at + each, at + 2 * each)
                name = label(self._bundle.descriptions[t] or target)
                entries.append(
                    Forecast(
                        name, facts.report_unit, facts.report_factor, task.horizons[horizon],
                        at, lower, upper, coverage, self._measured[t],
                    )
                )  # fmt: skip
        return entries

    def _tell(self, status: StreamStatus) -> None:
        """Report the start and the end of rejected values, not every tick."""
        rejected = status in (StreamStatus.HELD, StreamStatus.RESTARTED)
        if rejected != self._held:
            self._held = rejected
            if rejected:
                self._note(
                    "warning", "values that the network reads are missing or impossible: it holds the last ones", "held"
                )
            else:
                self._note("note", "the network reads all values again", "reads")


def spread(count: int, most: int = MAX_HORIZONS) -> list[int]:
    """Return at most `most` evenly spread values below `count`, including the first and the last."""
    if count <= most:
        return list(range(count))
    return sorted({round(i * (count - 1) / (most - 1)) for i in range(most)})
