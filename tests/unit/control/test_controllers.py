"""What every controller is protected by: limits, the safe command, the log of events."""

import numpy as np
import pytest

from edp.control.base import MAX_EVENTS, ControlFault, Controller
from edp.control.controllers import CONTROLLERS
from edp.control.geometry import TipGeometry
from edp.control.limits import LoopLimits
from edp.control.models import ControlModels
from edp.control.plant import PILOTS, STROKES, PlantInterface
from edp.control.reference import reference_of_strokes
from edp.control.valve_map import map_of_speeds
from edp.errors import ConfigError, DataError
from edp.signals import TABLE_A1, VOCABULARY
from edp.sim.machine.machine_files import load_machine

RATE = 100.0
NAMES = (*STROKES, "CylVels_1", "CylVels_2", "CylVels_3")


@pytest.fixture(scope="module")
def plant():
    machine = load_machine("M22")
    channels = tuple(VOCABULARY[name] for name in NAMES)
    commands = tuple(TABLE_A1[name] for name in PILOTS)
    return PlantInterface(channels, RATE, TipGeometry(machine), commands, pressures, "the bench")


def pressures(levers):
    return np.zeros((*levers.shape[:-1], len(PILOTS)))


@pytest.fixture(scope="module")
def reference(plant):
    strokes = np.repeat(0.5 * plant.geometry.full_m[None], 100, axis=0)
    return reference_of_strokes("rest", strokes, plant.geometry, RATE)


class Scripted(Controller):
    """Answers what a test lays down, a tick at a time."""

    def __init__(self, plant, limits, answers):
        super().__init__(plant, limits, STROKES)
        self.answers, self.seen = answers, []

    def begin(self, measured, reference):
        self.seen = [measured]

    def levers(self, measured, tick):
        self.seen.append(measured)
        answer = self.answers[tick]
        if isinstance(answer, Exception):
            raise answer
        return answer


def observed(plant):
    return np.concatenate([0.5 * plant.geometry.full_m, np.zeros(3)])


def test_levers_keep_range_and_slew_whatever_is_asked(plant, reference):
    limits = LoopLimits(lever_low=(-0.5, -1.0, -1.0), lever_high=(0.3, 1.0, 1.0), slew_per_s=(5.0, 10.0, 100.0))
    controller = Scripted(plant, limits, [np.array([9.0, 9.0, -9.0])] * 30)
    controller.reset(observed(plant), reference)
    levers = np.array([controller.step(observed(plant), tick) for tick in range(30)])
    assert levers[0] == pytest.approx([0.05, 0.1, -1.0])
    assert levers[-1] == pytest.approx([0.3, 1.0, -1.0])
    assert np.abs(np.diff(levers, axis=0)).max(axis=0) == pytest.approx([0.05, 0.1, 0.0])
    assert controller.before == pytest.approx(levers[-1])
    assert controller.events == []


@pytest.mark.parametrize(
    ("answer", "value", "text"),
    [
        (np.ones(3), np.nan, "CylStroke_2 is missing"),
        (np.ones(3), np.inf, "CylStroke_2 is missing"),
        (ControlFault("no step of the solver"), None, "no answer (no step of the solver)"),
        (ZeroDivisionError("division"), None, "no answer (division)"),
        (DataError("a command is missing"), None, "no answer (a command is missing)"),
        (np.linalg.LinAlgError("singular"), None, "no answer (singular)"),
        (np.array([0.0, np.nan, 0.0]), None, "not finite"),
        (np.zeros(2), None, "not finite"),
    ],
)
def test_without_an_answer_levers_go_to_neutral_at_the_slew_limit_and_it_is_logged(
    plant, reference, answer, value, text
):
    limits = LoopLimits(slew_per_s=(10.0, 10.0, 10.0))
    steady = np.array([1.0, -0.5, 0.25])
    controller = Scripted(plant, limits, [steady] * 20 + [answer] * 5 + [steady] * 5)
    controller.reset(observed(plant), reference)
    levers = []
    for tick in range(30):
        observation = observed(plant)
        if value is not None and 20 <= tick < 25:
            observation[1] = value
        levers.append(controller.step(observation, tick))
    assert levers[19] == pytest.approx(steady)
    assert levers[22] == pytest.approx([0.7, -0.2, 0.0])
    assert levers[24] == pytest.approx([0.5, 0.0, 0.0])
    (event,) = controller.events
    assert (event.tick, event.ticks) == (20, 5)
    assert text in event.text


def test_a_missing_channel_that_is_not_read_does_not_matter(plant, reference):
    controller = Scripted(plant, LoopLimits(), [np.zeros(3)])
    observation = observed(plant)
    observation[4] = np.nan
    controller.reset(observation, reference)
    controller.step(observation, 0)
    assert controller.events == []


def test_an_observation_of_another_width_is_answered_by_the_safe_command(plant, reference):
    controller = Scripted(plant, LoopLimits(), [np.ones(3)])
    controller.reset(observed(plant), reference)
    assert controller.step(np.zeros(4), 0) == pytest.approx(0.0)
    assert "shape (4,)" in controller.events[0].text


def test_the_log_of_events_is_bounded(plant, reference):
    answers = [ControlFault("odd") if tick % 2 else np.zeros(3) for tick in range(2 * MAX_EVENTS + 100)]
    controller = Scripted(plant, LoopLimits(), answers)
    controller.reset(observed(plant), reference)
    for tick in range(len(answers)):
        controller.step(observed(plant), tick)
    assert len(controller.events) == MAX_EVENTS


def test_a_start_that_cannot_be_is_refused(plant, reference):
    controller = Scripted(plant, LoopLimits(), [])
    observation = observed(plant)
    observation[2] = np.nan
    with pytest.raises(ConfigError, match="'CylStroke_3' is missing at the start"):
        controller.reset(observation, reference)
    slower = reference_of_strokes("rest", reference.strokes, plant.geometry, 50.0)
    with pytest.raises(ConfigError, match="the reference has 50 Hz, the bench 100 Hz"):
        controller.reset(observed(plant), slower)


def test_a_plant_without_a_channel_that_is_read_is_refused_before_the_start(plant):
    bare = PlantInterface(plant.channels[3:], RATE, plant.geometry, plant.command_channels, plant.commands, "the bench")
    with pytest.raises(ConfigError, match="the bench does not measure 'CylStroke_1'"):
        Scripted(bare, LoopLimits(), [])


@pytest.mark.parametrize("name", CONTROLLERS)
def test_a_controller_without_its_models_is_refused_before_the_start(plant, name):
    assert CONTROLLERS[name].needs
    with pytest.raises(ConfigError, match=f"controller '{name}' needs"):
        CONTROLLERS[name]().build(plant, LoopLimits(), ControlModels())


def test_a_map_begins_at_the_end_of_the_dead_band_and_its_inverse_is_exact():
    levels = np.array([0.1, 0.2, 0.3, 0.4, 1.0])
    speeds = np.broadcast_to(np.maximum(levels - 0.15, 0.0), (3, 2, 5)).copy()
    speeds[0, 0] = [-0.01, 0.001, 0.05, 0.15, 0.75]
    valves = map_of_speeds(levels, speeds, "the bench")
    assert valves.levers[1, 0, 0] == pytest.approx(0.15)
    # The boom sinks below 0.25, where the line through its first two moving points is at rest.
    assert valves.levers[0, 0, 0] == pytest.approx(0.25)
    for axis in range(3):
        for speed in (-0.6, -0.03, 0.02, 0.3, 0.7):
            assert valves.speed(axis, valves.lever(axis, speed)) == pytest.approx(speed, abs=1e-4)
    assert valves.lever(1, 0.004, rest=0.004) == 0.0
    assert valves.lever(1, -9.0) == -1.0
    assert valves.speed(2, -0.1) == 0.0


def test_a_cylinder_that_nothing_moves_is_named():
    speeds = np.full((3, 2, 4), 0.1)
    speeds[2, 1] = 0.0
    with pytest.raises(ConfigError, match="the bench: no lever position retracts the bucket"):
        map_of_speeds(np.array([0.2, 0.4, 0.6, 0.8]), speeds, "the bench")
