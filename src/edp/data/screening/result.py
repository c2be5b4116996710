"""Results of a screening: plain tables and arrays for pages, plots and JSON.

Lags are in samples, in the sense of Table 4.2: a lag of -15 means that the channel *leads*: the target at t goes best
with the channel at t - 15. A positive lag means that the channel follows the target.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from edp.settings.results import json_value

Array = NDArray[np.float64]
OnProgress = Callable[[str, float], None]
"""Callback with the current stage and the completed fraction of the whole screening, 0 to 1."""


class FlagKind(StrEnum):
    """Type of problem found in a channel."""

    CONSTANT = "constant"
    LEAK = "leak of the future"
    COPY = "delayed copy"
    DUPLICATE = "duplicate"
    ARTEFACT = "per-file artefact"
    NOISE = "no relation"
    UNSTEADY = "unsteady relation"
    REDUNDANT = "redundant"
    MISSING = "missing values"


@dataclass(frozen=True)
class Flag:
    """Defect of a channel, with the evidence for it.

    Attributes:
        channel: the channel.
        kind: type of the defect.
        source: original of a copy, or channel whose future it contains; empty for other defects.
        lag: delay of the channel relative to `source` in samples: -12 means that it has the value of the source 12
            samples later.
        value: value that decided about the flag (a correlation or a fraction), 0 to 1.
        evidence: sentence with the numerical evidence.
    """

    channel: str
    kind: FlagKind
    source: str = ""
    lag: int = 0
    value: float = math.nan
    evidence: str = ""


@dataclass(frozen=True, eq=False)
class Matrices:
    """Dependencies at the same instant over all samples, shape ``(channel, channel)``; NaN for constant channels.

    Attributes:
        names: channels, in the order of rows and columns.
        pearson: eq. 2.11.
        spearman: rank correlation (fig. 4.1).
        kendall: tau-b of evenly spread samples.
        information: mutual information in nat of evenly spread samples (eq. 2.12, fig. 4.2).
    """

    names: tuple[str, ...]
    pearson: Array
    spearman: Array
    kendall: Array
    information: Array


@dataclass(frozen=True, eq=False)
class LagCurve:
    """Cross-correlation of a channel with a target (eq. 2.13, both centred and scaled to deviation 1).

    Attributes:
        channel, target: names.
        group: kind of signal, as Table 4.2 groups them.
        lags: shape ``(lag,)``, negative where the channel leads.
        correlation: shape ``(lag,)``.
        best: lag of the largest absolute correlation.
        value: correlation there, with its sign.
        low, high: 95 % interval of the best lag over the segments.
        agreement: fraction of the segments whose correlation at `best` has this sign.
        certain: the correlation at `best` differs from chance over the segments.
        at_edge: whether the best lag is at the end of the search range, so that the true lag may be outside.
    """

    channel: str
    target: str
    group: str
    lags: NDArray[np.int64]
    correlation: Array
    best: int
    value: float
    low: float
    high: float
    agreement: float
    certain: bool
    at_edge: bool


@dataclass(frozen=True)
class LagRange:
    """Row of Table 4.2: range of the best lags of a group of channels, each with its most strongly related target.

    Attributes:
        group: kind of signal.
        low, high: smallest and largest best lag, samples.
        channels: channels whose best lag is significant and within the search range.
        left_out: the others of the group.
    """

    group: str
    low: int
    high: int
    channels: tuple[str, ...]
    left_out: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class Stability:
    """One metric between a channel at t and a target at t + horizon, in each segment of the data.

    Attributes:
        metric: ``pearson``, ``spearman``, ``kendall``, ``information`` or ``lag``.
        channel, target: names.
        values: value in each segment, shape ``(segment,)``; NaN if the channel is constant in a segment.
        mean, deviation: over the segments.
        agreement: fraction of the segments with the sign of the mean (1 for information).
        chance: mean absolute value between the channel and the target of different segments, which are unrelated.
    """

    metric: str
    channel: str
    target: str
    values: Array
    mean: float
    deviation: float
    agreement: float
    chance: float


@dataclass(frozen=True)
class GroupImportance:
    """Permutation importance of a group of collinear channels (eq. 2.14) on held-out recordings.

    Attributes:
        members: channels permuted together.
        target: name, or ``all`` for the mean of the targets.
        increase: mean increase of the mean squared error of the target's change up to the horizon, as a fraction of the
            variance of this change.
        low, high: 95 % interval over the held-out segments.
        share: fraction of all positive increases that belongs to the group.
    """

    members: tuple[str, ...]
    target: str
    increase: float
    low: float
    high: float
    share: float


@dataclass(frozen=True)
class Value:
    """Granger gain: reduction of the linear prediction error by a channel's past, given all other channels' pasts.

    Evaluated on left-out data.

    Attributes:
        channel, target: names.
        gain: fraction of the remaining squared error at the horizon that the channel removes; negative if the channel
            increases the error.
        low, high: 95 % interval over the held-out segments.
    """

    channel: str
    target: str
    gain: float
    low: float
    high: float


@dataclass(frozen=True)
class Cluster:
    """Channels that go together: complete linkage on the absolute rank correlation.

    Attributes:
        members: names.
        representative: the member that speaks for all where only one is kept.
        least: smallest absolute rank correlation of two members.
    """

    members: tuple[str, ...]
    representative: str
    least: float


@dataclass(frozen=True)
class ChannelVerdict:
    """Verdict on one channel.

    Attributes:
        channel: name.
        keep: whether it is proposed.
        rank: 1 is the most useful; kept channels come first.
        score: score that determines the rank, 0 to 1.
        reason: one or two sentences with the figures.
        flags: defects of the channel.
    """

    channel: str
    keep: bool
    rank: int
    score: float
    reason: str
    flags: tuple[Flag, ...] = ()


@dataclass(frozen=True)
class Proposal:
    """The feature set proposed, and the memory that it needs.

    Attributes:
        choices: all candidates by rank.
        window: suggested W, samples.
        window_reason: source of the window length.
        notes: limits of the data, each with advice.
    """

    choices: tuple[ChannelVerdict, ...]
    window: int
    window_reason: str
    notes: tuple[str, ...] = ()

    @property
    def kept(self) -> tuple[str, ...]:
        """Proposed channels, most useful first."""
        return tuple(choice.channel for choice in self.choices if choice.keep)

    @property
    def dropped(self) -> tuple[str, ...]:
        """The others, by rank."""
        return tuple(choice.channel for choice in self.choices if not choice.keep)


@dataclass(frozen=True, eq=False)
class ScreeningResult:
    """Everything that a screening found.

    Attributes:
        recordings: names of the recordings.
        pieces: names of the compared segments.
        samples: rows of all recordings.
        rate_hz: samples per second.
        channels: candidates, targets among them, in the order of the recordings.
        groups: kind of signal of each candidate, as Table 4.2 groups them.
        targets: predicted channels.
        horizon: samples ahead.
        matrices: dependencies at one instant.
        lags: a curve for each candidate and target.
        stability: metrics per segment.
        importance: importance of groups, for each target and for all.
        values: linear value of each channel with its past.
        clusters: groups of at least two collinear channels.
        flags: all flags.
        proposal: proposed feature set and memory.
        options: the options of the screening.
        seconds: time of each stage.
    """

    recordings: tuple[str, ...]
    pieces: tuple[str, ...]
    samples: int
    rate_hz: float
    channels: tuple[str, ...]
    groups: tuple[str, ...]
    targets: tuple[str, ...]
    horizon: int
    matrices: Matrices
    lags: tuple[LagCurve, ...]
    stability: tuple[Stability, ...]
    importance: tuple[GroupImportance, ...]
    values: tuple[Value, ...]
    clusters: tuple[Cluster, ...]
    flags: tuple[Flag, ...]
    proposal: Proposal
    options: dict[str, object]
    seconds: dict[str, float]

    def curve(self, channel: str, target: str) -> LagCurve:
        """Return the lag curve of a channel and a target."""
        return next(c for c in self.lags if (c.channel, c.target) == (channel, target))

    def lag_table(self) -> tuple[LagRange, ...]:
        """Return the table 4.2 for this data: a row for each group with a certain lag.

        Targets and flagged channels left out.
        """
        left_out = {*self.targets, *(flag.channel for flag in self.flags)}
        best: dict[str, LagCurve] = {}
        for curve in self.lags:
            best_curve = best.get(curve.channel)
            if curve.channel not in left_out and (best_curve is None or abs(curve.value) > abs(best_curve.value)):
                best[curve.channel] = curve
        rows = []
        for group in dict.fromkeys(curve.group for curve in best.values()):
            mine = [curve for curve in best.values() if curve.group == group]
            sure = [curve for curve in mine if curve.certain and not curve.at_edge]
            if sure:
                lags = [curve.best for curve in sure]
                others = tuple(curve.channel for curve in mine if curve not in sure)
                rows.append(LagRange(group, min(lags), max(lags), tuple(c.channel for c in sure), others))
        return tuple(rows)

    def to_json(self) -> dict[str, object]:
        """Return the plain JSON values: arrays as lists, a number that is not finite as None."""
        proposal = {"kept": list(self.proposal.kept), "dropped": list(self.proposal.dropped)}
        lag_table = json_value(self.lag_table())
        return {**json_value(self), "proposal": {**json_value(self.proposal), **proposal}, "lag_table": lag_table}
