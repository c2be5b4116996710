"""Tests and effects against statsmodels and SciPy, which fit, cluster and adjust by their own code."""

import warnings

import numpy as np
import pytest
import scipy.stats
from scipy.optimize import brentq

from edp.stats import (
    benjamini_hochberg,
    clustered_t,
    effect_interval,
    holm,
    kendalls_w,
    main_effects,
    mixed_model,
    paired_t,
    repeated_folds,
    two_level_design,
)

with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    import statsmodels.api as sm
    from statsmodels.stats.multitest import multipletests
    from statsmodels.stats.sandwich_covariance import cov_cluster


def long_form(table, mask):
    run, session = np.nonzero(mask)
    return table[mask], run, session


@pytest.mark.parametrize("seed", range(4))
def test_both_cluster_variances_are_those_of_statsmodels(seed):
    rng = np.random.default_rng(seed)
    mask = repeated_folds(13, 5, 3, seed)
    table = rng.normal(size=(15, 1)) + rng.normal(size=(1, 13)) + rng.normal(size=(15, 13))
    values, run, session = long_form(table, mask)
    fitted = sm.OLS(values, np.ones((len(values), 1))).fit()
    by_session = cov_cluster(fitted, session, use_correction=True)[0, 0]
    by_run = cov_cluster(fitted, run, use_correction=True)[0, 0]
    by_cell = cov_cluster(fitted, np.arange(len(values)), use_correction=False)[0, 0]
    test = clustered_t(table, mask)
    assert test.mean == pytest.approx(fitted.params[0], rel=1e-12)
    expected = max(by_session + by_run - by_cell, by_session, by_run)
    assert test.error**2 == pytest.approx(expected, rel=1e-12)
    assert test.p == pytest.approx(scipy.stats.t.cdf(test.statistic, 12), rel=1e-12)


@pytest.mark.filterwarnings("ignore")  # it warns of every fit near the boundary
@pytest.mark.parametrize(("split_spread", "seed"), [(3.0, 5), (1.0, 5), (0.3, 5), (0.0, 7)])
def test_closed_form_is_the_mixed_model_of_statsmodels(split_spread, seed):
    rng = np.random.default_rng(seed)
    splits, seeds = 8, 3
    intercepts = split_spread * rng.normal(size=(splits, 1))
    baseline = intercepts + rng.normal(size=(splits, seeds))
    module = intercepts - 0.4 + rng.normal(size=(splits, seeds))
    ours = mixed_model(module, baseline)
    y = np.concatenate([baseline.ravel(), module.ravel()])
    scale = y.std()
    arm = np.repeat([0.0, 1.0], splits * seeds)
    group = np.tile(np.repeat(np.arange(splits), seeds), 2)
    model = sm.MixedLM((y - y.mean()) / scale, np.column_stack([np.ones_like(arm), arm]), group)
    # Its default L-BFGS stops at a split variance of zero in the second case, where the likelihood is lower.
    fitted = model.fit(reml=True, method=["powell"], xtol=1e-10, ftol=1e-14)
    assert abs(ours.effect.mean - fitted.params[1] * scale) / ours.effect.error <= 1e-12
    assert ours.effect.error == pytest.approx(fitted.bse[1] * scale, rel=1e-7)
    assert ours.residual_variance == pytest.approx(fitted.scale * scale**2, rel=1e-7)
    assert ours.split_variance == pytest.approx(fitted.cov_re[0, 0] * scale**2, rel=1e-6, abs=1e-8)
    assert ours.effect.p == pytest.approx(scipy.stats.norm.cdf(fitted.tvalues[1]), rel=1e-6)


def test_adjustments_are_those_of_statsmodels():
    rng = np.random.default_rng(0)
    for n in (1, 2, 14, 40):
        p = rng.uniform(size=n) ** 3
        p[: n // 3] = p[0]  # ties
        assert benjamini_hochberg(p) == pytest.approx(multipletests(p, method="fdr_bh")[1], abs=1e-15)
        assert holm(p) == pytest.approx(multipletests(p, method="holm")[1], abs=1e-15)


def test_paired_t_is_that_of_scipy():
    rng = np.random.default_rng(1)
    differences = rng.normal(-0.2, 1.0, size=(5, 10))
    theirs = scipy.stats.ttest_1samp(differences, 0.0, axis=1, alternative="less")
    ours = paired_t(differences)
    assert ours.statistic == pytest.approx(theirs.statistic)
    assert ours.p == pytest.approx(theirs.pvalue)


@pytest.mark.parametrize(("d_z", "splits"), [(-0.785, 10), (0.05, 5), (1.4, 7), (-6.3, 7), (22.6, 7)])
def test_interval_of_d_z_inverts_the_noncentral_t(d_z, splits):
    found = effect_interval(d_z, splits)
    root, t = splits**0.5, abs(d_z) * splits**0.5

    def inverted(probability):
        return brentq(lambda nc: scipy.stats.nct.cdf(t, splits - 1, nc) - probability, -10.0, 3.0 * t + 10.0) / root

    ends = sorted(np.sign(d_z) * np.array([inverted(0.975), inverted(0.025)]))
    assert (found.low, found.high) == pytest.approx(tuple(ends), rel=1e-4, abs=1e-6)


def test_kendalls_w_is_friedmans_statistic_rescaled():
    rng = np.random.default_rng(2)
    scores = np.round(rng.normal(size=(9, 5)) + 0.6 * np.arange(5), 1)  # rounded, so that some tie
    theirs = scipy.stats.friedmanchisquare(*scores.T)
    ours = kendalls_w(scores)
    assert ours.w == pytest.approx(theirs.statistic / (9 * 4))
    assert ours.p == pytest.approx(theirs.pvalue)


def test_main_effects_are_ordinary_least_squares():
    rng = np.random.default_rng(3)
    design = two_level_design([f"m{i}" for i in range(6)], 16, exclusive=[("m0", "m1")])
    levels = np.vstack([design.levels, design.levels])
    rates = rng.normal(size=(32, 2))
    y = rng.normal(size=32) - 0.7 * levels[:, 2] + 0.3 * rates[:, 0]
    fitted = sm.OLS(y, np.column_stack([np.ones(32), levels, rates])).fit()
    for i, ours in enumerate(main_effects(levels, design.factors, y, rates), start=1):
        assert ours.effect == pytest.approx(fitted.params[i])
        assert ours.error == pytest.approx(fitted.bse[i])
        assert ours.p == pytest.approx(scipy.stats.t.cdf(fitted.tvalues[i], fitted.df_resid))
