"""The calibration of the search's decision, small: false positives within binomial bounds, and power that is there."""

import importlib.util
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import binom

pytestmark = pytest.mark.long

FOLDER = Path(__file__).parents[3] / "benchmarks"
STUDIES = 80


@pytest.fixture(scope="module")
def bench():
    added = [str(FOLDER)]
    sys.path[:0] = added
    try:
        spec = importlib.util.spec_from_file_location("bench_null_calibration", FOLDER / "null_calibration.py")
        module = importlib.util.module_from_spec(spec)
        sys.modules[spec.name] = module
        spec.loader.exec_module(module)
    finally:
        sys.path.remove(added[0])
    return module


@pytest.fixture(scope="module")
def null(bench):
    return bench.rates(bench.WORLDS["k = 1"], 0.0, STUDIES)


def test_any_false_module_stays_within_its_level(bench, null):
    bound = binom.isf(1e-3, STUDIES, 0.05)
    assert null[bench.BARE].any_false * STUDIES <= bound
    assert null[bench.SOUND].any_false <= null[bench.BARE].any_false


def test_a_single_test_keeps_its_level(bench, null):
    # Modules of one study share their baseline, so the bound is that of a quarter of the 14 tests as if independent.
    tests = 14 * STUDIES // 4
    raw = null["clustered t, one metric"].significant * tests
    assert binom.ppf(1e-3, tests, 0.02) <= raw <= binom.isf(1e-3, tests, 0.06)


def test_the_thesis_procedure_does_not(bench, null):
    assert null[bench.THESIS].any_false > 0.3


def test_the_race_saves_most_of_the_trainings(bench, null):
    assert null[bench.SOUND].trainings < 0.5 * null[bench.THESIS].trainings


def test_a_module_that_helps_is_found(bench):
    found = bench.rates(bench.WORLDS["k = 1"], -0.04, 30, seed=1, ways=(bench.sound_studies,))
    assert found[bench.SOUND].found >= 0.7


def test_no_test_of_shared_training_sets_sees_what_they_share(bench):
    # A negative result, kept so that nobody trusts the default where modules depend on the training sessions.
    found = bench.rates(bench.STRESS, 0.0, 30, ways=(bench.sound_studies,))
    assert found[bench.SOUND].any_false > 0.1


def test_worlds_have_the_spreads_that_they_say(bench):
    # One training set, whose effect on all arms would scale everything, so it is left out; few modules for speed.
    world = replace(bench.WORLDS["k = 1"], training=0.0, modules=1)
    tested = np.ones((2000, 25), dtype=bool)
    tested[:, 5:] = False
    scores = world.scores(tested, np.arange(2000), np.zeros(1), 3)
    relative = scores / scores.mean(axis=2, keepdims=True)
    difference = (relative[0, 1] - relative[0, 0]).mean(axis=-1)
    run = world.module_training**2 + 2 * world.seed**2 * (1 - world.common) + 2 * world.cell**2 / 25
    assert difference.std() == pytest.approx(np.sqrt(run), rel=0.05)
