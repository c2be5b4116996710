"""Smallest shift, scale and delay of each channel that a monitor finds, measured on healthy segments."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any

import numpy as np

from edp.errors import StorageError
from edp.monitor.fitting import FittedChain
from edp.monitor.monitor import Monitor
from edp.progress import SILENT, Progress
from edp.recording import Recording
from edp.signals import KINDS, Channel
from edp.storage.reading import Table
from edp.wording import figure, percent

FOUND_SHARE = 0.8
"""Fraction of the trials in which a change of the reported size must be detected."""
MAX_CHANNELS, MAX_SEGMENTS, SEGMENT_S = 12, 4, 120.0
"""Maximum number of channels, maximum number of healthy segments per channel, and length of a segment in s."""
ONSET = 0.3
"""Position of the change in a segment, as a fraction of its length."""
EFFORT_SHARE, MIN_EFFORT_S = 0.2, 20.0
"""Processor time for the trials: fraction of the preceding fit's time, and minimum in s."""
_SHOWN = 4
OUTSIDE = 1.5
"""Factor on the largest ratio of healthy sessions above which a residual is outside its healthy range."""


class Change(StrEnum):
    """Change of one channel that is injected."""

    SHIFT = "shift"
    SCALE = "scale"
    DELAY = "delay"


@dataclass(frozen=True)
class _Injection:
    """Type of an injected change.

    Attributes:
        factors: sizes that are tried: standard deviations of a shift, shares of a scale, seconds of a delay.
        signs: both directions, or one.
        segments: number of healthy segments.
        apply: returns the changed values, from the values, the onset, the signed size and the rate.
    """

    factors: tuple[float, ...]
    signs: tuple[float, ...]
    segments: int
    apply: Callable[[Any, int, float, float], Any]


def _shift(values: Any, onset: int, size: float, rate_hz: float) -> Any:
    return np.concatenate([values[:onset], values[onset:] + np.float32(size)])


def _scale(values: Any, onset: int, size: float, rate_hz: float) -> Any:
    return np.concatenate([values[:onset], values[onset:] * np.float32(1.0 + size)])


def _delay(values: Any, onset: int, size: float, rate_hz: float) -> Any:
    samples = min(max(1, round(size * rate_hz)), onset)
    return np.concatenate([values[:onset], values[onset - samples : len(values) - samples]])


INJECTIONS = {
    Change.SHIFT: _Injection((0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0), (1.0, -1.0), MAX_SEGMENTS, _shift),
    Change.SCALE: _Injection((0.01, 0.02, 0.05, 0.1, 0.2, 0.5), (1.0, -1.0), 2, _scale),
    Change.DELAY: _Injection((0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0), (1.0,), 2, _delay),
}
"""Changes tried per type. Shifts come first: they get more trials, and the time limit may stop the other types."""


@dataclass(frozen=True)
class FoundSize:
    """The smallest tried change of a channel that was found.

    Attributes:
        channel: name.
        unit: unit of the size, that of reports.
        size: smallest change found in `FOUND_SHARE` of the trials; None where the largest tried was not.
        largest: largest change that was tried.
        within_s: median time from the onset to the alarm at `size`; None without a size.
        share: fraction of the trials in which `size` (or `largest`) was found.
        trials: number of trials per size.
        minutes: length of all healthy logs of the fit.
        change: type of the injected change; earlier versions inject shifts only.
    """

    channel: str
    unit: str
    size: float | None
    largest: float
    within_s: float | None
    share: float
    trials: int
    minutes: float
    change: str = Change.SHIFT

    def amount(self) -> str:
        """Return the smallest size found, else the largest that was tried, with its unit."""
        size = self.largest if self.size is None else self.size
        return figure(size, 3) if self.unit == "1" else f"{figure(size, 3)} {self.unit}"

    def sentence(self) -> str:
        """Return the finding in words."""
        share = f"{percent(self.share)} of {self.trials} trial{'s' if self.trials > 1 else ''}"
        what = f"a {self.change} of {self.channel} by {self.amount()}"
        if self.within_s is None:
            return f"{what}, the largest tried, is found in {share} only"
        return f"{what} is found within {figure(self.within_s, 3)} s in {share}"


@dataclass(frozen=True)
class FoundSizes:
    """Detectable changes, and whether the trials ended early.

    Attributes:
        sizes: a row per change and channel, shifts first.
        planned: number of rows that were planned.
        seconds: processor time that the trials took.
        allowed_s: processor time that they may take.
    """

    sizes: tuple[FoundSize, ...]
    planned: int
    seconds: float
    allowed_s: float

    def effort(self) -> dict[str, float]:
        """Return the effort as a dictionary for the provenance of a monitor."""
        return {
            "measured": len(self.sizes),
            "planned": self.planned,
            "seconds": self.seconds,
            "allowed_s": self.allowed_s,
        }


class _Effort:
    """Processor-time budget of the trials."""

    def __init__(self, allowed_s: float) -> None:
        self.allowed_s, self._began = allowed_s, time.process_time()

    @property
    def seconds(self) -> float:
        return time.process_time() - self._began

    @property
    def is_exhausted(self) -> bool:
        return self.seconds >= self.allowed_s


def measure_found_sizes(
    monitor: Monitor, segments: Sequence[Recording], minutes: float, fit_s: float, progress: Progress = SILENT
) -> FoundSizes:
    """Inject changes into held-out healthy segments and return the smallest changes that are detected.

    A change counts as found where the monitor raises an alarm after the onset that it does not raise on the same
    segment unchanged. Sizes are searched by bisection. The trials end once they took `EFFORT_SHARE` of the processor
    time of the fit, and `MIN_EFFORT_S`.

    Args:
        monitor: fitted monitor.
        segments: healthy recordings that did not set the limits.
        minutes: length of all healthy logs of the fit.
        fit_s: processor time of the fit before.
        progress: receiver of what begins.
    """
    effort = _Effort(max(MIN_EFFORT_S, EFFORT_SHARE * fit_s))
    cut = [one.rows(0, min(one.samples, round(SEGMENT_S * one.rate_hz))) for one in segments[:MAX_SEGMENTS]]
    quiet = [one for one in cut if not monitor.watch(one).alarms]
    chosen = _spread(monitor.channels, MAX_CHANNELS) if quiet else []
    planned = [(change, channel) for change in INJECTIONS for channel in chosen]
    rows: list[FoundSize] = []
    for number, (change, channel) in enumerate(planned, start=1):
        progress.note(f"changes that are found: {change} of {channel.name}, {number} of {len(planned)}")
        row = _measure_channel(monitor, quiet, channel, change, effort)
        if row is None:
            break
        rows.append(replace(row, minutes=minutes))
    return FoundSizes(tuple(rows), len(planned), effort.seconds, effort.allowed_s)


def _measure_channel(
    monitor: Monitor, quiet: Sequence[Recording], channel: Channel, change: Change, effort: _Effort
) -> FoundSize | None:
    """Return the size that is found, by bisection; None where the effort ends before."""
    injection = INJECTIONS[change]
    factors, segments = injection.factors, quiet[: injection.segments]
    unit, base, factor = _size_unit(monitor, channel, change)
    results: dict[int, list[float]] = {}
    low, high, trials = 0, len(factors) - 1, len(injection.signs) * len(segments)
    while low <= high:
        if effort.is_exhausted:
            return None
        middle = (low + high) // 2
        results[middle] = _delays(monitor, segments, channel.name, injection, factors[middle] * base)
        if len(results[middle]) >= FOUND_SHARE * trials:
            high = middle - 1
        else:
            low = middle + 1
    good = low if low < len(factors) else None
    delays = results.get(low if good is not None else len(factors) - 1, [])
    return FoundSize(
        channel.name,
        unit,
        None if good is None else factors[good] * base * factor,
        factors[-1] * base * factor,
        None if good is None else float(np.median(delays)),
        len(delays) / trials,
        trials,
        0.0,
        change,
    )


def _size_unit(monitor: Monitor, channel: Channel, change: Change) -> tuple[str, float, float]:
    """Return the unit of a change, the size of its factor 1, and the factor from that size to the unit."""
    if change is Change.SCALE:
        return "%", 1.0, 100.0
    if change is Change.DELAY:
        return "s", 1.0, 1.0
    kind = KINDS[channel.kind]
    column = monitor.inputs.index(channel.name)
    return kind.report_unit, 1.0 / float(monitor.chain.summaries.spread[column]), kind.report_factor


def _delays(
    monitor: Monitor, segments: Sequence[Recording], name: str, injection: _Injection, size: float
) -> list[float]:
    """Return the times from onset to alarm of the trials in which the change was found."""
    delays = []
    for segment, sign in itertools.product(segments, injection.signs):
        onset, column = round(ONSET * segment.samples), segment.index(name)
        values = segment.values.copy()
        # A logger shows degrees Celsius: a scale acts on them, not on kelvin.
        zero = np.float32(KINDS[segment.channels[column].kind].from_report(0.0))
        values[:, column] = zero + injection.apply(values[:, column] - zero, onset, sign * size, segment.rate_hz)
        began = onset / segment.rate_hz
        raised = [alarm.raised_s for alarm in _alarms(monitor, replace(segment, values=values))]
        later = [at - began for at in raised if at > began]
        if later:
            delays.append(min(later))
    return delays


def _alarms(monitor: Monitor, recording: Recording) -> Sequence[Any]:
    # Without causes: naming them takes longer than finding the change.
    return replace(monitor, diagnosis=None, session_means=_any_machine(monitor)).watch(recording).alarms


def _any_machine(monitor: Monitor) -> Any:
    """Return the session means that accept every log: a large shift is a fault here, not another machine."""
    middle, width = monitor.session_means
    return np.stack([middle, np.full_like(width, np.inf)])


def _spread(channels: Sequence[Channel], most: int) -> list[Channel]:
    places = np.unique(np.linspace(0, len(channels) - 1, min(len(channels), most)).astype(int))
    return [channels[i] for i in places.tolist()]


def found_sizes(provenance: Table) -> list[FoundSize]:
    """Return what `measure_found_sizes` found, from the provenance of a monitor; empty for earlier versions.

    Raises:
        StorageError: the entry is damaged.
    """
    try:
        return [FoundSize(**row) for row in provenance.get("found_sizes", [])]
    except TypeError as error:
        raise StorageError("the monitor's found_sizes are damaged: fit the monitor again") from error


def promise_lines(sizes: Sequence[FoundSize]) -> list[str]:
    """Return sentences about the detectable changes, with the best and the worst channels first."""
    if not sizes:
        return ["what it finds was not measured: no healthy segment outside of the limits is free of alarms"]
    minutes = f"with {figure(sizes[0].minutes, 3)} healthy minutes"
    lines = []
    for rows in _measure_changes(sizes):
        more = [f"and {len(rows) - _SHOWN} more channels (--json)"] if len(rows) > _SHOWN else []
        lines.append(f"{minutes} {'; '.join([*(size.sentence() for size in rows[:_SHOWN]), *more])}")
    return lines


def effort_line(provenance: Table) -> str:
    """Return a sentence about trials left out for lack of time; an empty text if all were run.

    Raises:
        StorageError: the entry is damaged.
    """
    effort = provenance.get("found_effort")
    if effort is None:
        return ""  # a monitor of an earlier version
    try:
        measured, planned, seconds = int(effort["measured"]), int(effort["planned"]), float(effort["seconds"])
    except (KeyError, TypeError, ValueError) as error:
        raise StorageError("the monitor's found_effort is damaged: fit the monitor again") from error
    if measured >= planned:
        return ""
    return (
        f"the trials of what it finds ended early, after {figure(seconds, 3)} s of processor time: {measured} of "
        f"{planned} "
        "changes of channels were measured"
    )


def _measure_changes(sizes: Sequence[FoundSize]) -> list[list[FoundSize]]:
    """Return the sizes of each change that was injected, in the order of `INJECTIONS`."""
    groups = [[size for size in sizes if size.change == change] for change in INJECTIONS]
    return [group for group in groups if group]


def unseen_line(sizes: Sequence[FoundSize]) -> str:
    """Return what silence does not exclude: the sizes below which a change would not have been found."""
    if not sizes:
        return ""
    parts = []
    for rows in _measure_changes(sizes):
        named = ", ".join(
            f"of {size.channel} {'up to' if size.size is None else 'below'} {size.amount()}" for size in rows[:_SHOWN]
        )
        parts.append(f"a {rows[0].change} {named}{', and others' if len(rows) > _SHOWN else ''}")
    return (
        f"with {figure(sizes[0].minutes, 3)} healthy minutes {'; '.join(parts)} would not have been found in "
        f"{percent(FOUND_SHARE)} of trials"
    )


def healthy_range(fitted: FittedChain) -> dict[str, object]:
    """Return how far means of residuals over healthy sessions reach, for `outside_line`.

    Returns:
        ``means``: the largest absolute mean of each conditioned summary; ``limit``: how many times that a session may
        reach, which is `OUTSIDE` times what a healthy session reaches of the range of the others.
    """
    chain = fitted.chain
    tables = [chain.conditioning(session.summaries, session.points)[chain.settle :] for session in fitted.sessions]
    means = np.array([np.abs(_means(rows)) for rows in tables if len(rows)])
    if len(means) < 2:
        return {}
    others = np.array([np.delete(means, column, axis=0).max(axis=0) for column in range(len(means))])
    ratios = means / np.where(others > 0.0, others, np.inf)
    return {"means": means.max(axis=0).tolist(), "limit": OUTSIDE * max(1.0, float(ratios.max()))}


def _means(rows: Any) -> Any:
    """Return the mean of the finite values of each column; zero for a column without finite values."""
    there = np.isfinite(rows)
    return np.where(there, rows, 0.0).sum(axis=0) / np.maximum(there.sum(axis=0), 1)


def outside_line(monitor: Monitor, rows: Any) -> str:
    """Return the name of a residual outside its healthy range; an empty text if all are inside.

    Args:
        monitor: monitor of the recording.
        rows: conditioned summaries, shape (blocks, summaries).
    """
    reach = monitor.provenance.get("healthy_range", {})
    healthy, limit = np.asarray(reach.get("means", []), dtype=np.float64), float(reach.get("limit", np.inf))
    if healthy.shape != (rows.shape[1],) or not len(rows):
        return ""
    ratio = np.abs(_means(rows)) / np.where(healthy > 0.0, healthy, np.inf)
    worst = int(np.argmax(ratio))
    if ratio[worst] <= limit:
        return ""
    return (
        f"{monitor.summary_names[worst]} lies outside of its healthy range: its mean is {figure(ratio[worst], 2)} "
        "times the "
        "largest of a healthy session"
    )
