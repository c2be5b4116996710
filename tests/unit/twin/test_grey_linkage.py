"""Known linkages of grey boxes: the simulator's own bodies, exact tangents, a start from forces, what is refused."""

import re
from dataclasses import replace
from importlib import resources

import numpy as np
import pytest
from grey_front import ORDER, PREFIX, front, front_channels, series_of

from edp.config.twin import load_twin_experiment, twin_toml
from edp.data.series import Series
from edp.errors import ConfigError
from edp.networks.twin import fit_scales
from edp.networks.twin.disturbance_observer import DisturbanceObserver
from edp.networks.twin.grey import parameter_index as at
from edp.networks.twin.grey.bodies import forces_by_moments, moments_of
from edp.networks.twin.grey.datasheet import datasheet
from edp.networks.twin.grey.elements import MotorElement, ValveElement
from edp.networks.twin.grey.known_linkage import BODY_NAMES
from edp.networks.twin.grey.rollouts import RunBatch
from edp.networks.twin.grey.runner import SINGLE_TICKS
from edp.networks.twin.greybox import RunTarget
from edp.networks.twin.parameters import Datasheet
from edp.signals import Channel, Kind
from edp.sim.machine import layout as sim
from edp.sim.machine.machine_files import load_machine
from edp.sim.machine.parameters import pack
from edp.sim.physics import dynamics, linkage
from edp.training.grey_fit import fit_grey_box
from edp.training.twin_bundle import TwinBundle, load_twin, save_twin


@pytest.fixture(scope="module")
def twin():
    """Its load is that of M22; everything else plausible."""
    channels, series = front_channels(), [series_of()]
    made = front().start(channels, fit_scales(channels, series), series, 0)
    return made.with_parameters(made.table.nominal)


def strokes_and_angles(count, seed=0):
    """Poses of M22 as this twin orders its cylinders, and its joint angles, lever arms."""
    axes, plant = pack(load_machine("m22"))
    rng = np.random.default_rng(seed)
    own = rng.uniform(0.01, 0.99, (count, 3)) * axes[:, sim.STROKE]
    angles = np.array([[linkage.angle_at_stroke(i, s, axes, plant) for i, s in enumerate(row)] for row in own])
    levers = np.array([[linkage.cylinder(i, psi, plant)[1] for i, psi in enumerate(row)] for row in angles])
    return own, angles, levers, axes, plant


PLACES = [ORDER.index(name) for name in BODY_NAMES]


def balance_of(twin, numbers, strokes, speeds, accelerations):
    """Forces that a motion takes, a row for each."""
    rows = (np.atleast_2d(part) for part in (strokes, speeds, accelerations))
    moments = moments_of(numbers, twin.table.inertia_at, twin.table.linkage).values
    return forces_by_moments(*np.broadcast_arrays(*rows), twin.table.linkage) @ moments


def load_of(twin, numbers, strokes, speeds):
    """Forces of gravity and turning, and inertia, at one pose."""
    force = balance_of(twin, numbers, strokes, speeds, np.zeros(3))[0]
    return force, balance_of(twin, numbers, strokes, speeds, np.eye(3)).T - force[:, None]


def test_inertia_and_forces_are_those_of_the_simulators_bodies(twin):
    own, angles, levers, axes, plant = strokes_and_angles(60)
    rng = np.random.default_rng(1)
    worst = 0.0
    for row, psi, lever in zip(own, angles, levers, strict=True):
        speeds = rng.uniform(-0.4, 0.4, 3)
        rate = speeds / lever
        joint = np.empty((3, 3))
        dynamics.mass_matrix(psi, axes, joint)
        wanted = joint / np.outer(lever, lever) / 1e6
        # Accelerations of the joints at constant cylinder velocities: - J' rate^2 / J, differenced.
        bend = [(linkage.cylinder(i, psi[i] + 1e-5, plant)[1] - linkage.cylinder(i, psi[i] - 1e-5, plant)[1]) / 2e-5
                for i in range(3)]  # fmt: skip
        torque = dynamics.bias_torque(psi, rate, axes, plant) - joint @ (np.array(bend) * rate**2 / lever)
        strokes, velocities = np.empty(3), np.empty(3)
        strokes[PLACES], velocities[PLACES] = row, speeds
        force, mass = load_of(twin, twin.numbers, strokes, velocities)
        force_wanted = torque / lever / 1e6
        worst = max(worst, np.abs(mass[np.ix_(PLACES, PLACES)] / wanted - 1.0).max())
        worst = max(worst, np.abs(force[PLACES] - force_wanted).max() / np.abs(force_wanted).max())
    # What the polynomials between the knots, and numbers of single precision, leave.
    assert worst < 1e-3


def test_slopes_of_moments_are_those_of_differences(twin):
    first, last = twin.table.inertia_at, twin.table.potential_at
    slopes = moments_of(twin.numbers, first, twin.table.linkage).slopes
    for m in range(first, last):
        size = np.eye(len(twin.numbers))[m] * max(abs(twin.numbers[m]), 1e-3) * 1e-6
        above, below = (
            moments_of(twin.numbers + side * size, first, twin.table.linkage).values for side in (1.0, -1.0)
        )
        np.testing.assert_allclose(slopes[:, m - first] * 2.0 * size[m], above - below, rtol=1e-5, atol=1e-12)


def errors(twin, numbers, series, starts, full, ticks=8):
    """Matrix, gradient and losses of free runs of `ticks`."""
    rows = [slice(first, first + PREFIX + ticks + 1) for first in starts]
    values = np.stack([series.targets[row] for row in rows]) / twin.units
    demands = twin.demands(np.stack([series.inputs[row] for row in rows])[:, :-1])
    measured = values[:, :-1].copy()
    measured[:, PREFIX + 1 :] = np.nan
    rest = twin.rest(demands[:, 0], (measured[:, 0] * twin.units).astype(np.float32))
    state = (measured[:, 0].copy(), *(np.ascontiguousarray(part, dtype=np.float64) for part in rest))
    weight = twin.units / twin.scales.answer_width.astype(np.float64)
    target = RunTarget(np.ascontiguousarray(values[:, 1:]), weight, 1e9, PREFIX)
    normal = twin.evaluate_runs(numbers, RunBatch(demands, measured, *state), target, full)
    return normal.matrix, normal.gradient, normal.losses


START = np.array([[0.0] * 3 + [0.7, 0.5, 0.4] + [6e6, 4e6] * 3 + [5e6]], np.float32)


@pytest.fixture(scope="module")
def runs(twin):
    """What the machine does on levers of its own."""
    made = []
    for seed in range(3):
        levers = series_of(seed, 500).inputs
        state = twin.initial_state(levers[None, 0], START)
        answers, _ = twin.rollout(levers[None, :-1], state)
        made.append(Series(f"run {seed}", levers, np.concatenate([START, answers[0]])))
    return made


@pytest.mark.long
def test_tangents_are_those_of_differences_with_a_linkage(twin, runs):
    table, rng = twin.table, np.random.default_rng(1)
    moved = np.exp(rng.normal(0, 0.1, len(twin.numbers)))
    numbers = np.where(table.positive, twin.numbers * moved, twin.numbers)
    # Away from a whole number of ticks, where the interpolated dead time has a corner.
    numbers[table.valve_at[:, at.DELAY]] = 0.0363
    starts = (60, 230, 400)
    _, gradient, _ = errors(twin, numbers, runs[1], starts, True)
    size = np.where(table.positive, np.abs(numbers), table.width)
    apart = []
    for which in range(len(numbers)):
        step = np.zeros(len(numbers))
        step[which] = 1e-5 * size[which]
        sides = [errors(twin, numbers + sign * step, runs[1], starts, False)[2].sum() for sign in (1, -1)]
        apart.append(gradient[which] * size[which] - (sides[0] - sides[1]) / 2e-5)
    assert np.abs(apart).max() < 2e-4 * np.abs(gradient * size).max()
    bodies = slice(table.inertia_at, table.potential_at)
    assert np.abs(apart[bodies]).max() < 1e-3 * np.abs(gradient * size)[bodies].max()
    assert np.count_nonzero(gradient[bodies]) == at.BODIES * at.BODY_VALUES


def test_no_load_makes_energy(twin):
    """Power of the forces of inertia, gravity and turning is the change of kinetic and potential energy."""
    rng, step = np.random.default_rng(3), 1e-5
    strokes, speeds, pulls = np.array([0.9, 0.3, 0.6]), rng.uniform(-0.5, 0.5, 3), rng.uniform(-1, 1, 3)

    def kinetic(at_s, v):
        return 0.5 * v @ load_of(twin, twin.numbers, at_s, v)[1] @ v

    force, mass = load_of(twin, twin.numbers, strokes, speeds)
    gravity = load_of(twin, twin.numbers, strokes, 0 * speeds)[0]
    power = speeds @ (mass @ pulls + force - gravity)
    sides = [kinetic(strokes + side * step * speeds, speeds + side * step * pulls) for side in (1, -1)]
    assert power == pytest.approx((sides[0] - sides[1]) / (2 * step), rel=1e-6)
    # Gravity has a potential: its forces' slopes by the strokes are symmetric.
    forces = [
        load_of(twin, twin.numbers, strokes + side, 0 * speeds)[0] for side in (*np.eye(3) * step, *np.eye(3) * -step)
    ]
    slopes = np.array(forces[:3]) - forces[3:]
    np.testing.assert_allclose(slopes, slopes.T, atol=1e-6 * np.abs(slopes).max())


@pytest.fixture
def guess(tmp_path):
    """A machine file with M22's linkage and bodies that are not its own."""
    text = (resources.files("edp.sim") / "machines" / "m22.toml").read_text()
    for key, values in (("mass", "2400.0, 700.0, 1200.0"), ("com_x", "2.3, 1.2, 0.55"), ("inertia", "4e3, 1.6e3, 4e2")):
        text = re.sub(rf"^{key} = \[.*?\]", f"{key} = [{values}]", text, flags=re.M)
    path = tmp_path / "guess.toml"
    path.write_text(text)
    return path


def moments_and_inertias(twin, numbers):
    """The moments and inertias that inertia and gravity are linear in."""
    return moments_of(numbers, twin.table.inertia_at, twin.table.linkage).values


def test_a_fit_starts_from_bodies_that_balance_the_measured_forces(twin, runs, guess):
    begun = front(linkage=str(guess)).start(twin.channels, twin.scales, runs, 0)
    truth, before, after = (
        moments_and_inertias(twin, numbers) for numbers in (twin.numbers, begun.table.nominal, begun.numbers)
    )
    moments = [0, 2, 4]
    wrong = np.abs(before / truth - 1.0)[moments]
    assert wrong.max() > 0.1
    assert np.abs(after / truth - 1.0)[moments].max() < 0.5 * wrong.max()
    bodies = slice(begun.table.inertia_at, begun.table.potential_at)
    assert (begun.numbers[bodies][[at.MASS, at.INERTIA]] > 0.0).all()


def test_a_fit_moves_the_bodies_and_the_datasheet_has_them(twin, runs, guess, tmp_path):
    spec = front(linkage=str(guess))
    begun = spec.start(twin.channels, twin.scales, runs[:2], 0)
    result = fit_grey_box(begun, runs[:2], runs[2:], 0)
    table = begun.table
    bodies = slice(table.inertia_at, table.potential_at)
    assert not np.array_equal(result.twin.numbers[bodies], begun.numbers[bodies])
    rows = {f"{row.element}.{row.name}": row for row in datasheet(table, result.twin.numbers, result.information)}
    text = Datasheet(basis="", numbers=tuple(rows.values())).to_text()
    for name in BODY_NAMES:
        units = {"mass": "kg", "centre_along": "m", "centre_across": "m", "inertia_about_centre": "kg m^2"}
        for key, unit in units.items():
            row = rows[f"{name}_body.{key}"]
            assert row.unit == unit
            assert row.low <= row.value <= row.high
            assert f"{name}_body.{key}" in text
    assert 100.0 < rows["boom_body.mass"].value < 2e4
    # Of the boom with all that it carries, at the middle of the strokes: much more than its own mass.
    assert rows["load.inertia_boom"].value > 5e3
    assert not any("polynomial" in key or "root" in key for key in rows)
    # A twin is whole without the file that it was made with.
    commands = runs[0].inputs[None, :-1]
    answers = result.twin.rollout(commands, result.twin.initial_state(commands[:, 0], START))[0]
    save_twin(TwinBundle(spec, result.twin), tmp_path / "twin")
    guess.unlink()
    again = load_twin(tmp_path / "twin").twin
    np.testing.assert_array_equal(again.rollout(commands, again.initial_state(commands[:, 0], START))[0], answers)


def test_inertia_of_the_datasheet_is_that_of_the_load(twin):
    table, zero = twin.table, np.zeros(3)
    rows = datasheet(table, twin.numbers, np.zeros((len(twin.numbers),) * 2))
    mass = load_of(twin, twin.numbers, 0.5 * np.array([1.504, 1.26, 1.104]), zero)[1]
    told = [row.value for row in rows if row.name.startswith("inertia_") and row.element == "load"]
    np.testing.assert_allclose(told, 1e6 * np.diag(mass), rtol=1e-6)


def test_a_joint_goes_on_in_a_straight_line_far_beyond_its_stroke(twin):
    speeds = np.array([0.1, 0.2, 0.3])
    for stroke in (-5.0, -0.1, 3.0, 50.0):
        force, mass = load_of(twin, twin.numbers, np.full(3, stroke), speeds)
        assert np.isfinite(force).all()
        assert (np.linalg.eigvalsh(mass) > 0.0).all()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"linkage": "m23"}, "unknown machine 'M23'"),
        ({"linkage": "none.toml"}, "machine file none.toml cannot be read"),
        ({"inertia_degree": 3}, r"inertia_degree = 3 .* are of polynomials, which twin.linkage = 'm22' replaces"),
        (
            {"linkage": "c14"},
            r"'\w+_place' lies from 0\.0\d+ to 1\.\d* m in the recordings; the linkage of machine C14",
        ),
    ],
)
def test_a_linkage_that_cannot_be_is_refused(changes, message):
    series = [series_of()]
    with pytest.raises(ConfigError, match=message):
        front(**changes).start(front_channels(), fit_scales(front_channels(), series), series, 0)


def test_other_cylinders_and_strokes_that_nobody_measures_are_refused():
    channels = front_channels()
    spec = front()
    named = tuple(replace(one, name=one.name.replace("boom", "lift")) for one in spec.cylinders)
    valves = tuple(replace(one, actuator=one.actuator.replace("boom", "lift")) for one in spec.valves)
    with pytest.raises(ConfigError, match=r"cylinders called boom, arm, bucket; this twin has the cylinders arm, lift"):
        front(cylinders=named, valves=valves).shapes(channels)
    with pytest.raises(ConfigError, match=r"needs the strokes of all three cylinders, and this twin has none"):
        spec.shapes(replace(channels, strokes=()))
    swing = MotorElement(name="swing", velocity="turning")
    more = replace(channels, velocities=(*channels.velocities, Channel("turning", Kind.ANGULAR_VELOCITY)),
                   strokes=(*channels.strokes, Channel("heading", Kind.ANGLE)))  # fmt: skip
    turn = ValveElement(name="turn", actuator="swing", extend="boom_lever")
    with pytest.raises(ConfigError, match=r"and the motors swing: name them so"):
        front(motors=(swing,), valves=(*spec.valves, turn)).shapes(more)


@pytest.mark.parametrize("damage", ["joint", "actuator", "mass"])
def test_a_damaged_linkage_of_a_bundle_is_refused(twin, damage):
    arrays = {name: values.copy() for name, values in twin.arrays().items()}
    if damage == "joint":
        arrays["linkage"][at.JOINTS + at.KNOT + 2] *= -1.0
    elif damage == "actuator":
        arrays["linkage"][at.JOINTS + at.ACTUATOR] = 7.0
    else:
        arrays["bodies"][at.MASS] = 0.0
    with pytest.raises(ValueError, match="linkage"):
        twin.spec.build(twin.channels, twin.scales, arrays)


def test_the_setting_comes_back(tmp_path):
    experiment = load_twin_experiment(None, ["twin.kind=greybox", "twin.linkage=m22"])
    (tmp_path / "again.toml").write_text(twin_toml(experiment))
    assert load_twin_experiment(tmp_path / "again.toml").twin.linkage == "m22"


def near(twin, runs=7, ticks=30, seed=3):
    """Commands of a run and of others that go a little farther from a tick on, a state, a row, and where they part."""
    rng = np.random.default_rng(seed)
    base = np.repeat(rng.uniform(-0.8, 0.8, (ticks // 10, 3)), 10, axis=0).astype(np.float32)
    first = np.array([0, *np.repeat([0, 8], 3)])[:runs]
    commands = np.repeat(base[None], runs, axis=0)
    for run in range(1, runs):
        commands[run, first[run] :, (run - 1) % 3] *= 1.03
    middle = 0.5 * (twin.scales.low + twin.scales.high)
    row = np.where(twin.wiring.ports[:, 0] == 0, 0.0, middle).astype(np.float32)
    rows = np.repeat(row[None, None], PREFIX, axis=1)
    state = twin.reset(np.repeat(base[None, :1], PREFIX, axis=1), rows)
    row[-1] = np.nan
    return commands, state, row, first


def test_runs_near_a_run_differ_from_it_as_runs_of_their_own_do(twin):
    commands, state, row, first = near(twin)
    runner, width = twin.runner(), twin.scales.answer_width
    own, told = (call(commands, state, row, first) / width for call in (twin.branches, runner.neighbours))
    # Ticks with steps of their own are the twin's, those behind them nearly so.
    assert np.abs((told - own)[0, :SINGLE_TICKS]).max() < 1e-4
    assert np.sqrt(((told - own)[0] ** 2).mean()) < 0.1
    assert np.abs((told - own)[0, :, 3:6]).max() < 0.01
    apart, expected = told[1:] - told[:1], own[1:] - own[:1]
    for columns in (slice(0, 3), slice(3, 6), slice(6, 13)):
        size = np.sqrt((expected[..., columns] ** 2).mean())
        assert size > 1e-5
        assert np.sqrt(((apart - expected)[..., columns] ** 2).mean()) < 0.3 * size
    # Before it branches off, a run is the first one.
    assert np.array_equal(told[4:, :8], np.repeat(told[:1, :8], 3, axis=0))


def test_a_step_of_a_runner_is_one_of_the_twin(twin):
    commands, state, row, _ = near(twin)
    before = {name: values.copy() for name, values in state.items()}
    _, expected = twin.step(commands[:1, 0], state, row[None])
    after = twin.runner().step(commands[0, 0], state, row)
    assert after.keys() == expected.keys()
    for name, values in expected.items():
        assert after[name].shape == values.shape
        assert after[name] == pytest.approx(values, rel=1e-4, abs=1e-5), name
        assert np.array_equal(state[name], before[name])


def test_a_resistance_slows_the_cylinder_that_it_acts_on(twin):
    commands, state, row, _ = near(twin, runs=1)
    runner = twin.runner()
    free = runner.branches(commands, state, row, np.zeros(1, np.int64))
    for which in range(3):
        runner.resistance = 2e4 * (np.arange(3) == which)
        held = runner.branches(commands, state, row, np.zeros(1, np.int64))
        assert held[0, 0, which] < free[0, 0, which]


def test_forces_that_the_model_does_not_know_of_are_found_from_velocities(twin):
    commands, state, row, _ = near(twin, runs=1, ticks=60)
    plant, model = twin.runner(), twin.runner()
    plant.resistance = np.array([3e4, -2e4, 1e4])
    estimate, free = DisturbanceObserver(model, np.arange(3), 0.2), np.full(len(row), np.nan, np.float32)
    now = state
    for command in commands[0]:
        estimate.update(row[:3].astype(float))
        before, now = now, model.step(command, now, row)
        estimate.expect(command, row, before, now)
        state = plant.step(command, state, free)
        row = state["answer"][0].astype(np.float32)
    assert model.resistance == pytest.approx(plant.resistance, rel=0.15, abs=2e3)
    estimate.begin()
    assert not model.resistance.any()


def test_a_missing_velocity_leaves_an_estimate_of_forces_as_it_is(twin):
    commands, state, row, _ = near(twin, runs=1)
    runner = twin.runner()
    estimate = DisturbanceObserver(runner, np.arange(3), 0.2)
    estimate.expect(commands[0, 0], row, state, runner.step(commands[0, 0], state, row))
    estimate.update(np.array([0.1, np.nan, 0.0]))
    assert not runner.resistance.any()
    estimate.update(np.array([0.1, 0.0, 0.0]))
    assert runner.resistance.any()
