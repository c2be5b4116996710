import json
from dataclasses import asdict
from statistics import NormalDist

import numpy as np
import pytest
from sklearn import metrics as sk

from edp.errors import DataError
from edp.stats.metrics import (
    COMPOSITE_WEIGHTS,
    Scores,
    composite,
    interval_score,
    interval_scores,
    mean_scores,
    score,
    spread,
    weighted_interval_score,
)


@pytest.fixture
def pair() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(3)
    truth = rng.normal(20.0, 100.0, size=4001)
    return truth + rng.standard_t(3, size=4001) + 0.5, truth


def test_scores_match_independent_formulas(pair):
    prediction, truth = pair
    got = score(prediction, truth)
    assert got.mae == pytest.approx(sk.mean_absolute_error(truth, prediction), rel=1e-12)
    assert got.rmse == pytest.approx(sk.root_mean_squared_error(truth, prediction), rel=1e-12)
    assert got.r2 == pytest.approx(sk.r2_score(truth, prediction), rel=1e-12)
    ordered = np.sort(np.abs(prediction - truth))
    # 4000 intervals, so both percentiles are samples and need no interpolation.
    assert got.p95 == ordered[3800]
    assert got.p99 == ordered[3960]
    assert got.bias == pytest.approx(prediction.mean() - truth.mean(), abs=1e-10)
    assert got.count == 4001


def test_composite_is_equation_3_41():
    assert composite(1.0, 2.0, 3.0, 4.0) == pytest.approx(0.4 + 0.3 + 0.75 + 0.8)
    assert sum(COMPOSITE_WEIGHTS.values()) == pytest.approx(1.0)
    assert score(np.full(50, 3.0), np.arange(50) * 0.0).composite == pytest.approx(3.0)


def test_arguments_are_left_as_they_were(pair):
    prediction, truth = (values.copy() for values in pair)
    score(prediction, truth)
    np.testing.assert_array_equal(prediction, pair[0])
    np.testing.assert_array_equal(truth, pair[1])


def test_float32_is_summed_in_double_precision():
    truth = np.full(2_000_000, 1e5, dtype=np.float32)
    truth[0] = 0.0
    got = score(truth + np.float32(0.125), truth)
    assert got.mae == 0.125
    assert got.bias == 0.125
    assert got.r2 is not None


def test_constant_truth_has_no_r2_and_fits_into_json():
    got = score(np.array([0.1, 0.2, 0.3]), np.full(3, 0.1))
    assert got.r2 is None
    assert json.loads(json.dumps(got.to_json(), allow_nan=False))["r2"] is None


def test_perfect_prediction():
    truth = np.array([1.0, 2.0, 4.0])
    assert score(truth, truth) == Scores(0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 3)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_values_that_are_not_finite_are_refused(bad):
    values = np.zeros(5)
    broken = values.copy()
    broken[3] = bad
    with pytest.raises(DataError, match=r"prediction holds 1 .* first at index 3"):
        score(broken, values)
    with pytest.raises(DataError, match="truth holds"):
        score(values, broken)


@pytest.mark.parametrize(
    ("prediction", "truth", "message"),
    [([], [], "empty"), ([1.0], [1.0, 2.0], "1 predictions .* 2 true"), ([[1.0]], [[1.0]], "one output at a time")],
)
def test_shapes_are_checked(prediction, truth, message):
    with pytest.raises(DataError, match=message):
        score(prediction, truth)


def test_mean_over_outputs(pair):
    first, second = score(*pair), score(pair[0] * 1.1, pair[1])
    mean = mean_scores([first, second])
    assert mean.mae == pytest.approx((first.mae + second.mae) / 2)
    assert mean.r2 == pytest.approx((first.r2 + second.r2) / 2)
    assert mean.composite == pytest.approx(composite(mean.mae, mean.rmse, mean.p95, mean.p99))
    assert mean.count == 8002
    still = score([1.0, 2.0], [1.0, 1.0])
    assert mean_scores([first, still]).r2 is None
    with pytest.raises(DataError, match="no scores"):
        mean_scores([])


def test_spread():
    assert asdict(spread([4.0, 1.0, 2.0, 3.0, 5.0])) == {
        "median": 3.0,
        "q25": 2.0,
        "q75": 4.0,
        "min": 1.0,
        "max": 5.0,
        "std": pytest.approx(2.5**0.5),
    }
    assert spread([2.0]).std is None
    with pytest.raises(DataError, match="NaN"):
        spread([1.0, float("nan")])


def test_interval_scores_by_hand():
    """Width 2; the second value lies 1 below and the third 3 above: (0 + 1 + 3) / 3 times 2 / 0.1."""
    low, high, truth = np.zeros(3), np.full(3, 2.0), np.array([1.0, -1.0, 5.0])
    assert interval_score(low, high, truth, 0.9) == pytest.approx(2.0 + 20.0 * 4.0 / 3.0)
    for coverage in (0.0, 1.0, float("nan")):
        with pytest.raises(DataError, match="between 0 and 1"):
            interval_score(low, high, truth, coverage)


def test_true_quantiles_have_the_least_interval_score():
    truth = np.random.default_rng(0).normal(size=20_000)

    def score_of(reach):
        return interval_score(np.full(truth.shape, -reach), np.full(truth.shape, reach), truth, 0.9)

    assert score_of(1.645) < min(score_of(1.3), score_of(2.0))


def test_a_weighted_interval_score_is_twice_the_mean_pinball_loss_and_nears_the_crps():
    """Of a point it is the absolute error; of many intervals of N(0, 1) its CRPS, 0.5642 in expectation."""
    assert weighted_interval_score(3.0, {}) == 3.0
    truth, levels = np.random.default_rng(1).normal(size=20_000), (np.arange(1, 100) / 100)
    normal = NormalDist()
    bounds = {c: normal.inv_cdf(0.5 + c / 2) for c in (2 * levels[levels > 0.5] - 1).tolist()}
    scores = {
        c: interval_score(np.full(truth.shape, -reach), np.full(truth.shape, reach), truth, c)
        for c, reach in bounds.items()
    }
    ours = weighted_interval_score(float(np.abs(truth).mean()), scores)
    quantiles = np.array([normal.inv_cdf(level) for level in levels])
    off = truth[:, None] - quantiles
    assert ours == pytest.approx(2 * np.maximum(levels * off, (levels - 1) * off).mean(), rel=1e-9)
    assert ours == pytest.approx(0.5642, rel=0.03)


def test_intervals_count_what_lies_between_their_bounds():
    truth = np.array([0.0, 1.0, 2.0, 3.0])
    covered, width = interval_scores(np.array([0.0, 1.5, 1.0, 0.0]), np.array([1.0, 2.0, 2.0, 1.0]), truth)
    assert (covered, width) == (0.5, 0.875)
    with pytest.raises(DataError, match="4 lower and 3 upper bounds came for 4 true values"):
        interval_scores(truth, truth[1:], truth)
    with pytest.raises(DataError, match="the upper bound holds 1 NaN"):
        interval_scores(truth, np.array([0.0, np.nan, 0.0, 0.0]), truth)
