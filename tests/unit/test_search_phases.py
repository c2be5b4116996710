"""Phases of the search on a made-up world, in which what a training gives is a known function of its settings."""

import dataclasses
import hashlib
import json

import numpy as np
import pytest

from edp.config.experiment import load_experiment, plain_tree
from edp.errors import ConfigError, DataError
from edp.evaluation.controller import Budget
from edp.workflows.search.arms import Arm
from edp.workflows.search.context import SearchContext, set_apart
from edp.workflows.search.engine import run_phases
from edp.workflows.search.modules import THESIS_MODULES
from edp.workflows.search.phases import PHASES
from edp.workflows.search.settings import (
    CalibrationSpec,
    CompressionSpec,
    IsolationSpec,
    ModuleScreeningSpec,
    PlanningSpec,
    SearchSpec,
    TrialsSpec,
)
from edp.workflows.search.smaller import Recipe
from edp.workflows.search.space import Choice, Real
from edp.workflows.search.study import SamplerSpec
from edp.workflows.search.trainings import SCORES, Outcome

pytestmark = pytest.mark.long

SESSIONS = tuple(f"s{number:02d}" for number in range(12))
SPACE = {"learning_rate": Real(1e-4, 1e-1, log=True), "units": Choice((4, 8, 16))}
SPEC = SearchSpec(
    updates=10,
    folds=3,
    isolation=IsolationSpec(runs=6),
    calibration=CalibrationSpec(trials=8),
    space=SPACE,
    sampler=SamplerSpec(kind="tpe", startup=4),
    backbones=("lstm", "hybrid"),
)


def context(spec=SPEC):
    base = Arm.from_experiment(load_experiment(None, "quick", ["model.blocks=[]", "model.backbone.units=4"]))
    return SearchContext(spec, base, {"path": "nowhere"}, SESSIONS[:9], SESSIONS[9:11], second=SESSIONS[11:])


class World:
    """Scores by settings, session and seed; remembers what it did, like a ledger."""

    def __init__(self, effect, noise=0.02):
        self.effect, self.noise, self.done, self.trained = effect, noise, {}, 0

    def __call__(self, orders):
        return [self.outcome(order) for order in orders]

    def outcome(self, order):
        key = json.dumps(order.to_json(), sort_keys=True)
        if key not in self.done:
            self.trained += 1
            self.done[key] = self._train(order)
        return self.done[key]

    def _train(self, order):
        score = self.effect(order.settings)
        if score is None:
            return Outcome(order, "diverged", None, "the loss is nan")
        digest = hashlib.blake2b(json.dumps([order.settings, order.seed], sort_keys=True).encode(), digest_size=8)
        rng = np.random.default_rng(int.from_bytes(digest.digest(), "big"))
        sessions = {
            name: {"10": dict.fromkeys(SCORES, score + 0.1 * int(name[1:]) / 12 + self.noise * rng.normal())}
            for name in order.judged
        }
        more = {} if order.recipe is None else smaller_outcome(order, score)
        return Outcome(order, "done", {"sessions": sessions, **more})


def smaller_outcome(order, score):
    """What phase 6 is told of a network: wider ones are better, and all but the teacher fit."""
    recipe = Recipe.from_json(order.recipe)
    width = recipe.units or order.settings["model"]["backbone"]["units"]
    formats = {}
    for name in [recipe.final] if recipe.final else recipe.formats:
        if recipe.rounded and name != "w8a16":
            continue
        mae = score * (1 + 1 / width) * (1.0 if name == "float32" else 1.02)
        size = 400 * width if name == "float32" else 100 * width
        taken = {"parameters": 100 * width, "macs_tick": 100 * width, "macs_window": 900 * width}
        taken |= {"cycles": [900 * width] * 3, "parameter_bytes": size, "ram_bytes": size, "flash_bytes": size}
        over = {"cycles": [900 * width, 1]} if recipe.units is None else {}
        formats[name] = {"scores": {"10": {"mae": mae, "composite": mae}}, "resource_usage": taken, "over": over}
    plain = {"10": {"mae": score * (1 + 1 / width), "composite": score}}
    return {"formats": formats, "plain": plain, "left_out": {}}


def by_rate(settings):
    """Best at a rate of 3e-3; FG2 and hybrids better; units hardly matter."""
    rate = np.log10(settings["training"]["optimizer"]["learning_rate"])
    score = 5.0 + 0.5 * (rate + 2.5) ** 2 - 0.002 * settings["model"]["backbone"]["units"]
    score -= 0.5 * (settings["task"]["features"] == "FG2")
    return score - 0.3 * (settings["model"]["backbone"]["kind"] == "hybrid")


@pytest.fixture(scope="module")
def found():
    return run_phases(context(), World(by_rate), until="calibration")


def test_phase_0_takes_the_better_feature_set_and_says_how_sure_it_is(found):
    facts = found.decided["isolation"].to_json()["facts"]
    assert facts["features"] == "FG2"
    assert set(facts["arms"]) == {"lstm FG1", "lstm FG2", "hybrid FG1", "hybrid FG2"}
    assert all(held["p"] < 0.05 and held["change"] < -0.05 for held in facts["comparisons"].values())
    assert 0 < facts["arms"]["hybrid FG2"]["seed"] < 0.1
    assert np.mean(facts["arms"]["hybrid FG2"]["by_run"]) == pytest.approx(facts["arms"]["hybrid FG2"]["mean"])
    assert facts["arms"]["hybrid FG2"]["mae"]["mean"] == pytest.approx(facts["arms"]["hybrid FG2"]["mean"])
    assert all(held["low"] < held["change"] < held["high"] < 0 for held in facts["comparisons"].values())
    assert facts["variance"]["run"] >= 0


def test_phase_0_holds_the_best_backbone_against_the_others():
    def hybrid_gains(settings):
        return by_rate(settings) * (0.9 if settings["model"]["backbone"]["kind"] == "hybrid" else 1.0)

    facts = run_phases(context(), World(hybrid_gains), until="isolation").decided["isolation"].to_json()["facts"]
    (held,) = facts["backbones"].values()
    assert held["best"] == "hybrid"
    assert list(facts["backbones"]) == ["lstm"]
    assert held["low"] < held["change"] < held["high"] < 0


def test_phase_0_pairs_all_arms_on_the_same_folds_and_seeds():
    world = World(by_rate)
    run_phases(context(), world, until="isolation")
    orders = [json.loads(key) for key in world.done]
    assert len(orders) == 4 * 6 * 2
    pairs = {(tuple(order["judged"]), order["seed"]) for order in orders}
    assert len(pairs) == 12
    for order in orders:
        assert not set(order["judged"]) & set(order["train"])
        assert set(order["judged"]) | set(order["train"]) == set(SESSIONS[:9])


def test_phase_1_finds_the_rate_and_the_smallest_size_that_is_not_bettered(found):
    facts = found.decided["calibration"].to_json()["facts"]
    assert facts["backbone"] == "hybrid"
    assert abs(np.log10(facts["baseline"]["learning_rate"]) + 2.5) < 1.0
    assert facts["settings"]["task"]["features"] == "FG2"
    assert facts["settings"]["training"]["optimizer"]["learning_rate"] == facts["baseline"]["learning_rate"]
    assert len(facts["backbones"]["lstm"]["trials"]) == 8
    units = [trial["values"]["units"] for trial in facts["backbones"]["lstm"]["trials"][:3]]
    assert units == [4, 8, 16]  # the warm round asks every size once


class OneFoldMisleads(World):
    """The sessions of the first fold are easy for the LSTM, which is worse on all others."""

    def _train(self, order):
        found = super()._train(order)
        easy = order.judged == context().orders(Arm(), [0])[0].judged
        if easy and order.settings["model"]["backbone"]["kind"] == "lstm":
            for scores in found.result["sessions"].values():
                scores["10"] = {name: value - 2.0 for name, value in scores["10"].items()}
        return found


@pytest.mark.parametrize("mode", ["sound", "thesis"])
def test_backbones_are_chosen_on_all_folds_but_in_the_thesis_by_one(mode):
    def hybrid_gains(settings):
        return by_rate(settings) - 0.7 * (settings["model"]["backbone"]["kind"] == "hybrid")

    spec = dataclasses.replace(SPEC, mode=mode)
    facts = (
        run_phases(context(spec), OneFoldMisleads(hybrid_gains), until="calibration")
        .decided["calibration"]
        .to_json()["facts"]
    )
    kept = {name: held["score"] for name, held in facts["backbones"].items()}
    if mode == "sound":
        assert kept["lstm"] < kept["hybrid"]
        assert facts["final"]["runs"] == 3
        assert facts["final"]["scores"]["hybrid"] < facts["final"]["scores"]["lstm"]
        assert facts["final"]["against"]["lstm"]["best"] == "hybrid"
        assert facts["backbone"] == facts["settings"]["model"]["backbone"]["kind"] == "hybrid"
    else:
        assert "final" not in facts
        assert facts["backbone"] == min(kept, key=lambda name: kept[name])


def test_decisions_are_plain_and_come_again_without_a_training(found):
    world = World(by_rate)
    first = run_phases(context(), world, until="calibration")
    trained = world.trained
    again = run_phases(context(), world, until="calibration")
    assert world.trained == trained
    for name in ("isolation", "calibration"):
        plain = json.loads(json.dumps(again.decided[name].to_json()))
        assert plain == json.loads(json.dumps(first.decided[name].to_json()))
        assert first.decided[name].to_json()["facts"] == found.decided[name].to_json()["facts"]
        assert all(sentence.endswith(".") for sentence in plain["sentences"])


def test_trainings_that_diverge_count_as_the_worst_and_are_never_chosen():
    def brittle(settings):
        return None if settings["training"]["optimizer"]["learning_rate"] > 1e-2 else by_rate(settings)

    facts = run_phases(context(), World(brittle), until="calibration").decided["calibration"].to_json()["facts"]
    assert facts["baseline"]["learning_rate"] <= 1e-2
    statuses = [status for trial in facts["backbones"]["lstm"]["trials"] for status in trial["statuses"]]
    assert "diverged" in statuses

    def fg1_breaks(settings):
        return (
            None if settings["task"]["features"] == "FG1" and settings["model"]["backbone"]["kind"] == "lstm" else 5.0
        )

    assert (
        run_phases(context(), World(fg1_breaks), until="isolation").decided["isolation"].to_json()["facts"]["features"]
        == "FG2"
    )
    usual = context().base["training"]["optimizer"]["learning_rate"]

    def only_as_it_was(settings):
        return 9.0 if settings["training"]["optimizer"]["learning_rate"] == usual else None

    with pytest.raises(DataError, match="no training of any backbone ended well"):
        run_phases(context(), World(only_as_it_was), until="calibration")


def test_what_costs_too_much_is_not_trained_and_a_cost_gives_a_front():
    spec = dataclasses.replace(SPEC, limits={"parameters": 4000.0}, cost="parameters", backbones=("lstm",))
    world = World(by_rate)
    facts = run_phases(context(spec), world, until="calibration").decided["calibration"].to_json()["facts"]
    trials = facts["backbones"]["lstm"]["trials"]
    assert any(trial["parameters"] > 4000 for trial in trials)
    assert all((trial["score"] is None) == (trial["parameters"] > 4000) for trial in trials)
    front = facts["front"]["lstm"]
    costs = [held["parameters"] for held in sorted(front, key=lambda held: held["score"])]
    assert costs == sorted(costs, reverse=True)


def test_the_thesis_mode_uses_its_own_estimates():
    spec = dataclasses.replace(SPEC, mode="thesis")
    sound, thesis = (
        run_phases(context(s), World(by_rate), until="isolation").decided["isolation"].to_json()["facts"]
        for s in (SPEC, spec)
    )
    assert sound["arms"]["lstm FG1"]["split_interval"] is not None
    assert thesis["arms"]["lstm FG1"]["split_interval"] is None


def test_sessions_set_apart_are_spread_over_families_and_drawn_by_the_root():
    families = {name: "dig" if number % 3 else "grading" for number, name in enumerate(SESSIONS)}
    spec = dataclasses.replace(SPEC, test_fraction=0.25)
    development, test, second = set_apart(SESSIONS, families, spec)
    assert len(test) == 3
    assert len(second) == 1
    assert {families[name] for name in test} == {"dig", "grading"}
    assert sorted(development + test + second) == list(SESSIONS)
    assert set_apart(SESSIONS, families, spec) == (development, test, second)
    without = set_apart(SESSIONS, families, dataclasses.replace(spec, compression=CompressionSpec(enabled=False)))
    assert without == (tuple(name for name in SESSIONS if name not in test), test, ())
    others = {set_apart(SESSIONS, families, dataclasses.replace(spec, seed=seed))[1] for seed in range(6)}
    assert len(others) > 1
    with pytest.raises(DataError, match="1 are left for 3 folds"):
        set_apart(SESSIONS[:3], {}, spec)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"mode": "quick"}, "mode = 'quick'"),
        (
            {"updates": 0, "test_fraction": 1.0},
            r"updates = 0; .* test_fraction = 1\.0; 0 < test_fraction < 1 must hold",
        ),
        ({"folds": 3, "isolation": IsolationSpec(runs=4)}, "two repeats of the 3 folds"),
        ({"limits": {"flash": 1.0}}, "limits.flash"),
        ({"cost": "cycles"}, "cost = 'cycles'"),
    ],
)
def test_settings_out_of_range_are_refused(options, message):
    with pytest.raises(ConfigError, match=message):
        SearchSpec(**options)


def test_an_unknown_phase_is_named():
    with pytest.raises(ConfigError, match="unknown phase 'calibratoin'"):
        run_phases(context(), World(by_rate), until="calibratoin")
    assert list(PHASES)[:2] == ["isolation", "calibration"]
    assert plain_tree(load_experiment(None, "quick"))["task"]["features"] == "FG2"


def with_effects(settings):
    """Squeeze-excitation gains 6 %, zoneout loses 6 %, the others do nothing."""
    kinds = {block["kind"] for block in settings["model"]["blocks"]}
    score = by_rate(settings) * (1 - 0.06 * ("squeeze_excitation" in kinds))
    return score * (1 + 0.06 * (settings["model"]["backbone"].get("zoneout", 0) > 0))


CONFIRMED = dataclasses.replace(
    SPEC,
    backbones=("hybrid",),
    features=("FG1", "FG2"),
    planning=PlanningSpec(max_runs=6),
    calibration=CalibrationSpec(trials=6),
    synthesis=TrialsSpec(trials=6),
    exploration=TrialsSpec(trials=16),
    modules=tuple(THESIS_MODULES),
)


@pytest.fixture(scope="module")
def sound():
    world = World(with_effects)
    return run_phases(context(CONFIRMED), world), world


def test_the_design_passes_what_helps_and_stops_what_harms(sound):
    facts = sound[0].decided["screening"].to_json()["facts"]
    assert set(facts["registered"]) == set(THESIS_MODULES)
    assert "squeeze_excitation" in facts["passed"]
    assert "zoneout" not in facts["passed"]
    assert facts["modules"]["squeeze_excitation"]["change"] == pytest.approx(-0.06, abs=0.02)
    assert facts["modules"]["squeeze_excitation"]["importance"] > 0.2


def test_the_plan_says_how_many_runs_and_why(sound):
    decision = sound[0].decided["planning"]
    assert 3 <= decision.facts.runs <= 6
    assert "To see 2 %" in decision.sentences[0]


def test_a_plan_that_no_number_of_runs_meets_makes_the_most_that_are_allowed(sound):
    small = dataclasses.replace(
        sound[0], spec=dataclasses.replace(CONFIRMED, planning=PlanningSpec(max_runs=6, min_effect=1e-4))
    )
    decision = run_phases(small, World(with_effects), phases=["planning"]).decided["planning"]
    assert decision.facts.runs == 6
    assert decision.facts.enough is None
    assert "6 runs are made nevertheless" in decision.sentences[1]


def test_only_what_really_helps_is_confirmed(sound):
    facts = sound[0].decided["confirmation"].to_json()["facts"]
    assert facts["confirmed"] == ["squeeze_excitation"]
    by_name = {held["module"]: held for held in facts["evidence"]}
    assert set(by_name) == set(sound[0].decided["screening"].to_json()["facts"]["registered"])
    assert by_name["squeeze_excitation"]["change"] == pytest.approx(-0.06, abs=0.02)
    assert by_name["zoneout"]["p"] == 1.0


def test_what_a_look_drops_is_not_trained_any_more(sound):
    facts = sound[0].decided["confirmation"].to_json()["facts"]
    runs = sound[0].decided["planning"].to_json()["facts"]["runs"]
    for held in facts["evidence"]:
        assert held["runs"] in (0, 5, runs)
        assert (held["runs"] == 5 and runs > 5) == bool(held["dropped_after"])


def test_the_thesis_mode_walks_the_same_phases_by_its_own_rules():
    spec = dataclasses.replace(
        CONFIRMED,
        mode="thesis",
        run_seeds=2,
        screening=ModuleScreeningSpec(trials=3),
        planning=PlanningSpec(max_runs=4),
    )
    found = run_phases(context(spec), World(with_effects), until="confirmation")
    screening, confirmation = (found.decided[name].to_json()["facts"] for name in ("screening", "confirmation"))
    assert "squeeze_excitation" in screening["passed"]
    assert found.decided["planning"].to_json()["facts"]["runs"] <= 4
    assert "squeeze_excitation" in confirmation["confirmed"]
    assert {held["metric"] for held in confirmation["evidence"]} == {"mae", "rmse", "p95", "p99"}


def test_without_a_survivor_nothing_is_trained():
    world = World(lambda settings: 5.0 + bool(settings["model"]["blocks"]), noise=0.0)
    first = run_phases(context(CONFIRMED), world, until="planning")
    first = dataclasses.replace(
        first,
        decided={
            **first.decided,
            "screening": dataclasses.replace(
                first.decided["screening"], facts=dataclasses.replace(first.decided["screening"].facts, passed=())
            ),
        },
    )
    trained = world.trained
    found = run_phases(first, world, phases=["confirmation"])
    assert world.trained == trained
    assert found.decided["confirmation"].to_json()["facts"]["confirmed"] == []


def test_the_synthesis_opens_the_test_sessions_once_and_only_there(sound):
    found, world = sound
    orders = [json.loads(key) for key in world.done]
    opened = [order for order in orders if set(order["judged"]) & set(SESSIONS[9:11])]
    assert len(opened) == 2 * CONFIRMED.run_seeds
    assert all(order["judged"] == list(SESSIONS[9:11]) and order["train"] == list(SESSIONS[:9]) for order in opened)
    assert {order["updates"] for order in opened} == {CONFIRMED.final_updates}
    assert not any(set(order["train"]) & set(SESSIONS[9:]) for order in orders)
    facts = found.decided["synthesis"].to_json()["facts"]
    assert facts["modules"] == ["squeeze_excitation"]
    assert facts["test"]["synthesis"]["composite"] < facts["test"]["baseline"]["composite"]
    assert facts["test_gain"]["low"] < facts["test_gain"]["change"] < 0
    assert facts["test_gain"]["change"] == pytest.approx(
        facts["test"]["synthesis"]["composite"] / facts["test"]["baseline"]["composite"] - 1
    )
    assert len(facts["trials"]) == 6
    assert facts["trials"][0]["modules"] == ["squeeze_excitation"]  # the warm start


def test_the_exploration_starts_from_the_synthesis_and_is_judged_on_fresh_folds(sound):
    found, world = sound
    facts = found.decided["exploration"].to_json()["facts"]
    first = facts["trials"][0]
    assert first["modules"] == found.decided["synthesis"].to_json()["facts"]["modules"]
    assert facts["runs"] == 6
    assert facts["teacher"] in ("synthesis", "exploration")
    assert (
        "squeeze_excitation"
        in (facts if facts["teacher"] == "exploration" else found.decided["synthesis"].to_json()["facts"])["modules"]
    )
    seeds = {order["seed"] for order in map(json.loads, world.done)}
    fresh = {context(CONFIRMED).seed("run", run, 0) for run in range(6, 12)}
    assert fresh <= seeds


def test_the_exploration_varies_the_options_of_modules_that_are_on(sound):
    facts = sound[0].decided["exploration"].to_json()["facts"]
    for trial in facts["trials"]:
        asked = {name.partition(".")[0] for name in trial["values"] if "." in name}
        assert asked == set(trial["modules"]) & {name.partition(".")[0] for name in facts["options"]}
    seen = {(name, value) for trial in facts["trials"] for name, value in trial["values"].items() if "." in name}
    assert {value for name, value in seen if name == "squeeze_excitation.reduction"} > {4}


def test_synergies_that_no_module_has_alone_are_found_by_the_exploration():
    def together(settings):
        kinds = {block["kind"] for block in settings["model"]["blocks"]}
        return by_rate(settings) * (1 - 0.2 * ({"squeeze_excitation", "temporal_difference"} <= kinds))

    spec = dataclasses.replace(CONFIRMED, exploration=TrialsSpec(trials=40))
    world = World(together)
    found = run_phases(context(spec), world)
    facts = found.decided["exploration"].to_json()["facts"]
    assert {"squeeze_excitation", "temporal_difference"} <= set(facts["modules"])
    alone = found.decided["confirmation"].to_json()["facts"]["confirmed"]
    assert facts["teacher"] == "exploration" or {"squeeze_excitation", "temporal_difference"} <= set(alone)


def test_phase_6_compares_on_development_sessions_and_opens_the_second_lock_box_for_two(sound):
    found, world = sound
    orders = [json.loads(key) for key in world.done]
    made = [order for order in orders if "recipe" in order]
    sealed = [order for order in made if set(order["judged"]) & set(SESSIONS[11:])]
    assert [order["recipe"]["final"] for order in made[-2:]] == ["float32", sealed[-1]["recipe"]["final"]]
    assert sealed == made[-2:]
    context = found
    for order in made:
        assert order["train"] == list(context.training)
        assert order["updates"] == CONFIRMED.final_updates
        assert order["settings"] == found.decided["exploration"].to_json()["facts"]["teacher_settings"]
    assert all(order["judged"] == list(context.validation) for order in made[:-2])
    assert not any(set(order["judged"]) & set(SESSIONS[11:]) for order in orders if order not in sealed)
    facts = found.decided["compression"].to_json()["facts"]
    assert facts["chosen"] is not None
    row = facts["rows"][facts["chosen"]]
    assert row["error"] == min(one["error"] for one in facts["rows"] if not one["over"])
    assert facts["held_out_test"]["error"] > 0
    assert len(made) <= PHASES["compression"].trainings(found)


def test_phase_6_can_be_left_out_and_a_budget_that_nothing_meets_ends_in_a_sentence(sound):
    before = dataclasses.replace(
        sound[0], decided={name: held for name, held in sound[0].decided.items() if name != "compression"}
    )
    off = dataclasses.replace(CONFIRMED, compression=CompressionSpec(enabled=False))
    world = World(with_effects)
    found = run_phases(dataclasses.replace(before, spec=off), world, phases=["compression"])
    assert (world.trained, found.decided["compression"].to_json()["facts"]["on"]) == (0, False)
    assert PHASES["compression"].trainings(dataclasses.replace(before, spec=off)) == 0
    tight = dataclasses.replace(CONFIRMED, compression=CompressionSpec(budget=Budget(name="none", cycles=10)))
    found = run_phases(dataclasses.replace(before, spec=tight), world, phases=["compression"])
    assert world.trained == 1
    assert "budget 'none': cycles = 10 can be met by no width" in found.decided["compression"].sentences[0]
    assert found.decided["compression"].to_json()["facts"]["chosen"] is None


def test_phase_6_whose_teacher_fails_opens_nothing(sound):
    world = World(lambda settings: None)
    found = run_phases(sound[0], world, phases=["compression"])
    assert world.trained == 1
    assert "did not end well (the loss is nan)" in found.decided["compression"].sentences[0]


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"units": (0,)}, "units"),
        ({"width_fractions": ()}, "width_fractions"),
        ({"width_fractions": (2.0,)}, "width_fractions"),
        ({"formats": ("w8a61",)}, "did you mean 'w8a16'"),
        ({"updates": -1}, "updates = -1"),
        ({"units": (10**9,)}, "units"),
    ],
)
def test_settings_of_phase_6_out_of_range_are_refused(change, match):
    with pytest.raises(ConfigError, match=match):
        CompressionSpec(**change)
