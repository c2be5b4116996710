"""The study: repeatable questions, answers in any order, warm starts, bounds and Pareto sets."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from edp.errors import ConfigError
from edp.stats.pareto import pareto
from edp.workflows.search.space import Choice, Real
from edp.workflows.search.study import SAMPLERS, SamplerSpec, Study

pytestmark = pytest.mark.long

SPACE = {"learning_rate": Real(1e-4, 1e-1, log=True), "units": Choice((16, 32, 64))}
FLAGS = ("a", "b", "c")
BARRED = frozenset({frozenset({"a", "c"})})


def study(kind="tpe", root=7, **options):
    return Study(SPACE, root, SamplerSpec(kind=kind, startup=4), FLAGS, BARRED, **options)


def value(trial):
    return (
        (math.log10(trial.values["learning_rate"]) + 2.5) ** 2 + trial.values["units"] / 64 + ("b" not in trial.modules)
    )


def run(made, batches, order=None):
    asked = []
    for size in batches:
        batch = made.ask(size)
        asked += batch
        for place in range(size) if order is None else order.permutation(size):
            made.tell(batch[place].number, [value(batch[place])])
    return asked


@pytest.mark.parametrize("kind", ["tpe", "thesis_tpe", "random"])
def test_the_same_root_asks_the_same_and_another_root_other_questions(kind):
    one, again, other = (run(study(kind, root), [4] * 5) for root in (7, 7, 8))
    assert one == again
    assert one != other
    assert [trial.number for trial in one] == list(range(20))


def test_a_gaussian_process_is_repeatable_too():
    assert run(study("gp"), [5, 1]) == run(study("gp"), [5, 1])


@settings(max_examples=4, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_the_order_of_answers_does_not_matter(seed):
    shuffled = run(study(), [5] * 3, np.random.default_rng(seed))
    assert shuffled == run(study(), [5] * 3)


def test_a_replay_goes_on_with_the_same_questions():
    whole = run(study(), [4] * 6)
    replayed = study()
    run(replayed, [4] * 3)
    assert run(replayed, [4] * 3) == whole[12:]


def test_it_finds_better_ones_than_chance():
    def best(kind):
        return min(map(value, run(study(kind), [4] * 15)))

    assert best("tpe") < best("random")


def test_switches_that_bar_one_another_are_never_on_together():
    asked = run(study("random"), [30])
    assert any("a" in trial.modules for trial in asked)
    assert any("c" in trial.modules for trial in asked)
    assert not any({"a", "c"} <= set(trial.modules) for trial in asked)


def test_a_warm_start_is_asked_first_and_counts():
    made = study()
    made.suggest({"learning_rate": 1e-2, "units": 16}, ["b"])
    (first,) = made.ask(1)
    assert (first.number, dict(first.values), first.modules) == (0, {"learning_rate": 1e-2, "units": 16}, ("b",))
    made.tell(0, [0.1])
    assert [trial.number for trial in made.ask(2)] == [1, 2]


@pytest.mark.parametrize("kind", sorted(SAMPLERS))
def test_an_option_is_asked_where_its_switch_is_on_and_comes_again(kind):
    def asked():
        made = study(kind, options={"a": {"a.heads": Choice((2, 4))}, "b": {"b.form": Choice(("x", "y"))}})
        found = run(made, [3, 3, 3])
        return [(trial.modules, dict(trial.options)) for trial in found]

    found = asked()
    for flags, options in found:
        assert set(options) == {name for name in ("a.heads", "b.form") if name[0] in flags}
    assert {value for _, options in found for value in options.values()} <= {2, 4, "x", "y"}
    assert any(options for _, options in found)
    assert asked() == found


def test_a_warm_start_may_name_options_of_what_is_on():
    made = study(options={"a": {"a.heads": Choice((2, 4))}})
    made.suggest({"units": 16}, ["a"], {"a.heads": 4})
    (first,) = made.ask(1)
    assert (first.modules, dict(first.options)) == (("a",), {"a.heads": 4})
    with pytest.raises(ConfigError, match=r"no option 'a.heads' of what is on"):
        made.suggest({}, ["b"], {"a.heads": 4})
    with pytest.raises(ConfigError, match=r"a\.heads = 3 is not in"):
        made.suggest({}, ["a"], {"a.heads": 3})


def test_failed_trials_are_passed_over():
    made = study()
    for trial in made.ask(8):
        made.tell(trial.number, None if trial.number % 2 else [value(trial)])
    assert [trial.number for trial in made.ask(2)] == [8, 9]


def test_bounds_keep_most_questions_inside():
    made = study(bounds=1)
    wide = 0
    for _ in range(12):
        for trial in made.ask(4):
            cost = trial.values["units"] - 32
            wide += trial.number >= 32 and cost > 0
            made.tell(trial.number, None if cost > 0 else [value(trial)], [cost])
    assert wide <= 4


def test_two_objectives_give_a_front():
    made = study(objectives=2)
    points = []
    for trial in made.ask(12):
        points.append([value(trial), trial.values["units"]])
        made.tell(trial.number, points[-1])
    assert len(pareto(points)) >= 1


@given(st.lists(st.tuples(st.integers(0, 5), st.integers(0, 5)), min_size=1, max_size=20))
def test_a_pareto_set_is_what_nothing_dominates(points):
    kept = pareto(points)
    assert kept
    for place, (x, y) in enumerate(points):
        dominated = any(u <= x and v <= y and (u, v) != (x, y) for u, v in points)
        assert (place in kept) != dominated


def test_what_cannot_be_asked_or_told_is_refused():
    made = study()
    (trial,) = made.ask(1)
    for number, values, message in (
        (5, [1.0], "was not asked"),
        (0, [math.inf], "1 finite ones must hold"),
        (0, [1.0, 2.0], "1 finite ones must hold"),
    ):
        with pytest.raises(ConfigError, match=message):
            made.tell(number, values)
    made.tell(trial.number, [1.0])
    with pytest.raises(ConfigError, match="tell each once"):
        made.tell(trial.number, [1.0])
    with pytest.raises(ConfigError, match="units = 17 is not in Choice"):
        made.suggest({"learning_rate": 1e-2, "units": 17})
    with pytest.raises(ConfigError, match="no switch 'd'"):
        made.suggest({"learning_rate": 1e-2, "units": 16}, ["d"])
    with pytest.raises(ConfigError, match="sampler 'bayes'; gp, tpe"):
        SamplerSpec(kind="bayes")
    with pytest.raises(ConfigError, match="dimension and a switch"):
        Study(SPACE, 0, flags=("units",))
    assert set(SAMPLERS) == {"gp", "tpe", "thesis_tpe", "random"}
