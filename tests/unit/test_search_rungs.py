"""Questions that are judged at rungs on a made-up world: who goes on, what is told, and what is never counted."""

import dataclasses
import hashlib
import json
import random

import numpy as np
import pytest

from edp.config.experiment import load_experiment
from edp.errors import ConfigError
from edp.evaluation.study import Decision
from edp.evaluation.study_facts import IsolationFacts
from edp.stats.variance import PairedVariance
from edp.workflows.search.arms import Arm
from edp.workflows.search.context import SearchContext
from edp.workflows.search.engine import run_phases
from edp.workflows.search.settings import CalibrationSpec, IsolationSpec, SearchSpec
from edp.workflows.search.space import Choice, Real
from edp.workflows.search.study import SamplerSpec, Study
from edp.workflows.search.trainings import SCORES, Outcome, TrainingRequest

pytestmark = pytest.mark.long

SESSIONS = tuple(f"s{number:02d}" for number in range(12))
SPACE = {"learning_rate": Real(1e-4, 1e-1, log=True), "units": Choice((4, 8))}
SPEC = SearchSpec(
    updates=80,
    folds=3,
    isolation=IsolationSpec(runs=6),
    calibration=CalibrationSpec(trials=24),
    space=SPACE,
    sampler=SamplerSpec(kind="random"),
    backbones=("lstm",),
    rungs=(0.125, 0.25, 0.5),
    pruner="median",
)
FACTS = IsolationFacts(
    arms={},
    runs=6,
    seeds=1,
    features="FG2",
    mean_scores={},
    comparisons={},
    backbones={},
    variance=PairedVariance(0.0, 0.0),
)
ISOLATION = Decision("isolation", FACTS, ())


def context(**changes):
    base = Arm.from_experiment(load_experiment(None, "quick", ["model.blocks=[]", "model.backbone.units=4"]))
    spec = dataclasses.replace(SPEC, **changes)
    return SearchContext(spec, base, {"path": "nowhere"}, SESSIONS[:9], SESSIONS[9:], decided={"isolation": ISOLATION})


class World:
    """Scores that fall while a training goes on; each order is remembered."""

    def __init__(self, diverges=lambda order: False):
        self.orders, self.batches, self.diverges = [], [], diverges

    def __call__(self, orders):
        self.orders += orders
        self.batches.append(len(orders))
        return [self.outcome(order) for order in orders]

    def outcome(self, order):
        if self.diverges(order):
            return Outcome(order, "diverged", None, "the loss is nan")
        rate = np.log10(order.settings["training"]["optimizer"]["learning_rate"])
        digest = hashlib.blake2b(json.dumps(order.settings, sort_keys=True).encode(), digest_size=4).digest()
        noise = 0.02 * (int.from_bytes(digest, "big") / 2**32)
        left = 1.0 - (order.until or order.updates) / order.updates
        score = 5.0 + 0.5 * (rate + 2.5) ** 2 + 3.0 * left + noise
        sessions = {name: {"10": dict.fromkeys(SCORES, score)} for name in order.judged}
        return Outcome(order, "done", {"sessions": sessions})


def calibrated(do, **changes):
    decision = run_phases(context(**changes), do, phases=["calibration"]).decided["calibration"]
    return decision, decision.to_json()["facts"]["backbones"]["lstm"]["trials"]


@pytest.fixture(scope="module")
def pruned():
    world = World()
    return world, *calibrated(world)


def test_hopeless_questions_are_trained_no_further_than_the_rung_that_says_so(pruned):
    world, decision, trials = pruned
    ended = [trial for trial in trials if trial["pruned"]]
    assert 2 <= len(ended) < len(trials) - 4
    assert not any(trial["pruned"] for trial in trials[:8])  # two batches, until five were trained to their end
    for trial in trials:
        rungs = dict(trial["rungs"])
        assert list(rungs) == [10, 20, 40][: len(rungs)]
        assert (trial["score"] is None) == trial["pruned"]
        assert (trial["mae"] is None) == trial["pruned"]
        assert trial["statuses"] == ["done"]
        own = [o for o in world.orders if o.settings["training"]["optimizer"]["learning_rate"] == rate_of(trial)]
        wanted = [*rungs] if trial["pruned"] else [*rungs, None]
        assert [order.until for order in own] == wanted
        assert [order.stops for order in own] == [tuple(rungs)[:number] for number in range(len(wanted))]
    assert any(f"lstm: {len(ended)} of 24 questions were ended at a rung" in said for said in decision.sentences)


def rate_of(trial):
    return trial["values"]["learning_rate"]


def test_a_question_goes_on_where_it_is_no_worse_than_the_median_of_earlier_batches(pruned):
    _, _, trials = pruned
    for place, trial in enumerate(trials):
        before = [one for one in trials[: place // 4 * 4] if not one["pruned"]]
        best = float("inf")
        for step, value in trial["rungs"]:
            best = min(best, value)
            worse = len(before) >= 5 and best > np.median([dict(one["rungs"])[step] for one in before])
            assert worse == (trial["pruned"] and step == trial["rungs"][-1][0])


def test_the_search_learns_from_what_was_pruned(pruned):
    """The same answers told as failed would lead to other questions."""
    _, _, trials = pruned
    learned = _asked_after(trials, told_as_pruned=True)
    assert learned != _asked_after(trials, told_as_pruned=False)


def _asked_after(trials, told_as_pruned):
    study = Study(SPACE, 3, SamplerSpec(kind="thesis_tpe", startup=4), pruner="median")
    for trial in trials:
        study.suggest(trial["values"])
    for trial, asked in zip(trials, study.ask(len(trials)), strict=True):
        for step, value in trial["rungs"]:
            study.report(asked.number, step, value)
        score = None if trial["score"] is None else [trial["score"]]
        study.tell(asked.number, score, pruned=trial["pruned"] and told_as_pruned)
    return study.ask(4)


def test_rungs_without_a_pruner_change_nothing_but_what_is_known(pruned):
    whole, known = calibrated(World(), rungs=(), pruner="none"), calibrated(World(), pruner="none")
    assert [dict(trial["rungs"]).keys() for trial in known[1]] == [{10, 20, 40}] * 24
    without = [{k: v for k, v in trial.items() if k not in ("rungs", "pruned")} for trial in known[1]]
    assert without == whole[1]
    assert not any(trial["pruned"] for trial in known[1])
    assert known[0].sentences == whole[0].sentences


def test_a_training_that_diverges_at_a_rung_is_failed_and_not_pruned():
    def diverges(order):
        return order.until == 20 and order.settings["training"]["optimizer"]["learning_rate"] > 1e-2

    _, trials = calibrated(World(diverges), trial_runs=2)
    failed = [trial for trial in trials if trial["score"] is None and not trial["pruned"]]
    assert failed
    assert all([step for step, _ in trial["rungs"]] == [10] for trial in failed)
    assert all(trial["statuses"] == ["diverged", "diverged"] for trial in failed)


def test_limits_are_kept_before_the_first_rung(pruned):
    least = min(trial["parameters"] for trial in pruned[2])
    _, trials = calibrated(World(), limits={"parameters": least}, sampler=SamplerSpec(kind="tpe", startup=4))
    beyond = [trial for trial in trials if trial["parameters"] > least]
    assert beyond
    assert all(trial["score"] is None and "rungs" not in trial for trial in beyond)


def test_later_rungs_that_are_the_same_step_count_once():
    assert dataclasses.replace(SPEC, updates=4).stops == (1, 2)
    assert dataclasses.replace(SPEC, updates=1).stops == ()
    assert dataclasses.replace(SPEC, rungs=(), pruner="none").stops == ()


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"rungs": (0.5, 0.25)}, r"rungs = \[0\.5, 0\.25\] \(shares between 0 and 1, each above"),
        ({"rungs": (0.5, 1.0)}, r"rungs = \[0\.5, 1\.0\]; 0 < rungs < 1 must hold"),
        ({"rungs": ()}, r"pruner = 'median' with rungs = \[\] \(at least one rung"),
        ({"pruner": "mean"}, r"pruner = 'mean' \(none or median\)"),
        ({"cost": "parameters"}, "the rule knows one score"),
    ],
)
def test_rungs_that_cannot_be_are_refused(change, match):
    with pytest.raises(ConfigError, match=match):
        dataclasses.replace(SPEC, **change)


def test_reports_that_cannot_be_are_refused():
    study = Study(SPACE, 1, SPEC.sampler, pruner="median")
    (trial,) = study.ask(1)
    with pytest.raises(ConfigError, match="trial 1 was not asked"):
        study.report(1, 10, 5.0)
    with pytest.raises(ConfigError, match="reports nan at step 10"):
        study.report(trial.number, 10, float("nan"))
    with pytest.raises(ConfigError, match=r"reported as pruned, with values \[5\.0\]"):
        study.tell(trial.number, [5.0], pruned=True)
    study.tell(trial.number, None, pruned=True)
    with pytest.raises(ConfigError, match="report before you tell"):
        study.report(trial.number, 20, 5.0)
    with pytest.raises(ConfigError, match="pruner 'median' with 2 objectives"):
        Study(SPACE, 1, SPEC.sampler, objectives=2, pruner="median")


def test_the_order_in_which_answers_come_has_no_say(pruned):
    """Any number of workers: a batch ends in any order, and comes back in that of its orders."""

    class Shuffled(World):
        def __call__(self, orders):
            draw = random.Random(len(self.orders))
            some = list(enumerate(orders))
            draw.shuffle(some)
            self.orders += orders
            found = {place: self.outcome(order) for place, order in some}
            return [found[place] for place in range(len(orders))]

    assert calibrated(Shuffled())[0].to_json() == pruned[1].to_json()


def test_orders_in_parts_that_cannot_be_are_refused():
    order = TrainingRequest({}, {}, ("a", "b"), ("c",), 0, updates=10, until=5, stops=(2,))
    assert TrainingRequest.from_json(json.loads(json.dumps(order.to_json()))) == order
    assert order.whole == dataclasses.replace(order, until=None, stops=())
    for change in ({"until": 10}, {"until": 2}, {"until": 0, "stops": ()}, {"stops": (4, 3)}, {"stops": (0,)}):
        with pytest.raises(ConfigError, match=r"stops .* of 10 updates"):
            dataclasses.replace(order, **change)
