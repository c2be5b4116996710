"""Machines side by side: the bits of single ones, whatever the mode of resets."""

import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

from edp.errors import ConfigError
from edp.sim.environment import EnvironmentSpec, ExcavatorEnv, VectorExcavatorEnv

SPECS = [
    EnvironmentSpec(machine=machine, material=material, sensor_noise=noise, duration_s=0.5, lost_frames=0.1)
    for machine, material, noise in (
        ("M22", "", True),
        ("C14", "clay", True),
        ("C14", "", True),
        ("M22", "gravel", False),
    )
]
COUNT = len(SPECS)


def levers_of(seed, ticks):
    return np.repeat(np.random.default_rng(seed).uniform(-1, 1, (ticks // 10 + 1, COUNT, 3)), 10, axis=0)[:ticks]


def assert_same(vector, singles):
    """Observations, truth and ends of a step side by side are those of the single environments."""
    observations, rewards, terminated, truncated, infos = vector
    np.testing.assert_array_equal(observations, [single[0] for single in singles])
    np.testing.assert_array_equal(truncated, [single[3] for single in singles])
    assert not rewards.any()
    assert not terminated.any()
    for name in ("TipX", "OilTemperature", "CylPressures_1", "BmUp"):
        np.testing.assert_array_equal(infos["truth"][name], [single[4]["truth"][name] for single in singles])


@pytest.mark.parametrize("mode", list(AutoresetMode))
def test_machines_side_by_side_are_single_ones_to_the_bit(mode):
    vector, singles = VectorExcavatorEnv(COUNT, SPECS, autoreset_mode=mode), [ExcavatorEnv(spec) for spec in SPECS]
    observations, infos = vector.reset(seed=7)
    np.testing.assert_array_equal(observations, [env.reset(seed=7 + i)[0] for i, env in enumerate(singles)])
    assert infos["machine"].tolist() == ["M22", "C14", "C14", "M22"]
    ended = False
    for levers in levers_of(0, 120):
        if ended and mode is AutoresetMode.DISABLED:
            fresh, _ = vector.reset(options={"reset_mask": np.ones(COUNT, dtype=bool)})
            np.testing.assert_array_equal(fresh, [env.reset()[0] for env in singles])
        step = vector.step(levers)
        if ended and mode is AutoresetMode.NEXT_STEP:
            beginnings = [env.reset() for env in singles]
            steps = [(observation, 0.0, False, False, info) for observation, info in beginnings]
            assert step[4]["seed"].tolist() == [info["seed"] for _, info in beginnings]
        else:
            steps = [env.step(lever) for env, lever in zip(singles, levers, strict=True)]
        ended = steps[0][3]
        if ended and mode is AutoresetMode.SAME_STEP:
            np.testing.assert_array_equal(np.stack(step[4]["final_obs"]), [single[0] for single in steps])
            tips = [single[4]["truth"]["TipX"] for single in steps]
            np.testing.assert_array_equal(step[4]["final_info"]["truth"]["TipX"], tips)
            assert step[3].all()
            np.testing.assert_array_equal(step[0], [env.reset()[0] for env in singles])
            ended = False
            continue
        assert_same(step, steps)


def test_one_of_them_is_reset_alone_and_moments_pass_between_forms():
    vector = VectorExcavatorEnv(COUNT, SPECS, autoreset_mode="Disabled")
    vector.reset(seed=1)
    before = [vector.step(levers)[0] for levers in levers_of(1, 20)][-1]
    moment = vector.snapshot(1)
    mask = np.array([False, True, False, False])
    fresh, infos = vector.reset(seed=[None, 30, None, None], options={"reset_mask": mask})
    np.testing.assert_array_equal(fresh[~mask], before[~mask])
    np.testing.assert_array_equal(fresh[1], ExcavatorEnv(SPECS[1]).reset(seed=30)[0])
    np.testing.assert_array_equal(infos["_seed"], mask)

    single = ExcavatorEnv(SPECS[1])
    np.testing.assert_array_equal(single.restore(moment), before[1])
    np.testing.assert_array_equal(vector.restore(3, moment), before[1])
    for levers in levers_of(2, 20):
        levers[3] = levers[1]
        np.testing.assert_array_equal(vector.step(levers)[0][3], single.step(levers[1])[0])


def test_truth_that_was_given_stays():
    vector = VectorExcavatorEnv(COUNT, SPECS)
    vector.reset(seed=0)
    observations, *_, infos = vector.step(np.ones((COUNT, 3)))
    tip, shown = infos["truth"]["TipX"].copy(), observations.copy()
    for _ in range(5):
        vector.step(np.ones((COUNT, 3)))
    np.testing.assert_array_equal(infos["truth"]["TipX"], tip)
    np.testing.assert_array_equal(observations, shown)
    assert np.isnan(infos["truth"]["Ground_03"][[0, 2]]).all()
    assert np.isfinite(infos["truth"]["Ground_03"][[1, 3]]).all()


def test_drawn_machines_differ_side_by_side():
    vector = VectorExcavatorEnv(4, randomise=True, duration_s=1.0)
    _, infos = vector.reset(seed=5)
    assert len(set(infos["machine"])) == 4
    assert [model.machine.name for model in vector.models] == infos["machine"].tolist()
    single = ExcavatorEnv(randomise=True, duration_s=1.0)
    assert single.reset(seed=7)[1]["machine"] == infos["machine"][2]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"num_envs": 0}, "num_envs = 0"),
        ({"num_envs": 3, "settings": SPECS}, "4 settings for num_envs = 3"),
        ({"autoreset_mode": "later"}, "choose one of NextStep, SameStep, Disabled"),
        ({"render_mode": "human"}, "nothing to render"),
        ({"num_envs": 2, "settings": [SPECS[0], EnvironmentSpec(rate_hz=50.0)]}, "differ in observed or rate_hz"),
    ],
)
def test_what_cannot_go_side_by_side_is_refused(arguments, words):
    with pytest.raises(ConfigError, match=words):
        VectorExcavatorEnv(**arguments)


def test_bad_levers_and_seeds_are_refused_and_move_nothing():
    vector = VectorExcavatorEnv(2, duration_s=0.05, autoreset_mode="Disabled")
    with pytest.raises(ConfigError, match="not under way"):
        vector.step(np.zeros((2, 3)))
    vector.reset(seed=0)
    moment = vector.snapshot(0)
    for levers, words in ((np.zeros((3, 3)), "shape \\(3, 3\\)"), ([[0, 0, 0], [0, np.inf, 0]], "levers of episode 1")):
        with pytest.raises(ConfigError, match=words):
            vector.step(levers)
    np.testing.assert_array_equal(vector.snapshot(0).memory, moment.memory)
    with pytest.raises(ConfigError, match="3 seeds for 2 machines"):
        vector.reset(seed=[1, 2, 3])
    with pytest.raises(ConfigError, match="reset_mask"):
        vector.reset(options={"reset_mask": np.zeros(2, dtype=bool)})
    for _ in range(4):
        vector.step(np.zeros((2, 3)))
    with pytest.raises(ConfigError, match="not under way"):
        vector.step(np.zeros((2, 3)))
