"""Scores of a twin: free-run simulations on commands from measured starts, compared with the measurement."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from edp.data.series import Series
from edp.data.twin_channels import TwinChannels
from edp.errors import DataError
from edp.evaluation.free_run_file import (
    CoverageAt,
    FreeRunErrors,
    FreeRunScores,
    IntervalCoverage,
    PartCoverage,
    RunSummary,
)
from edp.evaluation.free_run_parts import (
    by_channel,
    by_horizon,
    by_name,
    nrmse_by_channel,
    situations,
    stroke_errors,
)
from edp.networks.twin import FreeRunIntervals, Twin, TwinScales, calibrate, even_starts, starts_within
from edp.networks.twin.windows import MeasuredWindows
from edp.settings.bounds import MAX_BATCH, MAX_NAMES, MOST_TICKS, above, between, check_bounds, check_count, integer
from edp.wording import figure

Array = NDArray[np.float32]
MAX_SECONDS = 86_400.0
"""Maximum length of a free-run simulation: one day."""
ASTRAY = 0.5
"""Fraction of the stroke range; a run with a larger stroke error counts as diverged."""
AT_FULL_SPEED_S = 1.0
"""Motion at the largest speed that counts as a range where no stroke is measured."""
SHORTER = (2, 4, 8)
"""Parts of the longest free run that calibrate intervals as well, where segments are shorter than what is asked."""
LANES = 64
"""Free runs side by side: all of a data set at once would need memory without bound."""


@dataclass(frozen=True, kw_only=True)
class FreeRunJudgeSpec:
    """Evaluation settings of a twin.

    Attributes:
        duration_s: length of a free run; cut to what the longest recording has.
        starts: free runs in each recording, evenly spread.
        at_s: times after the start at which strokes are compared.
        baselines: formulations that are fitted to the same recordings and evaluated beside it; one that does not suit
            them is left out.
        coverage: share of free runs that an interval is meant to hold.
        coverage_at_s: times after the start at which coverage is counted.
        calibration_starts: free runs in each validation recording that calibrate the intervals.
        horizon: horizon of k-step-ahead predictions from measured outputs, with given commands.

    Raises:
        ConfigError: a value out of range.
    """

    duration_s: float = 60.0
    starts: int = 4
    at_s: tuple[float, ...] = (1.0, 5.0, 10.0, 30.0, 60.0)
    baselines: tuple[str, ...] = ("static", "arx", "n4sid")
    coverage: float = 0.9
    coverage_at_s: tuple[float, ...] = (0.1, 1.0, 10.0, 60.0)
    calibration_starts: int = 16
    horizon: int = 10

    def __post_init__(self) -> None:
        length = above(0.0, MAX_SECONDS)
        count = integer(1, MAX_BATCH)
        check_bounds("evaluation", self, duration_s=length, at_s=length, starts=count, calibration_starts=count)
        check_bounds(
            "evaluation", self, coverage_at_s=length, coverage=between(0.0, 1.0), horizon=integer(1, MOST_TICKS)
        )
        check_count("evaluation", "at_s", self.at_s, MAX_NAMES, least=1)
        check_count("evaluation", "coverage_at_s", self.coverage_at_s, MAX_NAMES, least=1)
        check_count("evaluation", "baselines", self.baselines, MAX_NAMES)


@dataclass(frozen=True, eq=False)
class FreeRuns:
    """Free-run simulations with the corresponding measurements.

    Attributes:
        channels: channels of the twin.
        names: recording of each run.
        answers: ``(run, tick, output)``, SI units; row t is tick t + 1 of the free run.
        truth: measured, of the same shape.
        before: measured at the last tick before the first output ``(run, output)``.
        low: least value of each output, of a stroke the closed end stop ``(output,)``; `high` likewise.
        high: largest value.
    """

    channels: TwinChannels
    names: tuple[str, ...]
    answers: Array
    truth: Array
    before: Array
    low: Array
    high: Array

    @property
    def stroke_errors(self) -> NDArray[np.float64]:
        """Absolute errors of the strokes ``(run, tick, velocity)``, SI units; without strokes of integrals."""
        count = len(self.channels.velocities)
        if self.channels.strokes:
            return np.abs(self.answers[..., count : 2 * count].astype(np.float64) - self.truth[..., count : 2 * count])
        return np.abs(self._integral(self.answers) - self._integral(self.truth))

    @staticmethod
    def joined(parts: Sequence[FreeRuns]) -> FreeRuns:
        """Join runs of twins over the same channels, each cut to the shortest."""
        first, ticks = parts[0], min(part.truth.shape[1] for part in parts)
        if len(parts) == 1:
            return first
        names = tuple(name for part in parts for name in part.names)
        answers, truth = (np.concatenate([getattr(p, n)[:, :ticks] for p in parts]) for n in ("answers", "truth"))
        low, high = np.min([part.low for part in parts], axis=0), np.max([part.high for part in parts], axis=0)
        return FreeRuns(first.channels, names, answers, truth, np.concatenate([p.before for p in parts]), low, high)

    def only(self, of: NDArray[np.int64]) -> FreeRuns:
        """Return the runs with the given indices."""
        names = tuple(self.names[i] for i in of)
        return FreeRuns(self.channels, names, self.answers[of], self.truth[of], self.before[of], self.low, self.high)

    def _integral(self, values: Array) -> NDArray[np.float64]:
        rows = np.concatenate([self.before[:, None], values], axis=1)[..., : len(self.channels.velocities)]
        steps = (rows[:, 1:].astype(np.float64) + rows[:, :-1]) / (2.0 * self.channels.rate_hz)
        return np.asarray(np.cumsum(steps, axis=1))

    def _range(self) -> NDArray[np.float64]:
        """Return the range of each stroke ``(velocity,)``.

        Without strokes from the true integrals, or one second at full speed.

        What rests during all runs has no range, and any error would be one astray.
        """
        if self.channels.strokes:
            ends = slice(len(self.channels.velocities), 2 * len(self.channels.velocities))
            return (self.high - self.low)[ends].astype(np.float64)
        fastest = self.high[: len(self.channels.velocities)].astype(np.float64)
        return np.asarray(np.maximum(np.ptp(self._integral(self.truth), axis=(0, 1)), fastest * AT_FULL_SPEED_S))

    def diverged(self) -> NDArray[np.bool_]:
        """Return a mask of diverged runs ``(run,)``: stroke error above `ASTRAY` of its range, or not finite."""
        astray = (self.stroke_errors > ASTRAY * self._range()).any(axis=(1, 2))
        return np.asarray(astray | ~np.isfinite(self.answers).all(axis=(1, 2)))


def free_runs(twin: Twin, series: Sequence[Series], seconds: float, starts: int) -> FreeRuns:
    """Simulate a twin in free run from evenly spaced starts of each segment.

    Args:
        twin: any formulation.
        series: inputs are commands, targets are what it outputs.
        seconds: length of a run, cut to what the longest segment has; shorter segments, and starts
            beyond an end stop of the twin, are left out.
        starts: runs in each segment.

    Raises:
        DataError: no segment has a tick behind the prefix.
    """
    prefix = twin.prefix_ticks
    length = _run_ticks(twin.channels, prefix, series, seconds)
    runs = even_starts(twin, series, length, starts)
    answers, truths = [], []
    for first in range(0, len(runs), LANES):
        lanes = MeasuredWindows.read(runs[first : first + LANES], length - 1)
        with threadpool_limits(limits=1, user_api="blas"):  # see `fit_free_runs`
            state = twin.reset(lanes.commands[:, :prefix], lanes.outputs[:, :prefix])
            answers.append(twin.rollout(lanes.commands[:, prefix:], state)[0])
        truths.append(lanes.outputs[:, prefix:])
    whole_truth = np.concatenate(truths)
    names = tuple(part.name for part, _ in runs)
    return runs_of(twin, names, np.concatenate(answers), whole_truth)


def check_runs(
    channels: TwinChannels, scales: TwinScales, prefix: int, series: Sequence[Series], seconds: float, starts: int
) -> None:
    """Raise an error if `free_runs` would find no start in these recordings, before the twin is trained.

    Args:
        channels: channels of the future twin.
        scales: scales with the end stops.
        prefix: its measured ticks before a free run.
        series: evaluated series.
        seconds: length of a run, see `free_runs`.
        starts: runs in each segment.

    Raises:
        DataError: no segment has a tick behind the prefix, or all starts lie beyond an end stop.
    """
    starts_within(channels, scales, series, _run_ticks(channels, prefix, series, seconds), starts)


def _run_ticks(channels: TwinChannels, prefix: int, series: Sequence[Series], seconds: float) -> int:
    """Return the length of a free run with its prefix in samples; raise DataError if every recording is shorter."""
    rate, longest = channels.rate_hz, max((part.samples for part in series), default=0)
    ticks = min(round(seconds * rate), longest - prefix - 1)
    if ticks < 1:
        raise DataError(
            f"the longest recording has {longest} ticks ({figure(longest / rate)} s); the twin needs {prefix} "
            "measured ones "
            "and two more to be judged: give longer recordings"
        )
    return prefix + ticks + 1


def runs_of(twin: Twin, names: tuple[str, ...], answers: Array, truth: Array) -> FreeRuns:
    """Combine the outputs of a twin with the measurements.

    Args:
        twin: twin that computed the outputs.
        names: recording of each run.
        answers: ``(run, tick, output)``.
        truth: measured ``(run, tick + 1, output)``, from the last tick before the first output.
    """
    return FreeRuns(twin.channels, names, answers, truth[:, 1:], truth[:, 0], twin.scales.low, twin.scales.high)


def calibrated(unseen: Sequence[tuple[Twin, Sequence[Series]]], spec: FreeRunJudgeSpec) -> FreeRunIntervals:
    """Return free-run intervals of a twin, calibrated on free runs outside its training data.

    Args:
        unseen: the twin beside the validation part; or of a twin that is the mean of several, or that was fitted again
            to all of them, each fit beside the segments that it left out (the residuals of CV+, Barber et al. 2021).
        spec: their length and number, and the coverage.

    Raises:
        DataError: no segment has a tick behind the prefix.
    """
    whole = _unseen_runs(unseen, spec.duration_s, spec.calibration_starts)
    errors = [whole.answers - whole.truth]
    rate, longest = whole.channels.rate_hz, whole.truth.shape[1]
    # Runs as long as a short stretch all begin at its first tick: shorter ones tell short horizons by more starts.
    for ticks in (longest // share for share in SHORTER if longest < round(spec.duration_s * rate)):
        if ticks < 1:
            break
        runs = _unseen_runs(unseen, ticks / rate, spec.calibration_starts)
        missed = runs.answers - runs.truth
        errors.append(np.pad(missed, ((0, 0), (0, longest - missed.shape[1]), (0, 0)), constant_values=np.nan))
    return calibrate(np.concatenate(errors), spec.coverage)


def _unseen_runs(unseen: Sequence[tuple[Twin, Sequence[Series]]], seconds: float, starts: int) -> FreeRuns:
    """Return free runs of each twin on its own segments."""
    return FreeRuns.joined([free_runs(twin, series, seconds, starts) for twin, series in unseen])


def free_run_scores(
    runs: FreeRuns,
    spec: FreeRunJudgeSpec,
    intervals: FreeRunIntervals | None = None,
    labels: Mapping[str, str] | None = None,
) -> FreeRunScores:
    """Return the scores in the units of reports; velocities, strokes and pressures are never averaged together.

    Args:
        runs: free runs.
        spec: the times after the start at which strokes are compared and coverage is counted; those beyond the runs
            are left out.
        intervals: prediction intervals of the twin, if it has any.
        labels: way of driving by name of recording; none where they do not tell.
    """
    channels, names = runs.channels, np.array(runs.names)
    labels = labels or {}
    # A stretch of a recording is named after it, with the rows behind.
    driving = np.array([labels.get(name, labels.get(name.partition("[")[0], "")) for name in runs.names])
    return FreeRunScores(
        runs=len(names),
        recordings=len(set(runs.names)),
        seconds=runs.truth.shape[1] / channels.rate_hz,
        **vars(_errors(runs, spec.at_s)),
        by_horizon=by_horizon(channels, runs.answers - runs.truth, runs.stroke_errors),
        by_recording=by_name(runs.names, lambda of: _summary(runs.only(of), spec.at_s)),
        by_driving=by_name(driving.tolist(), lambda of: _summary(runs.only(of), spec.at_s)) if driving.all() else {},
        situations=situations(channels, runs.answers, runs.truth, runs.low, runs.high),
        intervals=None if intervals is None else coverage_of(runs, spec, intervals),
    )


def coverage_of(runs: FreeRuns, spec: FreeRunJudgeSpec, intervals: FreeRunIntervals) -> IntervalCoverage:
    """Return the fraction of free runs inside the interval at each horizon, by kind of channel, and the half widths."""
    channels, ticks = runs.channels, _ticks(runs, spec.coverage_at_s)
    rows = []
    for at, tick in ticks:
        half = intervals.at(np.array([tick]))[0]
        inside = np.abs(runs.answers[:, tick - 1] - runs.truth[:, tick - 1]) <= half
        parts = {}
        for part, columns in channels.parts.items():
            chosen = channels.answers[columns]
            if chosen:
                parts[part] = PartCoverage(
                    share=float(inside[:, columns].mean()),
                    by_channel={c.name: float(x) for c, x in zip(chosen, inside[:, columns].mean(axis=0), strict=True)},
                    half_width=by_channel(chosen, half[columns]),
                )
        rows.append(CoverageAt(at_s=at, calibrated=bool(tick <= intervals.ticks[-1]), **parts))
    return IntervalCoverage(coverage=intervals.coverage, calibrated_by=intervals.runs, at=tuple(rows))


def _errors(runs: FreeRuns, at_s: Sequence[float]) -> FreeRunErrors:
    """Return velocity MAE, stroke errors by time, pressure NRMSE and the fraction of diverged runs."""
    channels, count = runs.channels, len(runs.channels.velocities)
    velocity_mae = np.abs(runs.answers - runs.truth)[..., :count].mean(axis=(0, 1), dtype=np.float64)
    ends = channels.strokes or channels.velocities
    errors = runs.stroke_errors
    return FreeRunErrors(
        velocity_mae=by_channel(channels.velocities, velocity_mae),
        stroke_error=tuple(
            stroke_errors(ends, at, errors[:, tick - 1], integral=not channels.strokes)
            for at, tick in _ticks(runs, at_s)
        ),
        pressure_nrmse=nrmse_by_channel(channels, runs.answers, runs.truth),
        diverged=float(runs.diverged().mean()),
    )


def _summary(runs: FreeRuns, at_s: Sequence[float]) -> RunSummary:
    """Return errors over whole runs, and stroke errors at the given times and at the end of the runs."""
    end = runs.truth.shape[1] / runs.channels.rate_hz
    return RunSummary(runs=len(runs.names), **vars(_errors(runs, (*(at for at in at_s if at < end), end))))


def _ticks(runs: FreeRuns, at_s: Sequence[float]) -> list[tuple[float, int]]:
    """Return the times within the runs, each with its sample."""
    ticks = [(at, max(1, round(at * runs.channels.rate_hz))) for at in at_s]
    return [(at, tick) for at, tick in ticks if tick <= runs.truth.shape[1]]
