"""A guard beside a loop: channels that are not read, the fallback, and guards that fail."""

import numpy as np
import pytest

from edp.control.controllers import CONTROLLERS
from edp.control.guard import TRUSTED, GuardVerdict, verdict_of
from edp.control.loop import run_loop
from edp.control.models import ControlModels
from edp.control.plant import STROKES, VELOCITIES, interface_of
from edp.control.tasks import TASKS, draw_task
from edp.control.twin_environment import TwinEnvironment
from edp.control.valve_map import ValveMap
from edp.errors import DataError
from edp.sim.excitation.levers import speed_table
from edp.sim.machine.machine_files import load_machine
from edp.testing.control import sample_excavator_twin

FROM, UNTIL = 60, 160
LEVERS = ("Lever_1", "Lever_2", "Lever_3")


class Scripted:
    """Says one thing between two ticks, and nothing else."""

    def __init__(self, verdict):
        self.verdict, self.tick, self.plant = verdict, -1, None

    def reset(self, plant):
        self.plant, self.tick = plant, -1

    def step(self, observation):
        assert observation.shape == (len(self.plant.channels),)
        self.tick += 1
        return self.verdict if FROM <= self.tick < UNTIL else TRUSTED


class Failing:
    def reset(self, plant):
        pass

    def step(self, observation):
        raise DataError("its model has another width")


@pytest.fixture(scope="module")
def env():
    return TwinEnvironment(sample_excavator_twin(), "M22", 20.0)


@pytest.fixture(scope="module")
def models(env):
    return ControlModels(ValveMap(*speed_table(load_machine("M22"))), env.twin)


@pytest.fixture(scope="module")
def task(env):
    return draw_task(TASKS["grade"](length_m=(0.8, 1.0), speed_m_s=0.3), interface_of(env).geometry, env.rate_hz, 4)


def looped(name, env, task, models, guard=None, **options):
    if name == "nmpc":
        pytest.importorskip("daqp", reason="the solver is an optional package")
    controller = CONTROLLERS[name](**options).build(interface_of(env), task.limits, models)
    return run_loop(env, controller, task, 0, guard=guard)


@pytest.mark.long
@pytest.mark.parametrize("name", CONTROLLERS)
def test_a_guard_that_sees_nothing_changes_nothing(name, env, task, models):
    guarded = looped(name, env, task, models, Scripted(TRUSTED))
    assert np.array_equal(guarded.recording.values, looped(name, env, task, models).recording.values)
    assert guarded.warnings == ()


class FaultySensors(TwinEnvironment):
    """Velocities of boom and arm are far off or missing while the guard does not trust them."""

    def step(self, action):
        row, *rest = super().step(action)
        shown = row.copy()
        if FROM <= self._batch.tick[0] < UNTIL:
            shown[interface_of(self).columns(VELOCITIES[:2])] += 5.0 if self._batch.tick[0] % 2 else np.nan
        return shown, *rest


@pytest.mark.long
def test_ports_of_channels_that_are_not_trusted_run_free(env, task, models):
    faulty = FaultySensors(env.twin, "M22", 20.0)
    guard = Scripted(GuardVerdict(frozenset(VELOCITIES[:2]), reason="their residuals left the limit"))
    result, whole = looped("nmpc", faulty, task, models, guard), looped("nmpc", env, task, models)
    assert result.events == ()
    assert [(warning.tick, warning.ticks) for warning in result.warnings] == [(FROM, UNTIL - FROM)]
    assert "not trusted: CylVels_1, CylVels_2 (their residuals left the limit)" in result.warnings[0].text
    # The plant is its model here, so that it loses nothing by what it does not see.
    assert result.score.position_rms_mm < whole.score.position_rms_mm + 2.0
    assert looped("nmpc", faulty, task, models).events[0].text.startswith("CylVels_1 is missing")


def test_a_guard_cannot_change_what_the_controller_reads(env, task, models):
    class Writing(Scripted):
        def step(self, observation):
            observation[:] = 0.0

    with pytest.raises(ValueError, match="read-only"):
        looped("pi", env, task, models, Writing(TRUSTED))


@pytest.mark.long
def test_without_strokes_the_plan_goes_on_and_the_pi_loop_cannot(env, task, models):
    untrusted = frozenset({STROKES[1]})
    assert looped("nmpc", env, task, models, Scripted(GuardVerdict(untrusted))).events == ()
    for name, verdict in (("pi", GuardVerdict(untrusted)), ("nmpc", GuardVerdict(untrusted, fall_back=True))):
        result = looped(name, env, task, models, Scripted(verdict))
        assert result.events[0].tick == FROM
        assert "neutral" in result.events[0].text
        levers = result.recording.select(LEVERS)
        assert np.abs(levers[UNTIL - 20 : UNTIL]).max() == 0.0
        # It goes on where the guard trusts again.
        assert np.abs(levers[UNTIL + 20 :]).max() > 0.0


@pytest.mark.long
def test_where_a_guard_says_so_the_pi_loop_answers_with_the_levers_it_has_alone(env, task, models):
    class Always(Scripted):
        def step(self, observation):
            return self.verdict

    guard = Always(GuardVerdict(fall_back=True, reason="the machine is another one"))
    result, alone = looped("nmpc", env, task, models, guard), looped("pi", env, task, models)
    assert np.array_equal(result.recording.select(LEVERS), alone.recording.select(LEVERS))
    assert "the machine is another one" in result.events[0].text
    assert "the PI loop answers" in result.events[0].text
    assert result.events[0].ticks == result.score.missed == task.reference.ticks
    # A PI loop has no model to be doubted: it goes on, and nothing was missed.
    falling = looped("pi", env, task, models, guard)
    assert np.array_equal(falling.recording.select(LEVERS), alone.recording.select(LEVERS))
    assert falling.events == ()


@pytest.mark.long
def test_after_a_fallback_the_plan_takes_over_again(env, task, models):
    result = looped("nmpc", env, task, models, Scripted(GuardVerdict(fall_back=True)))
    assert [(event.tick, event.ticks) for event in result.events] == [(FROM, UNTIL - FROM)]
    assert np.isfinite(result.infos["iterations"][UNTIL:]).all()
    end = result.recording.select(("TipX_true", "TipY_true"))[-1] - task.reference.tip[-1, :2]
    assert np.hypot(*end) < 5e-3


@pytest.mark.long
@pytest.mark.parametrize(("name", "options"), [("inversion", {}), ("nmpc", {"fallback": False})])
def test_without_a_fallback_levers_go_to_neutral(name, options, env, task, models):
    result = looped(name, env, task, models, Scripted(GuardVerdict(fall_back=True, reason="drift")), **options)
    assert result.events[0].tick == FROM
    assert "drift" in result.events[0].text
    assert "neutral" in result.events[0].text
    assert np.abs(result.recording.select(LEVERS)[UNTIL - 20 : UNTIL]).max() == 0.0


def test_a_guard_that_fails_or_names_another_channel_falls_back(env, task, models):
    plant = interface_of(env)
    row = np.zeros(len(plant.channels))
    failed = verdict_of(Failing(), plant, row)
    assert failed.fall_back
    assert "its model has another width" in failed.reason
    named = Scripted(GuardVerdict(frozenset({"CylVel_1"})))
    named.reset(plant)
    named.tick = FROM
    verdict = verdict_of(named, plant, row)
    assert verdict.fall_back
    assert not verdict.untrusted
    assert "'CylVel_1'" in verdict.reason
    assert "CylVels_1" in verdict.reason
    assert looped("pi", env, task, models, Failing()).warnings[0].ticks == task.reference.ticks
