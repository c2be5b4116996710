"""The default decision and the thesis's, on worlds whose truth is known."""

import numpy as np
import pytest

from edp.errors import ConfigError, DataError
from edp.stats import Rule, confirm, repeated_folds, thesis_confirm

MASK = repeated_folds(25, 5, 6)
NAMES = ["good", "none", "bad"]
REGISTERED = ["early", "good", "none", "bad"]


@pytest.fixture
def scores():
    rng = np.random.default_rng(0)
    base = 2.0 + 0.4 * rng.normal(size=25)
    effect = np.array([0.0, -0.06, 0.0, 0.08])[:, None, None]
    noise = (
        0.02 * rng.normal(size=(4, 1, 25)) + 0.02 * rng.normal(size=(4, 30, 1)) + 0.02 * rng.normal(size=(4, 30, 25))
    )
    return base * (1.0 + effect + noise)


def by_name(found):
    return {one.module: one for one in found}


def test_decides_on_all_registered_modules(scores):
    found = confirm(scores, NAMES, REGISTERED, MASK)
    assert [one.module for one in found] == REGISTERED
    assert [one.confirmed for one in found] == [False, True, False, False]
    good, bad, early = (by_name(found)[name] for name in ("good", "bad", "early"))
    assert good.change == pytest.approx(-0.06, abs=0.02)
    assert good.low < good.change < good.high < 0.0
    assert good.adjusted == pytest.approx(4 * good.p)  # four registered, the only small one
    assert (good.runs, good.dropped_after) == (30, 0)
    assert good.d_z.value < -1.0
    assert good.stability > 0.9
    assert good.mixed_p < 0.05
    assert good.paired_p < good.resampled_p < 0.05  # overlap makes the plain test too sure
    assert (bad.runs, bad.dropped_after, bad.p) == (5, 5, 1.0)
    assert bad.change > 0.0
    assert "dropped after 5 runs" in bad.reason
    assert (early.p, early.adjusted, early.change) == (1.0, 1.0, None)


def test_runs_after_the_drop_are_never_read(scores):
    cut = scores.copy()
    cut[3, 5:] = np.nan
    assert by_name(confirm(cut, NAMES, REGISTERED, MASK))["bad"].dropped_after == 5


def test_more_registered_modules_ask_for_more(scores):
    crowd = [f"other{i}" for i in range(60)] + NAMES
    few, many = (by_name(confirm(scores, NAMES, names, MASK))["good"] for names in (NAMES, crowd))
    assert many.adjusted == pytest.approx(21 * few.adjusted)


def test_a_small_gain_does_not_pass_the_practical_gate(scores):
    rule = Rule(least_gain=0.2)
    good = by_name(confirm(scores, NAMES, REGISTERED, MASK, rule))["good"]
    assert not good.confirmed
    assert "below the 20 % asked for" in good.reason


def test_a_module_that_diverges_in_a_third_of_its_runs_is_not_confirmed(scores):
    broken = scores.copy()
    broken[1, ::3] = np.inf
    found = by_name(confirm(broken, NAMES, REGISTERED, MASK, worst=np.full(25, 6.0)))["good"]
    assert not found.confirmed
    assert found.change > 0.0


def test_says_so_where_the_test_for_shared_training_sets_disagrees(scores):
    assert "does not agree" not in by_name(confirm(scores, NAMES, REGISTERED, MASK))["good"].reason
    noisy = scores.copy()
    noisy[1] += 0.2 * np.random.default_rng(2).normal(size=(30, 1))  # runs differ by as much as the module brings
    good = by_name(confirm(noisy, NAMES, NAMES, MASK, Rule(interim_analyses=())))["good"]
    assert good.confirmed
    assert good.resampled_p > 0.05 > good.adjusted
    assert "more sessions are needed" in good.reason


def test_identical_arms_are_never_confirmed(scores):
    same = np.repeat(scores[:1], 4, axis=0)
    assert not any(one.confirmed for one in confirm(same, NAMES, REGISTERED, MASK, Rule(interim_analyses=())))


def test_thesis_gates_any_metric_suffices():
    rng = np.random.default_rng(1)
    table = 1.0 + 0.1 * rng.normal(size=(1, 1, 10, 1)) + 0.02 * rng.normal(size=(2, 3, 10, 3))
    table[1, 1] -= 0.05  # the first module, on the second metric
    table[0, 2] += 0.05
    found = {(one.module, one.metric): one for one in thesis_confirm(table, ["a", "b"], ["mae", "p99"])}
    assert found["a", "p99"].passed
    assert not found["a", "mae"].passed
    assert found["a", "mae"].confirmed
    assert not found["b", "mae"].confirmed
    assert found["b", "mae"].p > 0.95
    assert found["a", "p99"].d_z < -0.5
    assert found["a", "p99"].stability >= 0.75
    assert found["a", "p99"].printed_p < 0.05


@pytest.mark.parametrize(
    ("call", "error", "words"),
    [
        (lambda: confirm(np.ones((2, 30, 25)), NAMES, NAMES, MASK), DataError, "1 \\+ module, run, session"),
        (lambda: confirm(-np.ones((4, 30, 25)), NAMES, NAMES, MASK), DataError, "above zero"),
        (lambda: confirm(np.ones((4, 30, 25)), NAMES, ["good"], MASK), DataError, "not registered"),
        (lambda: thesis_confirm(np.ones((2, 3, 10, 3)), ["a"], ["mae", "p99"]), DataError, "metric, 1 \\+ module"),
        (lambda: Rule(alpha=1.5), ConfigError, "between 0 and 1"),
    ],
)
def test_refusals_say_what_to_do(call, error, words):
    with pytest.raises(error, match=words):
        call()
