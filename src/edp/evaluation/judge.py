"""Judge a predictor on held-out recordings beside honest baselines, on the same ticks and in the same units."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from edp.data.gathered import Slot
from edp.data.prepared import Prepared
from edp.data.scaling import feature_columns
from edp.data.series import Series
from edp.errors import DataError
from edp.evaluation.baselines import BASELINES, Baseline, BaselineTask
from edp.evaluation.scores_file import nearest_to_shown
from edp.evaluation.situation import situation_of
from edp.networks.predictor import Predictor
from edp.networks.running import stream_intervals, stream_predictions
from edp.settings.bounds import MOST_ROWS, MOST_TICKS, SEED, check_bounds, integer
from edp.signals import KINDS
from edp.stats.metrics import Scores, interval_scores, mean_scores, score, spread
from edp.storage.memory import check_setting

Predictions = list[NDArray[np.float32]]
B = TypeVar("B", bound=Baseline)
# Six bins show where an error grows with speed and leave enough samples in each.
SPEED_BINS = 6
SKIP = integer(0, MOST_ROWS)
"""Ticks that are not scored: a slice that begins with a negative one would score the last ticks alone."""


@dataclass(frozen=True, kw_only=True)
class JudgeSpec:
    """How to judge.

    Attributes:
        baselines: names of registered baselines.
        history: samples of history that baselines may use.
        skip: first ticks of each stretch that are not scored; None leaves out a whole window (start-up).
        seed: of the baselines' row sampling and initial weights.
    """

    baselines: tuple[str, ...] = tuple(BASELINES)
    history: int = 50
    skip: int | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        check_bounds("judge", self, history=integer(1, MOST_TICKS), skip=SKIP, seed=SEED)
        for name in self.baselines:
            _ = BASELINES[name]


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Scores of every model, and the predictions that pictures need.

    Attributes:
        scores: the content of ``scores.json`` (schema 1).
        predictions: by model, one array ``(time, horizon, target)`` for each series.
        series: the judged series.
        bounds: of the interval nearest to 90 %, ``(time, 2, horizon, target)`` for each series; none without intervals.
    """

    scores: dict[str, Any]
    predictions: dict[str, Predictions]
    series: list[Series]
    bounds: Predictions = field(default_factory=list)

    def kept(self, recordings: int, ticks: int) -> dict[str, NDArray[Any]]:
        """Truth, predictions and interval of the first recordings and ticks, by ``recording/name``, for the report."""
        tensors: dict[str, NDArray[Any]] = {}
        for i, series in enumerate(self.series[:recordings]):
            parts: dict[str, NDArray[Any]] = {"truth": series.targets}
            parts |= {name: self.predictions[name][i] for name in ("network", "ridge_arx") if name in self.predictions}
            for end, side in enumerate(("network_low", "network_high") if self.bounds else ()):
                parts[side] = self.bounds[i][:, end]
            if i == 0:  # of one recording: of all, they would take more room than everything else
                parts["inputs"] = series.inputs[:, : len(self.scores["inputs"])]
            tensors |= {f"{series.name}/{name}": np.ascontiguousarray(part[:ticks]) for name, part in parts.items()}
        return tensors


def judge(
    predictor: Predictor,
    data: Prepared,
    spec: JudgeSpec,
    label: str,
    seconds: float = 0.0,
    on_step: Callable[[str], None] | None = None,
    minutes: float | None = None,
) -> Evaluation:
    """Score the predictor and the baselines on ``data.test``.

    Args:
        predictor: the network.
        data: prepared series; baselines train on ``data.train`` and choose sizes on ``data.validation``.
        spec: which baselines, how much history, which ticks.
        label: how reports call the network.
        seconds: its training time.
        on_step: called with the name of each model before it runs.
        minutes: after which no further baseline is begun, the cheapest being first; scores name those left out.

    Raises:
        DataError: no tick of the test series can be scored.
    """
    say = on_step or (lambda name: None)
    _check_memory(predictor, data, spec)
    say("network")
    predictions = {"network": stream_predictions(predictor, data.test)}
    names, times = {"network": label}, {"network": seconds}
    on_validation: dict[str, Predictions] = {}
    start, left_out = time.perf_counter(), []
    for name in sorted(spec.baselines, key=lambda name: BASELINES[name].effort):
        began = time.perf_counter()
        if minutes is not None and began - start > 60 * minutes:
            left_out.append(name)
            continue
        say(name)
        predict, baseline = baseline_predictions(BASELINES[name], data, spec)
        predictions[name] = predict(data)
        on_validation[name] = predict(replace(data, test=data.validation))
        names[name], times[name] = baseline.label, time.perf_counter() - began
    # A whole window from reset: before that the network's memory is not filled, and baselines lack history.
    skip = predictor.spec.window if spec.skip is None else spec.skip
    if data.task.features.starting:  # While the start is read there is nothing to predict.
        skip = max(skip, data.task.features.starting_ticks)
    ruler = _Ruler(data, skip)
    models = {
        name: {"label": names[name], "seconds": times[name], **ruler.measure(predicted)}
        for name, predicted in predictions.items()
    }
    for name, scores in _on_validation(on_validation, data, max(skip, spec.history)).items():
        models[name]["validation"] = scores
    coverages, bounds = predictor.spec.output.coverages, []
    if coverages:
        say("intervals")
        bounds = stream_intervals(predictor, data.test)
        models["network"]["intervals"] = ruler.intervals(bounds, coverages)
        shown = nearest_to_shown(coverages)
        bounds = [pair[:, shown] for pair in bounds]
    left = {"left_out": left_out} if left_out else {}
    scores = ruler.header() | {"models": models, "situation": situation_of(data)} | left
    return Evaluation(scores, predictions, data.test, bounds)


def _on_validation(predictions: dict[str, Predictions], data: Prepared, skip: int) -> dict[str, Any]:
    """Overall scores of baselines on the validation part, which also chose their sizes; none where it is too short."""
    if max((part.samples for part in data.validation), default=0) - data.task.max_horizon <= skip:
        return {}
    ruler = _Ruler(replace(data, test=data.validation), skip)
    return {name: ruler.measure(predicted)["overall"] for name, predicted in predictions.items()}


def _check_memory(predictor: Predictor, data: Prepared, spec: JudgeSpec) -> None:
    """Refuse more horizons than the memory holds the truth and all models' predictions of."""
    task, ticks = data.task, sum(series.samples for series in data.test)
    ends = len(task.horizons) * len(task.targets)
    each = 4 * (1 + len(spec.baselines) + 2 * len(predictor.spec.output.coverages)) + 3 * 8  # truth, errors: doubles
    check_setting(
        ticks * ends * each,
        f"judge: {ticks:,} ticks of {len(task.horizons):,} horizon(s) of {len(task.targets):,} target(s)",
        "judge fewer recordings, or predict fewer horizons",
    )


def baseline_predictions(kind: type[B], data: Prepared, spec: JudgeSpec) -> tuple[Callable[[Prepared], Predictions], B]:
    """A baseline fitted on the training part: what it predicts on the test part of this or other data, and itself."""
    baseline = kind(baseline_task(data, spec))
    baseline.fit(_as_baselines_read(data, data.train), _as_baselines_read(data, data.validation))
    return lambda other: [baseline.predict(part) for part in _as_baselines_read(other, other.test)], baseline


def score_predictions(predictions: Predictions, data: Prepared, skip: int) -> dict[str, Any]:
    """Scores of predictions ``(time, horizon, target)`` of each of ``data.test``, as `judge` gives them for a model.

    Args:
        predictions: in SI units.
        data: series with truth.
        skip: first ticks of each stretch that are not scored.

    Raises:
        DataError: no tick can be scored.
    """
    return _Ruler(data, skip).measure(predictions)


def baseline_task(data: Prepared, spec: JudgeSpec) -> BaselineTask:
    """The baselines' task: present values only where an input measures them, or a feature derived from one."""
    inputs = (*data.task.features.channels, *_derived(data))
    present = tuple(inputs.index(target) if target in inputs else None for target in data.task.targets)
    longest = min(series.samples for series in [*data.train, *data.test]) - data.task.max_horizon - 1
    # At most half of the shortest recording, so that every recording still has ticks to score.
    history = max(1, min(spec.history, longest // 2))
    return BaselineTask(horizons=data.task.horizons, present=present, history=history, seed=spec.seed)


def _derived(data: Prepared) -> list[str]:
    """Derived features that baselines read: those which their history of the channels does not hold.

    These are the targets' present values, and what is derived from channels that are hidden from the network: a
    comparison is fair only where both sides know the same.
    """
    features = data.task.features
    return [one.name for one in features.derived if one.name in data.task.targets or one.source in features.hidden]


def _as_baselines_read(data: Prepared, parts: Sequence[Series]) -> list[Series]:
    """Series whose inputs are channels and derived features: none hidden, none of the start or of a physics base."""
    names, own = _derived(data), len(data.task.features.channels)
    if not names and own == len(data.task.inputs):
        return list(parts)
    places = [*range(own), *(data.task.features.features.index(name) for name in names)]
    slot = Slot()
    return [replace(part, inputs=feature_columns(data.task, part, places, slot)) for part in parts]


class _Ruler:
    """Measures predictions in report units; the same ticks for every model that reaches them."""

    def __init__(self, data: Prepared, skip: int) -> None:
        self.data, self.skip = data, skip
        self.task = data.task
        facts = [KINDS[kind] for kind in data.target_kinds]
        self.units = [fact.report_unit for fact in facts]
        self.factors = np.array([fact.report_factor for fact in facts])
        reach = self.task.max_horizon
        self.truth = []
        for series in data.test:
            ticks = max(0, series.samples - reach)
            future = np.stack([series.targets[k : k + ticks] for k in self.task.horizons], axis=1)
            self.truth.append(future.astype(np.float64) * self.factors)
        if sum(max(0, len(truth) - skip) for truth in self.truth) == 0:
            raise DataError(
                f"no tick of the test recordings can be scored: the longest has {max(map(len, self.truth))} ticks "
                f"before the horizon, the first {skip} are start-up; give longer recordings"
            )
        pooled = np.concatenate([np.abs(truth[skip:, 0]).ravel() for truth in self.truth])
        # The last half per cent of speeds are single events; they would stretch the bins and leave them empty.
        self.edges = np.linspace(0.0, float(np.quantile(pooled, 0.995)) or 1.0, SPEED_BINS + 1)

    def header(self) -> dict[str, Any]:
        targets = zip(self.task.targets, self.data.descriptions, self.units, self.factors, strict=True)
        return {
            "schema": 1,
            "task": {
                "name": self.task.features.name,
                "horizons": list(self.task.horizons),
                "rate_hz": self.task.rate_hz,
                "mode": str(self.task.mode),
                "skip": self.skip,
            },
            "targets": [
                {"name": name, "description": text, "unit": unit, "factor": float(factor)}
                for name, text, unit, factor in targets
            ],
            "inputs": [
                {"name": c.name, "unit": KINDS[c.kind].report_unit, "factor": float(KINDS[c.kind].report_factor)}
                for c in self.data.inputs
            ],
        }

    def measure(self, predictions: Predictions) -> dict[str, Any]:
        """Scores of one model: overall, by recording with spread, by speed, and of running integrals."""
        predicted = [values[: len(truth)] * self.factors for values, truth in zip(predictions, self.truth, strict=True)]
        overall: dict[str, Any] = {}
        recordings: dict[str, Any] = {}
        spreads: dict[str, Any] = {}
        speeds: dict[str, Any] = {}
        for h, horizon in enumerate(self.task.horizons):
            pairs = [self._ticks(p[:, h], t[:, h]) for p, t in zip(predicted, self.truth, strict=True)]
            overall[str(horizon)] = self._scores([p for p, _ in pairs], [t for _, t in pairs])
            by_name = {}
            for series, (p, t) in zip(self.data.test, pairs, strict=True):
                if len(t):
                    by_name[series.name] = {str(horizon): self._of_recording(p, t)}
            for name, entry in by_name.items():
                recordings.setdefault(name, {}).update(entry)
            spreads[str(horizon)] = spread([entry[str(horizon)]["mean"]["mae"] for entry in by_name.values()])
            speeds[str(horizon)] = self._by_speed(pairs)
        scores = {"overall": overall, "recordings": recordings, "spread": spreads, "by_speed": speeds}
        return scores | ({"integrated": self._integrated(predicted)} if self.task.integrate else {})

    def intervals(self, bounds: Predictions, coverages: Sequence[float]) -> dict[str, Any]:
        """Share of the truth that each interval holds and its mean width, by horizon, coverage and target."""
        by_horizon: dict[str, Any] = {str(horizon): [] for horizon in self.task.horizons}
        truth = np.concatenate([values[self.skip :] for values in self.truth])
        for which, coverage in enumerate(coverages):
            parts = [pair[self.skip : len(t), which] for pair, t in zip(bounds, self.truth, strict=True)]
            lower, upper = np.moveaxis(np.concatenate(parts).astype(np.float64) * self.factors, 1, 0)
            for h, horizon in enumerate(self.task.horizons):
                each = [interval_scores(lower[:, h, i], upper[:, h, i], truth[:, h, i]) for i in range(truth.shape[-1])]
                covered, wide = (self._named(values) for values in zip(*each, strict=True))
                by_horizon[str(horizon)].append({"coverage": coverage, "covered": covered, "width": wide})
        return by_horizon

    def _named(self, values: Sequence[float]) -> dict[str, float]:
        return {"mean": float(np.mean(values)), **dict(zip(self.task.targets, values, strict=True))}

    def _ticks(self, predicted: NDArray[Any], truth: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
        """Scored ticks: after start-up and where the model has its history."""
        predicted, truth = predicted[self.skip :], truth[self.skip :]
        # A baseline without its history says NaN; a tick counts only where all targets are predicted.
        predicted_ticks = np.isfinite(predicted).all(axis=1)
        return predicted[predicted_ticks], truth[predicted_ticks]

    def _scores(self, predicted: Sequence[NDArray[Any]], truth: Sequence[NDArray[Any]]) -> dict[str, Any]:
        p, t = np.concatenate(predicted), np.concatenate(truth)
        each = [score(p[:, i], t[:, i]) for i in range(p.shape[1])]
        named: dict[str, Scores] = {"mean": mean_scores(each), **dict(zip(self.task.targets, each, strict=True))}
        return {name: values.to_json() for name, values in named.items()}

    def _of_recording(self, predicted: NDArray[Any], truth: NDArray[Any]) -> dict[str, Any]:
        """All scores of the mean over outputs; of each output the error alone: runs have hundreds of recordings."""
        scores = self._scores([predicted], [truth])
        return {name: values if name == "mean" else {"mae": values["mae"]} for name, values in scores.items()}

    def _by_speed(self, pairs: Sequence[tuple[NDArray[Any], NDArray[Any]]]) -> list[dict[str, Any]]:
        """Mean absolute error in bins of the target's magnitude, outputs pooled."""
        truth = np.concatenate([np.abs(t).ravel() for _, t in pairs])
        error = np.concatenate([np.abs(p - t).ravel() for p, t in pairs])
        # Speeds beyond the last edge belong to the last bin.
        bin_index = np.clip(np.digitize(truth, self.edges) - 1, 0, SPEED_BINS - 1)
        rows = []
        for i in range(SPEED_BINS):
            inside = bin_index == i
            mae = float(error[inside].mean()) if inside.any() else None
            low, high = float(self.edges[i]), float(self.edges[i + 1])
            rows.append({"low": low, "high": high, "count": int(inside.sum()), "mae": mae})
        return rows

    def _integrated(self, predicted: Predictions) -> dict[str, Any]:
        """Root mean square of the running integral's error, in report unit times seconds, per integrated target."""
        h = self.task.horizons.index(0)
        scores = {}
        for target in self.task.integrate:
            column = self.task.targets.index(target)
            errors = []
            for p, t in zip(predicted, self.truth, strict=True):
                difference = (p[:, h, column] - t[:, h, column])[self.skip :]
                # Ticks without a prediction add nothing to the integral; NaN would end it.
                errors.append(np.nancumsum(difference) / self.task.rate_hz)
            scores[target] = {"rmse": float(np.sqrt(np.mean(np.concatenate(errors) ** 2)))}
        return scores
