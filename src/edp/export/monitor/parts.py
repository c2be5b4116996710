"""Content of an exported monitor: networks, parameters in SI units, and reference values of a self-test."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

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
        middle: what stands in for each of them before it was ever there, shape (reads,).
        judged: input of the monitor that each residual judges.
        results: place of each prediction among those of the network, horizon by horizon.
        delays: ticks by which each prediction is older than what it is compared with; 0 for a virtual sensor.
        scaled: whether residuals are divided by half the width of the first interval.
        least_width: of that half.
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
class BalancePart:
    """Levels less the integrals of their rates, with sums that fade.

    Attributes:
        reads: inputs of the monitor that are read.
        middle: what stands in for each of them before it was ever there, shape (reads,).
        levels: place of the level of each residual among `reads`.
        rates: likewise of its rate.
        steps: gain of the rate times the time of a tick, shape (residuals,).
        left: share of the sum that is left after a tick, shape (residuals,).
    """

    reads: Places
    middle: NDArray[np.float32]
    levels: Places
    rates: Places
    steps: Array
    left: Array


@dataclass(frozen=True, eq=False)
class TwinPart:
    """Residuals of a twin that runs once per group of its outputs, with the ports of the group free.

    Attributes:
        bundle: of its plant: commands, measured answers and flags in, answers one tick ahead out.
        reads: inputs of the monitor that are its commands and measured answers.
        middle: what stands in for each of them before it was ever there, shape (reads,).
        groups: answers that are judged together, by their place.
        prefix: ticks at which all is measured.
        period: ticks from one measured tick of a group to the next.
    """

    bundle: Bundle
    reads: Places
    middle: NDArray[np.float32]
    groups: tuple[Places, ...]
    prefix: int
    period: int


@dataclass(frozen=True, eq=False)
class FlowChamber:
    """A chamber's balance of flow.

    Attributes:
        velocity: place among `FlowPart.reads`, as are the next ones; of `stroke` -1 is none.
        own: pressure of the chamber.
        other: pressure of the one on the other side.
        stroke: see `velocity`.
        supplies: pressures of the pumps.
        spools: places of its spools.
        sign: 1 for a chamber that grows with the velocity, -1 for the other.
        end: stroke at which its outflow is cushioned, m.
        far: stroke at the other end, m.
        per_cushion: one over the length of the cushion, 1/m.
        tank: pressure of the return line, MPa.
        values: of its curves at the knots, shape (paths, knots); `slopes` from each knot on.
        slopes: see `values`.
        lines: factors of the terms without a spool, shape (9 + reliefs,).
        doubts: factors of what makes it uncertain, shape (8,).
    """

    velocity: int
    own: int
    other: int
    stroke: int
    supplies: Places
    spools: Places
    sign: int
    end: float
    far: float
    per_cushion: float
    tank: float
    values: NDArray[np.float32]
    slopes: NDArray[np.float32]
    lines: NDArray[np.float32]
    doubts: NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class FlowPart:
    """Flow balances: parameters of `edp.monitor.residuals.flow_balances`.

    Attributes:
        reads: inputs of the monitor that are read.
        middle: what stands in for each of them before it was ever there, shape (reads,).
        extend: place of the command that extends of each spool among `reads`; `retract` likewise, -1 for none.
        retract: see `extend`.
        gain: one over the full command, shape (spools,).
        dead: dead time in ticks, shape (spools,).
        stages: b1, b2, a1, a2 of both stages, shape (spools, 2, 4).
        play: half width, shape (spools,).
        memory: rows before a tick that are needed for it.
        back: ticks by which balances lag.
        knots: shape (knots,).
        reliefs: MPa, shape (reliefs,).
        smooth: MPa^2 below which an orifice turns laminar.
        cavity: MPa that are added where free air makes oil soft.
        empty: MPa below which a chamber may be drawn empty.
        doubtful: place of the relief, among `reliefs`, beyond which a balance is uncertain.
        per_tick: a sixth of the ticks per second.
        chambers: the balances.
        oil: place of the thermometer among `reads`, lowest and highest temperature at which they hold; None without.
    """

    reads: Places
    middle: NDArray[np.float32]
    extend: Places
    retract: Places
    gain: NDArray[np.float32]
    dead: Array
    stages: NDArray[np.float32]
    play: NDArray[np.float32]
    memory: int
    back: int
    knots: NDArray[np.float32]
    reliefs: NDArray[np.float32]
    smooth: float
    cavity: float
    empty: float
    doubtful: int
    per_tick: float
    chambers: tuple[FlowChamber, ...]
    oil: tuple[int, float, float] | None = None


SourcePart = NetworkPart | BalancePart | TwinPart | FlowPart
PIECE, ROW = 8, 32
"""Directions of a detector, and summaries, that one part of the work on a block takes; in C `EDP_PIECE`, `EDP_ROW`."""


def pieces(count: int, size: int) -> list[int]:
    """Return the sizes of the parts when `count` items are divided into parts of `size`."""
    return [min(size, count - first) for first in range(0, count, size)]


@dataclass(frozen=True, eq=False)
class WatchPart:
    """A view of conditioned summaries and the detector on it.

    Attributes:
        detector: ``cusum``, ``ewma``, ``glr`` or ``separate_cusums``.
        option: its slack, weight or window.
        mean: shape (summaries,).
        matrix: shape (summaries, directions), or (summaries,) where it sees each summary by itself.
        scale: of its statistic.
    """

    detector: str
    option: float
    mean: Array
    matrix: Array
    scale: float

    @property
    def directions(self) -> int:
        """Numbers that the detector sees."""
        return int(self.matrix.shape[-1])

    @property
    def own(self) -> bool:
        """Whether each summary is monitored by itself, without clipping."""
        return self.matrix.ndim == 1

    @property
    def rows(self) -> int:
        """Number of rows of the detector's state."""
        return int(self.option) if self.detector == "glr" else 2 if self.detector == "separate_cusums" else 1

    @property
    def passes(self) -> int:
        """Number of passes of the detector over its directions in a block."""
        return self.rows if self.detector == "glr" else 2 if self.detector == "cusum" else 1


@dataclass(frozen=True, eq=False)
class ChainPart:
    """Chain from residuals to alarms: parameters of `edp.monitor.chain`.

    Attributes:
        block: ticks of a block.
        centre: of each input, shape (inputs,).
        spread: one over the usual width of each input, shape (inputs,).
        impossible: usual widths from its centre beyond which an input counts as missing.
        scale: one over the usual width of each residual, shape (residuals,).
        change: usual variance of the change of the channel of each residual, shape (residuals,).
        channel: input that each residual judges.
        level: inputs whose mean is part of the operating point.
        moving: inputs whose mean size is.
        drivers: of each residual, pairs of inputs whose difference moves what it judges, shape (drivers, residuals, 2);
            a second one of -1 is none.
        point_offset: of the operating point, shape (points,); `point_width` likewise.
        point_limit: of its scaled numbers.
        usual: of each summary, shape (summaries, 1 + points); `wide` likewise.
        least: width of each summary, shape (summaries,).
        clip: of conditioned summaries.
        gross: largest size of those that are not clipped.
        drift_step: most by which the slow drift changes in a block.
        drift_most: its limit.
        watches: side by side.
        limit: of the largest statistic over its scale.
        quiet: at or below which it is at a healthy level.
        settle: blocks after a reset that are not judged.
    """

    block: int
    centre: Array
    spread: Array
    impossible: float
    scale: Array
    change: Array
    channel: Places
    level: Places
    moving: Places
    drivers: NDArray[np.int64]
    point_offset: Array
    point_width: Array
    point_limit: float
    usual: Array
    wide: Array
    least: Array
    clip: float
    gross: float
    drift_step: float
    drift_most: float
    watches: tuple[WatchPart, ...]
    limit: float
    quiet: float
    settle: int


@dataclass(frozen=True, eq=False)
class GoldenChain:
    """Results of Python for random residuals and inputs (`edp.export.monitor.golden.drawn_rows`), one row per block.

    Attributes:
        statistics: shape (blocks, watches).
        alarms: place of the watch that raised one, -1 without, shape (blocks,).
        since: block after which the deviation began, shape (blocks,).
        evidence: of the last alarm, shape (summaries,).
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
        tolerance: how far another form may be off, shape (residuals,).
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
        rate_hz: ticks per second.
        residuals: names.
        reads: inputs that each residual depends on.
        sources: in the order of the residuals.
        chain: what follows them.
        golden_chain: of the self-test.
        golden_residuals: of the self-test.
    """

    title: str
    digest: str
    promise: str
    inputs: tuple[Channel, ...]
    rate_hz: float
    residuals: tuple[str, ...]
    reads: Sequence[Places]
    sources: tuple[SourcePart, ...]
    chain: ChainPart
    golden_chain: GoldenChain
    golden_residuals: GoldenResiduals

    @property
    def summaries(self) -> int:
        """Numbers of a block."""
        return len(self.chain.least)

    @property
    def each(self) -> int:
        """Summaries of a residual and block."""
        return 5 + len(self.chain.drivers)

    @property
    def points(self) -> int:
        """Numbers of the operating point, without its 1."""
        return len(self.chain.point_offset)
