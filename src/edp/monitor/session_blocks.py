"""Summaries and operating points of sessions, with blocks and scales from healthy sessions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edp.data.roles import Axis, roles_of
from edp.monitor.residuals.base import ResidualSource, residuals_of, rows_of
from edp.monitor.summaries import BlockSummaries
from edp.recording import Recording
from edp.signals import Channel, Kind

Array = NDArray[np.float64]
SCALED_SESSIONS = 12
"""Number of sessions that determine the residual scales. The scales only set units; conditioning does the rest."""
MOVING = (Kind.VELOCITY, Kind.ANGULAR_VELOCITY, Kind.PILOT_PRESSURE, Kind.FLOW)
LEVELS = (Kind.PRESSURE, Kind.TEMPERATURE, Kind.POSITION, Kind.ANGLE, Kind.RATIO, Kind.CURRENT, Kind.VOLTAGE)
MAX_POINT = 24
"""Maximum number of channels of an operating point. If there are more, the channels with the largest variation are
used.
"""
MIN_TICKS = 10
"""Minimum length of a block in samples. Spreads of fewer samples are meaningless."""


@dataclass(frozen=True, eq=False)
class SessionBlocks:
    """Summaries and operating points of a session, shapes (blocks, summaries) and (blocks, points)."""

    name: str
    summaries: Array
    points: Array


def fit_summaries(
    block_s: float, sources: Sequence[ResidualSource], channels: Sequence[Channel], sessions: Sequence[Recording]
) -> BlockSummaries:
    """Return the blocks and scales from some healthy sessions."""
    names, block, chosen = [channel.name for channel in channels], block_ticks(block_s, sessions), _scaling(sessions)
    scales = []
    for source in sources:
        values = np.concatenate(residuals_of(source, chosen)).astype(np.float64)
        scales.append(_robust_width(values))
    rows = np.concatenate([rows_of(session, names) for session in chosen]).astype(np.float64)
    centre, spread = np.nanmean(rows, axis=0), np.nanstd(rows, axis=0)
    centre = np.nan_to_num(centre)
    spread = np.where(np.nan_to_num(spread) > 0.0, spread, 1.0)
    judged = [names.index(channel[0]) for source in sources for channel in source.judged]
    change = np.nanvar(np.diff(rows / spread, axis=0), axis=0)
    change = np.where(np.nan_to_num(change) > 0.0, change, 1.0)
    moving, level = _operating_channels(channels, rows, block)
    return BlockSummaries(
        block=block,
        scale=1.0 / np.concatenate(scales),
        channel=np.array(judged, np.int64),
        centre=centre,
        spread=1.0 / spread,
        change=change[judged],
        moving=moving,
        level=level,
        drivers=drivers_of(channels, sessions[0], [names[i] for i in judged]),
    )


def block_ticks(block_s: float, sessions: Sequence[Recording]) -> int:
    """Return the number of samples of a block in these sessions."""
    block = max(round(block_s * sessions[0].rate_hz), MIN_TICKS)
    return min(block, max(1, min(session.samples for session in sessions) // 2))


def operating_numbers(channels: Sequence[Channel], sessions: Sequence[Recording], block: int) -> int:
    """Return the dimension of the operating point of these sessions."""
    names = [channel.name for channel in channels]
    rows = np.concatenate([rows_of(session, names) for session in _scaling(sessions)]).astype(np.float64)
    return 1 + sum(len(places) for places in _operating_channels(channels, rows, block))


def _scaling(sessions: Sequence[Recording]) -> list[Recording]:
    """Return the sessions that scales and operating points are taken from, evenly chosen."""
    places = np.unique(np.linspace(0, len(sessions) - 1, min(len(sessions), SCALED_SESSIONS)).astype(int))
    return [sessions[i] for i in places]


def drivers_of(channels: Sequence[Channel], session: Recording, judged: Sequence[str]) -> NDArray[np.int64]:
    """Return the drivers of each residual: velocity and signed command of its channel's axis.

    A channel of no axis has those whose sizes go with it most. Shape (drivers, residuals, 2); a driver that no residual
    has is left out.
    """
    names = [channel.name for channel in channels]
    axes = roles_of(session).axes
    own = [
        next((axis for axis in axes if name in (axis.velocity, axis.stroke, *axis.pressures, *axis.command)), None)
        or _likely_axis(axes, session, name)
        for name in judged
    ]
    rows = []
    for choose in (lambda axis: (axis.velocity,), lambda axis: axis.command, lambda axis: axis.conflux):
        pairs = [tuple(n for n in choose(axis) if n in names) if axis is not None else () for axis in own]
        if any(pairs):
            # Without a driver the residual is driven by itself against itself, which is nothing: 0 less 0.
            rows.append([[names.index(p[0]), names.index(p[1]) if len(p) > 1 else -1] if p else [0, 0] for p in pairs])
    return np.array(rows, np.int64).reshape(len(rows), len(judged), 2)


def _likely_axis(axes: Sequence[Axis], session: Recording, name: str) -> Axis | None:
    """Return the axis whose velocity magnitude correlates most with the magnitude of a channel."""
    if not axes or name not in session.channel_names:
        return None
    sizes = np.abs(session.column(name).astype(np.float64) - float(session.column(name).mean()))

    def likeness(axis: Axis) -> float:
        if axis.velocity not in session.channel_names or axis.velocity == name:
            return -1.0
        other = np.abs(session.column(axis.velocity).astype(np.float64))
        width = float(sizes.std() * other.std())
        return float(((sizes - sizes.mean()) * (other - other.mean())).mean()) / width if width > 0.0 else -1.0

    return max(axes, key=likeness)


def _robust_width(values: Array) -> Array:
    """Return the deviation of each column, half of it from the middle of the distribution and half from all."""
    centred = np.abs(values - np.nanmedian(values, axis=0))
    width = 0.5 * (1.4826 * np.nanmedian(centred, axis=0) + np.sqrt(np.nanmean(np.square(centred), axis=0)))
    widest: Array = np.where(np.nan_to_num(width) > 0.0, width, 1.0)
    return widest


def _operating_channels(
    channels: Sequence[Channel], rows: Array, block: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return indices of channels whose magnitude, and of channels whose level, defines the operating point."""
    whole = rows[: len(rows) // block * block].reshape(-1, block, rows.shape[1])
    varies = np.nan_to_num(np.nanstd(np.nanmean(whole, axis=1), axis=0)) > 0.0
    moving = [i for i, c in enumerate(channels) if c.kind in MOVING and varies[i]]
    level = [i for i, c in enumerate(channels) if c.kind in LEVELS and varies[i]]
    return np.array(moving[:MAX_POINT], np.int64), np.array(level[:MAX_POINT], np.int64)


def blocks_of(
    summaries: BlockSummaries, sources: Sequence[ResidualSource], channels: Sequence[Channel], session: Recording
) -> SessionBlocks:
    """Return the summaries and operating points of a session."""
    residuals = np.concatenate([residuals_of(source, [session])[0] for source in sources], axis=1)
    rows = rows_of(session, [channel.name for channel in channels])
    raw, points, _ = summaries.run(residuals, rows, summaries.initial_state())
    return SessionBlocks(session.name, raw, points)


@dataclass(frozen=True, eq=False)
class BlocksJob:
    """Arguments of `blocks_of`."""

    summaries: BlockSummaries
    sources: Sequence[ResidualSource]
    channels: Sequence[Channel]
    session: Recording

    @property
    def label(self) -> str:
        """For messages."""
        return self.session.name


def summarised(job: BlocksJob) -> SessionBlocks:
    """Return `blocks_of` of a job."""
    return blocks_of(job.summaries, job.sources, job.channels, job.session)


def session_means(channels: Sequence[Channel], sessions: Sequence[Recording]) -> Array:
    """Return the mean over sessions of each channel's mean, and a generous deviation between sessions.

    Shape (2, inputs).
    """
    names = [channel.name for channel in channels]
    means, within = [], []
    # One session at a time: hundreds of hours in double precision would not fit into memory.
    for session in sessions:
        rows = rows_of(session, names).astype(np.float64)
        means.append(rows.mean(axis=0))
        within.append(rows.std(axis=0))
    width = np.std(means, axis=0) + 0.25 * np.mean(within, axis=0)
    return np.stack([np.mean(means, axis=0), np.where(width > 0.0, width, 1.0)])
