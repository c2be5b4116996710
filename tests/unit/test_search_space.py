"""Modules and dimensions of the search: changes of settings that leave a network that can be built."""

import re
from itertools import combinations
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edp.config.experiment import Experiment, build, load_experiment, merged, plain_tree
from edp.errors import ConfigError
from edp.networks.blocks import BLOCKS
from edp.networks.predictor import check_combination
from edp.workflows.search.modules import MODULES, THESIS_MODULES, add_modules, conflicts, contradicting, fitting
from edp.workflows.search.space import DIMENSIONS, THESIS, Choice, Real, applicable, apply, check, elastic, names

PAGE = Path(__file__).parents[2] / "docs" / "settings.md"
BACKBONES = ("hybrid", "lstm", "gru", "tcn")


def settings(backbone="hybrid", *changes):
    overrides = ["model.blocks=[]", f'model.backbone={{kind="{backbone}"}}', *changes]
    return plain_tree(load_experiment(None, "quick", overrides))


def listed():
    section = PAGE.read_text(encoding="utf-8").split("### The thesis's modules by name")[1].split("\n## ")[0]
    return re.findall(r"^\| ([^|`]+?) \| `([^`]+)` \| [^|]+ \|$", section, re.MULTILINE)


@pytest.mark.parametrize(("title", "setting"), listed(), ids=lambda value: value if "=" not in value else "")
def test_each_module_is_what_the_settings_page_says(title, setting):
    (name,) = [name for name, module in MODULES.items() if module.title == title]
    made = build(Experiment, add_modules(settings(), [name]), "test")
    wanted = load_experiment(None, "quick", ["model.blocks=[]", 'model.backbone={kind="hybrid"}', setting])
    assert made == wanted


def test_the_thesis_has_fourteen():
    assert len(THESIS_MODULES) == len(listed()) == 14


def test_every_block_with_a_space_is_a_module():
    assert {name for name in BLOCKS if BLOCKS[name].space} <= set(MODULES)
    assert set(MODULES) - set(THESIS_MODULES) <= set(BLOCKS)
    assert fitting(settings(), among=["stanh", "linear_bypass"]) == ("stanh", "linear_bypass")


@pytest.mark.parametrize("backbone", BACKBONES)
def test_modules_that_fit_can_be_built_in_any_pair_that_does_not_contradict(backbone):
    base = settings(backbone)
    free = fitting(base)
    barred = contradicting(base, free)
    for pair in combinations(free, 2):
        if frozenset(pair) in barred:
            with pytest.raises(ConfigError, match="modules: "):
                add_modules(base, pair)
            continue
        made = build(Experiment, add_modules(base, pair), "test")
        check_combination(made.task.resolve(100.0, physics=made.model.physics), made.model)


def test_what_fits_depends_on_the_network():
    assert fitting(settings()) == tuple(MODULES)
    pairs = {frozenset({"gru", "layer_norm_lstm"}), frozenset({"gru", "zoneout"})}
    assert contradicting(settings(), THESIS_MODULES) == pairs
    assert contradicting(settings(), ["physics_residual", "linear_bypass"])
    assert not {"gru", "zoneout", "temporal_difference"} & set(fitting(settings("tcn")))
    has_it = settings("hybrid", 'model.blocks=["temporal_difference"]')
    assert "temporal_difference" not in fitting(has_it)
    assert add_modules(has_it, ["temporal_difference"]) == has_it


def test_all_less_the_contradictions_go_together():
    made = add_modules(settings(), set(MODULES) - {"gru", "physics_residual"})
    kinds = [block["kind"] for block in made["model"]["blocks"]]
    assert sorted(kinds) == sorted(set(MODULES) & set(BLOCKS))
    assert build(Experiment, made, "test").model.backbone.zoneout == 0.1


@given(st.permutations(["squeeze_excitation", "temporal_difference", "glu_head", "stanh"]))
def test_the_order_of_modules_does_not_matter(order):
    assert add_modules(BASE, order) == add_modules(BASE, sorted(order))


BASE = settings()


def test_contradictions_say_why():
    (reason,) = conflicts(settings(), ["gru", "layer_norm_lstm"])
    assert reason == "'gru' and 'layer_norm_lstm' both set model.backbone.cell.kind; keep one of them"
    with pytest.raises(ConfigError, match=r"with gru, zoneout[\s\S]*zoneout keeps the h and c"):
        add_modules(settings(), ["zoneout", "gru"])
    with pytest.raises(ConfigError, match=r"unknown module 'sqeeze_excitation'.*squeeze_excitation"):
        add_modules(settings(), ["sqeeze_excitation"])


def test_the_feature_set_of_all_channels_needs_their_names():
    every = merged(settings(), {"task": {"features": "all"}})
    channels = load_experiment(None, "quick").task.resolve(100.0).features.channels
    assert fitting(every, channels) == tuple(MODULES)
    assert fitting(every) == ()


@pytest.mark.parametrize("backbone", BACKBONES)
def test_every_corner_of_the_thesis_space_can_be_built(backbone):
    base = settings(backbone)
    space = applicable(THESIS, base)
    assert ("kernel" in space) == (backbone in ("tcn", "hybrid"))
    for which in (0, -1):
        corner = {
            name: held.options[which] if isinstance(held, Choice) else (held.low, held.high)[which]
            for name, held in space.items()
        }
        check(space, corner)
        made = build(Experiment, apply(base, corner), "test")
        assert made.training.optimizer.learning_rate == corner["learning_rate"]
        assert made.model.backbone.dropout == corner["dropout"]
        if backbone in ("tcn", "hybrid"):
            assert made.model.backbone.channels == (corner["units"],) * corner["layers"]
            assert made.model.backbone.kernel == corner["kernel"]
        else:
            assert (made.model.backbone.units, made.model.backbone.layers) == (corner["units"], corner["layers"])


def test_depth_follows_width_whatever_the_order():
    base = settings()
    assert apply(base, {"layers": 3, "units": 16}) == apply(base, {"units": 16, "layers": 3})
    assert apply(base, {"layers": 3, "units": 16})["model"]["backbone"]["channels"] == [16, 16, 16]
    assert base["model"]["backbone"]["channels"] == [64]  # what came is not changed


def test_values_outside_and_unknown_dimensions_are_refused():
    with pytest.raises(ConfigError, match=r"learning_rate = 0\.1 is not in Real\(low=0\.0001"):
        check(THESIS, {**dict.fromkeys(THESIS, 1), "learning_rate": 0.1})
    with pytest.raises(ConfigError, match="has no value of 'dropout'"):
        check({"dropout": Real(0.0, 1.0)}, {})
    with pytest.raises(ConfigError, match=r"unknown dimension 'lerning_rate'.*learning_rate"):
        apply(settings(), {"lerning_rate": 1e-3})
    for wrong in (
        lambda: Real(1.0, 1.0),
        lambda: Real(0.0, 1.0, log=True),
        lambda: Choice((1,)),
        lambda: Choice((1, 1)),
    ):
        with pytest.raises(ConfigError, match="must hold"):
            wrong()


def test_the_elastic_window_is_a_decade_and_stays_in_the_space():
    window = elastic(THESIS, {"learning_rate": 1e-3, "weight_decay": 2e-5, "dropout": 0.1})
    assert window["learning_rate"] == Real(1e-4, 5e-3, log=True)
    assert window["weight_decay"].low == 1e-5
    assert window["weight_decay"].high == pytest.approx(2e-4)
    assert (window["dropout"].low, window["dropout"].high) == (0.05, pytest.approx(0.25))
    assert set(window) == {"learning_rate", "weight_decay", "dropout"}
    with pytest.raises(ConfigError, match="has no value of 'weight_decay'"):
        elastic(THESIS, {"learning_rate": 1e-3, "dropout": 0.1})


def test_a_space_has_the_order_of_the_registry():
    shuffled = dict(reversed(list(THESIS.items())))
    assert names(shuffled) == list(THESIS) == list(DIMENSIONS)[: len(THESIS)]
