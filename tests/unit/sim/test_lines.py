"""Long lines between valves and cylinders: balances, order of the integrator, limits; nothing where there are none."""

import dataclasses
import math
from importlib import resources

import numpy as np
import pytest
from snapshots import check_snapshot

from edp.errors import ConfigError
from edp.sim import Scenario, Simulation, load_machine
from edp.sim.environment import ExcavatorEnv
from edp.sim.machine import layout as at
from edp.sim.machine.machine_files import parse_machine
from edp.sim.machine.parameters import pack
from edp.sim.physics import hydraulics, lines, valve
from edp.sim.physics.plant import Plant

STEP_S = 1e-3
TEXT = resources.files("edp.sim").joinpath("machines", "m22.toml").read_text(encoding="utf-8")
BORES = (0.025, 0.025, 0.020)
"""Of the lines whose volumes M22's file gives: 5, 8 and 10 m."""
SOFT = (0.0, 6e8, 6e8)
"""Rigid pipes at the boom; hoses that grow by 3.5 % at 210 bar at arm and bucket."""


def text_with(cylinders="", sensors="") -> str:
    text = TEXT.replace("[cylinders]\n", f"[cylinders]\n{cylinders}\n")
    at_sensors = text.index("[sensors]")
    end = text.index("\n", at_sensors) + 1
    return text[:end] + sensors + "\n" + text[end:]


def long_lines(bores=BORES, walls=SOFT):
    machine = load_machine("M22")
    cylinders = dataclasses.replace(machine.cylinders, line_bore=bores, line_modulus=walls)
    return dataclasses.replace(machine, cylinders=cylinders)


def levers(seconds, rate_hz):
    time = np.arange(round(seconds * rate_hz)) / rate_hz
    return np.outer(np.sin(np.pi * time), [0.8, 0.6, -0.7])


def test_lengths_and_losses_are_those_of_the_books():
    """Hagen and Poiseuille below Re = 1187, Blasius above, by numbers of their own."""
    axes, plant = pack(long_lines())
    bore, area, length = 0.025, math.pi / 4 * 0.025**2, 3.9e-3 / (math.pi / 4 * 0.025**2)
    assert lines.lengths(long_lines().cylinders)[1] == pytest.approx(length)
    viscosity = 46e-6 / plant[at.THINNING]
    for reynolds in (200.0, 1100.0, 1300.0, 20000.0):
        flow = reynolds * viscosity / bore * area
        factor = 64.0 / reynolds if reynolds < 1187 else 0.3164 / reynolds**0.25
        expected = factor * length / bore * lines.DENSITY / 2 * (flow / area) ** 2
        assert lines.drop(flow, 1, axes, plant)[0] == pytest.approx(expected, rel=1e-6)
        assert lines.drop(-flow, 1, axes, plant)[0] == -lines.drop(flow, 1, axes, plant)[0]
        slope = (
            (lines.drop(1.001 * flow, 1, axes, plant)[0] - lines.drop(0.999 * flow, 1, axes, plant)[0]) / 2e-3 / flow
        )
        assert lines.drop(flow, 1, axes, plant)[1] == pytest.approx(slope, rel=1e-3)


def run_by_steps(machine, seconds):
    """States at every step, with the lines' flows, shape (steps, STATES), and the log."""
    plant = Plant(machine, np.array([0.4, 0.5, 0.5]), rate_hz=1 / STEP_S, step_s=STEP_S)
    states, logs = [], []
    for lever in levers(seconds, 1 / STEP_S):
        states.append(plant.state.copy())
        logs.append(plant.run(lever[None])[0])
    return plant, np.array(states), np.array(logs)


def test_what_enters_a_line_is_work_losses_kinetic_energy_and_compression():
    """Over 2 s of combined motion, for heads and rods of all cylinders together."""
    plant, states, log = run_by_steps(long_lines(), 2.0)
    axes, numbers, tank = plant.axes, plant.plant, plant.plant[at.TANK]
    into, leaked = np.zeros((len(log), 6)), np.zeros((len(log), 3))
    valves, opened = np.zeros((at.SPOOLS, 5)), np.zeros((3, at.OPENINGS))
    for k, row in enumerate(log):
        valves[:, at.SPOOL] = row[at.LOG_SPOOL : at.LOG_SPOOL + at.SPOOLS]
        valve.open_spools(valves, row[at.LOG_STROKE : at.LOG_STROKE + 3], axes, opened)
        for i in range(3):
            ends = tuple(states[k, [at.PORT_HEAD + i, at.PORT_ROD + i, at.PUMP, at.PUMP + 1]])
            flows = hydraulics.cylinder_flows(i, ends, (-1e9, -1e9), opened, axes, numbers)[0]
            into[k, i], into[k, 3 + i] = flows[:2]
            leaked[k, i] = axes[i, at.PISTON_LEAK] * numbers[at.THINNING] * (row[at.HEAD + i] - row[at.ROD + i]) ** 2
    port, chamber = states[:, at.PORT_HEAD : at.FLOW_HEAD] - tank, states[:, at.HEAD : at.PUMP] - tank
    flow, speed = states[:, at.FLOW_HEAD :], log[:, at.LOG_VELOCITY : at.LOG_VELOCITY + 3]
    lost = np.array([[lines.drop(q, n % 3, axes, numbers)[0] * q for n, q in enumerate(row)] for row in flow])
    work = chamber[:, :3] * axes[:, at.HEAD_AREA] * speed - chamber[:, 3:] * axes[:, at.ROD_AREA] * speed
    given, pistons, losses = (
        np.trapezoid(part.sum(axis=1), dx=STEP_S) for part in (port * into, work, np.hstack((lost, leaked)))
    )
    moving = (0.5 * np.tile(axes[:, at.LINE_INERTANCE], 2) * flow**2).sum(axis=1)
    stroke = log[:, at.LOG_STROKE : at.LOG_STROKE + 3]
    volume = np.hstack((axes[:, at.HEAD_DEAD] + axes[:, at.HEAD_AREA] * stroke,
                        axes[:, at.ROD_DEAD] + axes[:, at.ROD_AREA] * (axes[:, at.STROKE] - stroke)))  # fmt: skip
    stiff = np.vectorize(lambda p: hydraulics.stiffness(p, numbers))
    wall = np.tile(axes[:, at.LINE_WALL], 2)
    stored = 0.0
    for pressure, room in ((chamber, volume), (port, np.tile(axes[:, at.PORT_VOLUME], 2))):
        density = pressure * (room / stiff(pressure + tank) + wall)
        stored += (0.5 * (density[1:] + density[:-1]) * np.diff(pressure, axis=0)).sum()
    assert losses > 500.0
    assert np.ptp(moving) > 5.0
    assert given == pytest.approx(pistons + losses + stored + moving[-1] - moving[0], abs=2e-3 * abs(pistons))


def test_the_integrator_keeps_its_order():
    """Error against steps of 1/8 ms: a quarter of it at half the step."""
    logs = [Plant(long_lines(), np.full(3, 0.4), step_s=step).run(levers(1.0, 100.0)) for step in (1e-3, 5e-4, 1.25e-4)]
    for columns in (slice(at.LOG_VELOCITY, at.LOG_VELOCITY + 3), slice(at.LOG_PORT, at.LOG_PORT + 6)):
        coarse, fine = (np.sqrt(np.mean((log[:, columns] - logs[-1][:, columns]) ** 2)) for log in logs[:2])
        assert 3.0 < coarse / fine < 6.5
    speeds = slice(at.LOG_VELOCITY, at.LOG_VELOCITY + 3)
    assert np.abs(logs[0][:, speeds] - logs[-1][:, speeds]).max() < 2e-4


def test_wide_lines_are_none():
    """A third of a metre of 10 cm: the machine without lines, but for what the step makes of its fast oscillation."""
    logs = [
        Plant(m, np.full(3, 0.5)).run(levers(1.5, 100.0))
        for m in (load_machine("M22"), long_lines((0.1, 0.11, 0.1), (0.0,) * 3))
    ]
    off, wide = (log[:, at.LOG_VELOCITY : at.LOG_VELOCITY + 3] for log in logs)
    long = Plant(long_lines(), np.full(3, 0.5)).run(levers(1.5, 100.0))[:, at.LOG_VELOCITY : at.LOG_VELOCITY + 3]
    assert np.sqrt(np.mean((wide - off) ** 2)) < 5e-4
    assert np.sqrt(np.mean((long - off) ** 2)) > 2e-3


def test_oil_in_a_line_swings_at_its_own_frequency():
    """All valves shut, the piston still: half a line's oil against the other half and the chamber, by I and C."""
    plant = Plant(long_lines(walls=(0.0,) * 3), np.full(3, 0.5), rate_hz=1 / STEP_S, step_s=STEP_S)
    plant.run(np.zeros((300, 3)))
    plant.state[at.PORT_HEAD + 1] += 5e5
    trace = []
    for _ in range(120):
        trace.append(plant.state[at.FLOW_HEAD + 1])
        plant.run(np.zeros((1, 3)))
    crossings = np.flatnonzero(np.diff(np.sign(trace[2:])) != 0)
    period = 2.0 * STEP_S * np.mean(np.diff(crossings))
    pressure, axes = plant.state[at.HEAD + 1], plant.axes
    bulk = hydraulics.stiffness(pressure, plant.plant)
    chamber = axes[1, at.HEAD_DEAD] + axes[1, at.HEAD_AREA] * 0.5 * axes[1, at.STROKE]
    stiffness = bulk / axes[1, at.PORT_VOLUME] + bulk / chamber
    assert period == pytest.approx(2.0 * math.pi * math.sqrt(axes[1, at.LINE_INERTANCE] / stiffness), rel=0.05)


def test_without_lines_the_valve_sees_the_chambers():
    plant = Plant(load_machine("M22"), np.full(3, 0.5))
    log = plant.run(levers(0.5, 100.0))
    assert np.array_equal(log[:, at.LOG_PORT : at.LOG_PORT + 6], log[:, at.HEAD : at.PUMP])
    assert not plant.state[at.PORT_HEAD :].any()
    assert log.shape[1] == at.LOG_COLUMNS


def test_transmitters_at_the_valve_show_its_pressure(tmp_path):
    shown = {}
    for place in ("cylinder", "valve"):
        path = tmp_path / f"{place}.toml"
        path.write_text(text_with(f"line_bore = {list(BORES)}", f'pressure_at = "{place}"'))
        simulation = Simulation(Scenario(machine=str(path), excitation="combined", seed=2, duration_s=3.0))
        simulation.run(300)
        log = np.array(simulation.log)
        pressures = simulation.recording().column("CylPressures_2").astype(float)
        truth = {"cylinder": log[:, at.HEAD + 1], "valve": log[:, at.LOG_PORT + 1]}
        for name, values in truth.items():
            shown[place, name] = float(np.sqrt(np.mean((pressures - values) ** 2)))
    noise = load_machine("M22").sensors.pressure
    for place, other in (("cylinder", "valve"), ("valve", "cylinder")):
        assert shown[place, place] < 1.2 * noise
        assert shown[place, other] > 3.0 * noise


def test_a_snapshot_holds_the_lines(tmp_path):
    simulation = check_snapshot(tmp_path, text_with(f"line_bore = {list(BORES)}\nline_modulus = {list(SOFT)}"))
    assert np.abs(simulation.plant.state[at.FLOW_HEAD :]).max() > 1e-6


def test_an_environment_is_the_recording_of_its_levers_to_the_bit(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(text_with(f"line_bore = {list(BORES)}", 'pressure_at = "valve"'))
    scenario = Scenario(machine=str(path), excitation="combined", duration_s=1.5, seed=2, sensor_noise=False)
    simulation = Simulation(scenario)
    log = simulation.run(scenario.samples)
    alike = {"machine": str(path), "duration_s": 1.5, "step_s": scenario.step_s, "sensor_noise": False}
    env = ExcavatorEnv(**alike, hand=simulation.operator.by_hand)
    seen = [env.reset(seed=2)[0]] + [env.step(lever)[0] for lever in simulation.targets[:-1]]
    ports = log[:, at.LOG_PORT : at.LOG_PORT + 6].astype(np.float32)
    np.testing.assert_array_equal(np.array(seen)[:, 6:12], ports)


@pytest.mark.parametrize(
    ("cylinders", "sensors", "words"),
    [
        ("line_bore = [0.025, 0.0, 0.02]", "", "at least 0.001 m for all"),
        ("line_bore = [0.025, 0.025, 0.002]", "", r"line_bore\[bucket\] = 0.002 m makes of hose_volume"),
        ("line_bore = [0.15, 0.025, 0.02]", "", r"line_bore\[boom\]"),
        ("line_bore = [1e-300, 0.025, 0.02]", "", "at least 0.001 m for all"),
        ("line_bore = [0.5, 0.025, 0.02]", "", "from 0 to 0.2"),
        ("line_bore = [nan, 0.025, 0.02]", "", "line_bore"),
        ("line_bore = [0.025, 0.025]", "", "line_bore"),
        ("line_modulus = [0.0, 6e8, 6e8]", "", "line_modulus = .* asks for lines"),
        ("line_bore = [0.025, 0.025, 0.02]\nline_modulus = [-1.0, 0.0, 0.0]", "", "line_modulus"),
        ("line_bore = [0.025, 0.025, 0.02]\nline_modulus = [1e3, 0.0, 0.0]", "", "at least 1e.07"),
        ("", 'pressure_at = "valve"', "pressure_at = 'valve' asks for lines"),
        ("", 'pressure_at = "pump"', "must be one of cylinder, valve"),
    ],
)
def test_what_cannot_be_is_refused(cylinders, sensors, words):
    with pytest.raises(ConfigError, match=words):
        parse_machine(text_with(cylinders, sensors), "mine.toml")
