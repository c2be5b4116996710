"""Evaluation of a predictor on held-out recordings with baselines on the same samples and in the same units."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from edp.data.gathered import LastMade
from edp.data.prepared import Prepared
from edp.data.scaling import feature_columns
from edp.data.series import Series
from edp.data.spread_rows import spread_series
from edp.errors import ConfigError
from edp.evaluation.baselines import BASELINES, Baseline, BaselineTask
from edp.evaluation.measured import IntervalsState, MeasuredState
from edp.evaluation.ruler import Numbered, Ruler
from edp.evaluation.scores_file import (
    ByHorizon,
    IntervalScores,
    Means,
    ModelScores,
    ScoresFile,
    metric,
    nearest_to_shown,
)
from edp.networks.predictor import Predictor
from edp.networks.running import stream_groups, streamed
from edp.progress import SILENT, Progress
from edp.settings.bounds import MOST_TICKS, SEED, check_bounds, integer
from edp.stats.metrics import weighted_interval_score
from edp.stats.sketch import MAX_EXACT
from edp.storage.memory import check_setting

Predictions = list[NDArray[np.float32]]
B = TypeVar("B", bound=Baseline)
KEPT_RECORDINGS, KEPT_TICKS = 6, 60_000
"""Maximum number of recordings and samples whose predictions are stored for pictures: ten minutes at 100 Hz."""
SHOWN_MODELS = ("network", "ridge_arx")
MAX_VALIDATED = 1 << 20
"""Ticks of the validation part that baselines are evaluated on, about; three hours at 100 Hz."""
PART_TICKS, MAX_PARTS = 1 << 17, 64
"""Ticks of a part of the test recordings that a worker evaluates the network on, 22 min at 100 Hz, which take far
longer than to hand them out; and how many parts there are at most, as each brings back megabytes of what it
measured."""
SKIP = integer(0, MOST_TICKS)
"""Ticks that are not scored: a slice that begins with a negative one would score the last ticks alone."""


@dataclass(frozen=True, kw_only=True)
class JudgeSpec:
    """Evaluation settings.

    Attributes:
        baselines: names of registered baselines.
        history: samples of history that baselines may use.
        warmup_samples: first ticks of each segment that are not scored; None leaves out a whole window (start-up), and
            as many as baselines need of history: all are measured on the same ticks.
        seed: seed of the baselines' row sampling and initial weights.
    """

    baselines: tuple[str, ...] = tuple(BASELINES)
    history: int = 50
    warmup_samples: int | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        check_bounds("evaluation", self, history=integer(1, MOST_TICKS), warmup_samples=SKIP, seed=SEED)
        for name in self.baselines:
            _ = BASELINES[name]


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Scores of every model, and what pictures need of the first recordings.

    Attributes:
        scores: the content of ``scores.json``.
        tensors: truth, predictions, inputs and interval of the first `KEPT_RECORDINGS` and `KEPT_TICKS`, by
            ``recording/name``.
    """

    scores: ScoresFile
    tensors: dict[str, NDArray[Any]]


class _Kept:
    """Collector of the data needed for plots, while predictions are evaluated."""

    def __init__(self, series: Sequence[Series]) -> None:
        self.series, self.tensors = series[:KEPT_RECORDINGS], dict[str, NDArray[Any]]()

    def truth(self, inputs: int) -> None:
        """Keep the truth, and the inputs of the first recording."""
        for i, part in enumerate(self.series):
            self._keep(i, "truth", part.targets)
            if i == 0:  # of one recording: of all, they would take more room than everything else
                self._keep(i, "inputs", part.inputs[:KEPT_TICKS][:, :inputs])

    def seen(self, predictions: Numbered, name: str) -> Iterator[tuple[int, NDArray[np.float32]]]:
        """Yield the predictions unchanged, and store those shown in plots under a name."""
        for number, values in predictions:
            if number < len(self.series) and name in SHOWN_MODELS:
                self._keep(number, name, values)
            yield number, values

    def bounds(self, bounds: Numbered, which: int) -> Iterator[tuple[int, NDArray[np.float32]]]:
        """Yield the intervals ``(time, coverage, 2, horizon, target)`` unchanged, and store the selected one."""
        for number, values in bounds:
            for end, side in enumerate(("network_low", "network_high") if number < len(self.series) else ()):
                self._keep(number, side, values[:, which, end])
            yield number, values

    def _keep(self, number: int, name: str, values: NDArray[Any]) -> None:
        # A copy: a view would keep the whole recording in memory.
        self.tensors[f"{self.series[number].name}/{name}"] = np.array(values[:KEPT_TICKS], order="C")


def judge(
    predictor: Predictor,
    data: Prepared,
    spec: JudgeSpec,
    label: str,
    seconds: float = 0.0,
    progress: Progress = SILENT,
    minutes: float | None = None,
) -> Evaluation:
    """Score the predictor and the baselines on ``data.test``.

    Args:
        predictor: the network.
        data: prepared series; baselines train on ``data.train`` and choose sizes on ``data.validation``.
        spec: evaluation settings: baselines, history and samples.
        label: name of the network in reports.
        seconds: its training time.
        progress: receiver of the name of each model before it runs.
        minutes: after which no further baseline is begun, the cheapest being first; scores name those left out.

    Raises:
        DataError: no tick of the test series can be scored.
    """
    bench = ModelBench(predictor, data, spec)
    progress.note("network")
    models = {"network": bench.network(label, seconds)}
    start, left_out = time.perf_counter(), []
    for name in sort_by_effort(spec.baselines):
        if minutes is not None and time.perf_counter() - start > 60 * minutes:
            left_out.append(name)
            continue
        progress.note(name)
        models[name] = bench.baseline(name)
    return bench.together(models, left_out)


def sort_by_effort(names: Sequence[str]) -> list[str]:
    """Return the names of baselines, the cheapest first."""
    return sorted(names, key=lambda name: BASELINES[name].effort)


@dataclass(frozen=True, eq=False)
class JudgedModel:
    """Entry of one model in ``scores.json``, and its plot data by ``recording/name``."""

    entry: ModelScores
    tensors: Mapping[str, NDArray[np.float32]]


@dataclass(frozen=True, eq=False)
class JudgedPart:
    """Metrics of a network on a part of the test recordings, and its plot data.

    Attributes:
        measured: accumulated metrics of the part.
        intervals: None for a network without intervals.
        tensors: plot data by ``recording/name``.
    """

    measured: MeasuredState
    intervals: IntervalsState | None
    tensors: Mapping[str, NDArray[np.float32]]


def network_parts(data: Prepared) -> int:
    """Return the number of parts into which the test data are divided for a network; it depends only on their size."""
    ticks = sum(part.samples for part in data.test)
    return max(1, min(MAX_PARTS, ticks // PART_TICKS, len(stream_groups(data.test))))


def _groups_of_part(data: Prepared, number: int) -> list[list[int]]:
    """Return the stream groups of one part: consecutive groups, by the position of the middle of their samples."""
    groups = stream_groups(data.test)
    ticks = np.array([sum(data.test[i].samples for i in group) for group in groups], dtype=np.float64)
    middles = np.cumsum(ticks) - ticks / 2
    part_of = np.minimum(middles / ticks.sum() * network_parts(data), network_parts(data) - 1).astype(int)
    return [group for group, part in zip(groups, part_of, strict=True) if part == number]


def check_scored(data: Prepared, spec: JudgeSpec) -> None:
    """Refuse a stated `skip` that leaves no sample to evaluate, before a training begins.

    Raises:
        ConfigError: no segment of the test part is longer.
    """
    longest = max((part.samples for part in data.test), default=0) - data.task.max_horizon
    if spec.warmup_samples is not None and data.test and spec.warmup_samples >= longest:
        raise ConfigError(
            f"evaluation.warmup_samples: got {spec.warmup_samples:,}, expected fewer than the {longest:,} samples of "
            "the longest test segment that can be evaluated; give a smaller one, or longer recordings"
        )


def first_scored(predictor: Predictor, data: Prepared, spec: JudgeSpec) -> int:
    """Return the sample from which every segment is scored, equal for all models."""
    # A whole window from reset: before that the network's memory is not filled. Baselines lack history for longer
    # than the preset `auto` waits: without the rows in which sensors settle a rival looks far better than it is.
    history = baseline_task(data, spec).history if spec.baselines else 0
    first = max(predictor.spec.window, history) if spec.warmup_samples is None else spec.warmup_samples
    # While the start is read there is nothing to predict.
    return max(first, data.task.features.init_samples) if data.task.features.init_channels else first


class ModelBench:
    """Evaluation of several models on the same samples, in this process or in one process per model.

    Args:
        predictor: the network.
        data: prepared series.
        spec: evaluation settings: baselines, history and samples.

    Raises:
        DataError: no tick of the test series can be scored.
    """

    def __init__(self, predictor: Predictor, data: Prepared, spec: JudgeSpec) -> None:
        _check_memory(predictor, data, spec)
        self.predictor, self.data, self.spec = predictor, data, spec
        self.skip = first_scored(predictor, data, spec)
        self.ruler = Ruler(data, self.skip)

    def network(self, label: str, seconds: float) -> JudgedModel:
        """Run the network on the test part; label and training time appear in reports."""
        return self.network_of(map(self.network_part, range(network_parts(self.data))), label, seconds)

    def network_part(self, number: int) -> JudgedPart:
        """Run the network on a part of the test data; `network_parts` lists the parts."""
        net, test, pictures = self.predictor, self.data.test, _Kept(self.data.test)
        groups, coverages = _groups_of_part(self.data, number), net.spec.output.coverages
        predictions = pictures.seen(streamed(net, net.predict, test, groups=groups), "network")
        measured, within = self.ruler.gathered(predictions).state(), None
        if coverages:
            bounds = pictures.bounds(streamed(net, net.intervals, test, groups=groups), nearest_to_shown(coverages))
            within = self.ruler.gather_intervals(bounds, coverages).state()
        return JudgedPart(measured, within, pictures.tensors)

    def network_of(self, parts: Iterable[JudgedPart], label: str, seconds: float) -> JudgedModel:
        """Return the network's entry from its parts, in order; label and training time appear in reports."""
        coverages = self.predictor.spec.output.coverages
        measured, within = self.ruler.unmeasured(), self.ruler.new_interval_metrics(coverages)
        tensors: dict[str, NDArray[np.float32]] = {}
        for part in parts:
            measured.add(part.measured)
            if part.intervals is not None:
                within.add(part.intervals)
            tensors |= part.tensors
        scores = replace(self.ruler.scores(measured), label=label, seconds=seconds)
        if coverages:
            intervals = self.ruler.intervals(within, coverages)
            weighted = _weight_intervals(scores.overall, intervals)
            scores = replace(scores, intervals=intervals, weighted_interval_score=weighted)
        return JudgedModel(scores, tensors)

    def baseline(self, name: str) -> JudgedModel:
        """Fit a baseline on the training part, and run it along test and validation part."""
        began, pictures = time.perf_counter(), _Kept(self.data.test)
        baseline = _fit_baseline(BASELINES[name], self.data, self.spec)
        measured = self.ruler.measure(pictures.seen(_predict_parts(baseline, self.data, self.data.test), name))
        validation = _score_on_validation(baseline, self.data, max(self.skip, self.spec.history))
        seconds = time.perf_counter() - began
        scores = replace(measured, label=baseline.label, seconds=seconds, validation=validation)
        return JudgedModel(scores, pictures.tensors)

    def together(self, models: Mapping[str, JudgedModel], left_out: Sequence[str] = ()) -> Evaluation:
        """Combine all models into one evaluation; `left_out` names requested baselines that did not run."""
        pictures = _Kept(self.data.test)
        pictures.truth(len(self.data.inputs))
        tensors = {**pictures.tensors}
        for model in models.values():
            tensors |= model.tensors
        return Evaluation(self.ruler.file({name: model.entry for name, model in models.items()}, left_out), tensors)


def _weight_intervals(overall: ByHorizon, intervals: Mapping[str, Sequence[IntervalScores]]) -> dict[str, Means]:
    """Return the weighted interval score by horizon and target, of medians and intervals of the same ticks."""
    return {
        horizon: {
            target: weighted_interval_score(
                metric(overall[horizon][target], "mae"), {row.coverage: row.score[target] for row in rows}
            )
            for target in rows[0].score
        }
        for horizon, rows in intervals.items()
    }


def _score_on_validation(baseline: Baseline, data: Prepared, skip: int) -> ByHorizon:
    """Return overall scores on the validation part, which also selected the baseline's sizes.

    Empty if it is too short.
    """
    if max((part.samples for part in data.validation), default=0) - data.task.max_horizon <= skip:
        return {}
    # As epochs are judged: of a large validation part evenly spread stretches.
    parts = spread_series(data.validation, 100 * (skip + data.task.max_horizon), MAX_VALIDATED)
    ruler = Ruler(replace(data, test=parts), skip)
    return ruler.measure(_predict_parts(baseline, data, parts)).overall


def _check_memory(predictor: Predictor, data: Prepared, spec: JudgeSpec) -> None:
    """Refuse more horizons than the memory holds the truth and predictions of, for the recordings of a step."""
    task = data.task
    ends = len(task.horizons) * len(task.targets)
    ticks = max(series.samples for series in data.test) + min(MAX_EXACT, sum(series.samples for series in data.test))
    each = 4 * (2 + 2 * len(predictor.spec.output.coverages)) + 3 * 8  # predictions, intervals; truth, errors: doubles
    check_setting(
        ticks * ends * each,
        f"evaluation: {sum(series.samples for series in data.test):,} ticks of {len(task.horizons):,} horizon(s) of "
        f"{len(task.targets):,} target(s)",
        "evaluate fewer recordings, or predict fewer horizons",
    )


def baseline_predictions(kind: type[B], data: Prepared, spec: JudgeSpec) -> tuple[Callable[[Prepared], Predictions], B]:
    """Fit a baseline to the training part; return a function for its predictions on test data, and the baseline."""
    baseline = _fit_baseline(kind, data, spec)
    return lambda other: [values for _, values in _predict_parts(baseline, other, other.test)], baseline


def _fit_baseline(kind: type[B], data: Prepared, spec: JudgeSpec) -> B:
    baseline = kind(baseline_task(data, spec))
    baseline.fit(_select_baseline_inputs(data, data.train), _select_baseline_inputs(data, data.validation))
    return baseline


def _predict_parts(
    baseline: Baseline, data: Prepared, parts: Sequence[Series]
) -> Iterator[tuple[int, NDArray[np.float32]]]:
    for number, part in enumerate(_select_baseline_inputs(data, parts)):
        yield number, baseline.predict(part)


def score_predictions(predictions: Iterable[NDArray[np.float32]], data: Prepared, skip: int) -> ModelScores:
    """Return scores of predictions ``(time, horizon, target)`` for each of ``data.test``, as `judge` does.

    Args:
        predictions: predictions in SI units.
        data: series with truth.
        skip: first ticks of each segment that are not scored.

    Raises:
        DataError: no tick can be scored.
    """
    return Ruler(data, skip).measure(enumerate(predictions))


def score_network(predictor: Predictor, data: Prepared, skip: int) -> ModelScores:
    """Return scores like `score_predictions` for a network run as a stream over ``data.test``."""
    return Ruler(data, skip).measure(streamed(predictor, predictor.predict, data.test))


def baseline_task(data: Prepared, spec: JudgeSpec) -> BaselineTask:
    """Return the task of the baselines: present values only where an input, or a derived feature, measures them."""
    inputs = (*data.task.features.channels, *_list_derived_features(data))
    present = tuple(inputs.index(target) if target in inputs else None for target in data.task.targets)
    longest = min(series.samples for series in [*data.train, *data.test]) - data.task.max_horizon - 1
    # At most half of the shortest recording, so that every recording still has ticks to score.
    history = max(1, min(spec.history, longest // 2))
    return BaselineTask(horizons=data.task.horizons, present=present, history=history, seed=spec.seed)


def _list_derived_features(data: Prepared) -> list[str]:
    """Return the derived features that baselines read: those not contained in their channel history.

    These are the targets' present values, and what is derived from channels that are hidden from the network: a
    comparison is fair only where both sides know the same.
    """
    features = data.task.features
    return [one.name for one in features.derived if one.name in data.task.targets or one.source in features.hidden]


def _select_baseline_inputs(data: Prepared, parts: Sequence[Series]) -> list[Series]:
    """Return series with channels and derived features as inputs, without hidden, initialisation or physics inputs."""
    names, own = _list_derived_features(data), len(data.task.features.channels)
    if not names and own == len(data.task.inputs):
        return list(parts)
    places = [*range(own), *(data.task.features.features.index(name) for name in names)]
    slot = LastMade()
    return [replace(part, inputs=feature_columns(data.task, part, places, slot)) for part in parts]
