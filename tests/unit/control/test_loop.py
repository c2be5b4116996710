"""Loops on the simulator and on a twin: what is recorded, what is repeated, what is refused."""

import time

import numpy as np
import pytest

from edp.control.ahead import TwinAhead
from edp.control.base import Controller
from edp.control.controllers import CONTROLLERS
from edp.control.loop import run_loop
from edp.control.models import ControlModels
from edp.control.plant import STROKES, interface_of
from edp.control.plants import plant_of
from edp.control.tasks import TASKS, draw_task
from edp.control.twin_environment import TwinEnvironment
from edp.control.valve_map import ValveMap
from edp.errors import ConfigError
from edp.signals import VOCABULARY, Kind
from edp.sim.excitation.levers import speed_table
from edp.sim.machine.machine_files import load_machine
from edp.testing.control import sample_excavator_twin

SHORT = {"length_m": (0.4, 0.5), "hold_s": 0.3, "lead_s": 0.2}


@pytest.fixture(scope="module")
def env():
    return plant_of("M22", 10.0, 100.0)


@pytest.fixture(scope="module")
def valves():
    levers, speeds = speed_table(load_machine("M22"))
    return ValveMap(levers, speeds)


@pytest.fixture(scope="module")
def task(env):
    return draw_task(TASKS["grade"](**SHORT), interface_of(env).geometry, 100.0, 2)


@pytest.fixture(scope="module")
def twin():
    return sample_excavator_twin()


class Still(Controller):
    """Never moves."""

    def __init__(self, plant, limits):
        super().__init__(plant, limits, STROKES)

    def begin(self, measured, reference):
        self.info = {"begun": 1.0}

    def levers(self, measured, tick):
        self.info = {"tick": float(tick)}
        return np.zeros(3)


class Slow(Still):
    """Asks for full levers, and takes its time at two ticks."""

    def levers(self, measured, tick):
        if tick in (3, 4):
            time.sleep(0.3)
        return np.ones(3)


def test_an_answer_past_its_deadline_gives_way_to_the_safe_command(env, task):
    controller = Slow(interface_of(env), task.limits)
    result = run_loop(env, controller, task, 7, deadline_s=0.2)
    levers = result.recording.select(("Lever_1", "Lever_2", "Lever_3"))
    assert [(event.tick, event.ticks) for event in result.events] == [(3, 2)]
    assert "no answer within 200 ms: spools to neutral" in result.events[0].text
    step = 5.0 / 100.0
    assert levers[:6, 0] == pytest.approx(step * np.array([1, 2, 3, 2, 1, 2]))
    assert result.score.missed == 2


def test_a_loop_without_a_deadline_waits(env, task):
    result = run_loop(env, Slow(interface_of(env), task.limits), task, 7)
    assert result.events == ()


def test_a_loop_records_what_was_seen_true_wanted_and_done(env, valves, task):
    plant = interface_of(env)
    controller = CONTROLLERS["pi"]().build(plant, task.limits, ControlModels(valves))
    result = run_loop(env, controller, task, 7)
    recording, reference = result.recording, task.reference
    assert recording.samples == reference.ticks
    assert recording.channel_names[: len(plant.channels)] == tuple(channel.name for channel in plant.channels)
    assert recording.column("Reference_TipX") == pytest.approx(reference.tip[:, 0], abs=1e-6)
    assert recording.column("CylStroke_1_true")[0] == pytest.approx(reference.strokes[0, 0], abs=2e-3)
    tip = plant.geometry.tip(recording.select([f"{name}_true" for name in STROKES]))
    # The simulator's truth and the kinematics agree: both are of the same instant.
    assert recording.select(("TipX_true", "TipY_true", "TipAngle_true")) == pytest.approx(tip, abs=1e-4)
    levers = recording.select(("Lever_1", "Lever_2", "Lever_3"))
    assert np.abs(levers).max() <= 1.0
    assert np.abs(np.diff(levers, axis=0)).max() <= 5.0 / 100.0 + 1e-6
    assert result.solve_s.shape == (reference.ticks,)
    score = result.score
    assert score.finished
    assert dict(score.violations) == {"lever": 0, "slew": 0, "stroke": 0, "pressure": 0}
    assert score.energy_kj > 0.0
    assert 0.0 < score.path_rms_mm <= score.position_rms_mm + 1e-9
    standing = run_loop(env, Still(plant, task.limits), task, 7).score
    assert standing.path_rms_mm < score.path_rms_mm
    assert standing.position_rms_mm > 5.0 * score.position_rms_mm


def test_the_same_seed_gives_the_same_loop(env, valves, task):
    plant = interface_of(env)
    loops = []
    for seed in (1, 1, 2):
        controller = CONTROLLERS["pi"]().build(plant, task.limits, ControlModels(valves))
        loops.append(run_loop(env, controller, task, seed))
    assert np.array_equal(loops[0].recording.values, loops[1].recording.values)
    assert loops[0].score == loops[1].score
    assert not np.array_equal(loops[0].recording.values, loops[2].recording.values)


def test_figures_of_a_controller_are_collected_a_tick(env, task):
    result = run_loop(env, Still(interface_of(env), task.limits), task, 0)
    assert result.infos["tick"].tolist() == list(range(task.reference.ticks))
    assert result.events == ()


class Flickering:
    """A plant whose first stroke is lost at some ticks."""

    def __init__(self, env, lost):
        self.env, self.unwrapped, self.lost, self.tick = env, env.unwrapped, lost, 0

    def reset(self, **options):
        self.tick = 0
        return self.env.reset(**options)

    def step(self, levers):
        self.tick += 1
        observation, *rest = self.env.step(levers)
        if self.tick in self.lost:
            observation = observation.copy()
            observation[[c.name for c in self.unwrapped.channels].index("CylStroke_1")] = np.nan
        return observation, *rest


def test_a_sensor_that_is_lost_for_a_while_costs_accuracy_and_raises_nothing(env, valves, task):
    plant = interface_of(env)
    controller = CONTROLLERS["pi"]().build(plant, task.limits, ControlModels(valves))
    lost = set(range(60, 75)) | {90}
    result = run_loop(Flickering(env, lost), controller, task, 7)
    assert [(event.tick, event.ticks) for event in result.events] == [(60, 15), (90, 1)]
    assert result.score.missed == 16
    assert np.abs(result.recording.select(("Lever_1", "Lever_2", "Lever_3"))[74]).max() == 0.0


def test_a_plant_that_ends_early_is_scored_as_far_as_it_came(valves, task):
    short = plant_of("M22", 1.0, 100.0)
    controller = CONTROLLERS["pi"]().build(interface_of(short), task.limits, ControlModels(valves))
    result = run_loop(short, controller, task, 0)
    assert not result.score.finished
    assert result.recording.samples < task.reference.ticks


def test_a_twin_stands_in_for_the_simulator(twin, valves, task):
    plant = TwinEnvironment(twin, "M22", 10.0)
    interface = interface_of(plant)
    controller = CONTROLLERS["pi"]().build(interface, task.limits, ControlModels(valves))
    result = run_loop(plant, controller, task, 0)
    assert result.score.energy_kj is None
    assert result.score.finished
    again = run_loop(plant, CONTROLLERS["pi"]().build(interface, task.limits, ControlModels(valves)), task, 0)
    assert np.array_equal(result.recording.values, again.recording.values)
    # The twin follows the levers: the tip moves most of the way.
    tip = result.recording.select(("TipX_true", "TipY_true"))
    way = np.hypot(*(task.reference.tip[-1] - task.reference.tip[0])[:2])
    assert np.hypot(*(tip[-1] - tip[0])) > 0.5 * way


def test_a_twin_as_a_plant_answers_as_the_twin_alone_does(twin):
    plant = TwinEnvironment(twin, "M22", 10.0)
    observation, info = plant.reset(seed=0, options={"strokes": (0.4, 0.5, 0.6)})
    full = np.array(load_machine("M22").cylinders.stroke)
    assert [info["truth"][name] for name in STROKES] == pytest.approx(full * (0.4, 0.5, 0.6), abs=2e-3)
    levers = np.array([0.0, 0.5, 0.0], np.float32)
    rows = [plant.step(levers)[0] for _ in range(50)]
    assert all(row.shape == observation.shape for row in rows)
    names = [channel.name for channel in plant.channels]
    speed, stroke = names.index("CylVels_2"), names.index("CylStroke_2")
    assert rows[-1][speed] > 0.02
    # A stroke is the integral of its velocity by the trapezoidal rule.
    speeds = np.array([observation[speed], *(row[speed] for row in rows)])
    way = np.sum(0.5 * (speeds[1:] + speeds[:-1])) / 100.0
    assert rows[-1][stroke] - observation[stroke] == pytest.approx(way, abs=1e-4)


def test_a_twin_as_a_plant_refuses_soil_and_what_no_lever_commands(twin):
    plant = TwinEnvironment(twin, "M22", 1.0)
    with pytest.raises(ConfigError, match="call reset"):
        plant.step(np.zeros(3))
    with pytest.raises(ConfigError, match="a twin knows no soil"):
        plant.reset(options={"material": "clay"})
    with pytest.raises(ConfigError, match="option 'stroke' is unknown; did you mean 'strokes'"):
        plant.reset(options={"stroke": (0.5, 0.5, 0.5)})
    plant.reset(seed=0)
    with pytest.raises(ConfigError, match="three finite positions"):
        plant.step(np.array([0.0, np.nan, 0.0]))
    while not plant.step(np.zeros(3))[3]:
        pass
    with pytest.raises(ConfigError, match="the episode has ended; call reset"):
        plant.step(np.zeros(3))


def test_an_inversion_runs_a_twin_whose_ports_are_partly_measured(env, twin, task):
    interface = interface_of(env)
    controller = CONTROLLERS["inversion"]().build(interface, task.limits, ControlModels(twin=twin))
    moved = run_loop(env, controller, task, 3).score
    still = run_loop(env, Still(interface, task.limits), task, 3).score
    assert moved.position_rms_mm < 0.5 * still.position_rms_mm


def test_tried_commands_leave_the_memory_of_the_model_as_it_is(env, twin):
    measured = [name for name in (c.name for c in interface_of(env).channels) if not name.startswith("CylPressures")]
    model = TwinAhead(twin, 20, measured)
    assert not any(VOCABULARY[name].kind is Kind.PRESSURE for name in model.reads)
    row = np.array([0.7 if "Stroke" in name else 0.0 for name in model.reads])
    commands = env.unwrapped.commands(np.array([[0.0, 0.0, 0.0], [0.5, 0.0, 0.0], [0.0, -0.5, 0.0]]))
    model.begin(row, commands[0])
    first, second = model.ahead(row, commands), model.ahead(row, commands)
    assert np.array_equal(first, second)
    assert first[1, 0] > first[0, 0] + 0.01
    assert first[2, 1] < first[0, 1] - 0.01
