"""Every registered environment keeps Gymnasium's rules, without a warning."""

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from edp.sim import machine_names
from edp.sim.environment import ExcavatorEnv, VectorExcavatorEnv, register

IDS = [f"edp/Excavator-{name}-v0" for name in machine_names()]


def test_every_machine_has_a_name():
    register()
    assert sorted(name for name in gymnasium.registry if name.startswith("edp/Excavator-")) == sorted(IDS)


@pytest.mark.parametrize("name", IDS)
@pytest.mark.parametrize("changes", [{}, {"material": "clay"}, {"loop_latency": 2, "lost_frames": 0.2, "hand": True}])
def test_environments_pass_the_check_of_gymnasium(name, changes):
    env = gymnasium.make(name, duration_s=0.5, **changes)
    assert type(env.unwrapped) is ExcavatorEnv
    check_env(env.unwrapped)


def test_a_drawn_machine_passes_the_check_of_gymnasium():
    check_env(gymnasium.make("edp/Excavator-M22-v0", randomise=True, duration_s=0.5).unwrapped)


@pytest.mark.parametrize("name", IDS)
def test_side_by_side_is_what_gymnasium_makes_of_single_ones(name):
    modes = ("vector_entry_point", "sync")
    ours, theirs = (gymnasium.make_vec(name, num_envs=3, vectorization_mode=m, duration_s=0.2) for m in modes)
    assert type(ours) is VectorExcavatorEnv
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    np.testing.assert_array_equal(ours.reset(seed=4)[0], theirs.reset(seed=4)[0])
    rng = np.random.default_rng(0)
    for _ in range(50):
        levers = rng.uniform(-1, 1, (3, 3)).astype(np.float32)
        first, second = ours.step(levers), theirs.step(levers)
        for a, b in zip(first[:4], second[:4], strict=True):
            np.testing.assert_array_equal(a, b)
            assert a.dtype == b.dtype
        assert {key: value.tolist() for key, value in first[4].items() if key.endswith("seed")} == {
            key: value.tolist() for key, value in second[4].items() if key.endswith("seed")
        }
