"""Content of ``scores.json``: errors of a network and of its baselines on the same recordings, in report units."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from edp.errors import ConfigError, DataError
from edp.settings.bounds import MOST_TICKS, above, check_bounds, integer
from edp.settings.results import ResultFile
from edp.signals import display_offset
from edp.storage.paths import is_file_at

MEAN = "mean"
"""Key of the mean over targets in tables with one entry per target."""
Metrics = Mapping[str, float | int | None]
"""Metric values by metric name, such as ``rmse``; None if a metric is undefined."""
ByTarget = Mapping[str, Metrics]
"""Metrics by target, including `MEAN`."""
ByHorizon = Mapping[str, ByTarget]
"""Metrics by horizon in samples (as text)."""
Means = Mapping[str, float]
"""Value by target, including `MEAN`."""
PREDICTIONS = "predictions.safetensors"
FACTOR = above(0.0, 1e12)


@dataclass(frozen=True, kw_only=True)
class ScoredTask:
    """The task that was evaluated.

    Attributes:
        name: name of the task.
        horizons: samples ahead.
        rate_hz: samples per second; None where unknown.
        mode: prediction mode of the targets.
        skip: first samples of each segment that are not evaluated.
    """

    name: str = ""
    horizons: tuple[int, ...]
    rate_hz: float | None = None
    mode: str = ""
    skip: int = 0

    def __post_init__(self) -> None:
        check_bounds("task", self, horizons=integer(0, MOST_TICKS), skip=integer(0, MOST_TICKS))
        if self.rate_hz is not None:
            check_bounds("task", self, rate_hz=FACTOR)


@dataclass(frozen=True, kw_only=True)
class ScoredTarget:
    """A target. Values in `unit` are SI values times `factor` plus `offset`; differences have no offset."""

    name: str
    description: str = ""
    unit: str = ""
    factor: float = 1.0

    def __post_init__(self) -> None:
        check_bounds("target", self, factor=FACTOR)

    @property
    def offset(self) -> float:
        """See `edp.signals.display_offset`."""
        return display_offset(self.unit)


@dataclass(frozen=True, kw_only=True)
class ScoredInput:
    """An input channel, with the unit of reports and its factor."""

    name: str
    unit: str
    factor: float

    def __post_init__(self) -> None:
        check_bounds("input", self, factor=FACTOR)


@dataclass(frozen=True, kw_only=True)
class SpeedBin:
    """Mean absolute error of the samples whose target has a magnitude from `low` to `high`; None without samples."""

    low: float
    high: float
    count: int
    mae: float | None


@dataclass(frozen=True, kw_only=True)
class SituationErrors:
    """Errors while the axes do one thing.

    Attributes:
        situation: name, see `edp.evaluation.by_situation`.
        ticks: number of samples.
        share: fraction of the time.
        of_error: fraction of the summed error.
        mae: mean absolute error of each target; None without samples.
    """

    situation: str
    ticks: int = 0
    share: float
    of_error: float
    mae: Mapping[str, float | None]


@dataclass(frozen=True, kw_only=True)
class IntervalScores:
    """Scores of prediction intervals with one nominal coverage.

    Attributes:
        coverage: nominal.
        covered: fraction of the truth inside.
        width: mean width.
        score: mean interval score; empty in files of earlier versions.
    """

    coverage: float
    covered: Means
    width: Means
    score: Means = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in ("covered", "width"):
            check_mean(name, getattr(self, name))


@dataclass(frozen=True, kw_only=True)
class ModelScores:
    """Scores of one model.

    Attributes:
        label: name in tables.
        seconds: training time.
        overall: metrics over all recordings.
        recordings: metrics of each recording.
        spread: order statistics over recordings of the mean absolute error, by horizon.
        by_speed, by_situation: errors by horizon.
        integrated: error of the running integral, by target.
        intervals: interval metrics by horizon; empty for a model without intervals.
        weighted_interval_score: weighted interval score by horizon.
        validation: metrics on the validation part, of a baseline.
    """

    label: str = ""
    seconds: float | None = None
    overall: ByHorizon
    recordings: Mapping[str, ByHorizon] = field(default_factory=dict)
    spread: Mapping[str, Metrics] = field(default_factory=dict)
    by_speed: Mapping[str, tuple[SpeedBin, ...]] = field(default_factory=dict)
    by_situation: Mapping[str, tuple[SituationErrors, ...]] = field(default_factory=dict)
    integrated: Mapping[str, Metrics] = field(default_factory=dict)
    intervals: Mapping[str, tuple[IntervalScores, ...]] = field(default_factory=dict)
    weighted_interval_score: Mapping[str, Means] = field(default_factory=dict)
    validation: ByHorizon = field(default_factory=dict)

    def __post_init__(self) -> None:
        for horizon, values in self.weighted_interval_score.items():
            check_mean(f"weighted_interval_score.{horizon}", values)


@dataclass(frozen=True, kw_only=True)
class OutsideRange:
    """Channel outside its training range, and the fraction of the samples outside."""

    channel: str
    share: float


@dataclass(frozen=True, kw_only=True)
class TargetChange:
    """Difference between a target's changes in the test data and in the training data.

    Attributes:
        target: name.
        horizon: horizon in samples.
        ratio: root-mean-square change over that in training.
        beyond: fraction of the changes that are larger than any in training.
    """

    target: str
    horizon: int
    ratio: float
    beyond: float

    def __post_init__(self) -> None:
        check_bounds("change", self, horizon=integer(0, MOST_TICKS), ratio=FACTOR)


@dataclass(frozen=True, kw_only=True)
class DataSituation:
    """Differences between the evaluated recordings and the training recordings.

    Attributes:
        outside: channels that leave their range, most of the time first.
        changes: targets that change more or less than in training.
    """

    outside: tuple[OutsideRange, ...]
    changes: tuple[TargetChange, ...]


@dataclass(frozen=True, kw_only=True)
class DrawnSample:
    """Evaluated part of the recordings: hours out of all hours, in segments; `what` describes it."""

    hours: float
    of_hours: float
    stretches: int
    what: str


@dataclass(frozen=True, kw_only=True)
class ScoresFile(ResultFile):
    """Content of ``scores.json``.

    Attributes:
        models: scores by model name; the network is ``network``.
        left_out: baselines that were asked for and not run.
        drawn: the part of the recordings that was evaluated; None for all.
        key: key of the evaluation, see `edp.storage.runs.run_key`; empty if `left_out` has entries.
        files: hashes of files in the same folder.
    """

    NAME = "scores.json"
    SCHEMA = 1
    WHAT = "scores"
    ADVICE = "remove it and run edp evaluate"

    task: ScoredTask
    targets: tuple[ScoredTarget, ...]
    inputs: tuple[ScoredInput, ...] = ()
    models: Mapping[str, ModelScores]
    situation: DataSituation | None = None
    left_out: tuple[str, ...] = ()
    drawn: DrawnSample | None = None
    key: str | None = None
    files: Mapping[str, str] = field(default_factory=dict)


def metric(values: Metrics, name: str) -> float:
    """Return a metric by its name.

    Raises:
        DataError: the metric is absent or not defined.
    """
    value = values.get(name)
    if value is None:
        raise DataError(f"scores: '{name}' is not defined; evaluate again, on more recordings")
    return float(value)


def error_at(overall: ByHorizon, horizon: int, target: str, name: str) -> float | None:
    """Return a finite metric of a target, or of `MEAN`, at a horizon; None where it was not computed."""
    value = overall.get(str(horizon), {}).get(target, {}).get(name)
    return None if value is None or not math.isfinite(value) else float(value)


def check_mean(name: str, values: Means) -> None:
    """Raise ConfigError if values by target lack their mean."""
    if MEAN not in values:
        raise ConfigError(f"'{name}.{MEAN}' is missing; it must be given")


def earlier_scores(folder: Path, key: str) -> ScoresFile | None:
    """Return the scores of an earlier evaluation with this key and its predictions; None without one."""
    if not is_file_at(folder / ScoresFile.NAME) or not is_file_at(folder / PREDICTIONS):
        return None
    scores = ScoresFile.read(folder)
    return scores if scores.key == key else None


def nearest_to_shown(coverages: Sequence[float]) -> int:
    """Return the place of the interval that pictures show: the one nearest to 90 %."""
    return min(range(len(coverages)), key=lambda which: abs(coverages[which] - 0.9))
