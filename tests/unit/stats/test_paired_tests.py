"""Tests of paired differences: by hand, in their limits, and with what fails."""

import inspect
import math

import numpy as np
import pytest

import edp.stats
from edp.errors import DataError
from edp.stats import (
    adjust_registered,
    benjamini_hochberg,
    clustered_t,
    cohens_dz,
    effect_size,
    fill_worst,
    holm,
    kendalls_w,
    main_effects,
    mixed_model,
    paired,
    paired_t,
    printed_p,
    rank_stability,
    repeated_folds,
    resampled_t,
    run_means,
)


def test_clustered_variance_by_hand():
    # Two runs, three sessions. e = d - 2.
    d = np.array([[1.0, 2.0, 3.0], [0.0, 2.0, 4.0]])
    test = clustered_t(d)
    by_session = 3 / 2 * ((-3.0) ** 2 + 0.0 + 3.0**2) / 36
    by_run = 2 / 1 * (0.0 + 0.0) / 36
    by_cell = (1 + 0 + 1 + 4 + 0 + 4) / 36
    assert test.mean == 2.0
    assert test.error**2 == pytest.approx(max(by_session + by_run - by_cell, by_session, by_run))
    assert test.df == 1
    low, high = test.interval(0.9)
    assert high - test.mean == pytest.approx(6.313752 * test.error, rel=1e-6)
    assert low == pytest.approx(2 * test.mean - high)


def test_only_tested_cells_are_read_and_axes_broadcast():
    rng = np.random.default_rng(0)
    mask = repeated_folds(11, 4, 3, 1)
    tables = rng.normal(size=(5, 12, 11))
    together = clustered_t(np.where(mask, tables, np.nan), mask)
    apart = [clustered_t(np.where(mask, table, 1e9), mask) for table in tables]
    assert together.p == pytest.approx([float(one.p) for one in apart])
    assert together.error == pytest.approx([float(one.error) for one in apart])


def test_a_design_that_is_not_finished_counts_what_it_has():
    rng = np.random.default_rng(8)
    mask = repeated_folds(12, 5, 2)
    mask[3:] = False  # three runs of ten, so some sessions were not judged yet
    table = rng.normal(size=(10, 12))
    used = mask[:3].any(axis=0)
    cut = clustered_t(table[:3][:, used], mask[:3][:, used])
    whole = clustered_t(table, mask)
    assert (float(whole.p), whole.df) == (float(cut.p), cut.df)
    assert fill_worst(np.stack([table, table]), mask)[:, 3:].max() == 0.0


MEAN_TESTS = {
    "clustered_t": clustered_t,
    "paired_t": paired_t,
    "resampled_t": lambda d: resampled_t(d, 0.25),
    "mixed_model": lambda d: mixed_model(d, np.zeros_like(d)).effect,
}


def test_every_test_of_a_mean_is_listed_here():
    """A new function of `edp.stats` with a `MeanTest` or `MixedModel` result fails here."""
    results = {name: inspect.signature(one).return_annotation for name, one in inspect.getmembers(edp.stats, callable)
               if inspect.isfunction(one)}  # fmt: skip
    assert {name for name, result in results.items() if result in ("MeanTest", "MixedModel")} == set(MEAN_TESTS)


@pytest.mark.parametrize("name", sorted(MEAN_TESTS))
def test_equal_predictions_are_no_difference_one_sided_and_two_sided(name):
    test = MEAN_TESTS[name](np.zeros((4, 6)))
    assert test.p == pytest.approx(1.0)
    assert test.two_sided == pytest.approx(1.0)


@pytest.mark.parametrize("name", sorted(MEAN_TESTS))
def test_the_two_sided_p_value_is_twice_the_smaller_tail_on_both_sides(name):
    rows = np.random.default_rng(3).normal(0.3, 1.0, size=(4, 6))
    better, worse = MEAN_TESTS[name](-rows), MEAN_TESTS[name](rows)
    assert better.two_sided == pytest.approx(2 * np.minimum(better.p, worse.p))
    assert better.two_sided == pytest.approx(worse.two_sided)


def test_main_effects_of_equal_scores_pass_nothing():
    levels = np.array([[True, True], [True, False], [False, True], [False, False]] * 2)
    for score in (0.0, 0.1, 1e6 / 3):
        for effect in main_effects(levels, ("a", "b"), np.full(8, score)):
            assert (effect.p, effect.passed) == (1.0, False)


def test_equal_differences_speak_for_themselves():
    assert clustered_t(np.full((4, 6), -0.1)).p == 0.0
    assert clustered_t(np.full((4, 6), 0.1)).p == 1.0
    assert paired_t(np.full(5, -0.3)).p == 0.0
    assert effect_size(np.full(5, -0.3)).value == -math.inf
    assert effect_size(np.zeros(5)).value == 0.0


def test_correction_for_overlap_by_hand():
    d = np.array([-1.0, -2.0, 0.0, -3.0])
    t = -1.5 / (math.sqrt(5 / 3) * math.sqrt(1 / 4 + 1 / 4))
    assert resampled_t(d, 1 / 4).statistic == pytest.approx(t)
    assert resampled_t(d, 0.0).p < resampled_t(d, 1 / 4).p < 0.5


def test_mixed_model_without_split_differences_pools_everything():
    rng = np.random.default_rng(4)
    module, baseline = rng.normal(size=(2, 40, 2))
    module -= module.mean(axis=1, keepdims=True)  # splits differ by less than chance
    baseline -= baseline.mean(axis=1, keepdims=True)
    fitted = mixed_model(module, baseline)
    assert fitted.split_variance == 0.0
    total = np.square(module).sum() + np.square(baseline).sum()
    assert fitted.residual_variance == pytest.approx(total / (2 * 80 - 2))


def test_adjustment_by_hand_and_over_all_registered():
    assert benjamini_hochberg([0.01, 0.04, 0.03, 0.5]) == pytest.approx([0.04, 0.16 / 3, 0.16 / 3, 0.5])
    assert holm([0.01, 0.04, 0.03, 0.5]) == pytest.approx([0.04, 0.09, 0.09, 0.5])
    adjusted = adjust_registered({"b": 0.01, "d": 0.02}, ["a", "b", "c", "d"])
    assert adjusted == pytest.approx({"a": 1.0, "b": 0.04, "c": 1.0, "d": 0.04})
    assert benjamini_hochberg([0.01, 0.02]) == pytest.approx([0.02, 0.02])  # what forgetting a and c would give


def test_failed_runs_count_as_the_worst_of_their_session():
    scores = np.array(
        [
            [[1.0, 5.0], [1.2, 5.5]],  # baseline
            [[0.9, np.inf], [0.8, 5.0]],
            [[np.nan, 4.0], [1.5, np.nan]],
        ]
    )
    filled = fill_worst(scores)
    assert filled[1, 0, 1] == 5.5
    assert filled[2, 0, 0] == 1.5
    assert filled[2, 1, 1] == 5.5
    assert fill_worst(scores, worst=[10.0, 1.0])[2, 0, 0] == 10.0
    assert fill_worst(scores, worst=[10.0, 1.0])[1, 0, 1] == 5.5  # never less than what was seen


def test_diverging_cannot_help():
    rng = np.random.default_rng(6)
    baseline = 1.0 + 0.05 * rng.normal(size=(10, 8))
    module = baseline - 0.1
    broken = module.copy()
    broken[3] = np.nan
    good, bad = clustered_t(paired(module, baseline)), clustered_t(paired(broken, baseline))
    assert bad.mean > good.mean
    assert bad.p > good.p
    assert run_means(paired(broken, baseline))[3] >= 0.0


def test_planned_cells_only_are_filled():
    mask = np.array([[True, False], [True, True]])
    filled = fill_worst(np.broadcast_to(np.where(mask, 1.0, np.nan), (2, 2, 2)), mask)
    assert filled[:, 0, 1].tolist() == [0.0, 0.0]


def test_effect_sizes_and_stability_by_hand():
    d = [-1.0, -2.0, 0.0, 1.0]
    assert cohens_dz(d) == pytest.approx(-0.5 / math.sqrt(5 / 3))
    assert rank_stability(d) == 0.5  # a tie is no win
    assert float(printed_p(-0.5, 4)) == pytest.approx(0.158655, abs=1e-6)


def test_rankings_that_agree_and_that_do_not():
    assert kendalls_w(np.tile([3.0, 1.0, 2.0], (4, 1))).w == pytest.approx(1.0)
    assert kendalls_w([[1.0, 2.0, 3.0], [3.0, 2.0, 1.0]]).w == pytest.approx(0.0)
    chance = kendalls_w(np.random.default_rng(0).normal(size=(50, 6)))
    assert chance.w < 0.1
    assert chance.p > 0.01


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: clustered_t(np.zeros((1, 5))), "at least two"),
        (lambda: clustered_t([[0.0, np.nan], [1.0, 2.0]]), "NaN or infinite"),
        (lambda: clustered_t(np.zeros((3, 3)), np.ones((2, 3))), "shape"),
        (lambda: clustered_t(np.zeros((2, 2)), np.zeros((2, 2), bool)), "0 tested cells"),
        (lambda: clustered_t(np.zeros(4)), "run, session"),
        (lambda: resampled_t([1.0], 0.2), "at least two"),
        (lambda: resampled_t([1.0, 2.0], -1.0), "not negative"),
        (lambda: printed_p(0.1, 0), "at least one"),
        (lambda: mixed_model(np.zeros((3, 2)), np.zeros((2, 2))), "pair equal cells"),
        (lambda: mixed_model(np.zeros((1, 2)), np.zeros((1, 2))), "at least two"),
        (lambda: benjamini_hochberg([0.2, 1.2]), "between 0 and 1"),
        (lambda: adjust_registered({"gru_cel": 0.1}, ["gru_cell"]), "did you mean 'gru_cell'"),
        (lambda: adjust_registered({}, ["a", "a"]), "twice"),
        (lambda: fill_worst(np.full((2, 2, 2), np.nan)), "no arm has a score"),
        (lambda: fill_worst(np.zeros((2, 2))), "arm, run, session"),
        (lambda: fill_worst(np.zeros((2, 2, 2)), worst=[1.0]), "one finite score for each"),
        (lambda: paired(np.zeros((2, 2)), np.zeros((3, 2))), "pair equal cells"),
        (lambda: cohens_dz([1.0]), "at least two"),
        (lambda: kendalls_w(np.zeros((3, 3))), "nothing to rank"),
        (lambda: kendalls_w(np.zeros((1, 3))), "at least two splits"),
    ],
)
def test_refusals_say_what_to_do(call, words):
    with pytest.raises(DataError, match=words):
        call()
