"""Two-level designs and the effects read off them."""

from itertools import combinations

import numpy as np
import pytest

from edp.errors import ConfigError, DataError
from edp.stats import main_effects, two_level_design

NAMES = [f"m{i}" for i in range(14)]
EXCLUSIVE = [("m0", "m1"), ("m2", "m3")]


@pytest.fixture(scope="module")
def constrained():
    return two_level_design(NAMES, 32, EXCLUSIVE)


@pytest.mark.parametrize(("factors", "runs"), [(2, 4), (4, 8), (8, 16), (14, 32), (16, 32), (20, 64), (5, 16)])
def test_regular_designs_have_resolution_four(factors, runs):
    design = two_level_design([f"m{i}" for i in range(factors)], runs)
    signs = np.where(design.levels, 1, -1)
    assert signs.shape == (runs, factors)
    assert (signs.sum(axis=0) == 0).all()
    assert (signs.T @ signs == runs * np.eye(factors)).all()
    for a, b in combinations(range(factors), 2):
        assert (signs.T @ (signs[:, a] * signs[:, b]) == 0).all()  # no main effect is an interaction
    assert design.alias == 0.0
    assert design.error == pytest.approx(2 / np.sqrt(runs))
    assert not design.levels[0].any()  # the baseline is a run of its own


def test_smallest_number_of_runs_is_the_default():
    assert two_level_design(NAMES).levels.shape == (32, 14)


def test_excluded_pairs_never_meet_and_the_rest_stays_close_to_its_best(constrained):
    levels = constrained.levels
    for group in EXCLUSIVE:
        assert levels[:, [NAMES.index(name) for name in group]].sum(axis=1).max() <= 1
    assert levels.sum(axis=0).min() >= 6
    assert constrained.error < 1.5 * 2 / np.sqrt(32)
    assert constrained.alias < 0.7


def test_constrained_design_repeats_to_the_bit(constrained):
    assert (
        two_level_design(NAMES[:6], 16, [("m0", "m1")]).levels == two_level_design(NAMES[:6], 16, [("m0", "m1")]).levels
    ).all()
    assert len({row.tobytes() for row in constrained.levels}) == 32  # no run twice


def test_effects_and_importances_without_noise(constrained):
    true = np.zeros(14)
    true[[2, 5, 9]] = (-3.0, 1.0, -2.0)
    rng = np.random.default_rng(0)
    levels = np.vstack([constrained.levels] * 2)
    y = levels @ true + 10.0 + 1e-9 * rng.normal(size=64)
    found = main_effects(levels, NAMES, y)
    assert [one.effect for one in found] == pytest.approx(true, abs=1e-7)
    assert sum(one.importance for one in found) == pytest.approx(1.0)
    assert [one.factor for one in sorted(found, key=lambda one: one.effect)[:2]] == ["m2", "m9"]
    assert found[2].passed
    assert not found[5].passed


def test_signed_ranks_from_64_trainings_are_those_of_the_truth():
    rng = np.random.default_rng(1)
    design = two_level_design(NAMES)
    levels = np.vstack([design.levels] * 2)
    true = np.linspace(-0.06, 0.06, 14)
    interactions = sum(0.01 * rng.normal() * levels[:, a] * levels[:, b] for a, b in combinations(range(14), 2))
    rates = rng.normal(size=(64, 3))
    y = levels @ true + interactions + 0.02 * rates[:, 0] + 0.02 * rng.normal(size=64)
    effects = [one.effect for one in main_effects(levels, NAMES, y, rates)]
    ranks = np.argsort(np.argsort(effects))
    assert np.corrcoef(ranks, np.arange(14))[0, 1] > 0.85


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: two_level_design(["a"]), "at least two"),
        (lambda: two_level_design(["a", "a"]), "each once"),
        (lambda: two_level_design(NAMES, 16), "power of two from 32"),
        (lambda: two_level_design(NAMES, 48), "power of two from 32"),
        (lambda: two_level_design([str(i) for i in range(200)]), "at most 128"),
        (lambda: two_level_design(["gru", "zoneout"], exclusive=[("gro", "zoneout")]), "did you mean 'gru'"),
        (lambda: two_level_design(["gru", "zoneout"], exclusive=[("gru",)]), "at least two different"),
    ],
)
def test_bad_designs_are_refused(call, words):
    with pytest.raises(ConfigError, match=words):
        call()


@pytest.mark.parametrize(
    ("levels", "scores", "covariates", "words"),
    [
        (np.zeros((3, 2)), np.zeros(4), None, "levels of shape"),
        (np.zeros((8, 2)), np.arange(8.0), None, "distinguished"),
        ([[0, 1], [1, 0], [0, 0]], np.arange(3.0), None, "repeat the design"),
        ([[0, 1], [1, 0], [0, 0], [1, 1]] * 2, np.arange(8.0), np.ones((8, 1)), "never changes"),
        ([[0, 1], [1, 0], [0, 0], [1, 1]] * 2, np.arange(8.0), np.ones((7, 1)), "7 rows"),
        ([[0, 1], [1, 0], [0, 0], [1, 1]] * 2, np.full(8, np.inf), None, "NaN or infinite"),
    ],
)
def test_bad_tables_are_refused(levels, scores, covariates, words):
    with pytest.raises(DataError, match=words):
        main_effects(levels, ["a", "b"], scores, covariates)
