"""Every formulation of a twin, held to the contract that ships."""

from pathlib import Path

import numpy as np
import pytest
import torch

import edp
import edp.networks.twin
from edp.errors import BundleError, ConfigError
from edp.networks.twin import TWINS
from edp.networks.twin.recurrent import Recurrent
from edp.networks.twin.static_map import StaticMap, StaticTwin
from edp.testing import ContractError, check_spec, check_twin
from edp.testing.twins import sample_front, sample_twin
from edp.training.twin_bundle import TwinBundle, save_twin


@pytest.mark.long
@pytest.mark.parametrize("name", list(TWINS))
def test_a_formulation_keeps_the_contract(name):
    check_twin(name)


WITH_NETWORK = {"recurrent", "residual"}
"""Formulations whose numbers are weights of a PyTorch module."""


@pytest.mark.parametrize("name", list(TWINS))
def test_the_network_of_a_loaded_twin_is_what_it_runs_with_or_an_error_that_names_the_kind(name, tmp_path):
    spec = TWINS[name]()
    twin, commands, measured = sample_twin(spec)
    save_twin(TwinBundle(spec, twin), tmp_path / "run" / "twin")
    model, prefix = edp.load_twin(tmp_path / "run"), twin.prefix_ticks
    if name not in WITH_NETWORK:
        with pytest.raises(ConfigError, match=f"of kind '{name}', which has no network"):
            _ = model.network
        return
    assert isinstance(model.network, torch.nn.Module)

    def run():
        return model.twin.rollout(commands[:, prefix:], model.twin.reset(commands[:, :prefix], measured[:, :prefix]))[0]

    before = run()
    with torch.no_grad():
        model.network.out_bias.add_(1.0)
    assert not np.array_equal(run(), before)


def test_loading_a_twin_as_a_predictor_names_the_right_function(tmp_path):
    save_twin(TwinBundle(spec := TWINS["static"](), sample_twin(spec)[0]), tmp_path / "run" / "twin")
    with pytest.raises(BundleError, match=r"holds a twin, not a network that predicts; .*edp\.load_twin loads it"):
        edp.load(tmp_path / "run")


@pytest.mark.parametrize("members", [1, 3])
def test_a_recurrent_twin_on_a_static_map_keeps_the_contract(members):
    check_twin("recurrent", Recurrent(units=6, members=members, valve_map=True))


@pytest.mark.parametrize("name", ["greybox", "residual"])
def test_a_grey_box_with_a_known_linkage_keeps_the_contract(name):
    check_twin(name, TWINS[name](linkage="m22"), (sample_front(),))


@pytest.mark.parametrize("name", list(TWINS))
def test_options_of_a_formulation_are_frozen_and_survive_json(name):
    check_spec(TWINS, name)


def test_every_file_of_a_formulation_registers_it():
    shared = {
        "__init__",
        "base",
        "descent",
        "parameters",
        "windows",
        "intervals",
        "model_selection",
        "lowering",
        "plant",
        "recurrent_cell",
        "scales",
        "steps",
    }
    shared |= {"recurrent_members", "forecast", "disturbance_observer", "adaptive_twin", "adaptive_correction"}
    files = {path.stem for path in Path(edp.networks.twin.__path__[0]).glob("*.py")} - shared
    assert files == {TWINS[name].__module__.rpartition(".")[2] for name in TWINS}


class Forgetful(StaticTwin):
    """Drops the last answer at the end of every call."""

    def _run(self, commands, measured, state):
        answers, after = super()._run(commands, measured, state)
        return answers, after | {"answer": np.zeros_like(after["answer"])}


class Unbounded(StaticTwin):
    def bounded(self, feedback, velocity, pressure):
        answers = super().bounded(feedback, velocity, pressure)
        answers[:, : velocity.shape[1]] = 100.0 * velocity
        return answers


@pytest.mark.parametrize(("broken", "message"), [(Forgetful, "chunks differ"), (Unbounded, "leaves the bounds")])
def test_a_broken_formulation_is_named(monkeypatch, broken, message):
    def build(self, channels, scales, arrays):
        return broken(channels, scales, self.prefix_ticks, {name: arrays[name] for name in self.shapes(channels)})

    monkeypatch.setattr(StaticMap, "build", build)
    with pytest.raises(ContractError, match=f"twin 'static', speed_1.*{message}"):
        check_twin("static")
