"""Scores of predictions against the truth, always in report units (mm/s for cylinder speeds)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from edp.errors import DataError

COMPOSITE_WEIGHTS = {"mae": 0.40, "rmse": 0.15, "p95": 0.25, "p99": 0.20}
"""Weights of the composite score, thesis eq. 3.41. They sum to one, so the score has the unit of the errors."""


@dataclass(frozen=True)
class Scores:
    """Errors of one output over all evaluated samples; every field except `r2` and `count` has the caller's unit.

    Attributes:
        mae: mean absolute error.
        rmse: root of the mean squared error.
        r2: coefficient of determination; None when the truth is constant, where it is not defined.
        p95: 95th percentile of the absolute error.
        p99: 99th percentile of the absolute error.
        composite: weighted sum of MAE, RMSE, P95 and P99, thesis eq. 3.41.
        bias: mean of prediction minus truth.
        count: number of evaluated samples.
    """

    mae: float
    rmse: float
    r2: float | None
    p95: float
    p99: float
    composite: float
    bias: float
    count: int

    def to_json(self) -> dict[str, float | int | None]:
        """Convert to JSON types: the fields by name, all finite or None."""
        return asdict(self)


@dataclass(frozen=True)
class Spread:
    """Order statistics of repeated measurements, e.g. one score over seeds; `std` is None for a single value."""

    median: float
    q25: float
    q75: float
    min: float
    max: float
    std: float | None


def composite(mae: float, rmse: float, p95: float, p99: float) -> float:
    """Return the weighted sum 0.4 MAE + 0.15 RMSE + 0.25 P95 + 0.20 P99, thesis eq. 3.41."""
    weights = COMPOSITE_WEIGHTS
    return weights["mae"] * mae + weights["rmse"] * rmse + weights["p95"] * p95 + weights["p99"] * p99


def score(prediction: ArrayLike, truth: ArrayLike) -> Scores:
    """Return the scores of one output.

    Sums and percentiles are exact and in double precision. In addition to its arguments, the function needs two
    double-precision arrays of their length (16 bytes per sample).

    Args:
        prediction: ``(sample,)`` in the unit in which the scores are wanted.
        truth: ``(sample,)`` in the same unit.

    Raises:
        DataError: the arrays are empty, not one-dimensional, of unequal length, or hold NaN or infinite values.
    """
    predicted, true = _vector(prediction, "prediction"), _vector(truth, "truth")
    if predicted.shape != true.shape:
        raise DataError(
            f"{predicted.size} predictions came for {true.size} true values; score equal ticks of both, in order"
        )
    error = np.subtract(predicted, true, dtype=np.float64)
    # Before the absolute value is taken in place.
    bias, squares = float(error.mean()), float(error @ error)
    r2 = _r2(squares, true)
    np.abs(error, out=error)
    mae, rmse = float(error.mean()), float(np.sqrt(squares / error.size))
    # The order of the errors is not needed any more, so the percentiles may partition them in place.
    p95, p99 = (float(value) for value in np.percentile(error, [95.0, 99.0], overwrite_input=True))
    return Scores(mae, rmse, r2, p95, p99, composite(mae, rmse, p95, p99), bias, int(error.size))


def interval_scores(lower: ArrayLike, upper: ArrayLike, truth: ArrayLike) -> tuple[float, float]:
    """Return the fraction of the true values between two bounds, and the mean distance of the bounds.

    Args:
        lower: ``(sample,)`` in the unit of the width.
        upper: upper bounds, same shape.
        truth: true values, same shape.

    Raises:
        DataError: the arrays are empty, not one-dimensional, of unequal length, or hold NaN or infinite values.
    """
    low, high, true = _vector(lower, "lower bound"), _vector(upper, "upper bound"), _vector(truth, "truth")
    if not low.shape == high.shape == true.shape:
        raise DataError(
            f"{low.size} lower and {high.size} upper bounds came for {true.size} true values; score equal ticks of all"
        )
    inside = np.greater_equal(true, low) & np.less_equal(true, high)
    return float(inside.mean()), float(np.subtract(high, low, dtype=np.float64).mean())


def interval_score(lower: ArrayLike, upper: ArrayLike, truth: ArrayLike, coverage: float) -> float:
    """Return the mean interval score: width, plus ``2 / (1 - coverage)`` times the distance of a true value outside.

    Least in expectation where the bounds are the true quantiles (Gneiting and Raftery 2007, eq. 43).

    Args:
        lower: ``(sample,)`` in the unit of the score.
        upper: upper bounds, same shape.
        truth: true values, same shape.
        coverage: intended fraction of the truth within the interval, between 0 and 1.

    Raises:
        DataError: see `interval_scores`; also for a coverage outside 0 to 1.
    """
    if not 0.0 < coverage < 1.0:
        raise DataError(f"coverage {coverage!r} came; a share between 0 and 1 must hold")
    _, width = interval_scores(lower, upper, truth)
    low, high, true = (np.asarray(values, dtype=np.float64) for values in (lower, upper, truth))
    outside = np.maximum(low - true, 0.0) + np.maximum(true - high, 0.0)
    return width + 2.0 / (1.0 - coverage) * float(outside.mean())


def weighted_interval_score(mae: float, scores: Mapping[float, float]) -> float:
    """Return the weighted interval score of a median and its intervals, in the unit of both.

    ``(mae / 2 + sum over intervals of (1 - coverage) / 2 score) / (1/2 + their number)``: the pinball loss, mean over
    the levels of median and bounds, times two. It is the mean absolute error of a prediction without intervals, and
    converges to the continuous ranked probability score (CRPS) for many intervals (Bracher et al. 2021).

    Args:
        mae: mean absolute error of the medians.
        scores: mean interval score by coverage, of the same samples.
    """
    total = 0.5 * mae + sum(0.5 * (1.0 - coverage) * each for coverage, each in scores.items())
    return total / (0.5 + len(scores))


def mean_scores(scores: Sequence[Scores]) -> Scores:
    """Return the mean over outputs (the thesis's mean over cylinders); `count` is the sum.

    `r2` is None if any output has none, because a mean over the others would not be comparable between runs.

    Raises:
        DataError: `scores` is empty.
    """
    if not scores:
        raise DataError("no scores to average; score at least one output")
    defined_r2 = [one.r2 for one in scores if one.r2 is not None]
    return Scores(
        mae=float(np.mean([one.mae for one in scores])),
        rmse=float(np.mean([one.rmse for one in scores])),
        r2=float(np.mean(defined_r2)) if len(defined_r2) == len(scores) else None,
        p95=float(np.mean([one.p95 for one in scores])),
        p99=float(np.mean([one.p99 for one in scores])),
        composite=float(np.mean([one.composite for one in scores])),
        bias=float(np.mean([one.bias for one in scores])),
        count=sum(one.count for one in scores),
    )


def spread(values: Sequence[float]) -> Spread:
    """Return the median, quartiles, extremes and sample standard deviation (n - 1) of repeated measurements.

    Raises:
        DataError: `values` is empty or holds NaN or infinite values.
    """
    finite = _vector(values, "list of measurements").astype(np.float64)
    q25, median, q75 = (float(value) for value in np.percentile(finite, [25.0, 50.0, 75.0]))
    deviation = float(finite.std(ddof=1)) if finite.size > 1 else None
    return Spread(median=median, q25=q25, q75=q75, min=float(finite.min()), max=float(finite.max()), std=deviation)


def _vector(values: ArrayLike, what: str) -> NDArray[np.generic]:
    """Return `values` as a non-empty, finite, one-dimensional array."""
    array = np.asarray(values)
    if array.ndim != 1:
        raise DataError(f"the {what} has shape {array.shape}; give one output at a time, as a one-dimensional array")
    if array.size == 0:
        raise DataError(f"the {what} is empty; score at least one sample")
    # min and max carry NaN and infinity and need no mask of the array's length.
    if not (np.isfinite(array.min()) and np.isfinite(array.max())):
        bad = ~np.isfinite(array)
        raise DataError(
            f"the {what} holds {int(bad.sum())} NaN or infinite values, the first at index {int(bad.argmax())}; "
            "leave out the warm-up ticks, and look for a diverged network if others remain"
        )
    return array


def _r2(squared_errors: float, truth: NDArray[np.generic]) -> float | None:
    """Return 1 - residual / total sum of squares, or None where the truth does not vary."""
    # Asked of the values themselves: the mean of a constant may differ from it by rounding.
    if truth.min() == truth.max():
        return None
    deviation = np.subtract(truth, truth.mean(dtype=np.float64), dtype=np.float64)
    total = float(deviation @ deviation)
    # Differences below about 1e-162 square to zero: numerically constant.
    return 1.0 - squared_errors / total if total > 0.0 and np.isfinite(squared_errors / total) else None
