"""A whole screening, stage by stage (thesis 3.1.2)."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from edp.data.gathered import some_columns
from edp.data.screening import artefacts, copies, forest, stability, values
from edp.data.screening.clusters import clusters_of, least_of
from edp.data.screening.information import Information
from edp.data.screening.lagged import Lagged, compute_lagged_covariances
from edp.data.screening.proposal import ScreeningEvidence, noise_flags, propose, redundant_flags
from edp.data.screening.ranks import Kendall, correlation, rank_columns
from edp.data.screening.result import (
    Array,
    Cluster,
    Flag,
    GroupImportance,
    LagCurve,
    Matrices,
    OnProgress,
    ScreeningResult,
    Stability,
)
from edp.data.screening.spec import ScreeningSpec
from edp.data.screening.stability import Metrics
from edp.data.screening.table import CandidateTable, build_table
from edp.errors import DataError
from edp.recording import Recording
from edp.signals import TABLE_A1

SHARES = {
    "reading": 0.02,
    "correlation": 0.08,
    "rank correlation": 0.1,
    "mutual information": 0.3,
    "lags": 0.08,
    "leaks and copies": 0.05,
    "stability": 0.17,
    "forest": 0.15,
    "linear value": 0.05,
}
"""Stages in order, and about which share of the time each takes."""
MAX_RANKED = 1 << 20
"""Rows that Spearman's correlation is of, evenly spread."""
_SHIFTS = 6
"""Other segments with which each piece is paired for chance."""


@dataclass(eq=False)
class _Clock:
    """Tells progress and keeps the time of each stage."""

    tell: OnProgress | None
    seconds: dict[str, float] = field(default_factory=dict)
    done: float = 0.0

    @contextmanager
    def stage(self, name: str) -> Iterator[OnProgress]:
        """Time a stage; yield a function that receives the finished fraction."""
        began = time.perf_counter()

        def on_share(stage: str, share: float) -> None:
            if self.tell is not None:
                self.tell(stage, min(1.0, self.done + share * SHARES[name]))

        on_share(name, 0.0)
        yield on_share
        self.seconds[name] = time.perf_counter() - began
        self.done += SHARES[name]


def screen(
    recordings: Sequence[Recording], spec: ScreeningSpec | None = None, on_progress: OnProgress | None = None
) -> ScreeningResult:
    """Select input channels and memory length for a model that predicts the targets. Omitted channels get a reason.

    Args:
        recordings: recordings with one sample rate; all contain every channel of the first one.
        spec: options; None takes the defaults.
        on_progress: called with the stage and the share of the whole that is done.

    Raises:
        DataError: no recordings, mixed rates, channels or targets that are not there, missing values in a target,
            recordings too short for the lags.
    """
    # threads of the linear algebra library would wait for each other at many small products
    with threadpool_limits(limits=1, user_api="blas"):
        return _screen(recordings, spec or ScreeningSpec(), _Clock(on_progress))


def _screen(recordings: Sequence[Recording], spec: ScreeningSpec, clock: _Clock) -> ScreeningResult:
    with clock.stage("reading"):
        table = build_table(recordings, spec)
        live = np.flatnonzero(table.live)
    matrices = _matrices(table, spec, clock)
    with clock.stage("lags") as tell:
        lagged = compute_lagged_covariances(table, spec.max_lag, _SHIFTS, lambda share: tell("lags", share))
        names = [table.names[i] for i in live]
        targets = [table.names[i] for i in table.targets]
        curves, best = stability.lag_curves(table, lagged, names, targets, spec)
    with clock.stage("leaks and copies"):
        flags = _structural_flags(table, lagged, spec)
    with clock.stage("stability") as tell:
        metrics = stability.metrics_by_piece(table, live, spec, lambda share: tell("stability", share))
        stable = stability.stability_of(names, targets, metrics, best)
    flagged = {flag.channel for flag in flags}
    used = [int(i) for i in live if table.names[i] not in flagged or i in table.targets]
    measured = _Measured(matrices, metrics, curves, stable)
    evidence = _evidence(table, lagged, spec, measured, used, clock)
    return _assemble_result(recordings, table, spec, measured, flags, evidence, clock.seconds)


@dataclass(frozen=True)
class _Measured:
    """Figures of the live channels, flagged or not."""

    matrices: Matrices
    metrics: Metrics
    curves: list[LagCurve]
    stable: list[Stability]


def _matrices(table: CandidateTable, spec: ScreeningSpec, clock: _Clock) -> Matrices:
    """Return the dependencies at one instant; rows and columns of constant channels are NaN."""
    live = np.flatnonzero(table.live)
    stretches = [stretch for piece in table.pieces for stretch in piece.stretches]
    with clock.stage("correlation") as tell:
        pearson = correlation([some_columns(stretch, live.tolist()) for stretch in stretches])
        tell("correlation", 0.2)
        # Beyond, the error of a rank correlation is a thousandth.
        ranks = rank_columns(table.sample(MAX_RANKED)[:, live])
        tell("correlation", 0.8)
        spearman = correlation([ranks])
        # As large as the table; the next stages need the room.
        del ranks
    with clock.stage("rank correlation") as tell:
        sample = table.sample(spec.rank_samples)[:, live]
        kendall = Kendall(sample).matrix(lambda share: tell("rank correlation", share))
    with clock.stage("mutual information") as tell:
        sample = table.sample(spec.information_samples)[:, live]
        informed = Information(sample, spec.neighbours, spec.seed).matrix(
            lambda share: tell("mutual information", share)
        )
    return Matrices(table.names, *(_expand_matrix(table, m) for m in (pearson, spearman, kendall, informed)))


def _expand_matrix(table: CandidateTable, matrix: Array) -> Array:
    """Expand a matrix over live channels to all channels, NaN elsewhere."""
    live = np.flatnonzero(table.live)
    full = np.full((len(table.names), len(table.names)), np.nan)
    full[np.ix_(live, live)] = matrix
    return full


def list_trusted(table: CandidateTable, spec: ScreeningSpec) -> set[str]:
    """Return the channels known to be measured on the machine.

    Targets, the names of Table A.1, and those that the user names.
    """
    return {*(table.names[i] for i in table.targets), *spec.measured, *TABLE_A1}


def _structural_flags(table: CandidateTable, lagged: Lagged, spec: ScreeningSpec) -> list[Flag]:
    """Flag channels with problems independent of the targets: constant, clocks, per-file artefacts, leaks, copies."""
    names = [table.names[i] for i in lagged.live]
    trust = list_trusted(table, spec)
    trusted = [k for k, name in enumerate(names) if name in trust]
    targets = np.searchsorted(lagged.live, table.targets).tolist()
    flags = artefacts.dead_flags(table)

    def open_ones() -> list[int]:
        settled = {flag.channel for flag in flags}
        return [k for k, name in enumerate(names) if name not in settled and name not in trust]

    flags += artefacts.clock_flags(table, [int(lagged.live[k]) for k in open_ones()])
    correlations = lagged.pooled()
    support = np.abs(correlations[:, :, targets]).max(axis=(0, 2))
    flags += artefacts.changing_flags(names, lagged, open_ones(), trusted, support)
    flags += artefacts.flag_broken(table, [int(k) for k in lagged.live], open_ones(), trusted)
    flagged = sorted(set(range(len(names))) - set(open_ones()))
    flags += copies.find_leaks(names, correlations, trusted, targets, flagged)
    settled = {names.index(flag.channel) for flag in flags if flag.channel in names}
    pairs = copies.find_copies(correlations, spec.copy_threshold)
    return flags + copies.copy_flags(names, pairs, set(trusted), copies.innovations(correlations), settled)


def _evidence(
    table: CandidateTable,
    lagged: Lagged,
    spec: ScreeningSpec,
    measured: _Measured,
    used: list[int],
    clock: _Clock,
) -> ScreeningEvidence:
    """Return the multivariate figures of the channels without a flag, and the tests of all live ones."""
    spearman = measured.matrices.spearman
    columns = np.array(used, dtype=np.int64)
    targets = np.searchsorted(lagged.live, table.targets)
    relations = stability.relations_of(lagged, targets, measured.metrics, spec.significance_level)
    groups = clusters_of(spearman[np.ix_(columns, columns)], spec.collinearity_threshold)
    held_out = values.choose_held_out(len(table.pieces), spec.forest.test_fraction, spec.seed)
    read = columns if spec.horizon else columns[~np.isin(columns, table.targets)]
    if not len(read):
        raise DataError(
            "no channel is left from which the targets could be predicted: at horizon 0 targets are no inputs, and all "
            "others are flagged; give more channels, or a horizon of 1 or more"
        )
    with clock.stage("forest") as tell:
        places = {int(c): k for k, c in enumerate(read)}
        grouped = [[places[int(columns[k])] for k in group if int(columns[k]) in places] for group in groups]
        importance: list[GroupImportance] = forest.importances(
            table, read, [group for group in grouped if group], held_out, spec, lambda share: tell("forest", share)
        )
    with clock.stage("linear value") as tell:
        names = [table.names[i] for i in lagged.live]
        among = np.searchsorted(lagged.live, columns).tolist()
        worth = values.linear_values(
            names,
            lagged,
            among,
            targets.tolist(),
            spec.horizon,
            held_out,
            lambda share: tell("linear value", 0.7 * share),
        )
        history = values.window_needed(lagged, among, targets.tolist(), spec.horizon, held_out)
    clusters = _clusters(table, spearman, columns, groups, relations.linear[np.searchsorted(lagged.live, columns)])
    pieces = _select_best_lags(lagged, targets, relations)
    correlations = lagged.pooled()
    return ScreeningEvidence(
        table, lagged.live, correlations, relations, pieces, measured.curves, importance, worth, clusters, history
    )


def _clusters(
    table: CandidateTable, spearman: Array, columns: NDArray[np.int64], groups: list[list[int]], linear: Array
) -> list[Cluster]:
    """Return the clusters of two or more; a target speaks for its cluster, else a name of Table A.1.

    Else the best correlated.
    """
    clusters = []
    for group in groups:
        # One channel is no cluster.
        if len(group) < 2:
            continue
        members = [int(columns[k]) for k in group]
        first = max(
            group,
            key=lambda k: (
                int(columns[k]) in table.targets,
                table.names[columns[k]] in TABLE_A1,
                float(np.abs(linear[k]).max()),
            ),
        )
        clusters.append(
            Cluster(tuple(table.names[i] for i in members), table.names[columns[first]], least_of(spearman, members))
        )
    return clusters


def _select_best_lags(lagged: Lagged, targets: NDArray[np.int64], relations: stability.Relations) -> Array:
    """Return the correlation in each segment at the target and lag with the largest mean, ``(segment, channel)``."""
    pieces = lagged.by_piece(targets)[:, : lagged.reach + 1]
    target = np.abs(relations.linear).argmax(axis=1)
    chosen = pieces[:, :, np.arange(pieces.shape[2]), target]
    lag = np.abs(chosen.mean(axis=0)).argmax(axis=0)
    return np.asarray(chosen[:, lag, np.arange(pieces.shape[2])], dtype=np.float64)


def _assemble_result(
    recordings: Sequence[Recording],
    table: CandidateTable,
    spec: ScreeningSpec,
    measured: _Measured,
    flags: list[Flag],
    evidence: ScreeningEvidence,
    seconds: dict[str, float],
) -> ScreeningResult:
    """Add the last flags and the proposal, and assemble the result."""
    targets = tuple(table.names[i] for i in table.targets)
    free = {name for name in table.names if name not in targets} - {flag.channel for flag in flags}
    flags = flags + noise_flags(evidence, sorted(free))
    free = set(table.names) - {flag.channel for flag in flags}
    trust = list_trusted(table, spec)
    flags = flags + redundant_flags(evidence, sorted(free - trust), sorted(free))
    return ScreeningResult(
        tuple(recording.name for recording in recordings),
        tuple(piece.name for piece in table.pieces),
        table.samples,
        table.rate_hz,
        table.names,
        table.groups,
        targets,
        spec.horizon,
        measured.matrices,
        tuple(measured.curves),
        tuple(measured.stable),
        tuple(evidence.importance),
        tuple(evidence.values),
        tuple(evidence.clusters),
        tuple(flags),
        propose(evidence, (*table.names, *table.missing), targets, spec.horizon, flags),
        asdict(spec),
        seconds,
    )
