import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from edp.stats.metrics import score

FINITE = st.floats(-1e4, 1e4, allow_nan=False, width=32)
PAIRS = st.integers(1, 60).flatmap(
    lambda size: st.tuples(arrays(np.float32, size, elements=FINITE), arrays(np.float32, size, elements=FINITE))
)
small = settings(max_examples=60, deadline=None)


@small
@given(PAIRS)
def test_errors_are_ordered_and_the_composite_is_bounded(pair):
    got = score(*pair)
    slack = 1e-9 * (1.0 + got.rmse)
    assert abs(got.bias) <= got.mae + slack
    assert got.mae <= got.rmse + slack
    assert got.p95 <= got.p99 + slack
    assert got.composite >= 0.55 * got.mae - slack
    assert got.composite <= float(np.abs(pair[0].astype(float) - pair[1]).max()) + slack
    assert got.r2 is None or got.r2 <= 1.0


@small
@given(PAIRS, st.sampled_from([0.5, 2.0, 1024.0]))
def test_a_change_of_unit_scales_errors_and_keeps_r2(pair, factor):
    prediction, truth = pair[0].astype(float), pair[1].astype(float)
    one, other = score(prediction, truth), score(prediction * factor, truth * factor)
    assert other.composite == pytest.approx(one.composite * factor, rel=1e-9)
    if one.r2 is not None and other.r2 is not None:
        assert other.r2 == pytest.approx(one.r2, rel=1e-6, abs=1e-9)


@small
@given(PAIRS, st.randoms(use_true_random=False))
def test_order_of_samples_does_not_matter(pair, random):
    order = list(range(len(pair[0])))
    random.shuffle(order)
    one, other = score(*pair), score(pair[0][order], pair[1][order])
    assert other.p95 == one.p95
    assert other.p99 == one.p99
    assert other.composite == pytest.approx(one.composite, rel=1e-9, abs=1e-12)


@small
@given(PAIRS)
def test_swapping_prediction_and_truth_flips_only_the_bias(pair):
    one, other = score(*pair), score(pair[1], pair[0])
    assert other.bias == pytest.approx(-one.bias, rel=1e-9, abs=1e-12)
    assert other.composite == pytest.approx(one.composite, rel=1e-9, abs=1e-12)
