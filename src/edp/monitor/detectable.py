"""Smallest sensor changes that a monitor finds, measured by injecting them into healthy segments."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from edp.errors import StorageError
from edp.monitor.fitting import FittedChain
from edp.monitor.monitor import Monitor
from edp.recording import Recording
from edp.signals import KINDS, Channel

FOUND_SHARE = 0.8
"""Fraction of the trials in which a change of the stated size must be found."""
MAX_CHANNELS, MAX_SEGMENTS, SEGMENT_S = 12, 4, 120.0
"""Bounds of the work: channels, healthy segments per channel, and length of a segment."""
SIGNS = (1.0, -1.0)
ONSET = 0.3
"""Fraction of a segment after which the change begins."""
FACTORS = (0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0)
"""Sizes that are tried, in standard deviations of the channel over healthy sessions."""
_SHOWN = 4
OUTSIDE = 1.5
"""Margin over what a healthy session reaches of the range of the others, before a residual is called outside of it."""


@dataclass(frozen=True)
class FoundSize:
    """The smallest tried shift of a channel that was found.

    Attributes:
        channel: name.
        unit: unit of the size, that of reports.
        size: smallest shift found in `FOUND_SHARE` of the trials; None where the largest tried was not.
        largest: largest shift that was tried.
        within_s: median time from the onset to the alarm at `size`; None without a size.
        share: fraction of the trials in which `size` (or `largest`) was found.
        trials: number of trials per size.
        minutes: length of all healthy logs of the fit.
    """

    channel: str
    unit: str
    size: float | None
    largest: float
    within_s: float | None
    share: float
    trials: int
    minutes: float

    def sentence(self) -> str:
        """Return the finding in words."""
        size = self.largest if self.size is None else self.size
        amount = f"{size:.3g} {self.unit}" if self.unit != "1" else f"{size:.3g}"
        share = f"{self.share:.0%} of {self.trials} trials"
        if self.within_s is None:
            return f"a shift of {self.channel} by {amount}, the largest tried, is found in {share} only"
        return f"a shift of {self.channel} by {amount} is found within {self.within_s:.3g} s in {share}"


def measure_found_sizes(
    monitor: Monitor, segments: Sequence[Recording], minutes: float, note: Callable[[str], None]
) -> list[FoundSize]:
    """Inject shifts into healthy segments that set no threshold, and return what is found, a row per channel.

    A change counts as found where the monitor raises an alarm after the onset that it does not raise on the same
    segment unchanged. Sizes are searched by bisection over `FACTORS`, so that the work is bounded.

    Args:
        monitor: as fitted.
        segments: healthy recordings that did not set the limits.
        minutes: length of all healthy logs of the fit.
        note: called with what begins.
    """
    cut = [one.rows(0, min(one.samples, round(SEGMENT_S * one.rate_hz))) for one in segments[:MAX_SEGMENTS]]
    quiet = [one for one in cut if not monitor.watch(one).alarms]
    if not quiet:
        return []
    chosen = _spread(monitor.channels, MAX_CHANNELS)
    rows = []
    for number, channel in enumerate(chosen, start=1):
        note(f"sizes that are found: channel {number} of {len(chosen)}")
        rows.append(_of_channel(monitor, quiet, channel, minutes))
    return rows


def _of_channel(monitor: Monitor, segments: Sequence[Recording], channel: Channel, minutes: float) -> FoundSize:
    column = monitor.inputs.index(channel.name)
    spread = 1.0 / float(monitor.chain.summaries.spread[column])
    kind = KINDS[channel.kind]
    results: dict[int, list[float]] = {}
    low, high, trials = 0, len(FACTORS) - 1, len(SIGNS) * len(segments)
    while low <= high:
        middle = (low + high) // 2
        results[middle] = _delays(monitor, segments, channel.name, FACTORS[middle] * spread)
        if len(results[middle]) >= FOUND_SHARE * trials:
            high = middle - 1
        else:
            low = middle + 1
    good = low if low < len(FACTORS) else None
    delays = results.get(low if good is not None else len(FACTORS) - 1, [])
    factor = kind.report_factor
    return FoundSize(
        channel.name,
        kind.report_unit,
        None if good is None else FACTORS[good] * spread * factor,
        FACTORS[-1] * spread * factor,
        None if good is None else float(np.median(delays)),
        len(delays) / trials,
        trials,
        minutes,
    )


def _delays(monitor: Monitor, segments: Sequence[Recording], name: str, shift: float) -> list[float]:
    """Times from the onset to the alarm, of the trials in which the shift was found."""
    delays = []
    for segment, sign in itertools.product(segments, SIGNS):
        onset = round(ONSET * segment.samples)
        values = segment.values.copy()
        values[onset:, segment.index(name)] += np.float32(sign * shift)
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
    """Session means that accept every log: a large shift is a fault here, not another machine."""
    middle, width = monitor.session_means
    return np.stack([middle, np.full_like(width, np.inf)])


def _spread(channels: Sequence[Channel], most: int) -> list[Channel]:
    places = np.unique(np.linspace(0, len(channels) - 1, min(len(channels), most)).astype(int))
    return [channels[i] for i in places.tolist()]


def found_sizes(provenance: Mapping[str, Any]) -> list[FoundSize]:
    """Return what `measure_found_sizes` found, from the provenance of a monitor; empty for earlier versions.

    Raises:
        StorageError: the entry is damaged.
    """
    try:
        return [FoundSize(**row) for row in provenance.get("found_sizes", [])]
    except TypeError as error:
        raise StorageError("the monitor's found_sizes are damaged: fit the monitor again") from error


def promise_lines(sizes: Sequence[FoundSize]) -> list[str]:
    """Return sentences on what a monitor finds, the best and the worst channels first."""
    if not sizes:
        return ["what it finds was not measured: no healthy segment outside of the limits is free of alarms"]
    minutes = f"with {sizes[0].minutes:.3g} healthy minutes"
    shown = [size.sentence() for size in sizes[:_SHOWN]]
    more = [f"and {len(sizes) - _SHOWN} more channels (--json)"] if len(sizes) > _SHOWN else []
    return [f"{minutes} {'; '.join([*shown, *more])}"]


def unseen_line(sizes: Sequence[FoundSize]) -> str:
    """Return what silence does not exclude: the sizes below which a shift would not have been found."""
    if not sizes:
        return ""
    parts = [
        f"of {size.channel} below {size.size if size.size is not None else size.largest:.3g} {size.unit}".removesuffix(
            " 1"
        )
        for size in sizes[:_SHOWN]
    ]
    more = ", and others" if len(sizes) > _SHOWN else ""
    return (
        f"with {sizes[0].minutes:.3g} healthy minutes a shift {', '.join(parts)}{more} would not have been found in "
        f"{FOUND_SHARE:.0%} of trials"
    )


def healthy_range(fitted: FittedChain) -> dict[str, Any]:
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
    """Mean of each column over its finite values; zero for none."""
    there = np.isfinite(rows)
    return np.where(there, rows, 0.0).sum(axis=0) / np.maximum(there.sum(axis=0), 1)


def outside_line(monitor: Monitor, rows: Any) -> str:
    """Return which residual lies outside of its healthy range over a recording; empty where none does.

    Args:
        monitor: that watched.
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
        f"{monitor.summary_names[worst]} lies outside of its healthy range: its mean is {ratio[worst]:.2g} times the "
        "largest of a healthy session"
    )
