"""Every formulation of a twin in every form: its layers mean what it answers, and each target writes or refuses it."""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np
import pytest

from edp.errors import ExportError
from edp.export import TARGETS
from edp.export.golden import ROUNDED, SHARE, grown_tolerance, random_inputs, stream
from edp.ir import Graph
from edp.ir.memory import Feed, Feedback
from edp.networks.twin import TWINS, Twin, TwinPlant
from edp.networks.twin.recurrent import Recurrent
from edp.testing.targets import check_names_refused, refusal_of
from edp.testing.twins import sample_actuators, sample_twin
from edp.training.twin_bundle import TwinBundle, plant_bundle, save_twin
from edp.workflows.deployment import export_bundle, unheld_adaptation

QUICK = {"fmu": {"binaries": "none"}}
ON_A_MAP = "recurrent on a map"
SPECS = {"recurrent": Recurrent(units=5), ON_A_MAP: Recurrent(units=6, members=3, valve_map=True)}
# 12 s hardly tell the states of n4sid apart: what rounding makes of them would differ from machine to machine.
TICKS = {"n4sid": 2400}
SENSORS = {
    "all": {},
    "no pressures": {"pressures": False},
    "velocities only": {"strokes": False, "pressures": False},
}


def in_layers(name: str) -> bool:
    """Whether a formulation says what its layers are."""
    kind = type(sample_twin(SPECS.get(name) or TWINS[name]())[0])
    return kind.lower is not Twin.lower or kind.lower_answers is not Twin.lower_answers


LOWERED = [ON_A_MAP, *(name for name in TWINS if in_layers(name))]


C_ALONE = ("greybox", "residual")
REFUSED = {"onnx": "ONNX"}
"""Forms without Newton's method, which a grey box needs."""


def plant_of(name: str, sensors: str = "all") -> TwinPlant:
    recording = sample_actuators(TICKS.get(name, 600), **SENSORS[sensors])
    return TwinPlant(sample_twin(SPECS.get(name) or TWINS[name](), recording)[0], name)


def bundle_of(name: str):
    spec = SPECS.get(name) or TWINS[name]()
    return plant_bundle(TwinBundle(spec, sample_twin(spec)[0]))


def deviations(plant: TwinPlant, a: np.ndarray, b: np.ndarray) -> float:
    return float((np.abs(a - b) / plant.twin.scales.answer_width).max())


@pytest.mark.long
@pytest.mark.parametrize("sensors", list(SENSORS))
@pytest.mark.parametrize("name", LOWERED)
def test_the_layers_mean_what_the_twin_answers_measured_free_and_mixed(name, sensors):
    plant = plant_of(name, sensors)
    rows = random_inputs(plant, 90, seed=1)
    # The commands go far enough for bounds and end stops to act.
    rows[:, : plant.required] *= 3.0
    exact = stream(copy.deepcopy(plant).double(), rows)
    assert deviations(plant, stream(plant, rows), exact) < 1e-4  # a free ARX amplifies what rounding leaves


@pytest.mark.long
@pytest.mark.parametrize("name", LOWERED)
def test_a_free_run_of_the_plant_is_the_rollout_of_the_twin(name):
    plant = plant_of(name)
    # Lags of valves forget by an exponential: after two seconds no bit of the start is left.
    twin, prefix = plant.twin, plant.window + (100 if name in C_ALONE else 0)
    rows = random_inputs(plant, prefix + 40, seed=2, mixed=False)
    commands, measured, _ = np.split(rows, np.cumsum(plant.sizes[:2]), axis=1)
    # A prefix that is as long as all that the twin remembers leaves nothing of the start.
    state = twin.reset(commands[None, :prefix], np.clip(measured[None, :prefix], twin.scales.low, twin.scales.high))
    rows[:prefix, plant.required : -len(twin.channels.answers)] = np.clip(
        measured[:prefix], twin.scales.low, twin.scales.high
    )
    rows[:prefix, -len(twin.channels.answers) :] = 1.0
    free, _ = twin.rollout(commands[None, prefix:], state)
    assert np.array_equal(stream(plant, rows)[prefix:], free[0])


@pytest.mark.long
@pytest.mark.parametrize("name", LOWERED)
def test_a_port_reads_its_last_answer_whatever_is_fed_beside_a_flag_of_zero(name):
    plant = plant_of(name)
    rows = random_inputs(plant, 60, seed=3, mixed=False)
    other = rows.copy()
    other[plant.window :, plant.required : plant.required + plant.sizes[1]] = 1e5
    exact = copy.deepcopy(plant).double()
    assert np.array_equal(stream(exact, rows), stream(exact, other))


def test_the_feedback_edge_is_a_slot_that_an_answer_writes():
    graph = plant_of("recurrent").graph()
    feeds = [layer for layer in graph.layers if isinstance(layer, Feed)]
    assert [type(graph.layer(layer.into)) for layer in feeds] == [Feedback]
    assert graph.fed_back
    assert graph.width_of(feeds[0].inputs[0]) == graph.layer(feeds[0].into).size
    # A map of the commands reads no port, so it has no edge that leads nowhere.
    assert not plant_of("static", "velocities only").graph().fed_back


@pytest.mark.long
@pytest.mark.parametrize("target", list(TARGETS))
@pytest.mark.parametrize("name", LOWERED)
def test_every_form_writes_a_twin_or_says_why_not(name, target, tmp_path):
    refusal = refusal_of(target, bundle_of(name), tmp_path / "made", QUICK.get(target))
    if name in C_ALONE and target in REFUSED:
        assert f"Newton's method, which has no form in {REFUSED[target]}; export it to c, fmu, casadi" in refusal
    else:
        assert refusal == ""


@pytest.mark.parametrize("target", list(TARGETS))
def test_names_that_cannot_be_are_refused_of_a_twin_too(target, tmp_path):
    check_names_refused(target, bundle_of("recurrent"), tmp_path / "made", QUICK.get(target))


@pytest.mark.parametrize("target", list(TARGETS))
def test_a_formulation_without_layers_is_refused_by_name(target, tmp_path, monkeypatch):
    bundle = bundle_of("static")
    monkeypatch.setattr(type(bundle.predictor.twin), "lower", Twin.lower)
    assert "StaticTwin has no form as a list of layers" in refusal_of(target, bundle, tmp_path / "made")


def test_what_is_allowed_grows_with_the_run_and_does_not_shrink():
    plant = plant_of("recurrent")
    rows = random_inputs(plant, 200, seed=4, mixed=False)
    allowed = grown_tolerance(plant, rows, stream(plant, rows))
    assert allowed.shape == (200, len(plant.task.targets))
    assert (np.diff(allowed, axis=0) >= 0.0).all()
    sigma = plant.twin.scales.answer_width
    assert (allowed[0] >= SHARE * sigma).all()
    # Not so wide that it allows what a form with a wrong answer of a thousandth of a deviation makes of it.
    assert (allowed[-1] < 1e-3 * sigma).all()


def test_a_form_that_feeds_back_wrongly_is_beyond_what_is_allowed():
    plant = plant_of("recurrent")
    rows = random_inputs(plant, 200, seed=5, mixed=False)
    right = stream(plant, rows)
    allowed = grown_tolerance(plant, rows, right)
    wrong = copy.deepcopy(plant)
    # An integration that is off by three thousandths: within what is allowed at the first tick, not after two seconds.
    wrong.twin.bounds = replace(wrong.twin.bounds, trapezoid=wrong.twin.bounds.trapezoid * np.float32(1 + 3e-3))
    assert (np.abs(stream(wrong, rows) - right) > allowed).any()
    assert ROUNDED < SHARE


def test_the_run_folder_of_a_twin_is_exported(tmp_path):
    spec = SPECS["recurrent"]
    save_twin(TwinBundle(spec, sample_twin(spec)[0]), tmp_path / "run" / "twin")
    files = export_bundle(tmp_path / "run", "c", tmp_path / "made", "plant")
    assert files[0].name == "plant.h"
    assert "PLANT MODEL" in files[0].read_text()
    assert not unheld_adaptation(tmp_path / "run", "c")


def test_names_of_flags_give_way_to_channels_of_a_log():
    twin, _, _ = sample_twin(SPECS["recurrent"])
    named = replace(twin.channels.commands[0], name="speed_1_measured")
    channels = replace(twin.channels, commands=(named, *twin.channels.commands[1:]))
    twin.channels = channels
    names = [channel.name for channel in TwinPlant(twin, "x").inputs]
    assert len(set(names)) == len(names)
    assert "speed_1_measured_" in names


def test_a_plant_is_not_looked_into():
    plant = plant_of("recurrent")
    with pytest.raises(ExportError, match="edp rollout"):
        plant.forward_features(None, None)
    assert isinstance(plant.graph(), Graph)
