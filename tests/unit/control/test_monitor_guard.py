"""A monitor beside a loop on the simulator: a sensor that fails, and what the controller does about it."""

from dataclasses import replace

import numpy as np
import pytest

from edp.control.controllers import CONTROLLERS
from edp.control.guard import TRUSTED
from edp.control.loop import run_loop
from edp.control.models import ControlModels
from edp.control.plant import STROKES, VELOCITIES, interface_of
from edp.control.plants import plant_of
from edp.control.tasks import TASKS, draw_task
from edp.control.valve_map import ValveMap
from edp.errors import ConfigError
from edp.monitor.adaptation import SlowDrift
from edp.monitor.alarms import MonitorAlarm
from edp.monitor.calibration import AlarmLimit
from edp.monitor.chain import MonitorChain
from edp.monitor.conditioning import Conditioning
from edp.monitor.detectors import CusumSpec
from edp.monitor.diagnosis.causes import Cause
from edp.monitor.monitor import Monitor
from edp.monitor.residuals import BalancesSpec, FitMaterial
from edp.monitor.residuals.base import residuals_of
from edp.monitor.summaries import BlockSummaries
from edp.monitor.watches import Watch
from edp.sim.excitation.levers import speed_table
from edp.sim.machine.machine_files import load_machine
from edp.testing.control import sample_excavator_twin
from edp.workflows.monitor.loop_guard import MonitorGuard, suspected

ONSET, BIAS = 200, 1.0
"""Tick from which on the arm's velocity reads too high, and by how much (m/s)."""
FAULTY = "CylVels_2"


class FaultySensor:
    """The simulator, whose sensor of the arm's velocity fails."""

    def __init__(self, env, bias=BIAS):
        self.env, self.bias, self.tick = env, bias, 0
        self.column = interface_of(env).columns((FAULTY,))[0]

    def __getattr__(self, name):
        return getattr(self.env, name)

    def reset(self, **options):
        self.tick = 0
        return self.env.reset(**options)

    def step(self, action):
        row, *rest = self.env.step(action)
        self.tick += 1
        shown = np.array(row)
        if self.tick >= ONSET:
            shown[self.column] += self.bias
        return shown, *rest


@pytest.fixture(scope="module")
def env():
    return plant_of("M22", 30.0, 100.0)


@pytest.fixture(scope="module")
def models():
    return ControlModels(ValveMap(*speed_table(load_machine("M22"))), sample_excavator_twin())


def drawn(env, seed):
    spec = TASKS["grade"](length_m=(0.8, 1.0), speed_m_s=0.2, hold_s=0.5)
    return draw_task(spec, interface_of(env).geometry, 100.0, seed)


def looped(name, env, task, models, guard=None):
    controller = CONTROLLERS[name]().build(interface_of(env), task.limits, models)
    return run_loop(env, controller, task, task.seed, guard=guard)


def chosen(loop, names):
    """What sensors show, without references and truth."""
    places = [loop.index(name) for name in names]
    return replace(loop, channels=tuple(loop.channels[i] for i in places), values=loop.values[:, places])


@pytest.fixture(scope="module")
def monitor(env, models):
    """Strokes against velocities; means and widths are those of healthy loops, the limit twice their largest."""
    loops = [looped("pi", env, drawn(env, seed), models).recording for seed in (1, 2, 3)]
    channels = [channel for channel in interface_of(env).channels if channel.name in (*STROKES, *VELOCITIES)]
    loops = [chosen(loop, [channel.name for channel in channels]) for loop in loops]
    source = BalancesSpec(memory_s=(1.0,)).fit(FitMaterial(loops, loops, tuple(channels), 100.0))
    rows = np.concatenate(residuals_of(source, loops)).astype(float)
    inputs, count, width = len(channels), len(source.names), 5 * len(source.names)
    places = np.array([[c.name for c in channels].index(judged[0]) for judged in source.judged])
    summaries = BlockSummaries(
        20,
        1.0 / rows.std(axis=0),
        places,
        np.zeros(inputs),
        np.ones(inputs),
        np.ones(count),
        places[:0],
        places[:0],
        np.zeros((0, count, 2), np.int64),
    )
    plain = Conditioning(
        np.zeros(0), np.zeros(0), np.zeros((width, 1)), np.ones((width, 1)), np.full(width, 1e-3), 100.0
    )
    means = np.zeros((width, count))
    means[5 * np.arange(count), np.arange(count)] = 1.0  # the detector sees the mean of each residual alone
    watch = Watch(CusumSpec(slack=1.0), np.zeros(width), means)
    chain = MonitorChain(summaries, plain, SlowDrift(0.0, 0.0), (watch,), 1e9, 0.0, 3)
    limit = AlarmLimit(1e9, 0, 1.0, 1.0, 1.0, np.inf)
    quiet = Monitor(tuple(channels), 100.0, (source,), chain, limit, np.ones((2, inputs)))
    largest = max(verdict.statistics[0] for loop in loops for verdict in quiet.verdicts(loop))
    return replace(quiet, chain=replace(chain, limit=2.0 * largest + 5.0))


@pytest.mark.long
def test_a_healthy_loop_is_what_it_is_without_the_monitor(env, models, monitor):
    task = drawn(env, 1)
    result = looped("pi", env, task, models, MonitorGuard(monitor))
    assert np.array_equal(result.recording.values, looped("pi", env, task, models).recording.values)
    assert result.warnings == ()


@pytest.mark.long
def test_with_the_monitor_a_faulty_sensor_harms_the_loop_less(env, models, monitor):
    pytest.importorskip("daqp", reason="the solver is an optional package")
    task, faulty = drawn(env, 1), FaultySensor(env)
    guarded = looped("nmpc", faulty, task, models, MonitorGuard(monitor))
    alone, healthy = looped("nmpc", faulty, task, models), looped("nmpc", env, task, models)
    assert alone.score.position_rms_mm > 1.2 * healthy.score.position_rms_mm
    assert guarded.score.position_rms_mm <= alone.score.position_rms_mm
    first = guarded.warnings[0]
    assert ONSET <= first.tick < ONSET + 200
    assert FAULTY in first.text
    assert sum(guarded.score.violations.values()) <= sum(alone.score.violations.values())


def blamed(kind, site, probability, at_fault):
    """A cause as a diagnosis names it."""
    return Cause(kind=kind, site=site, probability=probability, at_fault=at_fault)


def alarm(*evidence, cause=None):
    return MonitorAlarm("", 2.0, 1.0, "cusum 1", 9.0, 8.0, evidence, () if cause is None else (cause,))


def test_a_diagnosed_sensor_is_taken_away_and_the_plan_goes_on(env, monitor):
    guard = MonitorGuard(monitor)
    guard.reset(interface_of(env))
    found = guard.verdict_of(alarm(("balance:x.mean", 5.0), cause=blamed("velocity_bias", "arm", 0.9, "sensor")))
    assert (found.untrusted, found.fall_back) == (frozenset({FAULTY}), False)
    machine = guard.verdict_of(alarm(("balance:x.mean", 5.0), cause=blamed("internal_leak", "boom", 0.9, "machine")))
    assert (machine.untrusted, machine.fall_back) == (frozenset(), True)
    stroke = guard.verdict_of(alarm(cause=blamed("stroke_bias", "boom", 0.9, "sensor")))
    assert (stroke.untrusted, stroke.fall_back) == (frozenset({STROKES[0]}), True)
    unsure = guard.verdict_of(alarm(("balance:x.mean", 5.0), cause=blamed("velocity_bias", "arm", 0.3, "sensor")))
    # The evidence names a residual that this monitor does not have: nothing to take away.
    assert (unsure.untrusted, unsure.fall_back) == (frozenset(), True)


def test_the_channel_that_explains_all_is_suspected():
    judged = {"virtual:v": ("v",), "balance:s-v": ("s", "v"), "virtual:p": ("p",)}
    assert suspected(alarm(("virtual:v.mean", 5.0), ("balance:s-v.mean", -5.0)), judged) == (("v",), 1.0)
    assert suspected(alarm(("virtual:p.mean", 5.0), ("virtual:v.gain", 0.5)), judged)[0] == ("p",)
    # Which of the two it is does not show where nothing else judges one of them.
    assert suspected(alarm(("balance:s-v.mean", 5.0)), {"balance:s-v": ("s", "v")}) == (("s", "v"), 1.0)
    assert suspected(alarm(), judged) == ((), 0.0)
    spread = {f"virtual:{name}": (name,) for name in "abcd"}
    assert suspected(alarm(*((f"{name}.mean", 3.0) for name in spread)), spread)[1] == 0.25


def test_an_alarm_holds_for_its_time_and_a_new_loop_begins_anew(env, models, monitor):
    guard = MonitorGuard(monitor, hold_s=1.0)
    task, faulty = drawn(env, 1), FaultySensor(env, bias=1.0)
    result = looped("pi", faulty, task, models, guard)
    first = result.warnings[0]
    assert first.ticks >= 100
    guard.reset(interface_of(env))
    assert guard.step(np.full(len(interface_of(env).channels), np.nan)) == TRUSTED


def test_a_plant_of_another_rate_or_without_its_channels_is_refused(env, monitor):
    with pytest.raises(ConfigError, match=r"50 Hz|100 Hz"):
        MonitorGuard(monitor).reset(interface_of(plant_of("M22", 10.0, 50.0)))
