"""Every formulation of a twin, held to the contract that ships."""

from pathlib import Path

import numpy as np
import pytest

import edp.networks.twin
from edp.networks.twin import TWINS
from edp.networks.twin.recurrent import Recurrent
from edp.networks.twin.static_map import StaticMap, StaticTwin
from edp.testing import ContractError, check_spec, check_twin
from edp.testing.twins import sample_front


@pytest.mark.parametrize("name", list(TWINS))
def test_a_formulation_keeps_the_contract(name):
    check_twin(name)


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
    shared = {"__init__", "base", "intervals", "kinds", "lowering", "plant", "recurrent_cell", "scales", "steps"}
    shared |= {"recurrent_members", "forecast", "load", "tuned", "tuned_correction"}
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
