"""The modules of the thesis's Table 4.5: the settings page names all fourteen, and each changes the predictions."""

import re
from pathlib import Path

import numpy as np
import pytest
import torch

from edp.config.experiment import Experiment, build, load_experiment
from edp.data.scaling import Scaler
from edp.errors import ConfigError
from edp.networks.predictor import build_model
from edp.workflows.search.modules import MODULES, add_modules, options_of, present_options
from edp.workflows.search.trainings import settings_of

PAGE = Path(__file__).parents[2] / "docs" / "settings.md"
PRINTED = {
    *("Cyl Gate Diagonal", "Temporal Diff", "Cross Cyl Attn", "GRU Backbone", "LayerNorm LSTM", "Multiscale TCN"),
    *("Zoneout", "Attention Bridge", "Global Avg Pool", "Squeeze-Excitation", "Physics Residual", "Deeper Head"),
    *("GLU Head", "STanh Activation"),
}
SMALL = ("model.backbone.units=8", "model.backbone.channels=[8]", "model.head.hidden=8", "model.blocks=[]")


def modules():
    page = PAGE.read_text(encoding="utf-8")
    section = page.split("### The thesis's modules by name")[1].split("\n## ")[0]
    return re.findall(r"^\| ([^|`]+?) \| `([^`]+)` \| [^|]+ \|$", section, re.MULTILINE)


def predictions(*changes):
    experiment = load_experiment(preset="quick", overrides=[*SMALL, *changes])
    task = experiment.task.resolve(100.0, physics=experiment.model.physics)
    features = len(task.features.features)
    scaler = Scaler(np.zeros(features), np.ones(features), np.zeros((1, 3)), np.ones((1, 3)))
    predictor = build_model(task, experiment.model, scaler, seed=1).eval()
    x = torch.randn(1, 20, predictor.front.inputs, generator=torch.Generator().manual_seed(2))
    with torch.no_grad():
        return experiment, predictor.predict(x, predictor.initial_state(1, x))[0]


def test_the_page_lists_the_fourteen_modules():
    assert len(PRINTED) == 14
    assert {name for name, _ in modules()} == PRINTED
    assert len(modules()) == 14


@pytest.mark.parametrize(("name", "setting"), modules(), ids=lambda value: value if "=" not in value else "")
def test_each_is_reached_by_its_setting_and_takes_part(name, setting):
    plain, base = predictions()
    changed, found = predictions(setting)
    assert changed.model != plain.model
    assert changed.training == plain.training
    assert torch.isfinite(found).all()
    assert not torch.allclose(found, base, rtol=0, atol=1e-6), name


@pytest.mark.parametrize("name", MODULES)
def test_every_option_of_a_module_makes_another_network_and_its_present_value_the_same(name):
    base = settings_of(load_experiment(None, "quick", ["model.blocks=[]"]))
    plain = add_modules(base, [name])
    assert add_modules(base, [name], options=present_options(base, [name])) == plain
    for key, held in options_of(base, name).items():
        made = [add_modules(base, [name], options={key: value}) for value in held.options]
        models = [build(Experiment, settings, "of a test").model for settings in made]
        assert len({repr(model) for model in models}) == len(held.options), key
    with pytest.raises(ConfigError, match=r"= 'odd'; one of"):
        add_modules(base, ["zoneout"], options={"zoneout.zoneout": "odd"})
