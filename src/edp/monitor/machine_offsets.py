"""Detection of logs of another machine of the same kind.

Balances of flow know the openings of a valve to less than a hundredth, so that machines of one series lie farther apart
than many a fault moves them. A fault concerns one axis, with few exceptions; another machine is off in all of them, and
from the start of a log on.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from edp.monitor.chain import MonitorChain
from edp.monitor.residuals.base import ResidualSource
from edp.monitor.residuals.flow_balances import FlowBalances
from edp.monitor.session_blocks import SessionBlocks
from edp.wording import figure

Array = NDArray[np.float64]
FIRST_S = 120.0
"""Start of a log whose means are compared with those of healthy sessions, s."""
MIN_THERE = 0.5
"""Minimum fraction of the log in which a balance must be available."""
OFF = 3.0
"""Mean of a balance, in healthy standard deviations, beyond which its axis counts as deviating. The least deviating
axis of 65 healthy sessions reaches 2.5, of sister machines within 1 % 2.9 to 15.
"""
MIN_AXES = 2
"""Minimum number of deviating axes. A single deviating axis may have a fault."""


def scatter_of(chain: MonitorChain, sessions: Sequence[SessionBlocks], block_s: float) -> Array:
    """Return the scatter of means over the start of healthy sessions, shape (summaries,); zero if unknown."""
    means = []
    for session in sessions:
        rows = chain.conditioning(session.summaries, session.points)
        first = _blocks(block_s)
        means.append(_means(rows[chain.settle :][:first], first))
    table = np.array(means)
    there = np.isfinite(table)
    squares = np.where(there, table, 0.0) ** 2
    scatter: Array = np.sqrt(squares.sum(axis=0) / np.maximum(there.sum(axis=0), 1))
    return scatter


def other_machine(
    sources: Sequence[ResidualSource], chain: MonitorChain, scatter: Array, rows: Array, block_s: float
) -> str:
    """Return a message if the flow balances of all axes deviate at the start and over the whole log; otherwise empty.

    Args:
        sources: sources of the monitor.
        chain: chain of the monitor.
        scatter: result of `scatter_of`.
        rows: conditioned summaries of the log, NaN where missing, shape (blocks, summaries).
        block_s: length of a block, s.
    """
    first, watched = _blocks(block_s), rows[chain.settle :]
    if len(watched) < first:
        return ""
    usual = np.where(scatter > 0.0, scatter, np.inf)
    start, whole = (np.abs(_means(part, first)) / usual for part in (watched[:first], watched))
    least = []
    for columns in _axes(sources, chain).values():
        sizes = [float(np.nan_to_num(part[columns]).max()) for part in (start, whole)]
        least.append(min(sizes))
    if len(least) < MIN_AXES or min(least) <= OFF:
        return ""
    return (
        f"balances of flow of all {len(least)} axes are off from its start on, by {figure(min(least), 2)} to "
        f"{figure(max(least), 2)} healthy deviations: this is another machine of its kind, or a fault that all axes "
        "share, "
        "such as in the return line; fit a monitor to this machine, or one for a series (edp monitor fit --set "
        "chain.tolerance=0.01)"
    )


def _axes(sources: Sequence[ResidualSource], chain: MonitorChain) -> dict[str, list[int]]:
    """Return the columns of the flow-balance summaries by monitored velocity."""
    each = chain.summaries.width // chain.summaries.residuals
    axes: dict[str, list[int]] = {}
    index = 0
    for source in sources:
        for judged in source.judged:
            if isinstance(source, FlowBalances):
                axes.setdefault(judged[0], []).extend(range(index * each, (index + 1) * each))
            index += 1
    return axes


def _blocks(block_s: float) -> int:
    return max(1, round(FIRST_S / block_s))


def _means(rows: Array, first: int) -> Array:
    """Return the means over the rows of a log, or over its first ones.

    NaN for a summary that is missing in most of the start.
    """
    there = np.isfinite(rows)
    counts = there.sum(axis=0)
    means = np.where(there, rows, 0.0).sum(axis=0) / np.maximum(counts, 1)
    return np.where(counts >= MIN_THERE * first, means, np.nan)
