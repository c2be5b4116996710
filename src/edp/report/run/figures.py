"""Data of each figure as plain values: aligned, downsampled, binned; `charts` gives their look."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from tsdownsample import MinMaxLTTBDownsampler

from edp.evaluation.guard import MEASURE
from edp.evaluation.scores_file import MEAN, ModelScores, SpeedBin, error_at
from edp.report.run.facts import HIGH, INPUTS, LOW, NETWORK, NO_MODELS, TRUTH, Facts, main_horizon, score

WHOLE, EXCERPT = "whole", "excerpt"
POINT_BUDGET = 250_000  # of all prediction traces together: about 2 MB of the page
RECORDINGS_SHOWN, HORIZONS_SHOWN = 6, 4
MIN_POINTS = 200  # of a trace: fewer no longer show its shape
EXCERPT_SECONDS = 12.0
Array = NDArray[np.floating]


@dataclass(frozen=True)
class Line:
    """One trace of the prediction figure.

    Attributes:
        horizon: Samples ahead; None for the truth, which every horizon shares.
        target: Place of the output among the data' targets.
        x: (point,) seconds, or samples where the rate is unknown.
        y: (point,) report units; NaN breaks the line.
        start: First sample and `step`: set instead of `x` where every sample is shown.
        low, high: (point,) ends of the interval, report units; None without one.
    """

    recording: str
    extent: str
    model: str
    horizon: int | None
    target: int
    y: Array
    x: Array | None = None
    start: float = 0.0
    step: float = 1.0
    low: Array | None = None
    high: Array | None = None


def horizons_shown(facts: Facts) -> list[int]:
    """Return the horizons of figures with a choice, shortest first: all, or a few including both ends."""
    return some_of(sorted(facts.horizons), HORIZONS_SHOWN)


def some_of(items: Sequence[int], most: int) -> list[int]:
    """Return at most `most` items of a sequence, evenly spread, with both ends."""
    if len(items) <= most:
        return list(items)
    return [items[i] for i in np.unique(np.linspace(0, len(items) - 1, most).round().astype(int))]


def aligned(predicted: Array, horizon: int) -> Array:
    """Move predictions to the time that they predict: row t holds the value stated at t - horizon; NaN without one.

    Args:
        predicted: (time, ...) prediction made at t for t + horizon.
        horizon: Samples ahead, 0 or more.
    """
    moved = np.full_like(predicted, np.nan)
    if horizon < len(predicted):
        moved[horizon:] = predicted[: len(predicted) - horizon]
    return moved


def downsample(y: Array, points: int) -> NDArray[np.intp]:
    """Return indices of about `points` samples that keep the shape of a line, peaks included.

    MinMaxLTTB on the finite samples; the first sample of each inner gap is kept too, so that a drawn line breaks there.
    """
    finite = np.flatnonzero(np.isfinite(y))
    if len(finite) == 0:
        return np.empty(0, dtype=np.intp)
    gaps = finite[:-1][np.diff(finite) > 1] + 1
    if len(finite) <= points:
        selected = finite
    else:
        values = np.ascontiguousarray(y[finite], dtype=np.float64)
        chosen = MinMaxLTTBDownsampler().downsample(finite.astype(np.float64), values, n_out=points)
        selected = finite[chosen.astype(np.intp)]
    return np.union1d(selected, gaps[:points]).astype(np.intp)


def busiest_start(truth: Array, length: int) -> int:
    """Return the first sample of the segment of `length` samples with the largest movement of the outputs.

    Args:
        truth: (time, target); each output counts in units of its own standard deviation.
        length: Samples in the segment.
    """
    if len(truth) <= length:
        return 0
    values = np.nan_to_num(truth)
    deviation = values.std(axis=0)
    travel = (np.abs(np.diff(values, axis=0)) / np.where(deviation > 0, deviation, 1.0)).sum(axis=1)
    run = np.concatenate([[0.0], np.cumsum(travel)])
    return int(np.argmax(run[length - 1 :] - run[: len(run) - length + 1]))


def prediction_lines(facts: Facts, budget: int = POINT_BUDGET) -> list[Line]:
    """Return truth and predictions of a few recordings: each whole, downsampled, and its busiest segment in full.

    All traces together hold about `budget` points, so that the page stays small whatever the run holds.
    """
    recordings = sorted(facts.predictions)[:RECORDINGS_SHOWN]
    horizons = horizons_shown(facts)
    each = len(facts.targets) * (1 + len(horizons) * max((_count_lines(facts, name) for name in recordings), default=0))
    # Many outputs: fewer recordings, so that what is drawn keeps its shape and the page its size.
    recordings = recordings[: max(1, budget // (2 * MIN_POINTS * max(each, 1)))]
    models = sum(_count_lines(facts, name) for name in recordings)
    traces = len(facts.targets) * (len(recordings) + models * len(horizons))
    if traces == 0 or not horizons:
        return []
    points = int(np.clip(budget // (2 * traces), MIN_POINTS, 2000))
    lines: list[Line] = []
    for recording in recordings:
        truth = facts.predictions[recording][TRUTH]
        rate = facts.rate_hz or 1.0
        length = min(round(EXCERPT_SECONDS * rate), points)
        first = busiest_start(truth, length)
        for model, horizon, values in _series(facts, recording, horizons):
            for output, target in enumerate(facts.targets):
                y = np.asarray(values[:, output] * target.factor + target.offset, dtype=np.float32)
                ends = _ends(facts, recording, model, horizon, output)
                selected, cut = downsample(y, points), slice(first, first + length)
                at = (selected / rate).astype(np.float32)
                low, high = (None if end is None else end[selected] for end in ends)
                lines.append(Line(recording, WHOLE, model, horizon, output, y[selected], at, low=low, high=high))
                low, high = (None if end is None else end[cut] for end in ends)
                lines.append(
                    Line(recording, EXCERPT, model, horizon, output, y[cut], None, first / rate, 1.0 / rate, low, high)
                )
    return lines


def _count_lines(facts: Facts, recording: str) -> int:
    """Count the lines of a recording next to its truth, for each horizon and output."""
    return len(facts.predictions[recording].keys() - {TRUTH, INPUTS})


def _series(facts: Facts, recording: str, horizons: Sequence[int]) -> list[tuple[str, int | None, Array]]:
    """Return (model, horizon, (time, target)) of the truth, the baselines and, on top, the network."""
    parts = facts.predictions[recording]
    series: list[tuple[str, int | None, Array]] = [(TRUTH, None, parts[TRUTH])]
    for name in sorted(parts.keys() - NO_MODELS, key=lambda name: name == NETWORK):
        for horizon in horizons:
            series.append((name, horizon, aligned(parts[name][:, facts.horizons.index(horizon)], horizon)))
    return series


def _ends(facts: Facts, recording: str, model: str, horizon: int | None, output: int) -> tuple[Array | None, ...]:
    """Return (time,) both ends of the network's interval at the moments it speaks of, report units.

    None without one.
    """
    parts = facts.predictions[recording]
    if model != NETWORK or horizon is None or LOW not in parts or HIGH not in parts:
        return None, None
    column, target = facts.horizons.index(horizon), facts.targets[output]
    ends = (aligned(parts[name][:, column, output], horizon) for name in (LOW, HIGH))
    return tuple(np.asarray(end * target.factor + target.offset, dtype=np.float32) for end in ends)


@dataclass(frozen=True)
class Histogram:
    """Shares of the residuals of one model, horizon and output, in equal bins.

    Attributes:
        centres: (bin,) report units.
        share: (bin,) share of all residuals, so that what lies outside the bins counts too.
        outside: Share of the residuals beyond the first and last bin.
    """

    model: str
    horizon: int
    target: int
    centres: Array
    share: Array
    outside: float
    mean: float
    deviation: float


def residual_histograms(facts: Facts, bins: int = 61) -> list[Histogram]:
    """Return histograms of prediction minus truth over the stored recordings.

    Bins span 99 % of the network's residuals.
    """
    histograms: list[Histogram] = []
    models = {name for parts in facts.predictions.values() for name in parts} - NO_MODELS
    order = sorted(models, key=lambda name: name != NETWORK)
    for horizon in horizons_shown(facts):
        for output, target in enumerate(facts.targets):
            reach = 0.0
            for model in order:
                errors = _residuals(facts, model, horizon, output) * target.factor
                if len(errors) == 0:
                    continue
                reach = reach or float(np.quantile(np.abs(errors), 0.99)) or 1e-9
                counts, edges = np.histogram(errors, bins=bins, range=(-reach, reach))
                share = counts / len(errors)
                centres = (edges[:-1] + edges[1:]) / 2
                outside = max(1.0 - float(share.sum()), 0.0)
                mean, deviation = float(errors.mean()), float(errors.std())
                histograms.append(Histogram(model, horizon, output, centres, share, outside, mean, deviation))
    return histograms


def _residuals(facts: Facts, model: str, horizon: int, output: int) -> Array:
    parts = [recording for recording in facts.predictions.values() if model in recording]
    column = facts.horizons.index(horizon)
    errors = [aligned(part[model][:, column, output], horizon) - part[TRUTH][:, output] for part in parts]
    joined = np.concatenate(errors).astype(np.float64) if errors else np.empty(0)
    return joined[np.isfinite(joined)]


def horizon_curves(facts: Facts) -> dict[str, list[tuple[float, float]]]:
    """Return error (`MEASURE`) of each model against the horizon: name -> (milliseconds or samples, report units)."""
    scale = 1000.0 / facts.rate_hz if facts.rate_hz else 1.0
    curves: dict[str, list[tuple[float, float]]] = {}
    for name, model in facts.models.items():
        points = [(k * scale, score(model, k)) for k in sorted(facts.horizons)]
        curve = [(x, error) for x, error in points if error is not None]
        if curve:
            curves[name] = curve
    return curves


def speed_bands(facts: Facts, horizon: int) -> dict[str, tuple[SpeedBin, ...]]:
    """Return the errors of each model by speed."""
    bands = {name: model.by_speed.get(str(horizon), ()) for name, model in facts.models.items()}
    return {name: rows for name, rows in bands.items() if rows}


def recording_errors(facts: Facts, horizon: int) -> tuple[list[str], dict[str, list[float | None]]]:
    """Return recordings sorted by the network's error, worst last, and each model's errors in that order."""

    def error(model: ModelScores, recording: str) -> float | None:
        return error_at(model.recordings.get(recording, {}), horizon, MEAN, MEASURE)

    scored = {name: model for name, model in facts.models.items() if model.recordings}
    lead = scored.get(NETWORK) or next(iter(scored.values()), None)
    keys = [] if lead is None else [(error(lead, recording), recording) for recording in lead.recordings]
    order = [recording for _, recording in sorted((value, key) for value, key in keys if value is not None)]
    return order, {name: [error(model, recording) for recording in order] for name, model in scored.items()}


def log_ticks(values: Sequence[float | None]) -> list[float]:
    """Return the ticks of a logarithmic axis: 1, 2 and 5 per decade, or 1 for many decades; empty with a value <= 0."""
    present = [value for value in values if value is not None]
    if not present or min(present) <= 0:
        return []
    low, high = math.floor(math.log10(min(present))), math.ceil(math.log10(max(present)))
    steps = (1, 2, 5) if high - low <= 3 else (1,)
    return [step * 10.0**decade for decade in range(low, high + 1) for step in steps]


def headline_first(facts: Facts) -> list[int]:
    """Return the horizons to choose from in the figures, the headline's first."""
    main = main_horizon(facts)
    return sorted(horizons_shown(facts), key=lambda k: (k != main, k))
