"""The monitor of a machine: raw channels in tick by tick, alarms out."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edp.errors import DataError, closest
from edp.monitor.alarms import MonitorAlarm
from edp.monitor.calibration import AlarmLimit
from edp.monitor.chain import BlockVerdict, ChainState, MonitorChain
from edp.monitor.diagnosis.diagnose import AFTER_S, MAX_ROWS, diagnosed, onset_of
from edp.monitor.diagnosis.signatures import Dictionary
from edp.monitor.machine_offsets import other_machine
from edp.monitor.residuals.base import ResidualSource, Rows, SourceState, rows_of
from edp.recording import Recording
from edp.settings.bounds import shown
from edp.signals import Channel
from edp.storage.reading import Table
from edp.wording import figure, number

Array = NDArray[np.float64]
PIECE = 4096
"""Number of samples of a recording processed at once: a compromise between speed and memory."""
MAX_EVIDENCE = 8
"""Maximum number of summaries listed as evidence of an alarm."""
OTHER_MACHINE = 6.0
"""Deviation of a channel's session mean, in healthy standard deviations, that indicates a different machine."""
IMPOSSIBLE = 1e5
"""Deviation in healthy standard deviations beyond which a value counts as invalid, as in the exported code."""
OTHER_SHARE = 0.25
"""Fraction of the channels beyond `OTHER_MACHINE` above which the log is attributed to a different machine."""


@dataclass(frozen=True, eq=False)
class MonitorState:
    """All that a monitor remembers of one machine.

    Attributes:
        sources: state of each source of residuals.
        chain: state of the chain.
        ticks: number of samples since the start.
        missing: number of samples since the end of the last block at which each input was missing, shape (inputs,).
    """

    sources: tuple[SourceState, ...]
    chain: ChainState
    ticks: int
    missing: NDArray[np.int64]


@dataclass(frozen=True)
class Verdict:
    """Result of one sample of a stream.

    Attributes:
        alarm: raised at this tick.
        silent: channels that are missing, so that what evaluates or reads them says nothing.
        statistics: statistic of each watch at the end of the last block divided by its scale; compare with the
            monitor's limit.
        block_ended: whether this tick ended a block.
    """

    alarm: MonitorAlarm | None
    silent: tuple[str, ...]
    statistics: tuple[float, ...]
    block_ended: bool


@dataclass(frozen=True, eq=False)
class Watched:
    """Result of a monitor on a recording.

    Attributes:
        alarms: alarms in order of time.
        statistics: statistics of each watch divided by its scale, shape (blocks, watches).
        rows: conditioned summaries, NaN where missing, shape (blocks, summaries).
    """

    alarms: tuple[MonitorAlarm, ...]
    statistics: Array
    rows: Rows


@dataclass(frozen=True, eq=False)
class Monitor:
    """A fitted monitor.

    Attributes:
        channels: raw channels, SI units, in the order of a row.
        rate_hz: sampling rate in Hz.
        sources: sources of residuals.
        chain: chain from residuals to statistics.
        limit: alarm limit with its false-alarm rate.
        session_means: mean over healthy sessions of each channel's mean in a session, and its deviation between
            sessions, shape (2, inputs).
        diagnosis: dictionary of faults that names causes; None where alarms have none.
        provenance: origin of the training data.
        scatter: standard deviation of the mean of each conditioned summary over the start of healthy sessions, shape
            (summaries,); None in monitors of earlier versions.
    """

    channels: tuple[Channel, ...]
    rate_hz: float
    sources: tuple[ResidualSource, ...]
    chain: MonitorChain
    limit: AlarmLimit
    session_means: Array
    diagnosis: Dictionary | None = None
    provenance: Table = field(default_factory=dict)
    scatter: Array | None = None

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of the channels."""
        return tuple(channel.name for channel in self.channels)

    @property
    def residual_names(self) -> tuple[str, ...]:
        """Names of all residuals, in order."""
        return tuple(name for source in self.sources for name in source.names)

    @property
    def summary_names(self) -> tuple[str, ...]:
        """Names of all summaries, in order."""
        return self.chain.summaries.names(self.residual_names)

    @property
    def block_s(self) -> float:
        """Length of a block."""
        return self.chain.summaries.block / self.rate_hz

    def initial_state(self) -> MonitorState:
        """Return the state before the first sample."""
        states = tuple(source.initial_state(1) for source in self.sources)
        return MonitorState(states, self.chain.initial_state(), 0, np.zeros(len(self.channels), np.int64))

    def plausible(self, rows: Rows) -> Rows:
        """Return the rows in which a value that no sensor gives is missing.

        Not finite, or beyond `IMPOSSIBLE` deviations.
        """
        summaries = self.chain.summaries
        with np.errstate(invalid="ignore", over="ignore"):
            possible = np.abs(rows.astype(np.float64) - summaries.centre) * summaries.spread <= IMPOSSIBLE
        return rows if possible.all() else np.where(possible, rows, np.float32(np.nan))

    def residuals(self, rows: Rows, state: MonitorState) -> tuple[Rows, tuple[SourceState, ...]]:
        """Return residuals of a segment of one machine, shape (ticks, residuals), and the next source states."""
        index = {name: i for i, name in enumerate(self.inputs)}
        parts, states = [], []
        for source, before in zip(self.sources, state.sources, strict=True):
            part, after = source.run(rows[None, :, [index[name] for name in source.inputs]], before)
            parts.append(part[0])
            states.append(after)
        return np.concatenate(parts, axis=1), tuple(states)

    def advance(self, rows: Rows, state: MonitorState) -> tuple[list[BlockVerdict], MonitorState]:
        """Return the verdicts of blocks that end in a segment; the division into calls does not matter.

        Args:
            rows: raw channels in SI units, shape (ticks, inputs), NaN where missing.
            state: before it; its detectors go on in place.
        """
        rows = self.plausible(rows)
        residuals, sources = self.residuals(rows, state)
        verdicts, chain = self.chain.run(residuals, rows, state.chain)
        missing = state.missing + (~np.isfinite(rows)).sum(axis=0)
        return verdicts, MonitorState(sources, chain, state.ticks + len(rows), missing)

    def verdicts(self, recording: Recording) -> Iterator[BlockVerdict]:
        """Yield the verdicts of a whole recording.

        Raises:
            DataError: another rate, or a log of another machine.
        """
        self.check(recording)
        state, rows = self.initial_state(), rows_of(recording, self.inputs)
        for start in range(0, len(rows), PIECE):
            verdicts, state = self.advance(rows[start : start + PIECE], state)
            yield from verdicts

    def run(self, recording: Recording) -> list[MonitorAlarm]:
        """Return all alarms of a recording; the detectors are reset at each, and a fault that stays alarms again.

        Raises:
            DataError: another rate, or a log of another machine.
        """
        return list(self.watch(recording).alarms)

    def watch(self, recording: Recording, start: datetime | None = None) -> Watched:
        """Return alarms of a recording with their causes, and what led to them block by block.

        Causes are named from the rows up to `AFTER_S` behind an alarm, as far as the recording has them.

        Args:
            recording: recording of this machine.
            start: time of day at the start of the recording, for the sentences.

        Raises:
            DataError: another rate, or a log of another machine.
        """
        statistics, rows, raised = [], [], []
        for verdict in self.verdicts(recording):
            statistics.append(verdict.statistics)
            rows.append(verdict.row.astype(np.float32))
            if verdict.alarm is not None:
                raised.append(verdict)
        table = np.array(rows, np.float32).reshape(len(rows), self.chain.summaries.width)
        alarms: list[MonitorAlarm] = []
        earlier: list[tuple[int, int]] = []
        behind = round(AFTER_S / self.block_s)
        for verdict in raised:
            onset = onset_of(verdict.since, earlier)
            earlier.append((verdict.since, verdict.block))
            alarm = self.alarm(verdict, recording.name)
            if self.diagnosis is not None:
                seen = table[onset : verdict.block + behind].astype(np.float64)
                alarm = diagnosed(alarm, self.diagnosis, seen, start)
            alarms.append(alarm)
        shape = (len(rows), len(self.chain.watches))
        return Watched(tuple(alarms), np.array(statistics).reshape(shape), table)

    def conditioned_rows(self, recording: Recording) -> Array:
        """Return the conditioned summaries of each block, NaN where missing, shape (blocks, summaries).

        See `summary_names`.
        """
        return self._condition(recording)[0]

    def _condition(self, recording: Recording) -> tuple[Array, Array]:
        """Return the conditioned rows with and without clipping."""
        self.check(recording)
        state, rows, out = self.initial_state(), rows_of(recording, self.inputs), []
        for start in range(0, len(rows), PIECE):
            piece = self.plausible(rows[start : start + PIECE])
            residuals, sources = self.residuals(piece, state)
            z, gross, chain = self.chain.conditioned(residuals, piece, state.chain)
            state = replace(state, sources=sources, chain=chain)
            out.append((z, gross))
        none = np.zeros((0, self.chain.summaries.width))
        near, far = zip(*out, strict=True) if out else ((none,), (none,))
        return np.concatenate(near), np.concatenate(far)

    def white_rows(self, recording: Recording) -> Array:
        """Return the white rows as the detectors see them, shape (blocks, directions of all watches)."""
        return self.chain.bank.white(*self._condition(recording))

    def alarm(self, verdict: BlockVerdict, recording: str = "") -> MonitorAlarm:
        """Create the alarm of a block's verdict.

        Raises:
            DataError: the block raised none.
        """
        if verdict.alarm is None:
            raise DataError(f"block {verdict.block} raised no alarm")
        watch, names = self.chain.watches[verdict.alarm], self.summary_names
        order = np.argsort(-np.abs(verdict.evidence), kind="stable")[:MAX_EVIDENCE]
        evidence = tuple((names[i], float(verdict.evidence[i])) for i in order.tolist())
        detector = type(watch.detector).__name__.removesuffix("Spec").lower()
        alarm = MonitorAlarm(
            recording=recording,
            raised_s=verdict.block * self.block_s,
            since_s=verdict.since * self.block_s,
            detector=f"{detector} {verdict.alarm + 1}",
            statistic=verdict.statistics[verdict.alarm],
            limit=self.chain.limit,
            evidence=evidence,
        )
        return replace(alarm, sentence=_sentence(alarm))

    def check(self, recording: Recording) -> tuple[str, ...]:
        """Raise an error for an incompatible recording; return the names of missing channels, which stay silent.

        Raises:
            DataError: another rate, none of the channels, or values that are not those of this machine.
        """
        # A thousandth: loggers state the same rate with different digits.
        if abs(recording.rate_hz - self.rate_hz) > 1e-3 * self.rate_hz:
            raise DataError(
                f"recording '{recording.name}' has {figure(recording.rate_hz)} Hz, the monitor {figure(self.rate_hz)} "
                "Hz; set "
                "rate_hz in the signal map"
            )
        lacking = tuple(name for name in self.inputs if name not in recording.channel_names)
        if len(lacking) == len(self.inputs):
            hint = closest(self.inputs[0], recording.channel_names)
            raise DataError(
                f"recording '{recording.name}' has none of the monitor's channels, such as '{self.inputs[0]}'{hint}"
            )
        self._check_machine(recording, lacking)
        return lacking

    def unlearned(self, recording: Recording) -> tuple[str, ...]:
        """Return the sentences on residuals that are silent in parts of a recording that healthy logs do not cover."""
        return tuple(filter(None, (source.unlearned(recording) for source in self.sources)))

    def unlike(self, watched: Watched) -> str:
        """Return the reason why a recording may be of another machine; empty if it looks like the same machine."""
        if self.scatter is None:
            return ""
        return other_machine(self.sources, self.chain, self.scatter, watched.rows.astype(np.float64), self.block_s)

    def _check_machine(self, recording: Recording, lacking: Sequence[str]) -> None:
        """Refuse a log whose channels lie far from all healthy sessions."""
        names = [name for name in self.inputs if name not in lacking]
        values = recording.select(names).astype(np.float64)
        with np.errstate(invalid="ignore"):
            there = np.isfinite(values)
            means = np.where(there, values, 0.0).sum(axis=0) / np.maximum(there.sum(axis=0), 1)
        places = [self.inputs.index(name) for name in names]
        middle, width = self.session_means[:, places]
        far = np.abs(means - middle) / width
        far[~there.any(axis=0)] = 0.0
        beyond = [name for name, value in zip(names, far, strict=True) if value > OTHER_MACHINE]
        if len(beyond) > max(1, OTHER_SHARE * len(names)):
            worst = names[int(far.argmax())]
            raise DataError(
                f"recording '{recording.name}' is not of the monitor's machine: {len(beyond)} of {len(names)} "
                f"channels, '{worst}' most of all, lie more than {figure(OTHER_MACHINE)} deviations from healthy "
                "sessions; "
                "check units and signs in the signal map, or fit a monitor for this machine"
            )

    def stream(self) -> MonitorStream:
        """Return the monitor for processing sample by sample."""
        return MonitorStream(self)


class MonitorStream:
    """A monitor at work on one machine, one row of raw channels a tick."""

    def __init__(self, monitor: Monitor) -> None:
        self.monitor, self.state = monitor, monitor.initial_state()
        self._statistics = (0.0,) * len(monitor.chain.watches)
        self._rows: deque[Array] = deque(maxlen=MAX_ROWS)
        self._earlier: deque[tuple[int, int]] = deque(maxlen=MAX_ROWS)

    def reset(self) -> None:
        """Restart."""
        self.state = self.monitor.initial_state()
        self._statistics = (0.0,) * len(self.monitor.chain.watches)
        self._rows.clear()
        self._earlier.clear()

    def step(self, row: Mapping[str, float] | Sequence[float] | NDArray[Any]) -> Verdict:
        """Take one tick.

        Args:
            row: SI values by channel, where a missing name or NaN is a missing channel; or all in the monitor's order.

        Raises:
            DataError: an unknown channel, or another number of values.
        """
        values = self._row(row)
        verdicts, self.state = self.monitor.advance(values[None], self.state)
        alarm = None
        for verdict in verdicts:
            self._statistics = verdict.statistics
            self._rows.append(verdict.row)
            alarm = self._alarm(verdict) if verdict.alarm is not None else None
        gone = ~np.isfinite(values)
        silent = tuple(name for name, missing in zip(self.monitor.inputs, gone, strict=True) if missing)
        return Verdict(alarm, silent, self._statistics, bool(verdicts))

    def _alarm(self, verdict: BlockVerdict) -> MonitorAlarm:
        """Return the alarm with causes from the rows until now."""
        alarm, onset = self.monitor.alarm(verdict), onset_of(verdict.since, tuple(self._earlier))
        self._earlier.append((verdict.since, verdict.block))
        if self.monitor.diagnosis is None:
            return alarm
        return diagnosed(alarm, self.monitor.diagnosis, np.array(self._rows)[-max(verdict.block - onset, 1) :])

    def _row(self, row: Mapping[str, float] | Sequence[float] | NDArray[Any]) -> NDArray[np.float32]:
        inputs = self.monitor.inputs
        if isinstance(row, Mapping):
            unknown = [name for name in row if name not in inputs]
            if unknown:
                raise DataError(
                    f"channel {shown(unknown[0])} is none of the monitor's{closest(str(unknown[0]), inputs)}"
                )
            row = [row.get(name, np.nan) for name in inputs]
        try:
            with np.errstate(over="ignore"):
                values = np.asarray(row, dtype=np.float64).astype(np.float32)
        except (TypeError, ValueError) as error:
            raise DataError(f"a row of the stream holds something else than numbers: {shown(row)}") from error
        if values.shape != (len(inputs),):
            raise DataError(f"a row of shape {values.shape}; shape ({len(inputs)},) must hold")
        return values


def _sentence(alarm: MonitorAlarm) -> str:
    """Describe an alarm without a diagnosis."""
    name, size = alarm.evidence[0] if alarm.evidence else ("nothing", 0.0)
    where = f"{alarm.recording}: " if alarm.recording else ""
    return (
        f"{where}not healthy since {figure(alarm.since_s)} s, raised at {figure(alarm.raised_s)} s: '{name}' deviates "
        "most, by "
        f"{number(size, signed=True)} healthy deviations on average"
    )
