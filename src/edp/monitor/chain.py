"""From residuals and raw channels at every tick to statistics at every block: sums, conditioning, views, detectors.

All arithmetic is + - * / sqrt and comparisons in a fixed order, so that C gives the same bits: in double precision, but
for the long sums of conditioning and views, which are in single precision.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edp.monitor.adaptation import SlowDrift
from edp.monitor.conditioning import Conditioning
from edp.monitor.detectors.base import DETECTORS, Detector
from edp.monitor.summaries import BlockSummaries, SummaryState
from edp.monitor.watches import BankSpec, Watch
from edp.settings.tree import SettingsTree
from edp.storage.arrays import ArrayRule, arrays_under, checked_arrays
from edp.storage.reading import Table

Array = NDArray[np.float64]
MAX_SUMMARIES = 5_000
MAX_WATCHES = 16
MEAN, WIDTHS, MATRIX = (ArrayRule(shape) for shape in (("summaries",), ("summaries",), ("summaries", "columns")))
"""Array rules of a watch: its mean, and the width of each summary or a whitening matrix."""
_TREE = SettingsTree({"detector": DETECTORS}, what="monitor")


@dataclass(frozen=True, kw_only=True)
class _Form:
    detector: Any


@dataclass(eq=False)
class ChainState:
    """All that a chain remembers of one machine.

    Attributes:
        summary: sums of the block that has begun.
        blocks: number of complete blocks since the start.
        drift: estimated slow changes, shape (summaries,).
        bank: detectors at work; None before the first block. They change in place: copy the state to branch off.
        since: blocks that had ended when the statistic was last at a healthy level.
        sums: sums of the conditioned rows since then, shape (summaries,); `counts` are the numbers of valid rows.
        counts: see `sums`.
    """

    summary: SummaryState
    blocks: int
    drift: Array
    bank: Detector
    since: int
    sums: Array
    counts: Array


@dataclass(frozen=True)
class BlockVerdict:
    """Result of one block.

    Attributes:
        block: index of the block, counted from the start.
        statistics: statistic of each watch divided by its scale.
        row: conditioned summaries, NaN where missing.
        alarm: place of the watch that passed the limit, None without an alarm.
        since: block after which the deviation began.
        evidence: mean conditioned deviation since then, shape (summaries,).
    """

    block: int
    statistics: tuple[float, ...]
    row: Array
    alarm: int | None
    since: int
    evidence: Array


@dataclass(frozen=True, eq=False)
class MonitorChain:
    """The fitted chain.

    Attributes:
        summaries: summaries of blocks.
        conditioning: conditioning on the operating point.
        drift: slow changes that are followed.
        watches: views and their detectors.
        limit: alarm limit of the largest scaled statistic.
        quiet: level below which the largest scaled statistic is healthy.
        settle: blocks after a start that are not watched.
    """

    summaries: BlockSummaries
    conditioning: Conditioning
    drift: SlowDrift
    watches: tuple[Watch, ...]
    limit: float
    quiet: float
    settle: int

    @property
    def bank(self) -> BankSpec:
        """All watches as one detector."""
        return BankSpec(self.watches)

    def initial_state(self) -> ChainState:
        """Return the state before the first sample of a machine."""
        width, directions = self.summaries.width, sum(watch.directions for watch in self.watches)
        none = np.zeros(width)
        bank = self.bank.build(directions)
        return ChainState(self.summaries.initial_state(), 0, none, bank, 0, none.copy(), none.copy())

    def conditioned(
        self, residuals: NDArray[Any], rows: NDArray[Any], state: ChainState
    ) -> tuple[Array, Array, ChainState]:
        """Return conditioned rows of the blocks that end in a segment, shape (blocks, summaries), and the next state.

        First within the clip and with drift taken off, then as far as they reach.
        """
        raw, points, summary = self.summaries.run(residuals, rows, state.summary)
        gross = self.conditioning.unclipped(raw, points)
        gross[: max(0, self.settle - state.blocks)] = np.nan
        z, drift = self.drift.run(np.clip(gross, -self.conditioning.clip, self.conditioning.clip), state.drift)
        state = replace(state, summary=summary, drift=drift, blocks=state.blocks + len(z))
        return z, gross, state

    def run(
        self, residuals: NDArray[Any], rows: NDArray[Any], state: ChainState
    ) -> tuple[list[BlockVerdict], ChainState]:
        """Return the verdicts of the blocks that end in a segment of one machine.

        Args:
            residuals: shape (ticks, residuals), NaN where not available.
            rows: raw inputs, shape (ticks, inputs).
            state: before it; its detectors go on in place.

        Returns:
            A verdict a block, and the state behind the segment.
        """
        first = state.blocks
        z, gross, state = self.conditioned(residuals, rows, state)
        verdicts = []
        white = self.bank.white(z, gross)
        for index, (row, seen) in enumerate(zip(z, white, strict=True)):
            number = first + index + 1
            if number <= self.settle:
                state.since = number
                verdicts.append(BlockVerdict(number, (0.0,) * len(self.watches), row, None, number, np.zeros(len(row))))
                continue
            verdicts.append(self._evaluate_block(number, row, seen, state))
        return verdicts, state

    def _evaluate_block(self, number: int, row: Array, seen: Array, state: ChainState) -> BlockVerdict:
        largest = float(state.bank.step(seen[None])[0])
        each: Array = state.bank.each[:, 0].copy()  # type: ignore[attr-defined]
        there = np.isfinite(row)
        state.sums = state.sums + np.where(there, row, 0.0)
        state.counts = state.counts + there
        evidence = np.where(state.counts > 0.0, state.sums / np.maximum(state.counts, 1.0), 0.0)
        alarm = int(each.argmax()) if largest > self.limit else None
        verdict = BlockVerdict(number, tuple(each.tolist()), row, alarm, state.since, evidence)
        if alarm is not None:
            state.bank.reset()
        if alarm is not None or largest <= self.quiet:
            state.since, state.sums, state.counts = number, np.zeros(len(row)), np.zeros(len(row))
        return verdict

    def to_dict(self) -> dict[str, object]:
        """Return the plain values of its file."""
        return {
            "summaries": self.summaries.to_dict(),
            "clip": self.conditioning.clip,
            "drift": self.drift.to_dict(),
            "watches": [
                {"detector": _TREE.to_dict(watch.detector, "detector"), "scale": watch.scale} for watch in self.watches
            ],
            "limit": self.limit,
            "quiet": self.quiet,
            "settle": self.settle,
        }

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return the arrays of its file."""
        named: dict[str, NDArray[Any]] = {f"summaries.{k}": v for k, v in self.summaries.arrays().items()}
        named |= {f"conditioning.{name}": values for name, values in self.conditioning.arrays().items()}
        for index, watch in enumerate(self.watches):
            named |= {f"watch.{index}.mean": watch.mean, f"watch.{index}.matrix": watch.matrix}
        return named

    @staticmethod
    def from_dict(plain: Table, arrays: Mapping[str, NDArray[Any]]) -> MonitorChain:
        """Create the chain from the result of `to_dict` and its arrays.

        Raises:
            ValueError: values that cannot be; files are data from outside.
        """
        summaries = BlockSummaries.from_dict(plain["summaries"], arrays_under(arrays, "summaries."))
        if summaries.width > MAX_SUMMARIES:
            raise ValueError(f"it has {summaries.width} summaries; at most {MAX_SUMMARIES} must hold")
        clip = _number(plain["clip"], "clip")
        conditioning = Conditioning.from_arrays(
            arrays_under(arrays, "conditioning."), clip, summaries.width, summaries.points
        )
        watches = _watches(plain["watches"], arrays, summaries.width)
        settle = plain["settle"]
        if isinstance(settle, bool) or not isinstance(settle, int) or not 0 <= settle <= 1_000_000:
            raise ValueError(f"settle is {str(settle)[:40]}; an integer from 0 to 1,000,000 must hold")
        limit, quiet = _number(plain["limit"], "limit"), _number(plain["quiet"], "quiet")
        return MonitorChain(summaries, conditioning, SlowDrift.from_dict(plain["drift"]), watches, limit, quiet, settle)


def _watches(entries: Sequence[Any], arrays: Mapping[str, NDArray[Any]], summaries: int) -> tuple[Watch, ...]:
    if not isinstance(entries, list) or not 1 <= len(entries) <= MAX_WATCHES:
        raise ValueError(f"it has no list of 1 to {MAX_WATCHES} watches")
    watches = []
    for index, entry in enumerate(entries):
        spec = _TREE.build(_Form, {"detector": entry["detector"]}, "of its watches").detector
        own, scale = arrays_under(arrays, f"watch.{index}."), _number(entry["scale"], "scale")
        # A matrix, or its diagonal.
        matrix = WIDTHS if own["matrix"].ndim == 1 else MATRIX
        numbers = checked_arrays(own, {"mean": MEAN, "matrix": matrix}, f"watch {index}", {"summaries": summaries})
        if not scale > 0.0:
            raise ValueError(f"scale of watch {index} is {scale}; above 0 must hold")
        watches.append(Watch(spec, numbers["mean"], numbers["matrix"], scale))
    return tuple(watches)


def _number(value: Any, what: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
        raise ValueError(f"{what} is {str(value)[:40]}; a finite number must hold")
    return float(value)
