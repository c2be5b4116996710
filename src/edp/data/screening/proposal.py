"""Proposal of a feature set: selected and omitted channels with reasons, order and required memory length."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edp.data.screening.artefacts import lonely
from edp.data.screening.copies import flag_explained
from edp.data.screening.result import (
    ChannelVerdict,
    Cluster,
    Flag,
    FlagKind,
    GroupImportance,
    LagCurve,
    Proposal,
    Value,
)
from edp.data.screening.stability import ABOVE_CHANCE, MIN_INFORMATION, Relations
from edp.data.screening.table import CandidateTable

NEGLIGIBLE = 0.002
"""Minimum fraction of the held-out error that a channel must remove to be kept."""
LARGE = 0.01
"""Fraction of the held-out error from which a related channel is not redundant, even if the held-out segments disagree.
"""
CLEAR = 0.2
"""Minimum correlation at which a lag counts for the window length."""
STEP = 5
"""Multiple to which window lengths are rounded up, in samples."""


@dataclass(frozen=True, eq=False)
class ScreeningEvidence:
    """Evidence for the proposal; arrays of `relations` are indexed like `live`.

    Attributes:
        table: the data.
        live: columns of the table that change.
        correlations: correlations of live channels over all segments, ``[reach + lag, i, j]``.
        relations: tests of live channels against targets.
        pieces: correlation at the best lag with the best target in each segment, ``(segment, live channel)``.
        curves: lag curves.
        importance: permutation importance in the forest, all entries.
        values: Granger gains in linear models.
        clusters: collinear channels.
        history: held-out error by window length, and the shortest sufficient window.
    """

    table: CandidateTable
    live: NDArray[np.int64]
    correlations: NDArray[np.float64]
    relations: Relations
    pieces: NDArray[np.float64]
    curves: Sequence[LagCurve]
    importance: Sequence[GroupImportance]
    values: Sequence[Value]
    clusters: Sequence[Cluster]
    history: tuple[int, Mapping[int, float]]

    def gain(self, name: str) -> tuple[float, float]:
        """Return the largest Granger gain of a channel over the targets and its lower confidence bound.

        NaN if not evaluated.
        """
        channel_values = [value for value in self.values if value.channel == name]
        if not channel_values:
            return math.nan, math.nan
        best = max(channel_values, key=lambda value: value.gain)
        return best.gain, best.low

    def importance_of(self, name: str) -> GroupImportance | None:
        """Return the importance, over all targets, of the group that contains a channel."""
        of_channel = (entry for entry in self.importance if entry.target == "all" and name in entry.members)
        return next(of_channel, None)


def noise_flags(evidence: ScreeningEvidence, judged: Sequence[str]) -> list[Flag]:
    """Return the channels that neither relate to a target nor improve a forest or a linear model on held-out data."""
    flags = []
    for live_index, column in enumerate(evidence.live):
        name = evidence.table.names[column]
        if name not in judged or evidence.relations.related[live_index].any():
            continue
        entry = evidence.importance_of(name)
        if _adds(evidence, name) or (entry is not None and entry.low > 0 and entry.increase > NEGLIGIBLE):
            continue
        flags.append(_noise(evidence, live_index, name))
    return flags


def _noise(evidence: ScreeningEvidence, live_index: int, name: str) -> Flag:
    relations = evidence.relations
    target = int(np.abs(relations.linear[live_index]).argmax())
    value = float(abs(relations.linear[live_index, target]))
    chance = float(relations.linear_chance[live_index, target])
    only = lonely(evidence.pieces[:, live_index], chance)
    if only is not None:
        text = (
            f"goes with a target in {evidence.table.pieces[only].name} only "
            f"(correlation {evidence.pieces[only, live_index]:.2f}), in no other piece"
        )
        return Flag(name, FlagKind.ARTEFACT, value=abs(float(evidence.pieces[only, live_index])), evidence=text)
    between = float(evidence.table.between[evidence.live[live_index]])
    correlation_text = f"correlation with a target at most {value:.3f} (between unrelated pieces up to {chance:.3f})"
    if between > 0.5:
        text = f"{100 * between:.0f} % of its variance lies between recordings; within them {correlation_text}"
        return Flag(name, FlagKind.ARTEFACT, value=between, evidence=text)
    information = float(np.nan_to_num(relations.information[live_index]).max())
    if value > ABOVE_CHANCE * chance or information > MIN_INFORMATION:
        spread = float(evidence.pieces[:, live_index].std(ddof=1))
        text = (
            f"relates to targets in some pieces, not in all alike (correlation {value:.2f} with deviation {spread:.2f} "
            f"among pieces, mutual information above chance {information:.2f} nat); no help to forest or linear model"
        )
        return Flag(name, FlagKind.UNSTEADY, value=value, evidence=text)
    text = (
        f"{correlation_text}; mutual information above chance {information:.3f} nat; no help to a forest or a linear "
        "model"
    )
    return Flag(name, FlagKind.NOISE, value=value, evidence=text)


def redundant_flags(evidence: ScreeningEvidence, judged: Sequence[str], free: Sequence[str]) -> list[Flag]:
    """Flag redundant channels: members of a cluster, and channels predicted by the pasts of other channels.

    Args:
        evidence: results of the screening.
        judged: channels that can be removed.
        free: all channels without a flag, `judged` among them.
    """
    # Only channels without a value of their own may go; a related one is kept even where its importance is nil.
    idle = {name for name in judged if not (_adds(evidence, name) or evidence.gain(name)[0] > LARGE)}
    flags = _cluster_flags(evidence, idle)
    idle -= {flag.channel for flag in flags}
    names = [evidence.table.names[column] for column in evidence.live]
    scores = _scores(evidence)
    # The least useful go first, and names break ties, so that a screening gives the same result each time.
    order = [names.index(name) for name in sorted(idle, key=lambda name: (scores[name], name))]
    gone = {flag.channel for flag in flags}
    base = [k for k, name in enumerate(names) if name in free and name not in gone]
    return flags + flag_explained(names, evidence.correlations, order, base)


def _adds(evidence: ScreeningEvidence, name: str) -> bool:
    """Return whether the past of a channel takes away some of the error that the others leave, held out."""
    gain, low = evidence.gain(name)
    return low > 0 and gain > NEGLIGIBLE


def _cluster_flags(evidence: ScreeningEvidence, idle: set[str]) -> list[Flag]:
    flags = []
    for cluster in evidence.clusters:
        for name in cluster.members:
            if name == cluster.representative or name not in idle:
                continue
            gain = evidence.gain(name)[0]
            text = (
                f"goes with {cluster.representative} (rank correlation {cluster.least:.2f} or more within the cluster) "
                f"and takes away only {100 * gain:.2f} % of the error that is left"
            )
            flags.append(Flag(name, FlagKind.REDUNDANT, cluster.representative, value=cluster.least, evidence=text))
    return flags


def propose(
    evidence: ScreeningEvidence, names: Sequence[str], targets: Sequence[str], horizon: int, flags: Sequence[Flag]
) -> Proposal:
    """Rank all candidates and suggest a window.

    Args:
        evidence: figures.
        names: names of all candidates, including channels with missing values.
        targets: names of the targets, which are also inputs unless the horizon is 0.
        horizon: samples ahead.
        flags: defects; a channel with a flag is removed.
    """
    by_channel: dict[str, list[Flag]] = {}
    for flag in flags:
        by_channel.setdefault(flag.channel, []).append(flag)
    scores = _scores(evidence)
    rows = []
    for name in names:
        own = tuple(by_channel.get(name, ()))
        barred = horizon == 0 and name in targets
        keep = (name in targets and not barred) or (not own and not barred)
        rows.append((not keep, -scores.get(name, 0.0), name, own, barred))
    choices = tuple(
        ChannelVerdict(name, not dropped, rank, -score, _reason(evidence, name, name in targets, own, barred), own)
        for rank, (dropped, score, name, own, barred) in enumerate(sorted(rows, key=lambda row: row[:3]), start=1)
    )
    proposed = {choice.channel for choice in choices if choice.keep}
    window, reason = _window(evidence, proposed, targets, horizon)
    return Proposal(choices, window, reason, _notes(evidence, flags, horizon))


def _scores(evidence: ScreeningEvidence) -> dict[str, float]:
    """Return half the importance, a quarter each of correlation and information, each relative to the largest; 0 to 1.

    Correlation and information are penalised where they spread among the segments: times ``m / (m + s)``, with mean m
    and deviation s.
    """
    relations, count = evidence.relations, len(evidence.table.pieces)
    linear = (np.abs(relations.linear) * _steadiness(relations.linear_t, count)).max(axis=1)
    steady = _steadiness(relations.information_t, count)
    information = (np.nan_to_num(relations.information) * steady).max(axis=1)
    names = [evidence.table.names[column] for column in evidence.live]
    entries = [evidence.importance_of(name) for name in names]
    # All members of a group have its importance, because collinear channels replace each other in a forest.
    weight = np.array([max(e.increase, 0.0) / len(e.members) if e is not None else 0.0 for e in entries])
    parts = [
        share * np.maximum(values, 0.0) / max(float(values.max()), 1e-30)
        for share, values in ((0.5, np.sqrt(weight)), (0.25, linear), (0.25, information))
    ]
    return dict(zip(names, np.clip(sum(parts), 0.0, 1.0).tolist()))


def _steadiness(t: NDArray[np.float64], count: int) -> NDArray[np.float64]:
    """Return ``m / (m + s)``, given the mean over standard error of `count` segments."""
    return t / (t + math.sqrt(count))


def _reason(evidence: ScreeningEvidence, name: str, target: bool, flags: tuple[Flag, ...], barred: bool) -> str:
    if barred:
        return "is what is to be predicted; at horizon 0 its present value is no input"
    if flags:
        text = "; ".join(f"{flag.kind}: {flag.evidence}" for flag in flags)
        return f"a target, kept for its past, but {text}" if target else text
    live_index = int(np.flatnonzero(evidence.live == evidence.table.names.index(name))[0])
    relations = evidence.relations
    best = int(np.abs(relations.linear[live_index]).argmax())
    goal = evidence.table.names[evidence.table.targets[best]]
    parts = []
    if target:
        parts.append("a target: its own past")
    else:
        pieces = evidence.pieces[:, live_index]
        same = int((np.sign(pieces) == np.sign(relations.linear[live_index, best])).sum())
        parts.append(
            f"correlation {relations.linear[live_index, best]:.2f} with {goal}, of this sign in {same} of "
            f"{len(pieces)} pieces"
        )
    informed = int(np.nan_to_num(relations.information[live_index]).argmax())
    goal = evidence.table.names[evidence.table.targets[informed]]
    parts.append(f"{max(float(np.nan_to_num(relations.information[live_index, informed])), 0.0):.2f} nat on {goal}")
    entry, (gain, _) = evidence.importance_of(name), evidence.gain(name)
    if entry is not None:
        group = "" if len(entry.members) == 1 else f" with {len(entry.members) - 1} collinear"
        parts.append(f"forest importance {100 * entry.increase:.1f} % of the variance{group}")
    if math.isfinite(gain):
        parts.append(f"its past takes away {100 * gain:.1f} % of the error that the others leave")
    return "; ".join(parts)


def _window(evidence: ScreeningEvidence, proposed: set[str], targets: Sequence[str], horizon: int) -> tuple[int, str]:
    """Return the proposed memory: the earliest useful lead or the range of useful lags, whichever is longer."""
    leads = [
        curve
        for curve in evidence.curves
        if curve.channel in proposed
        and curve.channel not in targets
        and curve.certain
        and not curve.at_edge
        and abs(curve.value) >= CLEAR
        and curve.best < 0
    ]
    needed, errors = evidence.history
    by_lag, text = 1, "no channel that is kept leads a target clearly"
    if leads:
        first = min(leads, key=lambda curve: curve.best)
        by_lag = -first.best
        text = f"the longest clear lead is {by_lag} samples ({first.channel} before {first.target})"
    window = STEP * math.ceil(max(by_lag, needed) / STEP)
    longest = max(errors)
    text += (
        f"; a linear prediction {horizon} samples ahead leaves {100 * errors[needed]:.1f} % of the change with "
        f"{needed} samples of history and {100 * errors[longest]:.1f} % with {longest}"
    )
    return window, text


def _notes(evidence: ScreeningEvidence, flags: Sequence[Flag], horizon: int) -> tuple[str, ...]:
    notes = []
    table = evidence.table
    # With fewer than eight segments a standard error has too few degrees of freedom.
    if len(table.pieces) < 8:
        notes.append(
            f"only {len(table.pieces)} pieces were compared: figures of stability are rough; give more recordings"
        )
    edge = sorted({c.channel for c in evidence.curves if c.certain and c.at_edge and abs(c.value) >= CLEAR})
    if edge:
        notes.append(f"the best lag of {', '.join(edge)} is the end of the search; raise max_lag")
    leaks = [flag.channel for flag in flags if flag.kind == FlagKind.LEAK]
    if leaks:
        subject = "a channel knows" if len(leaks) == 1 else f"{len(leaks)} channels know"
        notes.append(f"{subject} the future: a model fed with it does well in tests and fails on the machine")
    if table.left_out:
        notes.append(f"too short to be looked at and left out: {', '.join(table.left_out)}; lower max_lag to see them")
    if horizon == 0:
        notes.append("horizon 0: targets are no inputs")
    return tuple(notes)
