"""Parts of the model predictive controller against independent computations, and its answers to faults."""

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import lsq_linear

from edp.control.controllers import CONTROLLERS
from edp.control.controllers import nmpc as module
from edp.control.geometry import TipGeometry
from edp.control.limits import LoopLimits
from edp.control.loop import run_loop
from edp.control.models import ControlModels
from edp.control.nmpc.model import TwinModel
from edp.control.nmpc.moves import REST_M_S, Moves, SpeedToLever
from edp.control.nmpc.tip import TipTable
from edp.control.plant import interface_of
from edp.control.reference import reference_of_strokes
from edp.control.tasks import TASKS, draw_task
from edp.control.twin_environment import TwinEnvironment
from edp.control.valve_map import ValveMap
from edp.errors import ConfigError
from edp.sim.excitation.levers import speed_table
from edp.sim.machine.machine_files import load_machine
from edp.testing.control import sample_excavator_twin, sample_grey_box

pytest.importorskip("daqp", reason="the solver is an optional package")


@pytest.fixture(scope="module")
def twin():
    return sample_excavator_twin()


@pytest.fixture(scope="module")
def env(twin):
    return TwinEnvironment(twin, "M22", 20.0)


@pytest.fixture(scope="module")
def valves():
    return ValveMap(*speed_table(load_machine("M22")))


@pytest.fixture(scope="module")
def models(twin, valves):
    return ControlModels(valves, twin)


@pytest.mark.parametrize("machine", ["M22", "C14"])
def test_tables_of_the_tip_are_the_kinematics_and_their_slopes(machine):
    geometry = TipGeometry(load_machine(machine))
    table = TipTable(geometry)
    strokes = np.random.default_rng(0).uniform(0.01, 0.99, (60, 3)) * geometry.full_m
    tips, jacobians = table.poses(strokes)
    turned = (tips - geometry.tip(strokes) + np.pi) % (2 * np.pi) - np.pi
    assert np.abs(turned).max() < 5e-6
    # A step of many nodes, over which a table has the slope of the function.
    step = 2e-3
    for axis in range(3):
        shift = step * np.eye(3)[axis]
        slopes = (geometry.tip(strokes + shift) - geometry.tip(strokes - shift)) / (2 * step)
        assert jacobians[..., axis] == pytest.approx(slopes, rel=2e-2, abs=2e-2)


@given(
    blocks=st.lists(st.integers(1, 6), min_size=1, max_size=4).map(tuple),
    seed=st.integers(0, 1000),
)
@settings(max_examples=30, deadline=None)
def test_levers_move_to_their_targets_at_the_slew_limit(blocks, seed):
    rng = np.random.default_rng(seed)
    moves, step = Moves(blocks), rng.uniform(0.02, 0.6, 3)
    targets, before = rng.uniform(-1, 1, (4, len(blocks), 3)), rng.uniform(-1, 1, 3)
    levers = moves.levers(targets, before, step)
    position, tick = np.tile(before, (4, 1)), 0
    for block, ticks in enumerate(blocks):
        for _ in range(ticks):
            position = np.clip(targets[:, block], position - step, position + step)
            assert levers[:, tick] == pytest.approx(position)
            tick += 1
    assert tick == moves.ticks


def test_each_variable_has_a_run_that_branches_off_where_its_block_begins():
    moves = Moves((2, 3))
    speeds = np.arange(6.0).reshape(2, 3)
    runs = moves.runs(speeds, np.full((2, 3), 0.1))
    assert moves.first.tolist() == [0, 0, 0, 0, 2, 2, 2]
    assert (runs[1:] - runs[0]).reshape(6, 6) == pytest.approx(0.1 * np.eye(6))
    # The difference from block to block, the first from what was asked last.
    assert moves.difference @ speeds.ravel() == pytest.approx([0, 1, 2, 3, 3, 3])


def test_the_inverse_map_is_continuous_and_rises_through_the_dead_band(valves):
    limits = LoopLimits(lever_low=(-0.5, -1.0, -1.0), lever_high=(1.0, 0.6, 1.0))
    inverse = SpeedToLever(valves, limits)
    speeds = np.linspace(-0.3, 0.3, 20_001)[:, None] * np.ones(3)
    levers = inverse.levers(speeds)
    assert (np.diff(levers, axis=0) >= 0.0).all()
    assert np.abs(np.diff(levers, axis=0)).max() < 0.01
    assert inverse.levers(np.zeros(3)) == pytest.approx(0.0)
    for axis in range(3):
        for speed in (-0.2, -2 * REST_M_S, 2 * REST_M_S, 0.1):
            lever = inverse.levers(np.full(3, speed))[axis]
            assert valves.speed(axis, float(lever)) == pytest.approx(speed, rel=0.02)
    assert inverse.levers(inverse.slowest)[0] == pytest.approx(-0.5)
    assert inverse.levers(inverse.fastest)[1] == pytest.approx(0.6)


@pytest.mark.long
def test_on_its_own_model_it_follows_within_a_millimetre(env, models):
    plant = interface_of(env)
    task = draw_task(TASKS["grade"](length_m=(0.8, 1.0), speed_m_s=0.3), plant.geometry, plant.rate_hz, 4)
    result = run_loop(env, CONTROLLERS["nmpc"]().build(plant, task.limits, models), task, 0)
    assert result.score.position_rms_mm < 3.0
    assert result.events == ()
    assert np.isfinite(result.infos["iterations"]).all()


def test_the_disturbance_is_the_speed_that_the_twin_does_not_know_of(env, twin):
    plant = interface_of(env)
    model = TwinModel(twin, plant, window=20, smoothing=0.2)
    observation, _ = env.reset(seed=0, options={"strokes": (0.4, 0.5, 0.5)})
    columns = plant.columns(model.reads)
    row = observation.astype(float)[columns]
    stroke = model.reads.index("CylStroke_1")
    model.begin(row)
    for tick in range(150):
        drifted = row.copy()
        drifted[stroke] += 0.01 * tick / plant.rate_hz
        model.look_back(drifted)
        model.advance(drifted, np.zeros(3))
    assert model.disturbance == pytest.approx([0.01, 0.0, 0.0], abs=1e-3)
    levers = np.zeros((1, 10, 3))
    strokes, _ = model.predicted(levers, drifted, np.zeros(1, np.int64))
    assert strokes[0, -1, 0] - drifted[stroke] == pytest.approx(0.1 * 0.01, abs=2e-4)


@pytest.mark.long
def test_the_compiled_normal_equations_are_those_of_the_weighted_tip_errors(env, models):
    plant = interface_of(env)
    controller = CONTROLLERS["nmpc"](blocks=(2, 3), along=0.3).build(plant, LoopLimits(), models)
    rng = np.random.default_rng(2)
    shares = np.linspace(0.3, 0.6, 30)[:, None] + rng.uniform(-0.05, 0.05, 3)
    reference = reference_of_strokes("way", shares * plant.geometry.full_m, plant.geometry, plant.rate_hz)
    controller.begin(np.zeros(len(controller.reads)) + 0.5, reference)
    for tick in (4, 27, 60):  # inside, near the end, and behind it
        strokes = reference.strokes[reference.rows(tick + 1, 5)] + rng.uniform(-0.02, 0.02, (7, 5, 3))
        steps = rng.choice([-0.01, 0.01], 6)
        rows = reference.rows(tick + 1, 5)
        tips, jacobians = TipTable(plant.geometry).poses(strokes[0])
        error = tips - reference.tip[rows]
        error[:, 2] = (error[:, 2] + np.pi) % (2 * np.pi) - np.pi
        weights = module._directions(reference, controller.spec.along, controller.attitude_m)[rows]
        slopes = (strokes[1:] - strokes[0]) / steps[:, None, None]
        derivatives = np.einsum("tij,tjk,vtk->tiv", weights, jacobians, slopes).reshape(-1, 6)
        weighted = np.einsum("tij,tj->ti", weights, error).ravel()
        normal = controller._normal(strokes, steps, tick)
        assert normal[:, :-1] == pytest.approx(derivatives.T @ derivatives, rel=1e-9, abs=1e-12)
        assert normal[:, -1] == pytest.approx(derivatives.T @ weighted, rel=1e-9, abs=1e-12)


def test_compiled_rows_of_limits_are_those_of_values_near_one(env, models):
    plant = interface_of(env)
    limits = LoopLimits(stroke_margin=0.05, pressure_pa=20e6)
    controller = CONTROLLERS["nmpc"](blocks=(2, 3)).build(plant, limits, models)
    rng, full = np.random.default_rng(3), plant.geometry.full_m
    strokes = rng.uniform(0.0, 1.0, (7, 5, 3)) * full
    pressures = rng.uniform(0.0, 22e6, (7, 5, controller.model.pressures))
    steps = rng.choice([-0.01, 0.01], 6)
    rows, low, high = controller._limits(strokes, pressures, steps)
    values = np.concatenate([strokes / full, pressures / 20e6], axis=2)[:, [1, 4]]
    base, slopes = values[0].ravel(), ((values[1:] - values[0]) / steps[:, None, None]).reshape(6, -1).T
    least = np.tile([0.05] * 3 + [-1e30] * controller.model.pressures, 2)
    most = np.tile([0.95] * 3 + [1.0] * controller.model.pressures, 2)
    near = (base < least + module.NEAR_LIMIT) | (base > most - module.NEAR_LIMIT)
    assert 0 < near.sum() < len(near)
    assert rows == pytest.approx(slopes[near])
    assert low == pytest.approx((least - base)[near])
    assert high == pytest.approx((most - base)[near])


def test_compiled_levers_are_the_interpolated_map(valves):
    inverse = SpeedToLever(valves, LoopLimits())
    speeds = np.random.default_rng(4).uniform(-0.7, 0.7, (5, 40, 3))
    speeds[0, :6, 0] = (0.0, REST_M_S, -REST_M_S, REST_M_S / 2, 9.0, -9.0)
    levers = inverse.levers(speeds)
    for axis, (extend, retract) in enumerate(inverse._tables):
        out, back = np.interp(speeds[..., axis], *extend), np.interp(-speeds[..., axis], *retract)
        assert levers[..., axis] == pytest.approx(np.where(speeds[..., axis] >= 0.0, out, -back), abs=1e-14)


def test_a_step_of_the_plan_is_the_solution_of_the_bounded_least_squares(env, models):
    plant = interface_of(env)
    controller = CONTROLLERS["nmpc"](blocks=(3, 5), trust_m_s=100.0).build(plant, LoopLimits(), models)
    rng = np.random.default_rng(1)
    jacobian, error = rng.normal(size=(30, 6)), 3.0 * rng.normal(size=30)
    none = np.zeros((0, 6)), np.zeros(0), np.zeros(0)
    step, _ = controller._solve_step(jacobian.T @ jacobian, jacobian.T @ error, *none)
    low, high = np.tile(controller._valves.slowest, 2), np.tile(controller._valves.fastest, 2)
    expected = lsq_linear(jacobian, -error, bounds=(low, high), tol=1e-12)
    assert step == pytest.approx(expected.x, abs=1e-6)
    assert ((step <= low + 1e-9) | (step >= high - 1e-9)).any()


def test_a_soft_limit_gives_way_where_it_cannot_be_met(env, models):
    controller = CONTROLLERS["nmpc"](blocks=(3,), trust_m_s=100.0).build(interface_of(env), LoopLimits(), models)
    row = np.ones((1, 3))
    step, _ = controller._solve_step(np.eye(3), np.zeros(3), row, np.array([5.0]), np.array([6.0]))
    assert step == pytest.approx(controller._valves.fastest, rel=1e-3)


@pytest.mark.long
@pytest.mark.parametrize("fallback", [True, False])
def test_without_a_solution_the_pi_loop_answers_or_levers_go_to_neutral(fallback, env, models, monkeypatch):
    plant = interface_of(env)
    task = draw_task(TASKS["grade"](length_m=(0.4, 0.5)), plant.geometry, plant.rate_hz, 1)
    failing = SimpleNamespace(solve=lambda *problem: (np.zeros(18), 0.0, -1, {"iterations": 0}))
    monkeypatch.setattr(module, "_daqp", lambda: failing)
    result = run_loop(env, CONTROLLERS["nmpc"](fallback=fallback).build(plant, task.limits, models), task, 0)
    assert "DAQP says -1" in result.events[0].text
    levers = result.recording.select(("Lever_1", "Lever_2", "Lever_3"))
    if fallback:
        alone = run_loop(env, CONTROLLERS["pi"]().build(plant, task.limits, models), task, 0)
        assert "the PI loop answers" in result.events[0].text
        assert np.array_equal(levers, alone.recording.select(("Lever_1", "Lever_2", "Lever_3")))
    else:
        assert np.abs(levers).max() == 0.0


def test_predictions_that_are_not_finite_are_a_fault(env, models):
    controller = CONTROLLERS["nmpc"]().build(interface_of(env), LoopLimits(), models)
    hessian = np.full((18, 18), np.nan)
    with pytest.raises(module.ControlFault, match="not finite"):
        controller._solve_step(hessian, np.zeros(18), np.zeros((0, 18)), np.zeros(0), np.zeros(0))


@pytest.mark.long
def test_a_reference_beyond_the_margin_is_kept_away_from_the_stop(env, models):
    plant = interface_of(env)
    full = plant.geometry.full_m
    shares = np.full((900, 3), 0.5)
    # Slow: a model from two minutes of logs knows fast ways worst.
    shares[:, 2] = np.clip(np.linspace(0.5, 1.0, 900), 0.5, 0.97)
    limits = LoopLimits(stroke_margin=0.1)
    reference = reference_of_strokes("ramp", shares * full, plant.geometry, plant.rate_hz)
    controller = CONTROLLERS["nmpc"]().build(plant, limits, models)
    observation, _ = env.reset(seed=0, options={"strokes": (0.5, 0.5, 0.5)})
    controller.reset(observation, reference)
    column = plant.columns(("CylStroke_3",))[0]
    farthest = 0.0
    for tick in range(reference.ticks):
        observation = env.step(controller.step(observation, tick))[0]
        farthest = max(farthest, observation[column] / full[2])
    assert 0.85 < farthest < 0.905
    assert controller.info["constraints"] > 0


@pytest.mark.long
def test_a_plan_that_ends_before_the_machine_has_answered_is_refused(env, models, valves):
    plant = interface_of(env)
    observation, _ = env.reset(seed=0, options={"strokes": (0.3, 0.5, 0.7)})

    def check(known, *blocks):
        controller = CONTROLLERS["nmpc"](blocks=blocks).build(plant, LoopLimits(), known)
        controller.check(np.asarray(observation, float)[plant.columns(controller.reads)])

    for known in (ControlModels(valves, sample_grey_box().twin), models):
        check(known, 4, 12, 24)
        with pytest.raises(
            ConfigError, match=r"blocks = \[3, 2\] plans 50 ms ahead, but by its twin the machine takes"
        ):
            check(known, 3, 2)


@pytest.mark.long
def test_the_attitude_counts_more_with_a_twin_that_is_told_of_forces(env, models, valves):
    plant, grey = interface_of(env), ControlModels(valves, sample_grey_box().twin)

    def weight(known, **options):
        return CONTROLLERS["nmpc"](**options).build(plant, LoopLimits(), known).attitude_m

    assert (weight(models), weight(grey)) == (1.0, 2.0)
    assert weight(models, attitude_m=0.0) == weight(grey, attitude_m=0.0) == 0.0


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"blocks": ()}, "blocks"),
        ({"attitude_m": -1.0}, "attitude_m"),
        ({"blocks": (0, 3)}, "blocks"),
        ({"blocks": (1,) * 31}, "blocks"),
        ({"change": 0.0}, "change"),
        ({"smoothing": 1.5}, "smoothing"),
        ({"window_s": float("nan")}, "window_s"),
    ],
)
def test_settings_that_cannot_be_are_refused(options, text):
    with pytest.raises(ConfigError, match=text):
        CONTROLLERS["nmpc"](**options)


def test_a_twin_of_something_else_is_refused(env, models, valves):
    plant = interface_of(env)
    with pytest.raises(ConfigError, match="needs a twin"):
        CONTROLLERS["nmpc"]().build(plant, LoopLimits(), ControlModels(valves))
    slow = SimpleNamespace(channels=SimpleNamespace(answers=(), commands=(), rate_hz=50.0))
    with pytest.raises(ConfigError, match="train one at the rate of"):
        TwinModel(slow, plant, 20, 0.1)
