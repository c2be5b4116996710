"""Errors of a method on the test part: the scores of Table 4.10, skew, and distributions (figures 4.9 and 4.11)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edp.data.prepared import Prepared
from edp.evaluation.judge import Predictions, score_predictions
from edp.evaluation.scores_file import MEAN, ByHorizon, metric
from edp.evaluation.transfer_file import ErrorDistribution
from edp.signals import KINDS

# An odd number, so that one bin is centred on zero error.
BINS = 81
SHOWN_S = 30.0
SHOWN_RECORDINGS = 3

Errors = dict[str, NDArray[np.float64]]


@dataclass(frozen=True)
class MeasuredMethod:
    """Scores of a method on a test part.

    Attributes:
        overall: scores by horizon and target in report units, with skewness and mean square of the errors.
        by_recording: mean absolute error over targets of each recording, by horizon.
    """

    overall: ByHorizon
    by_recording: Mapping[str, Mapping[str, float]]


def measure(predictions: Predictions, data: Prepared, skip: int) -> MeasuredMethod:
    """Return the scores of predictions on the test part."""
    scored = score_predictions(predictions, data, skip)
    overall = {}
    for horizon, errors in errors_of(predictions, data, skip).items():
        rows = scored.overall[horizon]
        own = {
            name: {"mse": metric(rows[name], "rmse") ** 2, "skew": skew(errors[:, index])}
            for index, name in enumerate(data.task.targets)
        }
        own[MEAN] = {key: float(np.mean([row[key] for row in own.values()])) for key in ("mse", "skew")}
        overall[horizon] = {name: {**row, **own[name]} for name, row in rows.items()}
    by_recording = {
        name: {horizon: metric(row[MEAN], "mae") for horizon, row in by_horizon.items()}
        for name, by_horizon in scored.recordings.items()
    }
    return MeasuredMethod(overall, by_recording)


def errors_of(predictions: Predictions, data: Prepared, skip: int) -> Errors:
    """Return the prediction minus truth of all scored ticks by horizon, ``(tick, target)``, report units."""
    factors = np.array([KINDS[kind].report_factor for kind in data.target_kinds])
    errors = {}
    for index, horizon in enumerate(data.task.horizons):
        parts = []
        for values, series in zip(predictions, data.test, strict=True):
            ticks = series.samples - data.task.max_horizon
            truth = series.targets[horizon : horizon + max(0, ticks)].astype(np.float64)
            error = (values[: len(truth), index].astype(np.float64) - truth) * factors
            parts.append(error[skip:][np.isfinite(error[skip:]).all(axis=1)])
        errors[str(horizon)] = np.concatenate(parts)
    return errors


def skew(errors: NDArray[np.float64]) -> float:
    """Return the third standardised moment; 0 for errors that are all alike."""
    centred = errors - errors.mean()
    deviation = float(np.sqrt(np.mean(centred**2)))
    return float(np.mean((centred / deviation) ** 3)) if deviation > 0 else 0.0


def distributions(errors: Mapping[str, Errors], targets: Sequence[str]) -> dict[str, dict[str, ErrorDistribution]]:
    """Share of ticks by error, on edges that all methods have in common.

    Args:
        errors: errors of each method, see `errors_of`.
        targets: names.

    Returns:
        Histograms by horizon and target; errors beyond the edges are in no bin.
    """
    histograms: dict[str, dict[str, ErrorDistribution]] = {}
    for horizon in next(iter(errors.values())):
        histograms[horizon] = {}
        for index, target in enumerate(targets):
            # The outermost half per cent is cut off: single outliers would squeeze all others into one bin.
            reach = (
                max(
                    float(np.quantile(np.abs(method_errors[horizon][:, index]), 0.995))
                    for method_errors in errors.values()
                )
                or 1.0
            )
            edges = np.linspace(-reach, reach, BINS + 1)
            shares = {
                name: tuple((np.histogram(rows[horizon][:, index], edges)[0] / len(rows[horizon])).tolist())
                for name, rows in errors.items()
            }
            histograms[horizon][target] = ErrorDistribution(edges=tuple(edges.tolist()), shares=shares)
    return histograms


def excerpts(predictions: Mapping[str, Predictions], data: Prepared, skip: int) -> dict[str, NDArray[np.float32]]:
    """Return the segments of the test part with the most movement of targets: truth and predictions, SI units.

    Returns:
        ``NAME/truth`` ``(time, horizon, target)`` at t + k, ``NAME/METHOD`` the predictions made at t, and
        ``NAME/start`` ``(1,)``, the second of the recording's part at which it begins.
    """
    size = round(SHOWN_S * data.task.rate_hz)
    candidates = []
    for number, series in enumerate(data.test):
        ticks = series.samples - data.task.max_horizon
        # Half-overlapping stretches: the liveliest one may lie across a boundary.
        for start in range(skip, max(skip + 1, ticks - size + 1), max(1, size // 2)):
            stop = min(start + size, ticks)
            if stop > start:
                moved = series.targets[start:stop].astype(np.float64)
                candidates.append((float(moved.std(axis=0).sum()), number, start, stop))
    best: dict[int, tuple[float, int, int, int]] = {}
    for entry in candidates:
        # One stretch a recording, so that pictures show different drives.
        best[entry[1]] = max(entry, best.get(entry[1], entry))
    excerpt_arrays: dict[str, NDArray[np.float32]] = {}
    for _, number, start, stop in sorted(best.values(), reverse=True)[:SHOWN_RECORDINGS]:
        series = data.test[number]
        truth = np.stack([series.targets[start + k : stop + k] for k in data.task.horizons], axis=1)
        excerpt_arrays[f"{series.name}/truth"] = np.ascontiguousarray(truth, dtype=np.float32)
        excerpt_arrays[f"{series.name}/start"] = np.array([start / data.task.rate_hz], dtype=np.float32)
        for name, values in predictions.items():
            excerpt_arrays[f"{series.name}/{name}"] = np.ascontiguousarray(values[number][start:stop], dtype=np.float32)
    return excerpt_arrays
