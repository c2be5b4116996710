"""Every task is an environment that keeps Gymnasium's rules, on every plant."""

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from edp.control.controllers import CONTROLLERS
from edp.control.learning import (
    LearningSpec,
    PolicyController,
    RewardWeights,
    TaskEnvironment,
    VectorTaskEnvironment,
    register_tasks,
)
from edp.control.limits import LoopLimits
from edp.control.loop import run_loop
from edp.control.models import ControlModels
from edp.control.plant import interface_of
from edp.control.plants import plant_of
from edp.control.tasks import TASKS, draw_task
from edp.control.twin_environment import TwinEnvironment
from edp.control.valve_map import ValveMap
from edp.errors import ConfigError
from edp.networks.twin import TWINS
from edp.sim import machine_names
from edp.sim.environment import ExcavatorEnv
from edp.sim.excitation.levers import speed_table
from edp.sim.machine.machine_files import load_machine
from edp.testing.control import sample_excavator_twin
from edp.training.twin_bundle import TwinBundle, save_twin

SHORT = {
    "grade": {"length_m": (0.4, 0.5)},
    "corners": {"width_m": 0.3, "height_m": 0.3, "legs": 2},
    "level": {"speed_m_s": 1.0},
    "point": {"points": 1, "speed_m_s": 1.0},
    "dig": {"length_m": (0.5, 0.6), "speed_m_s": 0.8, "material": ""},
}
PLANTS = ("simulator", "twin")


@pytest.fixture(scope="module")
def twin():
    return sample_excavator_twin()


@pytest.fixture(scope="module", autouse=True)
def valves():
    """The valve map of a base controller takes ten thousand ticks a plant: here it is the one of the machine."""
    valves = ValveMap(*speed_table(load_machine("M22")))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("edp.control.learning.episodes.measure_valve_map", lambda *_: valves)
        yield valves


@pytest.fixture
def spec(twin):
    def make(task="grade", plant="simulator", **changes):
        own = {"options": SHORT[task], "duration_s": 3.0, "hold": 4} | changes
        return LearningSpec(task=task, plant=twin if plant == "twin" else None, **own)

    return make


def same_plant(settings, plant, twin):
    """Of the same length, on which the draws of its sensors depend."""
    return TwinEnvironment(twin, "M22", 30.0) if plant == "twin" else ExcavatorEnv(settings.plant_settings)


def driven(env, seed, actions):
    """Observations, rewards and ends of an episode whose actions come again and again."""
    rows, rewards = [env.reset(seed=seed)[0]], []
    for n in range(10_000):
        row, reward, terminated, truncated, info = env.step(actions[n % len(actions)])
        rows.append(row)
        rewards.append(reward)
        if terminated or truncated:
            break
    return np.array(rows), np.array(rewards), terminated, truncated, info


def test_every_task_has_a_name_on_every_machine():
    register_tasks()
    names = {name for name in gymnasium.registry if name.startswith("edp/") and not name.startswith("edp/Excavator-")}
    assert names == {f"edp/{task.title()}-{machine}-v0" for task in TASKS for machine in machine_names()}
    for name in sorted(names):
        env = gymnasium.make(name, duration_s=2.0)
        assert type(env.unwrapped) is TaskEnvironment
        assert env.unwrapped.settings.task.title() == name.split("/")[1].split("-")[0]
        assert env.unwrapped.settings.machine == name.split("-")[1]


@pytest.mark.parametrize("plant", PLANTS)
@pytest.mark.parametrize("task", TASKS)
def test_it_passes_the_check_of_gymnasium(task, plant, spec):
    env = gymnasium.make(f"edp/{task.title()}-M22-v0", settings=spec(task, plant)).unwrapped
    check_env(env)
    assert len(env.names) == len(set(env.names)) == env.observation_space.shape[0]


@pytest.mark.parametrize("plant", PLANTS)
@pytest.mark.parametrize("task", TASKS)
def test_the_same_seed_gives_the_same_episode_and_another_one_another(task, plant, spec):
    env, rng = TaskEnvironment(spec(task, plant)), np.random.default_rng(0)
    actions = rng.uniform(-0.5, 0.5, (7, 3))
    first, again, other = (driven(env, seed, actions) for seed in (3, 3, 4))
    for a, b in zip(first[:4], again[:4], strict=True):
        np.testing.assert_array_equal(a, b)
    assert not np.array_equal(first[0][0], other[0][0])
    assert first[2] != first[3]
    assert set(first[4]["score"]) == {
        "position_rms_mm", "position_max_mm", "attitude_rms_deg", "lever_travel", "violations",
    }  # fmt: skip


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
@pytest.mark.parametrize("base", ["", "pi"])
@pytest.mark.parametrize("plant", PLANTS)
def test_side_by_side_each_is_what_it_is_alone(plant, base, mode, spec):
    settings = spec("grade", plant, base=base, duration_s=0.6, lost_m=0.06)
    many = VectorTaskEnvironment(3, settings, autoreset_mode=mode)
    alone = [TaskEnvironment(settings) for _ in range(3)]
    near = {"rtol": 1e-5, "atol": 1e-5} if plant == "twin" else {"rtol": 0.0, "atol": 0.0}
    rows, _ = many.reset(seed=5)
    np.testing.assert_allclose(rows, [env.reset(seed=5 + n)[0] for n, env in enumerate(alone)], **near)
    rng, over, ends = np.random.default_rng(1), np.zeros(3, bool), 0
    for _ in range(40):
        actions = rng.uniform(-1.0, 1.0, (3, 3)).astype(np.float32)
        rows, rewards, lost, truncated, infos = many.step(actions)
        for n, env in enumerate(alone):
            if over[n]:
                row, reward, ended = env.reset()[0], 0.0, (False, False)
            else:
                row, reward, *ended, info = env.step(actions[n])
            assert [bool(lost[n]), bool(truncated[n])] == list(ended)
            assert rewards[n] == pytest.approx(reward, rel=near["rtol"], abs=near["atol"])
            if any(ended):
                ends += 1
                score = infos["final_info"]["score"] if mode == "SameStep" else infos["score"]
                assert score["position_rms_mm"][n] == pytest.approx(info["score"]["position_rms_mm"], rel=1e-4)
            if any(ended) and mode == "SameStep":
                np.testing.assert_allclose(infos["final_obs"][n], row, **near)
                row, ended = env.reset()[0], (False, False)
            np.testing.assert_allclose(rows[n], row, **near)
            over[n] = any(ended)
    assert ends >= 3


def test_without_a_reset_of_its_own_it_asks_for_one(spec):
    many = VectorTaskEnvironment(2, spec(duration_s=0.2), autoreset_mode="Disabled")
    with pytest.raises(ConfigError, match="call reset"):
        many.step(np.zeros((2, 3)))
    many.reset(seed=1)
    ended = np.zeros(2, bool)
    while not ended.any():
        *_, lost, ended, _ = many.step(np.zeros((2, 3)))
        assert not lost.any()
    with pytest.raises(ConfigError, match=r"episodes \[0, 1\] are not under way"):
        many.step(np.zeros((2, 3)))
    many.reset(options={"reset_mask": np.array([True, False])})
    with pytest.raises(ConfigError, match=r"episodes \[1\] are not under way"):
        many.step(np.zeros((2, 3)))
    many.reset(options={"reset_mask": np.array([False, True])})
    many.step(np.zeros((2, 3)))


@pytest.mark.parametrize("base", ["", "pi"])
@pytest.mark.parametrize("plant", PLANTS)
def test_a_policy_in_a_loop_does_what_it_did_in_the_environment(plant, base, spec, twin, valves):
    settings = spec("grade", plant, base=base, duration_s=20.0)
    env = TaskEnvironment(settings)
    weights = np.random.default_rng(2).normal(0.0, 0.1, (3, len(env.names)))

    def policy(seen):
        return np.tanh(weights @ seen)

    row, _ = env.reset(seed=3)
    done, seen = False, [row]
    while not done:
        row, _, lost, truncated, info = env.step(policy(row))
        seen.append(row)
        done = lost or truncated
    own = same_plant(settings, plant, twin)
    interface = interface_of(own)
    task = draw_task(settings.task_spec, interface.geometry, 100.0, 3)
    asked = []

    def noted(row):
        asked.append(row)
        return policy(row)

    controller = PolicyController(noted, settings, interface, task.limits, ControlModels(valves))
    score = run_loop(own, controller, task, 3).score
    common = min(len(asked), len(seen)) - 1
    np.testing.assert_allclose(asked[:common], seen[:common], atol=2e-4)
    assert not controller.events
    if truncated:
        # A loop has up to `hold` more ticks than whole actions fill.
        assert score.position_rms_mm == pytest.approx(info["score"]["position_rms_mm"], rel=0.02)


@pytest.mark.parametrize("plant", PLANTS)
def test_a_base_whose_levers_nothing_corrects_is_that_controller(plant, spec, twin, valves):
    settings = spec("grade", plant, base="pi", duration_s=20.0, hold=1)
    _, _, lost, truncated, info = driven(TaskEnvironment(settings), 3, np.zeros((1, 3)))
    assert truncated
    assert not lost
    own = same_plant(settings, plant, twin)
    interface = interface_of(own)
    task = draw_task(settings.task_spec, interface.geometry, 100.0, 3)
    pi = CONTROLLERS["pi"]().build(interface, task.limits, ControlModels(valves))
    score = run_loop(own, pi, task, 3).score
    assert info["score"]["position_rms_mm"] == pytest.approx(score.position_rms_mm, rel=1e-6)
    assert info["score"]["position_max_mm"] == pytest.approx(score.position_max_mm, rel=1e-6)
    assert info["score"]["attitude_rms_deg"] == pytest.approx(score.attitude_rms_deg, rel=1e-4)


def test_standing_still_is_worth_less_than_following(spec):
    follows, stands = (spec(base=base, duration_s=20.0, hold=1, lost_m=10.0) for base in ("pi", ""))
    worth = [driven(TaskEnvironment(settings), 3, np.zeros((1, 3)))[1].mean() for settings in (follows, stands)]
    assert worth[0] > 1.5 * worth[1]


def test_a_reward_is_what_its_weights_say():
    weights = RewardWeights(position_m=0.02, attitude=0.5, attitude_rad=0.01, travel=2.0, limit=3.0)
    position, attitude = np.array([0.0, 0.02, 0.06]), np.array([0.0, -0.01, 0.03])
    travel, violated = np.array([0.0, 0.1, 0.2]), np.array([False, False, True])
    expected = [1.0 + 0.5, 0.5 + 0.25 - 0.2, 0.25 + 0.125 - 0.4 - 3.0]
    assert weights.compute_reward(position, attitude, travel, violated) == pytest.approx(expected)


def test_a_lost_tip_terminates_and_costs_what_was_said(spec):
    settings = spec(lost_m=0.05, reward=RewardWeights(lost=7.0), duration_s=20.0)
    _, rewards, lost, truncated, info = driven(TaskEnvironment(settings), 3, np.ones((1, 3)))
    assert lost
    assert not truncated
    assert rewards[-1] < -5.0
    assert (rewards[:-1] > -1.0).all()
    assert info["position_m"] > 0.05


def test_levers_keep_the_limits_of_the_task_whatever_is_asked(spec):
    limits = LoopLimits(lever_low=(-0.1, -0.2, -0.3), lever_high=(0.1, 0.2, 0.3), slew_per_s=(1.0, 2.0, 3.0))
    env = TaskEnvironment(spec(options={**SHORT["grade"], "limits": limits}, hold=1, lost_m=10.0))
    names = [f"{axis} lever 1 ticks ago" for axis in ("boom", "arm", "bucket")]
    columns = [env.names.index(name) for name in names]
    rows = driven(env, 3, np.repeat([[1.0, -1.0, 1.0], [-1.0, 1.0, -1.0]], 40, axis=0))[0][:, columns]
    assert (np.abs(rows) <= np.array([0.1, 0.2, 0.3]) + 1e-6).all()
    assert (np.abs(np.diff(rows, axis=0)) <= np.array([0.01, 0.02, 0.03]) + 1e-6).all()
    assert np.abs(rows).max(axis=0) == pytest.approx([0.1, 0.2, 0.3])


def test_references_that_are_drawn_are_never_those_that_judge(spec):
    env = TaskEnvironment(spec(seeds=(2_000_000, 2_000_004)))
    drawn = [env.reset(seed=11 if not n else None)[1]["seed"] for n in range(12)]
    assert drawn[0] == 11
    assert set(drawn[1:]) <= set(range(2_000_000, 2_000_005))
    assert len(set(drawn[1:])) > 1
    assert LearningSpec().seeds[0] == 1_000_000


def test_seeds_without_a_reference_are_passed_over_where_none_is_asked_for(spec, monkeypatch):
    # Draws of a seed are few here, so that many seeds have no reference.
    monkeypatch.setattr("edp.control.tasks.base.TRIES", 2)
    env = TaskEnvironment(spec(options={"length_m": (2.0, 2.2)}))
    refused = []
    for seed in range(6):
        try:
            assert env.reset(seed=seed)[1]["seed"] == seed
        except ConfigError as error:
            refused.append(str(error))
    assert 0 < len(refused) < 6
    assert all("none of 2 draws can be done" in text for text in refused)
    assert all(env.reset()[1]["seed"] >= 1_000_000 for _ in range(6))
    never = TaskEnvironment(spec(options={"length_m": (9.0, 9.5)}))
    with pytest.raises(ConfigError, match="none of 2 draws can be done"):
        never.reset()


def test_a_twin_on_disk_is_a_plant_by_one_argument(twin, tmp_path, spec):
    save_twin(TwinBundle(TWINS["static"](), twin), tmp_path / "run" / "twin")
    rows = [
        driven(TaskEnvironment(spec(plant="twin")), 3, np.full((1, 3), 0.1))[0],
        driven(
            gymnasium.make(
                "edp/Grade-M22-v0", plant=str(tmp_path / "run"), options=SHORT["grade"], duration_s=3.0, hold=4
            ),
            3,
            np.full((1, 3), 0.1),
        )[0],
    ]
    np.testing.assert_array_equal(*rows)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"task": "grad"}, "unknown task 'grad'; did you mean 'grade'"),
        ({"base": "pid"}, "unknown controller 'pid'"),
        ({"base": "nmpc"}, "needs a twin"),
        ({"gains": {"integral": 1.0}}, "without a base"),
        ({"base": "pi", "gains": {"integrall": 1.0}}, "'integrall' is unknown; did you mean 'integral'"),
        ({"options": {"slope": 3}}, "option 'slope' is unknown; did you mean 'slope_deg'"),
        ({"options": {"slope_deg": 99.0}}, "slope_deg"),
        ({"observd": ()}, "'observd' is unknown; did you mean 'observed'"),
        ({"observed": ("CylVel_1",)}, "does not measure 'CylVel_1'; did you mean 'CylVels_1'"),
        ({"hold": 0}, "hold"),
        ({"duration_s": 0.01}, "more than one action"),
        ({"seeds": (5, 4)}, "the lowest and the highest"),
        ({"simulator": {"machine": "C14"}}, "simulator setting 'machine' is unknown"),
        ({"simulator": {"sensor_noise": False}, "plant": "runs/none"}, "another plant is set"),
        ({"plant": "runs/none"}, "is not a twin"),
        ({"rate_hz": 50.0, "plant": "TWIN"}, "the twin has 100 Hz, the loops 50 Hz"),
        ({"machine": "M2"}, "M2"),
        ({"render_mode": "human"}, "nothing to render"),
    ],
)
def test_settings_that_cannot_be_are_refused_in_one_message(changes, message, twin):
    if changes.get("plant") == "TWIN":
        changes = changes | {"plant": twin}
    with pytest.raises(Exception, match=message) as error:
        TaskEnvironment(**changes)
    assert type(error.value).__module__ == "edp.errors"


def test_calls_that_cannot_be_are_refused(spec):
    env, many = TaskEnvironment(spec()), VectorTaskEnvironment(2, spec())
    with pytest.raises(ConfigError, match="call reset"):
        env.step(np.zeros(3))
    with pytest.raises(ConfigError, match="option 'strokes' is unknown"):
        env.reset(options={"strokes": (0.5, 0.5, 0.5)})
    env.reset(seed=3)
    many.reset(seed=3)
    for bad, message in ((np.zeros(2), "shape"), (np.array([0.0, np.nan, 0.0]), "not finite")):
        with pytest.raises(ConfigError, match=message):
            env.step(bad)
        with pytest.raises(ConfigError, match=message):
            many.step(np.stack([bad, bad]))
    for arguments, message in (
        ({"seed": [1]}, "1 seeds for 2"),
        ({"options": {"reset_mask": np.zeros(2, bool)}}, "reset_mask"),
        ({"seed": -1}, "seed"),
    ):
        with pytest.raises(ConfigError, match=message):
            many.reset(**arguments)
    with pytest.raises(ConfigError, match="num_envs = 0"):
        VectorTaskEnvironment(0)
    with pytest.raises(ConfigError, match="autoreset_mode"):
        VectorTaskEnvironment(1, autoreset_mode="never")


def test_soil_on_a_twin_is_refused_where_the_episode_begins(twin):
    env = TaskEnvironment(task="dig", plant=twin, duration_s=3.0)
    with pytest.raises(ConfigError, match="a twin knows no soil"):
        env.reset(seed=0)


@pytest.mark.parametrize("answer", [np.zeros(2), np.full(3, np.nan), "nothing", None])
def test_a_policy_without_an_answer_gives_the_safe_command(answer, spec, valves):
    env = plant_of("M22", 5.0, 100.0)
    interface = interface_of(env)
    task = draw_task(spec().task_spec, interface.geometry, 100.0, 3)

    def policy(seen):
        if answer is None:
            raise ZeroDivisionError("no answer")
        return answer

    controller = PolicyController(policy, spec(), interface, task.limits, ControlModels(valves))
    result = run_loop(env, controller, task, 3)
    assert np.abs(result.recording.select(("Lever_1", "Lever_2", "Lever_3"))).max() == 0.0
    assert result.score.missed > 0
    with pytest.raises(ConfigError, match="learned at 50 Hz"):
        PolicyController(policy, spec(rate_hz=50.0), interface, task.limits, ControlModels())
