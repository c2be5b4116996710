"""A chain from healthy sessions: scales, conditioning, views, and the limit for the expected rate of false alarms."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from edp.errors import DataError
from edp.monitor.adaptation import SlowDrift
from edp.monitor.calibration import AlarmLimit, calibrated
from edp.monitor.chain import MonitorChain
from edp.monitor.conditioning import Conditioning, check_blocks, fit_conditioning
from edp.monitor.detectors.cusum import CusumSpec
from edp.monitor.detectors.separate_cusums import SeparateCusumsSpec
from edp.monitor.residuals.base import ONE_BY_ONE, ResidualSource, SideBySide, sisters_of
from edp.monitor.session_blocks import (
    BlocksJob,
    SessionBlocks,
    block_ticks,
    fit_summaries,
    operating_numbers,
    summarised,
)
from edp.monitor.summaries import BlockSummaries
from edp.monitor.watches import BankSpec, Watch, WatchSpec, check_rows, fit_watch, scale_watches
from edp.progress import SILENT, Progress
from edp.recording import Recording
from edp.settings.bounds import above, below, check_bounds, check_count, integer, span
from edp.signals import Channel

Array = NDArray[np.float64]
MIN_SESSIONS = 4
"""Minimum number of sessions for conditioning and limits."""
NO_FOLD = -1
"""Index of a fold when no fold is left out."""


def default_watches() -> tuple[WatchSpec, ...]:
    """Return the default views: shifts of many summaries, shift of a single summary, gross deviations."""
    return (
        WatchSpec(detector=CusumSpec(slack=0.5), memory_s=40.0),
        WatchSpec(detector=SeparateCusumsSpec(slack=0.25), memory_s=40.0, view="adjusted"),
        WatchSpec(detector=SeparateCusumsSpec(slack=0.7), view="own", reserve=1.2),
    )


@dataclass(frozen=True, kw_only=True)
class ChainSpec:
    """Options of a chain.

    Attributes:
        block_s: length of a block, s; where it has fewer than ten ticks, ten ticks are taken.
        settle_s: start of every session that is not watched, s; at most a tenth of the shortest healthy session.
        clip: largest size of a conditioned summary, in healthy standard deviations.
        watches: views with their detectors.
        folds: parts into which sessions are dealt, at most as many as there are; what evaluates a session was fitted
            without its part. Of few parts each lacks much of what the monitor itself is fitted to: limits are too high.
        drift_per_hour: maximum drift per hour of a summary level that is followed, in healthy standard deviations.
        max_drift: maximum total drift, in healthy standard deviations.
        tolerance: share by which numbers of machines of the series may lie off that of the logs. The sessions that set
            the limit are seen as those of such machines, a machine each, by the residuals that know what a machine is
            made of; 0 watches this one machine, and sees smaller faults of it.
        doubtful: largest deviation of a session's means, over the usual largest one, beyond which it is left out and
            named.

    Raises:
        ConfigError: a value is out of its bounds.
    """

    block_s: float = 1.0
    settle_s: float = 5.0
    clip: float = 6.0
    watches: tuple[WatchSpec, ...] = field(default_factory=default_watches)
    folds: int = 10
    drift_per_hour: float = 0.05
    max_drift: float = 0.5
    tolerance: float = 0.0
    doubtful: float = 8.0

    def __post_init__(self) -> None:
        check_bounds(
            "chain",
            self,
            block_s=above(0.0, 3600.0),
            settle_s=span(0.0, 3600.0),
            clip=above(0.0, 1e3),
            folds=integer(2, 100),
            drift_per_hour=below(0.0, 1e3),
            max_drift=below(0.0, 1e3),
            tolerance=below(0.0, 0.2),
            doubtful=above(0.0, 1e6),
        )
        check_count("chain", "watches", self.watches, 16, least=1)


@dataclass(frozen=True, eq=False)
class FittedChain:
    """Result of a fit.

    Attributes:
        chain: chain fitted to all remaining sessions.
        limit: limit from sessions not used in the fits.
        doubtful: names of sessions that were left out.
        sessions: blocks of those that were not.
    """

    chain: MonitorChain
    limit: AlarmLimit
    doubtful: tuple[str, ...]
    sessions: tuple[SessionBlocks, ...]


def fit_chain(
    spec: ChainSpec,
    sources: Sequence[ResidualSource],
    channels: Sequence[Channel],
    sessions: Sequence[Recording],
    promised_hours: float,
    progress: Progress = SILENT,
    side_by_side: SideBySide = ONE_BY_ONE,
) -> FittedChain:
    """Fit all behind the residuals.

    Args:
        spec: options.
        sources: fitted to other sessions than these.
        channels: raw inputs, in order.
        sessions: healthy ones.
        promised_hours: operating hours to one false alarm.
        progress: receiver of what begins.
        side_by_side: calls a function for each of some jobs, such as in processes.

    Raises:
        ConfigError: too few hours for the expected error; says for which there are enough.
        DataError: too few sessions or blocks.
    """
    _check_sessions(spec, len(sessions))
    progress.note("summaries of healthy sessions")
    summaries = fit_summaries(spec.block_s, sources, channels, sessions)
    jobs = [
        BlocksJob(summaries, sisters_of(sources, spec.tolerance, number), channels, session)
        for number, session in enumerate(sessions)
    ]
    blocks = list(side_by_side(summarised, jobs))
    settle = _settle_blocks(spec, sessions, summaries.block)
    progress.note("conditioning, views and limit")
    return fit_from_blocks(spec, summaries, blocks, sessions[0].rate_hz, settle, promised_hours, side_by_side)


def check_healthy_sessions(spec: ChainSpec, channels: Sequence[Channel], sessions: Sequence[Recording]) -> None:
    """Refuse sessions that are too few or too short for `fit_chain`, before any residual is fitted.

    Lengths and channels alone tell it; sessions that turn out doubtful can still leave too little.

    Args:
        spec: options.
        channels: raw inputs, in order.
        sessions: healthy ones that no residual is fitted to.

    Raises:
        DataError: too few sessions or blocks.
    """
    _check_sessions(spec, len(sessions))
    block = block_ticks(spec.block_s, sessions)
    points = operating_numbers(channels, sessions, block)
    lengths = count_watched_blocks(spec, sessions)
    folds = min(spec.folds, len(sessions))
    for fold in (NO_FOLD, *range(folds)):
        left_out = set(_list_left_out(fold, len(sessions), folds))
        others = [length for index, length in enumerate(lengths) if index not in left_out]
        check_blocks(sum(others), points)
        for watch in spec.watches:
            check_rows(watch, others, sessions[0].rate_hz / block)


def count_watched_blocks(spec: ChainSpec, sessions: Sequence[Recording]) -> list[int]:
    """Return the number of blocks of each session that are watched, those at the start left out."""
    block = block_ticks(spec.block_s, sessions)
    settle = _settle_blocks(spec, sessions, block)
    return [max(0, session.samples // block - settle) for session in sessions]


def _check_sessions(spec: ChainSpec, count: int) -> None:
    least = min(spec.folds, MIN_SESSIONS)
    if count < least:
        raise DataError(
            f"{count} healthy sessions are left for conditioning and limits; {least} at least must hold: "
            "bring more sessions, or cut long ones"
        )


def _settle_blocks(spec: ChainSpec, sessions: Sequence[Recording], block: int) -> int:
    """Return the number of blocks at the start of every session that are not monitored."""
    shortest = min(session.samples for session in sessions)
    # A tenth: one-minute cycles of a rig would otherwise lose most of what they have.
    settle_ticks = min(round(spec.settle_s * sessions[0].rate_hz), shortest // 10)
    return -(-settle_ticks // block)


def _list_left_out(fold: int, sessions: int, folds: int) -> range:
    """Return the indices of the sessions left out by the fold."""
    return range(0) if fold == NO_FOLD else range(fold, sessions, folds)


def fit_from_blocks(
    spec: ChainSpec,
    summaries: BlockSummaries,
    blocks: Sequence[SessionBlocks],
    rate_hz: float,
    settle: int,
    promised_hours: float,
    side_by_side: SideBySide = ONE_BY_ONE,
) -> FittedChain:
    """Fit a chain like `fit_chain`, given the blocks of the sessions."""
    remaining, doubtful = _drop_doubtful(spec, blocks, settle)
    blocks_per_s = rate_hz / summaries.block
    drift = SlowDrift(spec.drift_per_hour / 3600.0 / blocks_per_s, spec.max_drift)
    folds = min(spec.folds, len(remaining))
    jobs = [_Part(spec, remaining, drift, blocks_per_s, settle, fold, folds) for fold in (NO_FOLD, *range(folds))]
    white: list[Array] = [np.zeros(0)] * len(remaining)
    for job, fitted in zip(jobs, side_by_side(fit_part, jobs), strict=True):
        if job.fold == NO_FOLD:
            conditioning, watches = fitted.conditioning, fitted.watches
        for index, part in zip(job.left_out, fitted.rows, strict=True):
            white[index] = _extend_rows(part, [watch.directions for watch in watches])
    # On sessions that a view was not fitted to: on its own ones one of many directions looks far too calm.
    bank = BankSpec(scale_watches(spec.watches, watches, white))
    limit = calibrated(bank, white, blocks_per_s, promised_hours)
    quiet = _quiet(bank, white)
    chain = MonitorChain(summaries, conditioning, drift, bank.watches, limit.limit, quiet, settle)
    return FittedChain(chain, limit, doubtful, tuple(remaining))


def _watches(spec: ChainSpec, sessions: Sequence[tuple[Array, Array]], blocks_per_s: float, settle: int) -> list[Watch]:
    """Fit the views to healthy sessions, each to its kind of rows."""
    return [
        fit_watch(watch, [gross if watch.view == "own" else rows for rows, gross in sessions], blocks_per_s, settle)
        for watch in spec.watches
    ]


def _extend_rows(parts: Sequence[Array], directions: Sequence[int]) -> Array:
    """Extend the rows of a fold's views to the width of the full views; missing directions count as healthy."""
    wide = []
    for part, width in zip(parts, directions, strict=True):
        fitting = part[:, :width]
        wide.append(np.pad(fitting, ((0, 0), (0, width - fitting.shape[1]))))
    return np.concatenate(wide, axis=1)


@dataclass(frozen=True, eq=False)
class _Part:
    """A fit to all sessions, or to those outside a fold."""

    spec: ChainSpec
    sessions: Sequence[SessionBlocks]
    drift: SlowDrift
    blocks_per_s: float
    settle: int
    fold: int
    folds: int

    @property
    def label(self) -> str:
        """For messages."""
        return "conditioning and views" if self.fold == NO_FOLD else f"fold {self.fold + 1} of {self.folds}"

    @property
    def left_out(self) -> range:
        """Indices of the left-out sessions."""
        return _list_left_out(self.fold, len(self.sessions), self.folds)


@dataclass(frozen=True, eq=False)
class FittedPart:
    """Conditioning and views, with the rows of each view for sessions outside its training data."""

    conditioning: Conditioning
    watches: tuple[Watch, ...]
    rows: tuple[tuple[Array, ...], ...]


def fit_part(job: _Part) -> FittedPart:
    """Fit conditioning and views."""
    out = set(job.left_out)
    others = [session for index, session in enumerate(job.sessions) if index not in out]
    conditioning = _conditioning(job.spec, others, job.settle)
    fitted = [_condition(conditioning, job.drift, session, job.settle) for session in others]
    watches = _watches(job.spec, fitted, job.blocks_per_s, job.settle)
    rows = []
    for index in job.left_out:
        # The start of a session is operating time: its rows are missing, and count as healthy.
        clipped, gross = _condition(conditioning, job.drift, job.sessions[index], job.settle)
        rows.append(tuple(watch(gross if watch.own else clipped) for watch in watches))
    return FittedPart(conditioning, tuple(watches), tuple(rows))


def _quiet(bank: BankSpec, sessions: Sequence[Array]) -> float:
    """Return the median of the largest statistic on healthy sessions."""
    values = []
    for rows in sessions:
        detector = bank.build(rows.shape[1])
        values += [float(detector.step(row[None])[0]) for row in rows]
    return float(np.median(values)) if values else 0.0


def _conditioning(spec: ChainSpec, sessions: Sequence[SessionBlocks], settle: int) -> Conditioning:
    return fit_conditioning([p.summaries[settle:] for p in sessions], [p.points[settle:] for p in sessions], spec.clip)


def _condition(
    conditioning: Conditioning, drift: SlowDrift, session: SessionBlocks, settle: int
) -> tuple[Array, Array]:
    """Return the conditioned rows with and without clipping, drift removed."""
    gross = conditioning.unclipped(session.summaries, session.points)
    gross[:settle] = np.nan
    z = np.clip(gross, -conditioning.clip, conditioning.clip)
    return drift.run(z, np.zeros(z.shape[1]))[0], gross


def _drop_doubtful(
    spec: ChainSpec, sessions: Sequence[SessionBlocks], settle: int
) -> tuple[list[SessionBlocks], tuple[str, ...]]:
    """Return the sessions without those whose means lie far from all others, and the names of those."""
    bad = _doubtful(spec, sessions, sessions, settle)
    remaining = [session for session, out in zip(sessions, bad, strict=True) if not out]
    return remaining, tuple(session.name for session, out in zip(sessions, bad, strict=True) if out)


def doubtful_sessions(
    fitted: FittedChain,
    spec: ChainSpec,
    sources: Sequence[ResidualSource],
    channels: Sequence[Channel],
    sessions: Sequence[Recording],
    side_by_side: SideBySide = ONE_BY_ONE,
) -> tuple[str, ...]:
    """Return names of other sessions, such as training sessions, whose means are far from the fitted sessions."""
    chain = fitted.chain
    blocks = list(
        side_by_side(summarised, [BlocksJob(chain.summaries, sources, channels, session) for session in sessions])
    )
    bad = _doubtful(spec, blocks, fitted.sessions, chain.settle)
    return tuple(block.name for block, out in zip(blocks, bad, strict=True) if out)


def _doubtful(
    spec: ChainSpec, sessions: Sequence[SessionBlocks], usual: Sequence[SessionBlocks], settle: int
) -> NDArray[np.bool_]:
    """Return a mask of the sessions whose means are far from the usual ones."""
    # As they are: what is usual at an operating point would be learned from the doubtful sessions, too.
    means, others = (
        np.stack([np.nan_to_num(session.summaries[settle:]).mean(axis=0) for session in part])
        for part in (sessions, usual)
    )
    middle = np.median(others, axis=0)
    width = 1.4826 * np.median(np.abs(others - middle), axis=0)
    # A summary that hardly varies between sessions would make every one stand out.
    width = np.maximum(width, 0.02 + 1e-3 * np.abs(middle))
    worst, usual_worst = ((np.abs(part - middle) / width).max(axis=1) for part in (means, others))
    # Healthy sessions differ as well: what is doubtful stands far out among their own largest deviations.
    bad = worst > spec.doubtful * float(np.median(usual_worst))
    # A fifth at most: where more stand out, they are not exceptions.
    most = max(1, len(sessions) // 5)
    return np.asarray(bad & (worst >= np.sort(worst)[-most]), dtype=bool)
