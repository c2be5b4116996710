"""Swing and travel: what they take from the pumps, what they move, and who may have them."""

import dataclasses
from importlib import resources

import numpy as np
import pytest

from edp.errors import ConfigError
from edp.signals import MOTOR_CHANNELS, TABLE_A1
from edp.sim import EXCITATIONS, Scenario, Simulation, load_machine
from edp.sim.environment import EnvironmentSpec
from edp.sim.machine import layout as at
from edp.sim.machine.machine_files import parse_machine
from edp.sim.physics import dynamics, friction, motors
from edp.sim.physics.motor_circuit import MotorCircuit
from edp.sim.physics.plant import Plant
from edp.sim.sensors.sensors import truth_columns
from edp.workflows.live.sources.sim import SimSource

STEP_S = 1e-3
TEXT = resources.files("edp.sim").joinpath("machines", "m22.toml").read_text(encoding="utf-8")
SENSING = {"load_margin": 30e5, "bypass": (4.0, 20.0), "min_displacement": 0.01, "time_constant": 0.05}


def machine_with(pumps=None, **sections):
    """M22 with other numbers of its pumps, swing and travel."""
    machine = load_machine("M22")
    changed = {name: dataclasses.replace(getattr(machine, name), **values) for name, values in sections.items()}
    return dataclasses.replace(machine, pumps=dataclasses.replace(machine.pumps, **(pumps or {})), **changed)


def run(levers, seconds=2.0, machine=None, strokes=(0.4, 0.5, 0.5), moves=True):
    """Log of levers that are held from the start on."""
    plant = Plant(machine or load_machine("M22"), np.array(strokes), moves=moves)
    return plant, plant.run(np.tile(levers, (round(seconds * 100), 1)))


def column(log, name):
    return log[:, truth_columns(log.shape[1])[name]]


def inertia(plant, psi):
    """Of the swing at these joint angles, kg m^2, from points in the complex plane."""
    machine = plant.machine
    bodies, place, total = machine.bodies, complex(machine.swing.boom_foot_ahead), machine.swing.inertia
    for k, angle in enumerate(np.cumsum(psi)):
        turn = np.exp(1j * angle)
        centre = place + complex(bodies.com_x[k], bodies.com_y[k]) * turn
        total += bodies.mass[k] * centre.real**2 + bodies.inertia[k] * turn.real**2
        place += bodies.length[k] * turn
    return total


def test_the_inertia_and_its_slopes_are_those_of_the_pose():
    plant = Plant(load_machine("M22"), np.full(3, 0.5), moves=True)
    arrays = plant.motors.arrays(np.zeros((1, 3)), np.zeros((1, at.MOTOR_COLUMNS)))
    for psi in np.random.default_rng(0).uniform(-2.0, 1.0, (20, 3)):
        angles = np.cumsum(psi)
        turns = np.column_stack((np.cos(angles), np.sin(angles))).ravel()
        motors.freeze_inertia(arrays, turns, plant.axes)
        frozen = arrays[motors.FROZEN]
        slopes = [(inertia(plant, psi + d) - inertia(plant, psi - d)) / 2e-6 for d in 1e-6 * np.eye(3)]
        assert frozen[motors.INERTIA] == pytest.approx(inertia(plant, psi), rel=1e-12)
        np.testing.assert_allclose(frozen[motors.BY_JOINT :], slopes, rtol=1e-6, atol=1e-2)


def test_work_of_cylinders_and_swing_is_energy_of_front_and_upper_structure():
    """Over 2 s in which the front moves while it swings; neither alone keeps its energy."""
    plant = Plant(load_machine("M22"), np.array([0.4, 0.5, 0.5]), rate_hz=1 / STEP_S, step_s=STEP_S, moves=True)
    time = np.arange(round(2.0 / STEP_S)) * STEP_S
    levers = np.outer(np.sin(np.pi * time), [0.8, 0.6, -0.7, 0.0, 0.0, 0.0])
    levers[:, 3] = 1.0
    log = plant.run(levers)
    axes, numbers = plant.axes, plant.motors.numbers[0]
    power, energy = np.zeros(len(log)), np.zeros(len(log))
    for k, row in enumerate(log):
        for i in range(3):
            v = row[at.LOG_VELOCITY + i]
            viscous = axes[i, at.VISCOUS] * plant.plant[at.VISCOUS_SHARE]
            drag = friction.lugre(v, row[at.BRISTLE + i], axes, i, viscous)[0]
            push = axes[i, at.HEAD_AREA] * row[at.HEAD + i] - axes[i, at.ROD_AREA] * row[at.ROD + i]
            power[k] += (push - drag) * v
        speed, torque = (
            column(log, "SwingVel")[k],
            numbers[at.SWEPT] * (column(log, "SwingPressure_1")[k] - column(log, "SwingPressure_2")[k]),
        )
        brake = numbers[at.BRAKE] if abs(column(log, "SwingSpool")[k]) <= numbers[at.MOTOR_DEAD_BAND] else 0.0
        dry = (numbers[at.MOTOR_COULOMB] + brake) * speed / np.hypot(speed, motors.STILL)
        power[k] += (torque - dry - numbers[at.MOTOR_VISCOUS] * speed) * speed
        psi, rate = row[at.PSI : at.PSI + 3], row[at.RATE : at.RATE + 3]
        energy[k] = dynamics.mechanical_energy(psi, rate, axes, plant.plant) + 0.5 * inertia(plant, psi) * speed**2
    swing = 0.5 * np.array([inertia(plant, row[:3]) for row in log]) * column(log, "SwingVel") ** 2
    assert swing.max() > 1e4
    assert energy[-1] - energy[0] == pytest.approx(np.trapezoid(power, dx=STEP_S), abs=30.0)


def test_the_swing_slows_the_boom_and_travel_starves_the_rest():
    boom, swung = (run([0.9, 0, 0, swing, 0, 0])[1] for swing in (0.0, 1.0))
    arm, travelled = (run([0, -0.9, 0, 0, both, both])[1] for both in (0.0, 1.0))
    speed = {name: log[100:, at.LOG_VELOCITY : at.LOG_VELOCITY + 3].mean(axis=0) for name, log in
             {"boom": boom, "swung": swung, "arm": arm, "travelled": travelled}.items()}  # fmt: skip
    assert speed["swung"][0] < 0.9 * speed["boom"][0]
    assert abs(speed["travelled"][1]) < 0.9 * abs(speed["arm"][1])
    assert column(swung, "SwingVel")[-1] > 0.3
    alone = run([0, 0, 0, 0, 1.0, 1.0])[1]
    assert column(travelled, "TrackVel_1")[-1] < 0.9 * column(alone, "TrackVel_1")[-1]


def test_tracks_have_a_pump_each_and_the_swing_one():
    for levers, fed in (([0, 0, 0, 1, 0, 0], 1), ([0, 0, 0, 0, -1, 0], 1), ([0, 0, 0, 0, 0, 1], 0)):
        log = run(levers)[1]
        assert log[-1, at.DISPLACEMENT + fed] > 0.9
        assert log[-1, at.DISPLACEMENT + 1 - fed] < 0.2


def test_a_swing_of_a_quarter_turn_takes_what_such_machines_take():
    """90 deg from the lever in 2.3 to 4.5 s, 10 to 12 1/min at most, stopped by its valves within 90 deg."""
    plant, log = run([0, 0, 0, 1, 0, 0], 6.0)
    swing, speed = column(log, "SwingAngle"), column(log, "SwingVel")
    assert 2.3 < np.argmax(swing > np.pi / 2) / 100 < 4.5
    assert 10 < speed.max() * 30 / np.pi < 12.5
    log = plant.run(np.zeros((600, 6)))
    assert abs(column(log, "SwingVel")[-1]) < 1e-3
    assert np.pi / 8 < column(log, "SwingAngle")[-1] - swing[-1] < np.pi / 2
    assert column(log, "SwingPressure_2").max() > plant.motors.numbers[0, at.MOTOR_RELIEF]
    assert log[:50, at.LOG_EVENTS + at.RELIEF].max() == 1.0


def test_a_far_load_is_flung_outwards_and_swings_slower():
    near, far = (run([0, 0, 0, 1, 0, 0], 1.5, strokes=strokes)[1] for strokes in ((0.5, 0.9, 0.5), (0.5, 0.05, 0.5)))
    assert column(far, "SwingVel")[-1] < 0.9 * column(near, "SwingVel")[-1]
    still = run([0, 0, 0, 0, 0, 0], 1.5, strokes=(0.5, 0.05, 0.5))[1]
    # Its weight hangs in front of and below the boom's foot: swinging lifts it from the arm's cylinder.
    load = [log[-1, at.HEAD + 1] - log[-1, at.ROD + 1] for log in (still, far)]
    assert load[1] - load[0] > 2e5


def test_the_brake_holds_what_the_levers_leave():
    plant, _ = run([0, 0, 0, 0, 1, 1], 2.0)
    log = plant.run(np.zeros((300, 6)))
    held = column(log, "TrackVel_1")[-50:]
    assert np.abs(held).max() < 1e-3
    assert plant.motors.state[1, at.IDLE] > plant.motors.numbers[1, at.BRAKE_DELAY]


def test_levers_at_rest_are_the_machine_without_motors():
    levers = np.column_stack([np.sin(np.arange(150) * 0.05 + phase) for phase in range(3)])
    machine = load_machine("M22")
    logs = [
        Plant(m, np.full(3, 0.5), moves=moves).run(levers)
        for m, moves in ((machine, False), (dataclasses.replace(machine, swing=None, travel=None), False),
                         (machine, True))
    ]  # fmt: skip
    assert np.array_equal(logs[0], logs[1])
    columns = slice(at.LOG_VELOCITY, at.LOG_VELOCITY + 3)
    np.testing.assert_allclose(logs[2][:, columns], logs[0][:, columns], atol=1e-7)
    assert np.abs(column(logs[2], "SwingVel")).max() < 1e-6


def test_the_integrator_keeps_its_order():
    time = np.arange(100) / 100
    levers = np.outer(np.sin(np.pi * time), [0.8, 0.6, -0.7, 0.9, 0.7, -0.8])
    levers[:, 3:] += 0.1
    logs = [
        Plant(load_machine("M22"), np.full(3, 0.4), step_s=s, moves=True).run(levers) for s in (1e-3, 5e-4, 1.25e-4)
    ]
    for names in (["SwingVel"], ["TrackVel_1", "TrackVel_2"], ["SwingPressure_1", "SwingPressure_2"]):
        fine = np.array([column(logs[-1], name) for name in names])
        coarse, half = (np.sqrt(np.mean((np.array([column(log, n) for n in names]) - fine) ** 2)) for log in logs[:2])
        assert 3.0 < coarse / half < 6.5, names


def test_pumps_that_sense_loads_sense_the_swing():
    log = run([0, 0, 0, 0.5, 0, 0], 1.5, machine_with(SENSING))[1]
    margin = log[-50:, at.PUMP + 1] - column(log, "SwingPressure_1")[-50:]
    assert 0.65 * 30e5 < margin.mean() < 1.05 * 30e5
    assert log[-1, at.PUMP] < 40e5
    shared = machine_with(SENSING, valves={"flow_sharing": "compensated"})
    alone, both = (
        run([0, -1.0, 0, swing, 0, 0], 1.0, shared, (0.4, 0.9, 0.5))[1][-1, at.LOG_VELOCITY + 1] for swing in (0.0, 1.0)
    )
    assert abs(both) < 0.9 * abs(alone)


def test_an_engine_feels_the_tracks():
    engine = {"engine_droop": 0.08, "engine_power": 118e3, "engine_inertia": 3.0, "engine_speed_rpm": 1900.0}
    speeds = [run([0, 0, 0, 0, both, both], 2.0, machine_with(engine))[0].engine_speed for both in (0.0, 1.0)]
    assert speeds[1] < speeds[0] - 0.01


@pytest.mark.parametrize(("excitation", "material"), [("six_levers", ""), ("swing_dig", "sandy_loam")])
def test_a_snapshot_holds_swing_and_travel(excitation, material, tmp_path):
    scenario = Scenario(excitation=excitation, material=material, seed=2, duration_s=30.0)
    simulation = Simulation(scenario)
    simulation.run(700)
    moment = simulation.snapshot()
    first = simulation.run(300).copy()
    simulation.restore(moment)
    assert np.array_equal(simulation.run(300), first)
    again = Simulation.from_snapshot(type(moment).load(moment.save(tmp_path / "moment.npz")))
    assert np.array_equal(again.run(300), first)
    again.restore(moment)
    again.branch(np.random.SeedSequence(9))
    assert not np.array_equal(again.run(300), first)
    assert np.abs(column(first, "SwingDemand")).max() > 0.1


def test_a_recording_has_the_channels_of_the_motors_behind_the_others():
    simulation = Simulation(Scenario(excitation="six_levers", duration_s=20.0, seed=4))
    simulation.run(2000)
    recording = simulation.recording()
    assert recording.channel_names[: len(TABLE_A1)] == tuple(TABLE_A1)
    assert recording.channel_names[-len(MOTOR_CHANNELS) :] == tuple(MOTOR_CHANNELS)
    units = {channel.name: channel.unit for channel in recording.channels}
    assert (units["SwingAngle"], units["SwingVel"], units["TrackVel_2"]) == ("rad", "rad/s", "m/s")
    assert {units[name] for name in units if name.startswith(("SwingPressure", "TrackPressure"))} == {"Pa"}
    turned = np.cumsum(recording.column("SwingVel").astype(float)) / 100
    np.testing.assert_allclose(np.diff(turned[::100]), np.diff(recording.column("SwingAngle")[::100]), atol=2e-2)
    assert np.array_equal(simulation.log[:, -at.MOTOR_COLUMNS + at.LOG_SWING], column(simulation.log, "SwingAngle"))


@pytest.mark.parametrize("machine", ["M22", "C14"])
def test_a_dig_with_swing_dumps_beside_where_it_dug(machine):
    simulation = Simulation(
        Scenario(machine=machine, excitation="swing_dig", material="sandy_loam", duration_s=60.0, seed=1)
    )
    log = simulation.run(6000)
    load, swing = log[:, at.LOG_PAYLOAD], column(log, "SwingAngle")
    filled, emptied = np.flatnonzero(np.diff(load) > 0.5), np.flatnonzero(np.diff(load) < -1.0)
    assert load.max() > 300.0
    assert np.median(np.abs(swing[emptied])) > 0.5
    assert len(filled) > 100
    assert np.quantile(np.abs(swing[filled]), 0.9) < 0.3


def test_environments_and_the_live_simulator_move_the_front_alone():
    with pytest.raises(ConfigError, match="six_levers swings and travels, which nothing here does"):
        SimSource("M22", 100.0, settings={"excitation": "six_levers"})
    assert EnvironmentSpec().scenario(0).excitation == "combined"
    with pytest.raises(ConfigError, match="observed channel 'SwingVel' is unknown"):
        EnvironmentSpec(observed=("SwingVel",))


def test_a_member_of_a_family_swings_and_keeps_the_laws():
    small, base = load_machine("family-1-0-12-12"), load_machine("M22")
    s = (12.0 / 21.7) ** (1 / 3)
    assert small.swing.inertia == pytest.approx(base.swing.inertia * s**5)
    assert small.travel.displacement == pytest.approx(base.travel.displacement * s**2)
    log = run([0, 0, 0, 1, 0, 0], 4.0, small)[1]
    assert 0.5 < column(log, "SwingVel").max() < 2.5


def test_who_has_no_motors_neither_swings_nor_travels(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(without("swing", "travel"))
    assert Scenario(machine=str(path)).load().swing is None
    for excitation in (name for name, kind in EXCITATIONS.items() if kind.swings):
        with pytest.raises(ConfigError, match=r"no \[swing\] and \[travel\]; copy both"):
            Scenario(machine=str(path), excitation=excitation)
    with pytest.raises(ConfigError, match="neither swings nor travels"):
        MotorCircuit(load_machine(str(path)), 100.0, (5e-4, 1e-4))
    with pytest.raises(ConfigError, match=r"levers of shape \(5, 6\); give \(samples, 3\): boom, arm, bucket$"):
        Plant(load_machine("M22"), np.full(3, 0.5)).run(np.zeros((5, 6)))
    with pytest.raises(ConfigError, match=r"levers of shape \(5, 4\); give \(samples, 3 or 6\)"):
        Plant(load_machine("M22"), np.full(3, 0.5), moves=True).run(np.zeros((5, 4)))


def without(*tables) -> str:
    """M22's file without some tables."""
    parts = TEXT.split("\n[")
    return "\n[".join(part for part in parts if part.split("]")[0] not in tables)


def with_value(table, line) -> str:
    """M22's file with one line of a table replaced."""
    key = line.split("=")[0].strip()
    head, _, rest = TEXT.partition(f"\n[{table}]")
    lines = rest.split("\n")
    at_line = next(n for n, text in enumerate(lines) if text.startswith(f"{key} "))
    return f"{head}\n[{table}]" + "\n".join([*lines[:at_line], line, *lines[at_line + 1 :]])


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (without("swing"), r"the table \[swing\] is missing; give both"),
        (without("travel"), r"the table \[travel\] is missing; give both"),
        (with_value("swing", "pump = 3"), r"\[swing\]: pump = 3 must be an integer from 1 to 2"),
        (with_value("travel", "pump = 0"), r"\[travel\]: pump = 0"),
        (with_value("swing", "pump = true"), "pump"),
        (with_value("swing", "displacement = 0.0"), "displacement = 0.0 must be above 0"),
        (with_value("swing", "displacement = nan"), "displacement"),
        (with_value("swing", "inertia = -1.0"), "inertia"),
        (with_value("travel", "inertia = inf"), "inertia"),
        (with_value("travel", "volume = 0.0"), "volume = 0.0 must be from 1e-05"),
        (with_value("swing", "volume = 1e300"), "volume"),
        (with_value("swing", "leakage = -1e-12"), "leakage"),
        (with_value("swing", "coulomb = 1e9"), r"\[swing\]: coulomb = 1000000000.0 must be below .* or it never moves"),
        (with_value("swing", "relief = 1.0"), "or it never moves"),
        (with_value("swing", "relief_slope = 0.0"), "relief_slope = 0.0 must be above 0"),
        (with_value("swing", "dead_time = 1e9"), "dead_time = 1000000000.0 must be from 0 to 2"),
        (with_value("swing", "dead_band = 1.0"), "dead_band"),
        (with_value("swing", "pilot_frequency = 0.0"), "pilot_frequency"),
        (with_value("travel", "meter_in = [0.0, 14.0]"), "meter_in, flow in L/min"),
        (with_value("travel", "meter_out = [100.0, 0.0]"), "meter_out, pressure in bar"),
        (with_value("travel", "meter_out = [100.0]"), "meter_out"),
        (with_value("swing", "brake_delay = 1e9"), "brake_delay"),
        (with_value("swing", "boom_foot_ahead = 1e6"), "boom_foot_ahead"),
        (with_value("travel", "pump = 2\nboom_foot_ahead = 0.1"), "unknown key 'travel.boom_foot_ahead'"),
        (with_value("travel", "pump = 2\ngears = 2"), "unknown key 'travel.gears'"),
        ('swing = "fast"\n' + without("swing"), "swing = 'fast'|swing: expected a table"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_refused(text, words):
    with pytest.raises(ConfigError, match=words):
        parse_machine(text, "mine.toml")
