"""The search of the thesis: what `--preset thesis` can reach and does, against the text and its printed figures."""

import dataclasses
import itertools
import re
from pathlib import Path

import numpy as np
import pytest

from edp.errors import ConfigError
from edp.workflows.search.arms import Arm
from edp.workflows.search.context import SearchContext
from edp.workflows.search.engine import run_phases
from edp.workflows.search.modules import THESIS_MODULES, TOGGLES, fitting
from edp.workflows.search.phases import PHASES
from edp.workflows.search.phases.isolation import arm_of
from edp.workflows.search.plan import load_plan
from edp.workflows.search.settings import (
    CalibrationSpec,
    ModuleScreeningSpec,
    SearchSpec,
    TrialsSpec,
)
from edp.workflows.search.space import Choice, Real, apply, elastic, halved
from edp.workflows.search.trainings import SCORES, Outcome, costs_of

PLAN = load_plan(None, "thesis")
DOC = Path(__file__).parents[2] / "docs/explanation/thesis.md"
SESSIONS = tuple(f"s{number:02d}" for number in range(31))


def context(**changes):
    spec = dataclasses.replace(PLAN.spec, **changes)
    return SearchContext(spec, Arm.from_experiment(PLAN.experiment), {"path": "nowhere"}, SESSIONS[:25], SESSIONS[25:])


def network(values, modules=(), options=None):
    """Settings of a network of the space: a point of phase 1, then modules with options of phase 5."""
    held = context()
    check = {**held.spec.space, **held.spec.deferred}
    assert all(check[name].holds(value) for name, value in values.items())
    return held.network(held.shaped(apply(held.base, values)), modules, options)


# Hybrid, FG2. Table 4.8 and 4.9; how the counts come about is in design/golden_architectures.md.
PRINTED = {
    677_572: ({"units": 128, "layers": 3, "kernel": 7}, ("multi_scale_tcn",)),
    703_527: (
        {"units": 128, "layers": 3, "kernel": 7},
        (
            *("multi_scale_tcn", "attention_bridge", "temporal_difference", "layer_norm_lstm"),
            *("deeper_head", "stanh"),
        ),
    ),
    1_197_319: ({"units": 256, "layers": 1, "kernel": 5}, ("temporal_difference", "stanh")),
    # Table B.1, which is of the appendix and no winner.
    1_376_775: (
        {"units": 256, "layers": 4, "kernel": 3},
        ("multi_scale_tcn", "cylinder_gate", "deeper_head", "stanh"),
    ),
}


@pytest.mark.parametrize("parameters", PRINTED)
def test_the_printed_networks_are_points_of_the_space(parameters):
    values, modules = PRINTED[parameters]
    assert costs_of(network(values, modules))["parameters"] == parameters


def test_the_teacher_of_ten_samples_may_have_zoneout():
    values, modules = PRINTED[1_197_319]
    assert costs_of(network(values, (*modules, "zoneout")))["parameters"] == 1_197_319


def test_widths_halve_and_the_baseline_is_that_of_table_4_8():
    """Table 4.8: 677,572 are 70.7 % more than the baseline, 703,527 are 77.3 % more; one network meets both."""
    settings = network({"units": 128, "layers": 3, "kernel": 7})
    assert settings["model"]["backbone"]["channels"] == [128, 64, 32]
    assert settings["model"]["head"] == {"kind": "mlp", "hidden": 64, "layers": 1}
    base = costs_of(settings)["parameters"]
    assert base == 396_900
    assert round(100 * (677_572 / base - 1), 1) == 70.7
    assert round(100 * (703_527 / base - 1), 1) == 77.3


def test_every_point_of_the_space_makes_a_network_of_every_backbone():
    held = context()
    for backbone in PLAN.spec.backbones:
        arm = held.base
        if backbone != "hybrid":
            arm = arm_of(held.base, backbone, "FG2")
        for layers, kernel in itertools.product((1, 2, 3, 4), (3, 5, 7)):
            made = held.shaped(
                apply(arm, {"units": 64, "layers": layers, "kernel": kernel} if backbone != "lstm" else {})
            )
            assert costs_of(made)["parameters"] > 0
            if backbone == "tcn":  # R >= W, section 3.2.3.2
                levels = len(made["model"]["backbone"]["channels"])
                assert 1 + 2 * (kernel - 1) * (2**levels - 1) >= 50
                assert levels == layers or 1 + 2 * (kernel - 1) * (2 ** (levels - 1) - 1) < 50


def test_all_fourteen_modules_can_be_screened_and_none_is_in_the_baseline():
    base = network({"units": 128, "layers": 3, "kernel": 7})
    assert fitting(base, among=PLAN.spec.modules) == tuple(THESIS_MODULES) == PLAN.spec.modules
    assert len(THESIS_MODULES) == 14
    plain = costs_of(base)["parameters"]
    for name in THESIS_MODULES:
        changed = context().network(base, [name])
        assert changed != base
        assert (costs_of(changed)["parameters"] == plain) == (name in ("zoneout", "physics_residual"))


def test_a_gated_head_has_the_width_of_the_plain_one():
    """Section 3.2.2.3: the projection is 2 d' wide for the d' of the baseline."""
    base = network({"units": 256, "layers": 1, "kernel": 5})
    assert context().network(base, ["glu_head"])["model"]["head"]["hidden"] == 128
    made = context().network(base, ["glu_head"], {"glu_head.hidden": 32})
    assert made["model"]["head"]["hidden"] == 32


def test_widths_are_those_whatever_is_repeated():
    once = network({"units": 256, "layers": 4, "kernel": 3}, ("deeper_head",))
    assert halved(once) == once
    assert once["model"]["backbone"]["channels"] == [256, 128, 64, 32]


def test_toggles_are_those_of_table_4_6_that_are_no_module():
    table = {"SWA", "Correlation Loss", "Focal Loss"}
    assert {TOGGLES[name].title for name in PLAN.spec.toggles} == table
    assert not table & {module.title for module in THESIS_MODULES.values()}
    held = context()
    made = held.network(held.base, PLAN.spec.toggles)["training"]
    assert made["average"] == {"kind": "swa"}
    assert made["loss"] == {"kind": "focal", "gamma": 2.0, "delta": 1.5}
    assert made["terms"] == [{"kind": "correlation", "weight": 0.1}]
    squares = held.network(apply(held.base, {"loss": "mse"}), ["focal_loss"])["training"]["loss"]
    assert squares == {"kind": "focal", "gamma": 2.0, "delta": 1e6}


def test_the_space_is_the_printed_one():
    """Section 3.3.2, and 3.2.4.2 and 3.2.4.3 for what is deferred."""
    assert PLAN.spec.space == {
        "learning_rate": Real(1e-4, 5e-3, log=True),
        "weight_decay": Real(1e-5, 1e-2, log=True),
        "dropout": Real(0.05, 0.40),
        "units": Choice((64, 128, 256, 512)),
        "layers": Choice((1, 2, 3, 4)),
        "kernel": Choice((3, 5, 7)),
        "loss": Choice(("mse", "huber")),
    }
    assert set(PLAN.spec.deferred) == {"schedule", "patience", "smoothness"}
    assert 0.0 in PLAN.spec.deferred["smoothness"].options
    table = dict(re.findall(r"^\| `(\w+)` \| (.+?) \| ", DOC.read_text(), re.MULTILINE))
    for name, held in {**PLAN.spec.space, **PLAN.spec.deferred}.items():
        said = ", ".join(map(str, held.options)) if isinstance(held, Choice) else f"{held.low:g} to {held.high:g}"
        assert table[name].startswith(said), name


def test_deferred_dimensions_set_what_they_say():
    base = context().base
    cosine = apply(base, {"schedule": "cosine", "patience": 3})["training"]["schedule"]
    assert cosine == {"kind": "cosine", "warmup": 0.0, "min_lr_ratio": 0.0}
    plateau = apply(base, {"schedule": "plateau", "patience": 3})["training"]["schedule"]
    assert (plateau["kind"], plateau["factor"], plateau["patience"], plateau["threshold"]) == ("plateau", 0.5, 3, 1e-4)
    smooth = apply(base, {"smoothness": 0.05})["training"]
    assert smooth["terms"] == [{"kind": "smoothness", "weight": 0.05}]
    assert smooth["chunks"]["consecutive"] == 4  # of a batch of 32: three are needed for a second difference
    assert apply(base, {"smoothness": 0.0})["training"] == base["training"]


def test_the_elastic_window_leaves_the_space_as_printed():
    """Section 3.3.3: a decade to both sides, and the dropout within [0, 1]."""
    baseline = {"learning_rate": 4e-3, "weight_decay": 1e-5, "dropout": 0.1}
    window = elastic(PLAN.spec.space, baseline, beyond=True)
    assert (window["learning_rate"].low, window["learning_rate"].high) == pytest.approx((4e-4, 4e-2))
    assert (window["weight_decay"].low, window["weight_decay"].high) == pytest.approx((1e-6, 1e-4))
    assert (window["dropout"].low, window["dropout"].high) == pytest.approx((0.0, 0.25))


def denominators(percentages, most=200):
    """How many runs there may have been, if each percentage is a whole number of them to one decimal."""
    return [
        n
        for n in range(1, most)
        if all(any(f"{100 * k / n:.1f}" == said for k in range(n + 1)) for said in percentages.split())
    ]


def test_the_percentages_of_table_4_6_say_how_many_trials_there_were():
    assert denominators("0.0 70.6 23.5 29.4")[0] == 17
    assert denominators("0.0 76.5 23.5")[0] == 17
    assert denominators("68.3 29.3 40.2 79.3 73.2 20.7 14.6 51.2 35.4")[0] == 82
    assert denominators("83.0 73.0 41.1 17.0 42.6 15.6 7.8 18.4 14.9 35.5")[0] == 141
    assert (PLAN.spec.horizon, PLAN.spec.exploration.trials, PLAN.spec.synthesis.trials) == (10, 141, 15)


def test_budgets_are_the_printed_ones():
    spec = PLAN.spec
    assert spec.calibration == CalibrationSpec(trials=28, warm_rounds=6)
    assert (spec.screening.trials, spec.confirmation.alpha, spec.planning.power) == (10, 0.05, 0.8)
    assert (spec.planning.min_effect, spec.planning.max_runs, spec.pruner, spec.sampler.kind) == (
        0.02,
        25,
        "median",
        "thesis_tpe",
    )
    assert (spec.epochs, spec.patience, spec.updates, spec.final_updates) == (25, 8, 0, 0)
    training = PLAN.experiment.training
    assert (training.chunks.regime, training.chunks.batch, training.clip_norm) == ("window", 32, 1.0)
    assert spec.stops == tuple(range(1, 25))


def test_the_page_says_what_the_planner_counts():
    held = context()
    asked = [phase.trainings(held) for phase in PHASES.values()]
    assert (
        f"{sum(asked):,}"
        in re.search(r"^\| `thesis` \|.*$", (DOC.parents[1] / "howto" / "run_search.md").read_text(), re.MULTILINE)[0]
    )
    assert f"**{sum(asked):,} trainings**" in DOC.read_text()


class World:
    """Scores by settings and seed; remembers the orders that came."""

    def __init__(self):
        self.orders = []

    def __call__(self, orders):
        self.orders += orders
        return [self.outcome(order) for order in orders]

    def outcome(self, order):
        rng = np.random.default_rng([order.seed, len(order.settings["model"]["blocks"])])
        drawn = 5.0 + 0.02 * rng.normal() - 0.3 * len(order.settings["model"]["blocks"])
        scores = {name: drawn * (1 + 0.1 * place) for place, name in enumerate(SCORES)}
        return Outcome(order, "done", {"sessions": {name: {"10": scores} for name in order.judged}})


@pytest.fixture(scope="module")
def walked():
    world = World()
    small = {
        "screening": ModuleScreeningSpec(trials=2),
        "exploration": TrialsSpec(trials=4),
        "synthesis": TrialsSpec(trials=3),
        "isolation": dataclasses.replace(PLAN.spec.isolation, runs=10),
        "planning": dataclasses.replace(PLAN.spec.planning, max_runs=5),
        "calibration": CalibrationSpec(trials=6, warm_rounds=1),
    }
    found = run_phases(context(**small, rungs=(0.5,)), world, until="exploration")
    return found, world.orders


def test_trainings_have_epochs_that_the_judging_sessions_validate_and_the_test_sessions_never(walked):
    _, orders = walked
    assert {order.epochs for order in orders} == {25}
    assert {order.patience for order in orders} == {8}
    for order in orders:
        assert not set(order.validation) & {*order.train, *SESSIONS[25:]}
        if order.judged == SESSIONS[25:]:
            assert {*order.train, *order.validation} == set(SESSIONS[:25])
        else:
            assert order.validation == order.judged
            assert len(order.judged) == 5


def test_the_plan_of_phase_2_5_is_made_on_the_mean_absolute_error(walked):
    """By hand from the trainings of phase 0: eq. 2.18 for each backbone, eq. 2.21 with the largest."""
    found, orders = walked
    facts = found.decided["planning"].to_json()["facts"]
    features = found.decided["isolation"].to_json()["facts"]["features"]
    backbone = found.decided["calibration"].to_json()["facts"]["backbone"]
    world = World()
    errors = {}
    for order in orders[: 6 * 30]:
        key = (order.settings["model"]["backbone"]["kind"], order.settings["task"]["features"])
        errors.setdefault(key, []).append(world.outcome(order).mean(10, "mae"))
    tables = {key: np.reshape(values, (3, 10)) for key, values in errors.items()}
    deviation = max(np.mean(table.std(axis=0, ddof=1)) for key, table in tables.items() if key[1] == features)
    mean = tables[backbone, features].mean()
    analytical = ((1.644854 + 0.841621) * deviation / np.sqrt(3) / (0.02 * mean)) ** 2
    assert facts["sigma_seed"] == pytest.approx(deviation)
    assert facts["mae"] == pytest.approx(mean)
    assert facts["analytical"] == pytest.approx(analytical, rel=1e-5)


def test_only_phase_1_is_pruned_and_phase_4_begins_without_a_warm_start(walked):
    found, orders = walked
    ended = [order for order in orders if order.until is not None]
    assert {order.until for order in ended} == {12}
    assert all(not order.settings["model"]["blocks"] for order in ended)
    values = [trial["values"] for trial in found.decided["synthesis"].to_json()["facts"]["trials"]]
    assert found.decided["calibration"].to_json()["facts"]["baseline"]["learning_rate"] not in [
        v["learning_rate"] for v in values
    ]
    assert all(
        set(v) == {"learning_rate", "weight_decay", "dropout", "schedule", "patience", "smoothness"} for v in values
    )
    on = found.decided["synthesis"].to_json()["facts"]["on"]
    assert set(PLAN.spec.toggles) <= set(on)
    assert set(on) - set(PLAN.spec.toggles) == set(found.decided["confirmation"].to_json()["facts"]["confirmed"])
    registered = fitting(Arm(found.decided["calibration"].facts.settings), among=PLAN.spec.modules)
    assert set(found.decided["exploration"].to_json()["facts"]["on"]) == {*registered, *PLAN.spec.toggles}
    first = found.decided["exploration"].to_json()["facts"]["trials"][0]
    earlier = found.decided["synthesis"].to_json()["facts"]
    assert set(first["modules"]) == set(earlier["modules"])
    assert all(first["values"][name] == earlier["values"][name] for name in PLAN.spec.deferred)


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"updates": 30}, "updates = 30 .a multiple of epochs = 25"),
        ({"mode": "sound"}, "epochs = 25 with mode = 'sound'"),
        ({"epochs": 1, "updates": 5, "final_updates": 5}, "patience = 8 with epochs = 1"),
        ({"epochs": 1, "patience": 0}, r"updates = 0"),
        ({"widths": "thirds"}, "widths = 'thirds'"),
        ({"toggles": ("swa", "stanh")}, "toggles = 'stanh'"),
        ({"deferred": {"dropout": Real(0.0, 0.5)}}, r"deferred\.dropout"),
    ],
)
def test_settings_that_cannot_be_are_refused(changes, match):
    with pytest.raises(ConfigError, match=match):
        dataclasses.replace(PLAN.spec, **changes)
    assert SearchSpec(mode="thesis").epochs == 1
