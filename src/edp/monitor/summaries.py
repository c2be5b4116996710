"""Block summaries of residuals: sums in a fixed order, which C repeats bit for bit.

Only + - * / sqrt and comparisons are used, in double precision, one tick after the other.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edp.storage.arrays import POSITIVE, ArrayRule, checked_arrays

Array = NDArray[np.float64]
ARRAYS = {
    "centre": ArrayRule(("inputs",)),
    "spread": ArrayRule(("inputs",), low=POSITIVE),
    "scale": ArrayRule(("residuals",), low=POSITIVE),
    "change": ArrayRule(("residuals",), low=POSITIVE),
    "channel": ArrayRule(("residuals",), np.int64, low=0, high="inputs"),
    "moving": ArrayRule(("moving",), np.int64, low=0, high="inputs"),
    "level": ArrayRule(("level",), np.int64, low=0, high="inputs"),
    "drivers": ArrayRule(("drivers", "residuals", 2), np.int64, low=-1, high="inputs"),
}
"""Arrays of the summaries in the monitor file, with their rules."""
SUMMARIES = ("mean", "spread", "gain", "lag", "peak")
"""Summaries of each residual per block, in this order. One more for each driver follows."""
MAX_DRIVERS = 8
NEAR_ZERO = 0.05
"""Variance in healthy units added to the denominators of `gain` and `lag`, because a channel in steady state determines
neither.
"""
BLOCKS_AT_ONCE = 32
"""Number of blocks processed together, small enough that their sums stay in the processor's cache."""
MAX_BLOCK = 1_000_000
"""Maximum number of samples in a block."""


@dataclass(frozen=True, eq=False)
class BlockSummaries:
    """Summaries of a block.

    r is a residual times one over its healthy scale, u the channel that it evaluates less its `centre`, times one over
    its healthy deviation, d the change of u since the tick before, n the ticks of the block at which r is there::

        mean = sum r / n                      spread = sqrt(sqrt(max(sum r^2 / n - mean^2, 0)))
        gain = sum r u / (sum u^2 + 0.05 n)   lag    = sum r d / (sum d^2 + 0.05 n D)
        peak = sqrt(max |r|)
        drive = sum r w / (sum w^2 + 0.05 n) for each driver, w one scaled input less another

    A driver is what moves the part: friction shows as a residual that goes with the velocity, a dead band as one that
    goes with the command.

    A block in which more than half of the ticks of a residual are missing gives NaN for it.

    Attributes:
        block: number of samples per block.
        scale: inverse healthy width of each residual, shape (residuals,), because a controller multiplies faster than
            it divides.
        channel: place of the channel that each residual evaluates among the raw inputs, shape (residuals,).
        centre: centre of each raw input, shape (inputs,).
        spread: inverse healthy standard deviation of each input, above zero.
        change: D, healthy variance of d of the channel of each residual, shape (residuals,).
        moving: places of inputs whose mean size is part of the operating point.
        level: places of inputs whose mean is part of the operating point.
        drivers: places of the two inputs of each driver, shape (drivers, residuals, 2); a second one of -1 is none.
    """

    block: int
    scale: Array
    channel: NDArray[np.int64]
    centre: Array
    spread: Array
    change: Array
    moving: NDArray[np.int64]
    level: NDArray[np.int64]
    drivers: NDArray[np.int64]

    @property
    def residuals(self) -> int:
        """Number of residuals."""
        return len(self.scale)

    @property
    def width(self) -> int:
        """Number of values per block: `SUMMARIES` and the driver columns of each residual."""
        return (len(SUMMARIES) + len(self.drivers)) * self.residuals

    @property
    def points(self) -> int:
        """Numbers of the operating point: 1, levels, sizes of what moves."""
        return 1 + len(self.level) + len(self.moving)

    def initial_state(self) -> SummaryState:
        """Return the state before the first sample of a machine."""
        sums = {name: np.zeros(self.residuals) for name in ("n", "r", "rr", "ru", "uu", "rd", "dd", "peak")}
        inputs, driven = len(self.centre), (len(self.drivers), self.residuals)
        sums |= {"rw": np.zeros(driven), "ww": np.zeros(driven)}
        sums |= {"y": np.zeros(inputs), "size": np.zeros(inputs)}
        return SummaryState(0, self.centre, False, sums)

    def run(
        self, residuals: NDArray[Any], rows: NDArray[Any], state: SummaryState
    ) -> tuple[Array, Array, SummaryState]:
        """Return the blocks that end in a segment.

        Args:
            residuals: shape (ticks, residuals), NaN where not available.
            rows: raw inputs, shape (ticks, inputs); a missing value counts as the last one that was there.
            state: before it.

        Returns:
            Summaries, shape (blocks, width); operating points, shape (blocks, points); the state behind the segment.
        """
        summaries, points = [], []
        at, ticks = 0, len(residuals)
        # Whole blocks from a block's beginning run side by side; the rest goes tick by tick. The bits are the same.
        while at < ticks:
            if state.ticks == 0 and ticks - at >= self.block:
                blocks = min((ticks - at) // self.block, BLOCKS_AT_ONCE)
                stop = at + blocks * self.block
            else:
                blocks, stop = 1, min(ticks, at + self.block - state.ticks)
            shape = (blocks, (stop - at) // blocks, -1)
            state = self._take(residuals[at:stop].reshape(shape), rows[at:stop].reshape(shape), state)
            if state.ticks == self.block:
                summary, point = self._close_blocks(state)
                summaries.append(summary.reshape(-1, self.width))
                points.append(point.reshape(-1, self.points))
                fresh = self.initial_state()
                state = SummaryState(0, state.last, state.started, fresh.sums)
            at = stop
        none = (np.zeros((0, self.width)), np.zeros((0, self.points)))
        return (np.concatenate(summaries), np.concatenate(points), state) if summaries else (*none, state)

    def _take(self, residuals: NDArray[Any], rows: NDArray[Any], state: SummaryState) -> SummaryState:
        """Add samples of several consecutive blocks in parallel, shape (blocks, ticks, ...) each."""
        blocks, ticks = residuals.shape[:2]
        there = np.isfinite(residuals)
        r = np.where(there, residuals, 0.0).astype(np.float64) * self.scale
        flat = _fill_missing(rows.reshape(blocks * ticks, -1).astype(np.float64), state.last)
        y_flat = (flat - self.centre) * self.spread
        # The first tick of a stream is its own predecessor.
        first = (state.last - self.centre) * self.spread if state.started else y_flat[0]
        before = np.concatenate([first[None], y_flat[:-1]])
        y, d = y_flat.reshape(blocks, ticks, -1), (y_flat - before).reshape(blocks, ticks, -1)
        u, change = y[..., self.channel], d[..., self.channel]
        first_of, second_of = self.drivers[..., 0], self.drivers[..., 1]
        w = y[..., first_of] - np.where(second_of >= 0, y[..., np.maximum(second_of, 0)], 0.0)
        sums = {name: np.repeat(values[None], blocks, 0) for name, values in state.sums.items()}
        for tick in range(ticks):
            rt, ut, dt, finite = r[:, tick], u[:, tick], change[:, tick], there[:, tick]
            sums["n"] = sums["n"] + finite
            sums["r"] = sums["r"] + rt
            sums["rr"] = sums["rr"] + rt * rt
            sums["ru"] = sums["ru"] + rt * ut
            sums["uu"] = sums["uu"] + ut * ut
            sums["rd"] = sums["rd"] + rt * dt
            sums["dd"] = sums["dd"] + dt * dt
            sums["rw"] = sums["rw"] + rt[:, None] * w[:, tick]
            sums["ww"] = sums["ww"] + w[:, tick] * w[:, tick]
            sums["peak"] = np.maximum(sums["peak"], np.abs(rt))
            sums["y"] = sums["y"] + y[:, tick]
            sums["size"] = sums["size"] + np.abs(y[:, tick])
        if blocks == 1:
            sums = {name: values[0] for name, values in sums.items()}
        return SummaryState(state.ticks + ticks, flat[-1].copy(), True, sums)

    def _close_blocks(self, state: SummaryState) -> tuple[Array, Array]:
        """Return summaries and operating points of completed blocks."""
        sums = state.sums
        n = np.maximum(sums["n"], 1.0)
        mean = sums["r"] / n
        variance = np.maximum(sums["rr"] / n - mean * mean, 0.0)
        whole = float(self.block)
        gain = sums["ru"] / (sums["uu"] + NEAR_ZERO * whole)
        lag = sums["rd"] / (sums["dd"] + NEAR_ZERO * whole * self.change)
        own = np.stack([mean, np.sqrt(np.sqrt(variance)), gain, lag, np.sqrt(sums["peak"])], axis=-1)
        drive = sums["rw"] / (sums["ww"] + NEAR_ZERO * whole)
        summary = np.concatenate([own, np.moveaxis(drive, -2, -1)], axis=-1)
        # More than half of the ticks are missing: the block says nothing of this residual.
        summary[2.0 * sums["n"] < whole] = np.nan
        levels = sums["y"][..., self.level] / whole
        sizes = sums["size"][..., self.moving] / whole
        return summary, np.concatenate([np.ones((*levels.shape[:-1], 1)), levels, sizes], axis=-1)

    def names(self, residuals: Sequence[str]) -> tuple[str, ...]:
        """Return the names of the summaries, such as ``virtual:CylVels_1.mean``."""
        summaries = (*SUMMARIES, *(f"drive{number + 1}" for number in range(len(self.drivers))))
        return tuple(f"{residual}.{summary}" for residual in residuals for summary in summaries)

    def to_dict(self) -> dict[str, object]:
        """Return the plain values of its file."""
        return {"block": self.block}

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return the arrays of its file."""
        return {name: getattr(self, name) for name in ARRAYS}

    @staticmethod
    def from_dict(plain: Mapping[str, object], arrays: Mapping[str, NDArray[Any]]) -> BlockSummaries:
        """Create the summaries from the result of `to_dict` and their arrays.

        Raises:
            ValueError: values that cannot be.
        """
        block = plain["block"]
        if isinstance(block, bool) or not isinstance(block, int) or not 1 <= block <= MAX_BLOCK:
            raise ValueError(f"a block has {str(block)[:40]} ticks; 1 to {MAX_BLOCK:,} must hold")
        values = checked_arrays(arrays, ARRAYS, "the summaries")
        drivers = values["drivers"]
        if len(drivers) > MAX_DRIVERS or (drivers[..., 0] < 0).any():
            raise ValueError(f"the summaries have more than {MAX_DRIVERS} drivers, or one without its first input")
        return BlockSummaries(block, **values)


@dataclass(frozen=True, eq=False)
class SummaryState:
    """Sums of a block that has begun.

    Attributes:
        ticks: number of samples in the block so far.
        last: the inputs of the tick before, the last ones that were there, shape (inputs,).
        started: whether there was a tick before.
        sums: sums by name.
    """

    ticks: int
    last: Array
    started: bool
    sums: Mapping[str, Array] = field(default_factory=dict)


def _fill_missing(rows: Array, last: Array) -> Array:
    """Return rows with missing values replaced by the last value."""
    there = np.isfinite(rows)
    if there.all():
        return rows
    newest = np.maximum.accumulate(np.where(there, np.arange(1, len(rows) + 1)[:, None], 0), axis=0)
    filled: Array = np.take_along_axis(np.concatenate([last[None], rows]), newest, axis=0)
    return filled
