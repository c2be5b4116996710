"""Content of an exported monitor: networks, parameters in SI units, and reference values of a self-test."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from edp.errors import ExportError
from edp.monitor.chain import MonitorChain
from edp.monitor.detectors import DETECTORS as REGISTERED
from edp.monitor.detectors import CusumSpec, EwmaSpec, GlrSpec, SeparateCusumsSpec
from edp.monitor.residuals.balances import Balances
from edp.monitor.residuals.flow_balances import FlowBalances
from edp.monitor.summaries import SUMMARIES
from edp.monitor.watches import Watch
from edp.signals import Channel
from edp.training.bundle import Bundle

Array = NDArray[np.float64]
Places = tuple[int, ...]


@dataclass(frozen=True, eq=False)
class NetworkPart:
    """Residuals of a network: measurement minus prediction.

    Attributes:
        bundle: the network.
        reads: inputs of the monitor that it is fed, in its order.
        middle: substitute for each input that was never received, shape (reads,).
        judged: input of the monitor that each residual evaluates.
        results: place of each prediction among those of the network, horizon by horizon.
        delays: ticks by which each prediction is older than what it is compared with; 0 for a virtual sensor.
        scaled: whether residuals are divided by half the width of the first interval.
        least_width: minimum of that half width.
        every: ticks from one run of the network to the next, between which its residuals hold; 1 where it has delays.
        first: tick of its first run, below `every`.
    """

    bundle: Bundle
    reads: Places
    middle: NDArray[np.float32]
    judged: Places
    results: Places
    delays: Places
    scaled: bool = False
    least_width: float = 0.0
    every: int = 1
    first: int = 0


@dataclass(frozen=True, eq=False)
class TwinPart:
    """Residuals of a twin that runs once per group of its outputs, with the ports of the group free.

    Attributes:
        bundle: bundle of its plant, which maps commands, measured outputs and flags to outputs one sample ahead.
        reads: inputs of the monitor that are its commands and measured answers.
        middle: substitute for each input that was never received, shape (reads,).
        groups: answers that are evaluated together, by their place.
        prefix: ticks at which all is measured.
        period: number of samples between two measured samples of a group.
    """

    bundle: Bundle
    reads: Places
    middle: NDArray[np.float32]
    groups: tuple[Places, ...]
    prefix: int
    period: int


SourcePart = NetworkPart | TwinPart | Balances | FlowBalances
DETECTORS = {
    "cusum": "EDP_CUSUM",
    "ewma": "EDP_EWMA",
    "glr": "EDP_GLR",
    "separate_cusums": "EDP_SEPARATE_CUSUMS",
}
"""C names of the detectors."""
PIECE, ROW = 8, 32
"""Number of detector directions, and of summaries, per computing step of a block; in C `EDP_PIECE` and `EDP_ROW`."""


def pieces(count: int, size: int) -> list[int]:
    """Return the sizes of the parts when `count` items are divided into parts of `size`."""
    return [min(size, count - first) for first in range(0, count, size)]


@dataclass(frozen=True, eq=False)
class WatchCode:
    """A view of the monitor with the C form of its detector.

    Attributes:
        watch: the view.
        detector: ``cusum``, ``ewma``, ``glr`` or ``separate_cusums``.
        option: its slack, weight or window.
        rows: number of rows of its state.
        passes: over its directions in a block.
    """

    watch: Watch
    detector: str
    option: float
    rows: int = 1
    passes: int = 1

    @property
    def directions(self) -> int:
        """Numbers that the detector sees."""
        return self.watch.directions

    @property
    def memory(self) -> int:
        """Numbers of the detector's state."""
        return self.directions * self.rows

    @property
    def slices(self) -> int:
        """Number of calls of `edp_watch_part`: centring, whitening and detector steps."""
        detector = len(pieces(self.directions, PIECE)) * self.passes
        white = len(pieces(self.directions, ROW)) if self.watch.own else self.directions
        return len(pieces(len(self.watch.mean), ROW)) + white + detector


def watch_code(watch: Watch) -> WatchCode:
    """Return a view with the C form of its detector.

    Raises:
        ExportError: there is none.
    """
    detector = watch.detector
    if isinstance(detector, CusumSpec):
        return WatchCode(watch, "cusum", detector.slack, passes=2)
    if isinstance(detector, EwmaSpec):
        return WatchCode(watch, "ewma", detector.weight)
    if isinstance(detector, GlrSpec):
        return WatchCode(watch, "glr", float(detector.window), rows=detector.window, passes=detector.window)
    if isinstance(detector, SeparateCusumsSpec):
        return WatchCode(watch, "separate_cusums", detector.slack, rows=2)
    raise ExportError(
        f"detector '{REGISTERED.name_of(detector)}' has no form in C; these have: {', '.join(DETECTORS)}. Fit the "
        "monitor with one of them"
    )


@dataclass(frozen=True, eq=False)
class GoldenChain:
    """Results of Python for random residuals and inputs (`edp.export.monitor.golden.drawn_rows`), one row per block.

    Attributes:
        statistics: shape (blocks, watches).
        alarms: place of the watch that raised one, -1 without, shape (blocks,).
        since: block after which the deviation began, shape (blocks,).
        evidence: evidence of the last alarm, shape (summaries,).
    """

    statistics: Array
    alarms: Places
    since: Places
    evidence: Array


@dataclass(frozen=True, eq=False)
class GoldenResiduals:
    """Inputs, and the residuals that Python computes from them.

    Attributes:
        inputs: shape (ticks, inputs).
        residuals: shape (ticks, residuals); NaN where silent.
        tolerance: tolerance of another form, shape (residuals,).
    """

    inputs: NDArray[np.float32]
    residuals: NDArray[np.float32]
    tolerance: NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class MonitorParts:
    """A monitor.

    Attributes:
        title: a line about it.
        digest: content address.
        promise: a sentence on false alarms.
        inputs: measured channels, in the order in which they are given.
        rate_hz: sampling rate in Hz.
        residuals: names.
        reads: inputs that each residual depends on.
        columns: place of each input among `inputs`, by its name in the monitor.
        sources: sources in the order of the residuals.
        chain: chain after the sources.
        golden_chain: data of the chain's self-test.
        golden_residuals: data of the residuals' self-test.
    """

    title: str
    digest: str
    promise: str
    inputs: tuple[Channel, ...]
    rate_hz: float
    residuals: tuple[str, ...]
    reads: Sequence[Places]
    columns: Mapping[str, int]
    sources: tuple[SourcePart, ...]
    chain: MonitorChain
    golden_chain: GoldenChain
    golden_residuals: GoldenResiduals

    @cached_property
    def watches(self) -> tuple[WatchCode, ...]:
        """Views of the chain with the C forms of their detectors."""
        return tuple(map(watch_code, self.chain.watches))

    @property
    def flows(self) -> tuple[FlowBalances, ...]:
        """Balances of flow among the sources."""
        return tuple(source for source in self.sources if isinstance(source, FlowBalances))

    @property
    def each(self) -> int:
        """Summaries of a residual and block."""
        return len(SUMMARIES) + len(self.chain.summaries.drivers)

    @property
    def points(self) -> int:
        """Numbers of the operating point, without its 1."""
        return len(self.chain.conditioning.offset)
