"""What holds for every registered controller on every registered task."""

from dataclasses import fields

import numpy as np
import pytest

from edp.config.control import CONTROL_SETTINGS, ControlExperiment, load_control_experiment
from edp.control.base import Controller
from edp.control.controllers import CONTROLLERS
from edp.control.limits import LoopLimits
from edp.control.loop import run_loop
from edp.control.models import ControlModels
from edp.control.plant import interface_of
from edp.control.plants import plant_of
from edp.control.tasks import TASKS, draw_task
from edp.control.valve_map import ValveMap
from edp.sim.excitation.levers import speed_table
from edp.testing.control import sample_excavator_twin

SHORT = {
    "grade": {"length_m": (0.4, 0.5)},
    "corners": {"width_m": 0.3, "height_m": 0.3, "legs": 2},
    "level": {"speed_m_s": 1.0},
    "point": {"points": 1, "speed_m_s": 1.0},
    "dig": {"length_m": (0.5, 0.6), "speed_m_s": 0.8},
}
LIMITS = LoopLimits(lever_low=(-0.8, -0.9, -0.7), lever_high=(0.8, 0.7, 0.9), slew_per_s=(3.0, 4.0, 5.0))


@pytest.fixture(scope="module")
def env():
    return plant_of("M22", 40.0, 100.0)


@pytest.fixture(scope="module")
def models(env):
    twin = sample_excavator_twin()
    return ControlModels(ValveMap(*speed_table(env.machine)), twin)


def built(name, env, models, limits=LIMITS):
    return CONTROLLERS[name]().build(interface_of(env), limits, models)


def needs_a_model(name):
    return any("twin" in need for need in CONTROLLERS[name].needs)


# Of all tasks but the first the quick check runs the controllers that cost milliseconds a tick in `make test` alone.
@pytest.mark.long
@pytest.mark.parametrize(
    ("task", "name"),
    [
        pytest.param(task, name, marks=[pytest.mark.long] * (number > 0 and needs_a_model(name)))
        for number, task in enumerate(TASKS)
        for name in CONTROLLERS
    ],
)
def test_limits_hold_and_the_loop_repeats_itself(name, task, env, models):
    drawn = draw_task(TASKS[task](limits=LIMITS, **SHORT[task]), interface_of(env).geometry, 100.0, 1)
    controller = built(name, env, models)
    assert isinstance(controller, Controller)
    first = run_loop(env, controller, drawn, 5)
    levers = first.recording.select(("Lever_1", "Lever_2", "Lever_3"))
    assert (levers >= np.float32(LIMITS.lever_low)).all()
    assert (levers <= np.float32(LIMITS.lever_high)).all()
    assert (np.abs(np.diff(levers, axis=0)) * 100.0 <= np.array(LIMITS.slew_per_s) + 1e-4).all()
    assert first.events == ()
    assert first.score.finished
    # A controller that was used before begins anew.
    assert np.array_equal(run_loop(env, controller, drawn, 5).recording.values, first.recording.values)


@pytest.mark.long
@pytest.mark.parametrize("name", CONTROLLERS)
def test_it_moves_the_tip_along(name, env, models):
    drawn = draw_task(TASKS["grade"](length_m=(1.0, 1.2)), interface_of(env).geometry, 100.0, 3)
    score = run_loop(env, built(name, env, models, LoopLimits()), drawn, 0).score
    way = 1e3 * np.hypot(*(drawn.reference.tip[-1] - drawn.reference.tip[0])[:2])
    assert score.position_rms_mm < 0.15 * way


@pytest.mark.long
@pytest.mark.parametrize("name", CONTROLLERS)
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_each_missing_channel_that_it_reads_gives_the_safe_command_and_no_error(name, value, env, models):
    drawn = draw_task(TASKS["grade"](**SHORT["grade"]), interface_of(env).geometry, 100.0, 1)
    controller = built(name, env, models)
    observation = env.reset(seed=0, options={"strokes": (0.5, 0.5, 0.5)})[0].astype(float)
    names = [channel.name for channel in controller.plant.channels]
    for channel in controller.reads:
        controller.reset(observation, drawn.reference)
        before = [controller.step(observation, tick) for tick in range(40)][-1]
        broken = observation.copy()
        broken[names.index(channel)] = value
        levers = [controller.step(broken, 40 + tick) for tick in range(40)]
        assert np.abs(levers[0]).max() <= np.abs(before).max() + 1e-12
        assert levers[-1] == pytest.approx(0.0)
        assert channel in controller.events[0].text
        assert np.isfinite(controller.step(observation, 80)).all()


@pytest.mark.parametrize("name", CONTROLLERS)
def test_its_gains_are_options_with_room_to_vary(name):
    spec = CONTROLLERS[name]()
    options = {entry.name for entry in fields(spec)}
    assert set(spec.space) <= options
    for option, (low, high) in spec.space.items():
        assert low < high
        CONTROLLERS[name](**{option: low})
        CONTROLLERS[name](**{option: high})


@pytest.mark.parametrize("name", CONTROLLERS)
@pytest.mark.parametrize("task", TASKS)
def test_settings_come_back_from_what_a_run_folder_keeps(name, task):
    experiment = load_control_experiment(None, (), {"task": {"kind": task}, "controller": {"kind": name}})
    plain = CONTROL_SETTINGS.to_dict(experiment)
    assert CONTROL_SETTINGS.build(ControlExperiment, plain, "of a test") == experiment
