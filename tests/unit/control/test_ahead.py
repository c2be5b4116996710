"""Velocities ahead of commands that are tried: the predictor's own numbers, memory that stays, what does not fit."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from edp.control.ahead import PredictorAhead, TwinAhead
from edp.control.controllers import CONTROLLERS
from edp.control.limits import LoopLimits
from edp.control.models import ControlModels
from edp.control.plant import PILOTS, VELOCITIES, interface_of
from edp.control.plants import plant_of
from edp.data.features import FeatureSet
from edp.data.prepared import prepare
from edp.data.splits import ByRecording
from edp.data.task import TargetMode, Task
from edp.errors import ConfigError
from edp.networks.backbones import HybridSpec
from edp.networks.predictor import ModelSpec, build_model
from edp.sim.scenario import Scenario
from edp.sim.simulate import simulate
from edp.testing.control import sample_excavator_twin
from edp.training.bundle import make_bundle

INPUTS = (*VELOCITIES, *PILOTS[:6])


def bundle_of(inputs=INPUTS, targets=VELOCITIES, horizons=(1, 20)):
    """A predictor that was never trained."""
    recordings = [simulate(Scenario(duration_s=6.0, seed=seed)) for seed in range(3)]
    task = Task(FeatureSet("some", inputs), targets, horizons, TargetMode.DELTA, 100.0)
    data = prepare(recordings, task, ByRecording(), 20)
    model = ModelSpec(backbone=HybridSpec(channels=(4,), kernel=3, units=4, dropout=0.0), window=20)
    names = {"data": {"train": {"names": [recording.name for recording in recordings]}}}
    return make_bundle(build_model(task, model, data.scaler(), 0).eval(), data, names)


@pytest.fixture(scope="module")
def bundle():
    return bundle_of()


def test_candidates_are_answered_as_the_predictor_alone_would(bundle):
    rng = np.random.default_rng(0)
    model = PredictorAhead(bundle, 20)
    assert model.reads == VELOCITIES
    rest, rows = np.zeros(3), rng.uniform(-0.2, 0.2, (6, 3))
    commands = rng.uniform(0.0, 3e6, (6, 12))
    candidates = rng.uniform(0.0, 3e6, (5, 12))
    model.begin(rest, np.zeros(12))
    for row, command in zip(rows, commands, strict=True):
        model.advance(row, command)
    now = np.array([0.1, 0.0, -0.1])
    first, second = model.ahead(now, candidates), model.ahead(now, candidates)
    assert np.array_equal(first, second)
    history = np.concatenate([np.zeros((20, 9)), np.concatenate([rows, commands[:, :6]], axis=1)])
    for candidate, answer in zip(candidates, first, strict=True):
        whole = np.concatenate([history, [[*now, *candidate[:6]]]]).astype(np.float32)[None]
        with torch.inference_mode():
            alone, _ = bundle.predictor.predict(
                torch.from_numpy(whole), bundle.predictor.initial_state(1, torch.zeros(1))
            )
        assert answer == pytest.approx(alone[0, -1, 1].numpy(), abs=1e-5)


def test_threads_of_the_caller_come_back(bundle):
    before = torch.get_num_threads()
    model = PredictorAhead(bundle, 20)
    model.begin(np.zeros(3), np.zeros(12))
    model.ahead(np.zeros(3), np.zeros((2, 12)))
    assert torch.get_num_threads() == before


def test_the_nearest_horizon_is_taken_and_a_far_one_refused(bundle):
    assert PredictorAhead(bundle, 18).ticks == 20
    with pytest.raises(ConfigError, match=r"looks 20 ticks ahead, the inversion 40; train one with task.horizons"):
        PredictorAhead(bundle, 40)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"targets": VELOCITIES[:2]}, "does not predict 'CylVels_3'"),
        ({"inputs": VELOCITIES}, "reads no pilot"),
    ],
)
def test_a_predictor_that_is_none_of_levers_is_refused(changes, message):
    with pytest.raises(ConfigError, match=message):
        PredictorAhead(bundle_of(**changes), 20)


def test_a_predictor_whose_inputs_the_plant_lacks_is_refused_before_the_start(bundle):
    plant = interface_of(plant_of("M22", 1.0, 100.0))
    bare = replace(plant, channels=tuple(c for c in plant.channels if c.name != "CylVels_2"))
    with pytest.raises(ConfigError, match="does not measure 'CylVels_2'"):
        CONTROLLERS["inversion"]().build(bare, LoopLimits(), ControlModels(predictor=bundle))


@pytest.mark.long
def test_a_twin_ahead_is_its_free_run_from_what_is_measured():
    twin = sample_excavator_twin()
    names = [channel.name for channel in twin.channels.answers]
    model = TwinAhead(twin, 15, names)
    assert list(model.reads) == names
    row = np.array([0.7 if "Stroke" in name else 0.0 if "Vels" in name else 5e6 for name in names])
    command = np.zeros(12)
    command[2] = 1.5e6
    model.begin(row, np.zeros(12))
    model.advance(row, np.zeros(12))
    (answer,) = model.ahead(row, command[None])
    own = [PILOTS.index(channel.name) for channel in twin.channels.commands]
    ticks = twin.prefix_ticks + 1
    rows = np.repeat(row[None, None], ticks, axis=1).astype(np.float32)
    state = twin.reset(np.zeros((1, ticks, len(own)), np.float32), rows)
    ports = np.full((1, 15, len(names)), np.nan, np.float32)
    ports[0, 0] = row
    free, _ = twin.rollout(np.repeat(command[None, None, own], 15, axis=1).astype(np.float32), state, ports)
    assert answer == pytest.approx(free[0, -1, :3], abs=1e-6)
