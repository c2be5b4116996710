"""Variances, sample sizes, folds, races, the efficiency rule."""

import math

import numpy as np
import pytest

from edp.errors import ConfigError, DataError
from edp.stats import (
    INTERIM_ANALYSES,
    InterimAnalysis,
    PairedVariance,
    SizeScore,
    clustered_t,
    most_efficient,
    paired_variance,
    plan_runs,
    power,
    race,
    race_rates,
    repeated_folds,
    repeated_splits,
    seed_correlation,
    simulate_differences,
    simulated_power,
    split_variance,
    thesis_plan,
    thesis_power,
    thesis_splits_analytical,
    thesis_variance,
)

WORLD = PairedVariance(session=0.04**2, run=0.03**2, cell=0.05**2)


def test_thesis_variance_by_hand_and_its_bias():
    table = np.array([[1.0, 2.0, 3.0], [4.0, 6.0, 8.0]])
    found = thesis_variance(table)
    assert found.mean == 4.0
    assert found.split == pytest.approx(math.sqrt(8.0))
    assert found.seed == pytest.approx((1.0 + 2.0) / 2)
    assert thesis_variance(table[:, :1]).seed is None
    drawn = np.random.default_rng(0).normal(size=(4000, 3))
    assert thesis_variance(drawn).seed == pytest.approx(0.886, abs=0.02)  # c4(3)
    assert split_variance(drawn).seed == pytest.approx(1.0, abs=0.02)


def test_split_variance_is_net_of_seeds():
    rng = np.random.default_rng(1)
    table = 2.0 * rng.normal(size=(3000, 1)) + rng.normal(size=(3000, 3))
    found = split_variance(table)
    assert found.split == pytest.approx(2.0, rel=0.04)
    assert thesis_variance(table).split == pytest.approx(math.sqrt(4.0 + 1 / 3), rel=0.04)


def test_intervals_of_the_variances_hold_the_truth_as_often_as_they_say():
    rng = np.random.default_rng(2)
    tables = 2.0 * rng.normal(size=(400, 6, 1)) + rng.normal(size=(400, 6, 3))
    found = [split_variance(table) for table in tables]
    one_seed = [split_variance(table[:, :1]) for table in tables]
    covered = [
        np.mean([one.split_interval[0] <= 2.0 <= one.split_interval[1] for one in found]),
        np.mean([one.seed_interval[0] <= 1.0 <= one.seed_interval[1] for one in found]),
        np.mean([one.split_interval[0] <= math.sqrt(5.0) <= one.split_interval[1] for one in one_seed]),
    ]
    assert all(0.91 <= share <= 0.985 for share in covered), covered  # 95 % of 400, four standard errors


def test_paired_variances_are_found_again():
    mask = repeated_folds(25, 5, 4)
    draws = simulate_differences(WORLD, mask, 0.0, 200, np.random.default_rng(3))
    found = np.array([(v.session, v.run, v.cell) for v in (paired_variance(d, mask) for d in draws)]).mean(axis=0)
    assert found == pytest.approx([WORLD.session, WORLD.run, WORLD.cell], rel=0.1)


def test_common_random_numbers_show_as_correlation():
    rng = np.random.default_rng(4)
    common, own = rng.normal(size=(2000, 3)), rng.normal(size=(2, 2000, 3))
    assert seed_correlation(common + own[0], common + own[1]) == pytest.approx(0.5, abs=0.05)


def test_closed_form_power_is_the_simulated_one():
    for repeats in (3, 6):
        closed = power(0.02, WORLD, 25, 5 * repeats, 5, 0.05)
        assert simulated_power(0.02, WORLD, repeated_folds(25, 5, repeats)) == pytest.approx(closed, abs=0.045)


def test_plan_reaches_its_target_with_no_repeat_too_many():
    plan = plan_runs(0.02, WORLD, 60)
    assert plan.runs % 5 == 0
    assert plan.power >= 0.80 > power(0.02, WORLD, 60, plan.runs - 5, 5, 0.05)


def test_plan_says_when_no_number_of_runs_suffices():
    plan = plan_runs(0.02, WORLD, 10)
    assert plan.runs is None
    assert "no number of runs suffices" in plan.reason
    assert power(0.02, WORLD, plan.sessions_needed, math.inf, 5, 0.05) >= 0.80
    assert power(0.02, WORLD, plan.sessions_needed - 1, math.inf, 5, 0.05) < 0.80
    assert power(0.02, WORLD, 10, 10_000, 5, 0.05) < 0.80
    hopeless = plan_runs(1e-6, WORLD, 10)
    assert hopeless.sessions_needed is None
    capped = plan_runs(0.02, WORLD, 60, most=12)
    assert capped.runs is None
    assert "10 runs, the most allowed" in capped.reason


def test_folds_judge_every_session_once_a_repeat():
    mask = repeated_folds(13, 5, 4, seed=7)
    assert mask.shape == (20, 13)
    assert (mask.reshape(4, 5, 13).sum(axis=1) == 1).all()
    assert set(mask.sum(axis=1)) == {2, 3}
    assert (repeated_folds(13, 5, 2, seed=7) == mask[:10]).all()  # a study can go on
    assert len({mask[5 * i : 5 * i + 5].tobytes() for i in range(4)}) == 4  # a new partition each time
    assert (repeated_splits(25, 5, 10).sum(axis=1) == 5).all()


def test_race_drops_at_the_look_and_judges_the_rest_as_ever():
    mask = repeated_folds(25, 5, 6)
    rng = np.random.default_rng(5)
    draws = simulate_differences(WORLD, mask, [[[-0.08]]], 2, rng)
    draws[1] += 0.16
    result = race(draws, mask)
    assert result.dropped_after.tolist() == [0, 5]
    assert result.runs.tolist() == [30, 5]
    assert result.p[0] == clustered_t(draws[0], mask).p
    assert result.p[1] == 1.0
    later = draws.copy()
    later[1, 5:] = -9.0  # runs that were never made cannot bring it back
    assert race(later, mask).p[1] == 1.0


def test_race_spends_no_alpha_and_saves_runs():
    mask = repeated_folds(25, 5, 6)
    null = race_rates(0.0, WORLD, mask, repetitions=800)
    assert null.confirmed <= null.confirmed_without
    assert null.confirmed <= 0.05 + 3 * math.sqrt(0.05 * 0.95 / 800)
    assert null.mean_runs < 12
    assert sum(null.dropped.values()) <= 1.0
    strong = race_rates(0.06, WORLD, mask, repetitions=400)
    assert strong.confirmed > 0.95
    assert race_rates(0.0, WORLD, mask, interim_analyses=(), repetitions=50).mean_runs == 30


def test_smallest_network_that_a_larger_one_does_not_repay():
    # The thesis at k = 1: 512 units bring 13 % for 15 times the parameters of 128 units, and it takes 128.
    units = {
        "64": SizeScore("64", 110e3, 1.20),
        "128": SizeScore("128", 397e3, 1.00),
        "256": SizeScore("256", 1.5e6, 0.95),
        "512": SizeScore("512", 15 * 397e3, 0.87),
    }
    assert most_efficient(list(units.values())).name == "128"
    assert most_efficient(list(units.values()), gain=0.03).name == "512"
    noisy = [SizeScore("small", 1e5, 1.0, error=0.1), SizeScore("large", 2e5, 0.9, error=0.1)]
    assert most_efficient(noisy).name == "small"
    by_chance_poor = [SizeScore("a", 1e5, 1.0), SizeScore("b", 2e5, 1.1), SizeScore("c", 4e5, 0.8)]
    assert most_efficient(by_chance_poor).name == "c"


@pytest.mark.parametrize(
    ("call", "error", "words"),
    [
        (lambda: repeated_folds(4, 5), ConfigError, "4 sessions cannot be dealt into 5 folds"),
        (lambda: repeated_folds(4, 1), ConfigError, "at least 2 folds"),
        (lambda: repeated_splits(5, 5, 2), ConfigError, "both parts need a session"),
        (lambda: plan_runs(0.0, WORLD, 20), ConfigError, "above 0"),
        (lambda: plan_runs(0.1, WORLD, 3), ConfigError, "fewer folds"),
        (lambda: paired_variance(np.zeros((5, 10)), repeated_folds(10, 5)), DataError, "another partition"),
        (lambda: paired_variance(np.zeros(5)), DataError, "run, session"),
        (lambda: thesis_variance(np.zeros((1, 3))), DataError, "at least two splits"),
        (lambda: seed_correlation(np.zeros((3, 2)), np.ones((3, 2))), DataError, "do not differ"),
        (lambda: seed_correlation(np.zeros((3, 1)), np.ones((3, 1))), DataError, "at least two seeds"),
        (
            lambda: race(np.zeros((6, 4)), interim_analyses=(InterimAnalysis(4, 0.1), InterimAnalysis(3, 0.1))),
            ConfigError,
            "ascend",
        ),
        (lambda: race(np.zeros((6, 4)), interim_analyses=(InterimAnalysis(4, 1.4),)), ConfigError, "between 0 and 1"),
        (lambda: most_efficient([]), DataError, "no candidate"),
        (lambda: most_efficient([SizeScore("a", 1.0, math.nan)]), DataError, "'a'"),
        (lambda: most_efficient([SizeScore("a", 1.0, 2.0), SizeScore("b", 1.0, 3.0)]), DataError, "one size"),
        (lambda: thesis_power(1, 0.1, 0.1, 1), ConfigError, "two splits"),
        (lambda: thesis_splits_analytical(0.1, 0.0, 1), ConfigError, "above zero"),
        (lambda: thesis_plan(1.0, 0.1, 0), ConfigError, "above zero"),
    ],
)
def test_refusals_say_what_to_do(call, error, words):
    with pytest.raises(error, match=words):
        call()


def test_interim_analyses_are_those_of_the_design():
    assert [(analysis.runs, analysis.drop_above) for analysis in INTERIM_ANALYSES] == [
        (5, 0.35),
        (10, 0.15),
        (15, 0.08),
    ]
