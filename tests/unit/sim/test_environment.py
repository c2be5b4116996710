"""One machine as an environment: the bits of recordings, exact restarts, and what is refused."""

import copy
import importlib
import re
import subprocess
import sys
from dataclasses import fields
from pathlib import Path

import gymnasium
import numpy as np
import pytest

from edp.errors import ConfigError
from edp.signals import TABLE_A1
from edp.sim import Scenario, Simulation, SimulationError, load_machine
from edp.sim.environment import EnvironmentSpec, ExcavatorEnv
from edp.sim.environment.spec import OBSERVED
from edp.sim.episodes import blocks
from edp.sim.machine import layout as at
from edp.sim.sensors import sensors
from edp.sim.start import seeds_of

SCENES = [
    Scenario("M22", "combined", 6.0, seed=5, step_s=2.5e-3),
    Scenario("C14", "reversals", 6.0, seed=6, rate_hz=50.0, step_s=2e-3),
    Scenario("C14", "dig", 12.0, seed=7, material="clay"),
    Scenario("M22", "dig", 12.0, seed=8, material="gravel", sensor_noise=False),
]


def env_of(scenario, **changes):
    keys = ("machine", "material", "duration_s", "rate_hz", "step_s", "sensor_noise")
    return ExcavatorEnv(**{key: getattr(scenario, key) for key in keys}, **changes)


def run(env, levers):
    """Observations of these levers, and behind them the true tip, shape (time, channel + 1)."""
    steps = [env.step(lever) for lever in levers]
    return np.array([[*step[0], step[4]["truth"]["TipX"]] for step in steps])


def levers_of(seed, ticks, machines=()):
    """Random levers that stay for a tenth of a second."""
    return np.repeat(np.random.default_rng(seed).uniform(-1, 1, (ticks // 10 + 1, *machines, 3)), 10, axis=0)[:ticks]


@pytest.mark.parametrize("scenario", SCENES, ids=lambda s: s.label)
def test_an_episode_is_the_recording_of_its_levers_to_the_bit(scenario):
    simulation = Simulation(scenario)
    log = simulation.run(scenario.samples)
    shifted = log.copy()
    demands = slice(at.LOG_DEMAND, at.LOG_DEMAND + at.SPOOLS)
    # what an observation knows of the commands is the lever before it
    shifted[1:, demands], shifted[0, demands] = log[:-1, demands], 0.0
    noise = np.random.default_rng(seeds_of(scenario)[2]) if scenario.sensor_noise else None
    kelvin = log[:, at.LOG_OIL] + 273.15
    measured = sensors.measure_signals(shifted, simulation.machine, scenario.rate_hz, noise, kelvin)
    truth = sensors.truth_signals(shifted)

    env = env_of(scenario, hand=simulation.operator.by_hand)
    observation, info = env.reset(seed=scenario.seed)
    observations, truths = [observation], [dict(info["truth"])]
    for lever in simulation.targets[:-1]:
        observation, reward, terminated, truncated, info = env.step(lever)
        observations.append(observation)
        truths.append(dict(info["truth"]))
        assert (reward, terminated) == (0.0, False)
    assert truncated
    np.testing.assert_array_equal(np.array(observations)[:, :24], measured.astype(np.float32))
    assert set(truths[0]) == set(truth) | set(TABLE_A1) - {"CylAcc_1", "CylAcc_2", "CylAcc_3"}
    for name, column in truth.items():
        np.testing.assert_array_equal([row[name] for row in truths], column, err_msg=name)
    np.testing.assert_array_equal([row["CylVels_2"] for row in truths], log[:, at.LOG_VELOCITY + 1])
    np.testing.assert_array_equal([row["CylPressures_5"] for row in truths], log[:, at.ROD])
    with pytest.raises(ConfigError, match="the episode has ended; call reset"):
        env.step(np.zeros(3))


def test_channels_name_what_is_shown():
    env = ExcavatorEnv(observed=("TipX", "CylVels_2", "OilTemperature"), sensor_noise=False)
    observation, info = env.reset(seed=1)
    assert [(c.name, c.unit) for c in env.channels] == [("TipX", "m"), ("CylVels_2", "m/s"), ("OilTemperature", "K")]
    observation, *_, info = env.step([0.0, 0.9, 0.0])
    np.testing.assert_array_equal(observation, np.array([info["truth"][c.name] for c in env.channels], np.float32))
    assert [c.name for c in ExcavatorEnv().channels] == list(OBSERVED)


def test_commands_are_the_pilot_pressures_that_levers_give():
    env = ExcavatorEnv(sensor_noise=False)
    env.reset(seed=2)
    pilots = list(TABLE_A1)[12:]
    for lever in ([0.3, -1.0, 0.0], [-0.9, 0.02, 1.0]):
        observation, *_, info = env.step(lever)
        np.testing.assert_array_equal(observation[12:24], env.commands(lever).astype(np.float32))
        np.testing.assert_array_equal([info["truth"][name] for name in pilots], env.commands(lever))
    rows = levers_of(0, 24).reshape(2, 12, 3)
    assert env.commands(rows).shape == (2, 12, 12)
    np.testing.assert_array_equal(env.commands(rows)[1, 3], env.commands(rows[1, 3]))


@pytest.mark.parametrize("machine", ["M22", "C14"])
def test_kinematics_agree_with_the_plant_and_with_their_inverse(machine):
    env = ExcavatorEnv(machine=machine)
    _, info = env.reset(seed=3)
    truth = info["truth"]
    strokes = [truth[f"CylStroke_{i}"] for i in (1, 2, 3)]
    np.testing.assert_allclose(env.tip(strokes), [truth["TipX"], truth["TipY"], truth["TipAngle"]], atol=1e-9)
    full = np.array(load_machine(machine).cylinders.stroke)
    grid = np.stack(np.meshgrid(*[np.linspace(0.02, 0.98, 7)] * 3, indexing="ij"), axis=-1) * full
    np.testing.assert_allclose(env.strokes(env.tip(grid)), grid, atol=1e-9)
    assert np.isnan(env.strokes([100.0, 0.0, 0.0])).all()


@pytest.mark.parametrize("scenario", SCENES[1:3], ids=lambda s: s.label)
def test_snapshots_copies_and_branches(scenario):
    env = env_of(scenario, loop_latency=2, lost_frames=0.1)
    env.reset(seed=scenario.seed)
    first, rest = levers_of(0, 160)[:100], levers_of(1, 90)
    last = run(env, first)[-1, :-1]
    moment = env.snapshot()
    kept = moment.memory.copy(), moment.drawn.copy()
    double = copy.deepcopy(env)
    whole = run(env, rest)
    other = env_of(scenario, loop_latency=2, lost_frames=0.1)
    np.testing.assert_array_equal(other.restore(moment), last)
    env.restore(moment)
    for again in (env, double, other):
        np.testing.assert_array_equal(run(again, rest), whole)
    np.testing.assert_array_equal(moment.memory, kept[0])
    np.testing.assert_array_equal(moment.drawn, kept[1])

    branches = []
    for seed in (1, 1, 2):
        env.restore(moment)
        env.branch(seed)
        branches.append(run(env, rest))
    np.testing.assert_array_equal(branches[0], branches[1])
    assert (branches[0][3:] != whole[3:]).any()
    assert (branches[0][3:] != branches[2][3:]).any()


def test_what_is_on_its_way_at_a_branch_arrives_as_it_is():
    env = ExcavatorEnv(loop_latency=2)
    env.reset(seed=0)
    run(env, levers_of(0, 50))
    moment, rest = env.snapshot(), levers_of(1, 10)
    whole = run(env, rest)
    env.restore(moment)
    env.branch(1)
    branch = run(env, rest)
    np.testing.assert_array_equal(branch[:2], whole[:2])
    assert (branch[2] != whole[2]).any()


def test_a_branch_keeps_the_bias_of_the_joints_and_the_order_of_the_frames():
    env = ExcavatorEnv(machine="C14", sensors={"joint_bias_walk_deg": 50.0}, duration_s=4.0)
    env.reset(seed=0)
    run(env, np.zeros((200, 3)))
    env.branch(3)
    drawn = blocks.view(blocks.SENSOR_DRAWS, env.snapshot().memory, env.snapshot().drawn)
    steps = np.abs(np.diff(drawn[:, 3:6], axis=0))
    assert steps[195:205].max() < 5 * steps.max(axis=0).mean()
    assert drawn[200, 3:6].any()
    assert (np.diff(drawn[:, :3], axis=0) >= 0.0).all()
    assert (np.arange(len(drawn))[:, None] - drawn[:, :3] >= 0.0).all()


def test_latency_and_lost_frames_act_on_the_whole_observation():
    levers = levers_of(0, 399)
    plain, late = ExcavatorEnv(duration_s=4.0), ExcavatorEnv(duration_s=4.0, loop_latency=3)
    first = np.concatenate([[plain.reset(seed=4)[0]], run(plain, levers)[:, :-1]])
    second = np.concatenate([[late.reset(seed=4)[0]], run(late, levers)[:, :-1]])
    np.testing.assert_array_equal(second[3:], first[:-3])
    np.testing.assert_array_equal(second[:3], np.tile(first[0], (3, 1)))

    lossy = ExcavatorEnv(duration_s=4.0, lost_frames=0.3)
    third = np.concatenate([[lossy.reset(seed=4)[0]], run(lossy, levers)[:, :-1]])
    lost = (third != first).any(axis=1)
    assert 0.2 < lost.mean() < 0.4
    for k in np.flatnonzero(lost):
        np.testing.assert_array_equal(third[k], third[k - 1])


def test_levers_beyond_the_ends_stand_at_the_end_and_bad_ones_move_nothing():
    env = ExcavatorEnv(hand=True)
    env.reset(seed=0)
    moment = env.snapshot()
    far = run(env, np.full((30, 3), [5.0, -3.0, 1.5]))
    env.restore(moment)
    np.testing.assert_array_equal(run(env, np.full((30, 3), [1.0, -1.0, 1.0])), far)
    env.restore(moment)
    for bad, words in (
        ([0.0, np.nan, 0.0], "finite numbers from -1 to 1"),
        ([0.0, 1.0], "shape \\(2,\\); give three positions"),
        (np.zeros((1, 3)), "shape \\(1, 3\\)"),
    ):
        with pytest.raises(ConfigError, match=words):
            env.step(bad)
    np.testing.assert_array_equal(env.snapshot().memory, moment.memory)


def test_a_diverged_state_is_one_error():
    env = ExcavatorEnv()
    env.reset(seed=0)
    moment = env.snapshot()
    blocks.view(blocks.STATE, moment.memory, moment.drawn)[0, at.RATE] = np.nan
    env.restore(moment)
    with pytest.raises(
        SimulationError, match=r"diverged at t = 0.01 s \(machine M22, seed 0\); choose a smaller step_s"
    ):
        env.step(np.zeros(3))


def test_options_of_a_reset_hold_for_one_episode():
    env = ExcavatorEnv()
    base = env.reset(seed=1)[0]
    changes = {"machine": "C14", "material": "clay", "strokes": [0.6, 0.4, 0.3], "oil_temperature": 65.0}
    _, info = env.reset(seed=1, options=changes)
    assert (info["machine"], info["material"], env.machine.name) == ("C14", "clay", "C14")
    assert info["truth"]["OilTemperature"] == pytest.approx(338.15)
    strokes = [info["truth"][f"CylStroke_{i}"] for i in (1, 2, 3)]
    np.testing.assert_allclose(strokes, np.array([0.6, 0.4, 0.3]) * env.machine.cylinders.stroke, atol=1e-9)
    assert "Ground_07" in info["truth"]
    observation, info = env.reset(seed=1)
    np.testing.assert_array_equal(observation, base)
    assert env.machine.name == "M22"
    assert "Ground_07" not in info["truth"]


def test_a_drawn_machine_follows_from_the_seed():
    env = ExcavatorEnv(randomise=1.5, masses_t=(10.0, 30.0))
    draws = [env.reset(seed=seed)[1] for seed in (1, 1, 2, 3, 4)]
    names = [info["machine"] for info in draws]
    assert names[0] == names[1]
    assert len(set(names)) == 4
    assert all(10.0 <= info["mass_t"] <= 30.0 for info in draws)
    # the name alone gives the machine again
    assert load_machine(names[-1]).bodies == env.machine.bodies
    assert len({env.reset()[1]["machine"] for _ in range(3)}) == 3


def test_episodes_without_a_seed_go_on_with_the_generator():
    env = ExcavatorEnv()
    first = [env.reset(seed=9)[1]["seed"], env.reset()[1]["seed"], env.reset()[1]["seed"]]
    again = [env.reset(seed=9)[1]["seed"], env.reset()[1]["seed"], env.reset()[1]["seed"]]
    assert first == again
    assert len(set(first)) == 3


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"settings": "M22"}, "got 'M22' as settings, expected an EnvironmentSpec"),
        ({"machin": "M22"}, "setting 'machin' is unknown; did you mean 'machine'"),
        ({"machine": "M23"}, "unknown machine 'M23'"),
        ({"material": "mud"}, "unknown material 'mud'"),
        ({"observed": ("CylVels_9",)}, "observed channel 'CylVels_9' is unknown; did you mean"),
        ({"observed": ("Ground_00",)}, "only in soil; choose a material"),
        ({"observed": ()}, "at least one"),
        ({"observed": ("TipX", "TipX")}, "each channel once"),
        ({"loop_latency": -1}, "loop_latency"),
        ({"lost_frames": 1.0}, "lost_frames"),
        ({"rate_hz": 300.0}, "does not divide the sample time"),
        ({"duration_s": 1e9}, "choose shorter episodes"),
        ({"randomise": 9.0}, "a spread is above 0 and at most 2.5"),
        ({"randomise": True, "machine": "C14"}, "family of M22"),
        ({"randomise": True, "masses_t": (30.0, 10.0)}, "family of machines from 30.0 to 10.0 t"),
        ({"render_mode": "human"}, "nothing to render"),
    ],
)
def test_what_cannot_be_is_refused_before_the_first_step(changes, words):
    with pytest.raises(ConfigError, match=words):
        ExcavatorEnv(**changes)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"machne": "M22"}, "option 'machne' is unknown; did you mean 'machine'"),
        ({"oil_temperature": "hot"}, "give a number in degC"),
        ({"oil_temperature": 900.0}, "oil_temperature"),
        ({"strokes": [0.5, 0.5]}, "three shares of full stroke"),
        ({"strokes": [0.5, 0.5, 1.5]}, "from 0 to 1"),
        ({"machine": "C15"}, "unknown machine 'C15'"),
    ],
)
def test_options_that_cannot_be_are_refused(options, words):
    with pytest.raises(ConfigError, match=words):
        ExcavatorEnv().reset(seed=0, options=options)


def test_what_has_not_begun_and_other_channels_are_refused():
    env = ExcavatorEnv()
    for call in (lambda: env.step(np.zeros(3)), env.snapshot, lambda: env.branch(1)):
        with pytest.raises(ConfigError, match="has not begun"):
            call()
    env.reset(seed=0)
    with pytest.raises(ConfigError, match="shows other channels"):
        ExcavatorEnv(observed=("TipX",)).restore(env.snapshot())
    for seed in (-1, 1.5, True):
        with pytest.raises(ConfigError, match="give a whole number that is not negative"):
            env.reset(seed=seed)
    with pytest.raises(ConfigError, match="the last axis must have three values"):
        env.tip([0.1, 0.2])


def test_settings_stand_in_a_spec_or_beside_it():
    spec = EnvironmentSpec(machine="C14", duration_s=2.0)
    env = ExcavatorEnv(spec, rate_hz=50.0)
    assert (env.settings.machine, env.settings.duration_s, env.rate_hz) == ("C14", 2.0, 50.0)
    made = gymnasium.make("edp/Excavator-C14-v0", duration_s=2.0)
    assert made.unwrapped.settings == spec


def test_a_missing_gymnasium_is_one_error(monkeypatch):
    from edp.sim.environment import library

    monkeypatch.setitem(sys.modules, "gymnasium", None)
    with pytest.raises(ConfigError, match=r"pip install 'excavator-dynamics-predictor\[control\]'"):
        importlib.reload(library)
    monkeypatch.undo()
    importlib.reload(library)


@pytest.mark.processes
def test_the_simulator_needs_no_gymnasium():
    code = "import sys; sys.modules['gymnasium'] = None; import edp, edp.sim; edp.sim.Simulation(edp.sim.Scenario())"
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.long
def test_the_page_runs_as_it_stands():
    page = (Path(__file__).parents[3] / "docs" / "howto" / "reinforcement_learning.md").read_text(encoding="utf-8")
    blocks_of_page = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    assert len(blocks_of_page) == 4
    blocks_of_page = [block.replace("num_envs=64", "num_envs=2") for block in blocks_of_page]
    namespace: dict[str, object] = {}
    for number, block in enumerate(blocks_of_page):
        exec(compile(block, f"environment.md, block {number}", "exec"), namespace)


def test_the_page_lists_every_setting_with_its_default():
    page = (Path(__file__).parents[3] / "docs" / "howto" / "reinforcement_learning.md").read_text(encoding="utf-8")
    table = dict(re.findall(r"^\| `(\w+)` \| (.+?) \|", page, re.MULTILINE))
    assert set(table) == {entry.name for entry in fields(EnvironmentSpec)}
    for name in ("duration_s", "rate_hz", "step_s", "loop_latency", "lost_frames"):
        assert float(table[name]) == getattr(EnvironmentSpec(), name)
