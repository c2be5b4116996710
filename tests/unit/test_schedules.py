import itertools
import math

import pytest

from edp.training.schedules import SCHEDULES, Constant, Cosine, OneCycle, Plateau, ScheduleState

GRID = [i / 200 for i in range(201)]


@pytest.mark.parametrize("name", list(SCHEDULES))
def test_factors_stay_within_the_base_rate(name):
    spec, state = SCHEDULES[name](), ScheduleState()
    factors = [spec.rate_factor(share, state) for share in GRID]
    assert all(0 < factor <= 1 for factor in factors)
    assert [spec.rate_factor(share, state) for share in GRID] == factors


def test_cosine_rises_in_its_warm_up_and_falls_to_its_floor():
    spec, state = Cosine(warmup=0.1, min_lr_ratio=0.02), ScheduleState()
    factors = [spec.rate_factor(share, state) for share in GRID]
    assert factors[0] < 0.02
    assert factors[20] == pytest.approx(1.0)
    assert factors[-1] == pytest.approx(0.02)
    assert all(later >= earlier for earlier, later in itertools.pairwise(factors[:21]))
    assert all(later <= earlier for earlier, later in itertools.pairwise(factors[20:]))
    assert spec.rate_factor(0.55, state) == pytest.approx((1 + 0.02) / 2)
    assert Cosine(warmup=0.0).rate_factor(0.0, state) == pytest.approx(1.0)


def test_one_cycle_starts_peaks_and_ends_where_it_says():
    spec, state = OneCycle(warmup=0.3, start_lr_ratio=0.04, min_lr_ratio=1e-3), ScheduleState()
    assert spec.rate_factor(0.0, state) == pytest.approx(0.04)
    assert spec.rate_factor(0.3, state) == pytest.approx(1.0)
    assert spec.rate_factor(1.0, state) == pytest.approx(1e-3)


def test_constant_is_constant_after_its_warm_up():
    assert Constant().rate_factor(0.0, ScheduleState()) == 1.0
    assert Constant(warmup=0.5).rate_factor(0.25, ScheduleState()) == pytest.approx(0.5, rel=0.01)
    assert Constant(warmup=0.5).rate_factor(0.75, ScheduleState()) == 1.0


def test_plateau_shrinks_after_its_patience_and_never_below_its_floor():
    spec, state = Plateau(factor=0.5, patience=2, threshold=0.01, min_lr_ratio=0.2), ScheduleState()
    spec.observe(1.0, state)
    for score in (0.995, 0.999):  # less than the threshold better: no improvement
        spec.observe(score, state)
    assert state.factor == 1.0
    spec.observe(1.1, state)
    assert state.factor == 0.5
    spec.observe(0.5, state)
    for _ in range(12):
        spec.observe(math.inf, state)
    assert spec.rate_factor(0.9, state) == 0.2
