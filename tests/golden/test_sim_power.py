"""Where the pumps' energy goes, how oil warms, what the bucket can push with, and shared flow."""

import dataclasses

import numpy as np
import pytest

from edp.sim import load_machine
from edp.sim.machine import layout as at
from edp.sim.physics import hydraulics, linkage, pump, valve
from edp.sim.physics.plant import Plant

STEP_S = 1e-3


def moving(seconds=2.0, pumps=None, **valves):
    """Combined motion of M22 logged at every step."""
    machine = load_machine("M22")
    machine = dataclasses.replace(
        machine,
        valves=dataclasses.replace(machine.valves, **valves),
        pumps=dataclasses.replace(machine.pumps, **(pumps or {})),
    )
    plant = Plant(machine, np.array([0.4, 0.5, 0.5]), rate_hz=1 / STEP_S, step_s=STEP_S)
    time = np.arange(round(seconds / STEP_S)) * STEP_S
    return plant, plant.run(np.outer(np.sin(np.pi * time), [0.8, 0.6, -0.7]))


def flows(plant, row):
    """Net inflow of heads and rods, and what leaves either pump line, m^3/s."""
    valves, opened = np.zeros((at.SPOOLS, 5)), np.zeros((3, at.OPENINGS))
    valves[:, at.SPOOL] = row[at.LOG_SPOOL : at.LOG_SPOOL + at.SPOOLS]
    valve.open_spools(valves, row[at.LOG_STROKE : at.LOG_STROKE + 3], plant.axes, opened)
    loads = tuple(hydraulics.highest_load(m, row, opened, plant.plant) for m in range(2))
    highest = loads if plant.plant[at.COMPENSATED] else (-1e9, -1e9)
    found = [
        hydraulics.cylinder_flows(
            i,
            (row[at.HEAD + i], row[at.ROD + i], row[at.PUMP], row[at.PUMP + 1]),
            highest,
            opened,
            plant.axes,
            plant.plant,
        )[0]
        for i in range(3)
    ]
    bypass = pump.bypass_conductances(valves, plant.axes, plant.plant)
    reliefs = [hydraulics.relief_of(load, plant.plant) for load in loads]
    lost = [hydraulics.pump_outflow(row[at.PUMP + m], bypass[m], reliefs[m], plant.plant)[0] for m in range(2)]
    drawn = np.sum([q[2:] for q in found], axis=0) + lost
    return np.array([*(q[0] for q in found), *(q[1] for q in found)]), drawn


def balance(plant, log):
    """Energies (J) of pumps, pistons, losses and compression, and the least loss power (W)."""
    tank = plant.plant[at.TANK]
    pressure = log[:, at.HEAD : at.BRISTLE] - tank
    inflow, drawn = (np.array(part) for part in zip(*(flows(plant, row) for row in log), strict=True))
    loss = (pressure[:, 6:] * drawn).sum(axis=1) - (pressure[:, :6] * inflow).sum(axis=1)
    supply = plant.plant[at.EFFICIENCY] * plant.plant[at.MAX_FLOW] * log[:, at.DISPLACEMENT : at.DISPLACEMENT + 2]
    pumps = (pressure[:, 6:] * supply).sum(axis=1)
    ends = np.concatenate((plant.axes[:, at.HEAD_AREA], -plant.axes[:, at.ROD_AREA]))
    speed = np.tile(log[:, at.LOG_VELOCITY : at.LOG_VELOCITY + 3], 2)
    pistons = (pressure[:, :6] * ends * speed).sum(axis=1)
    stroke = log[:, at.LOG_STROKE : at.LOG_STROKE + 3]
    left = plant.axes[:, at.STROKE] - stroke
    volume = np.hstack(
        (
            plant.axes[:, at.HEAD_DEAD] + plant.axes[:, at.HEAD_AREA] * stroke,
            plant.axes[:, at.ROD_DEAD] + plant.axes[:, at.ROD_AREA] * left,
            np.full((len(log), 2), plant.plant[at.LINE_VOLUME]),
        )
    )
    bulk = np.vectorize(lambda p: hydraulics.stiffness(p, plant.plant))(pressure + tank)
    density = pressure * volume / bulk
    stored = (0.5 * (density[1:] + density[:-1]) * np.diff(pressure, axis=0)).sum()
    return (*(np.trapezoid(part, dx=STEP_S) for part in (pumps, pistons, loss)), stored, loss.min())


SENSING = {"load_margin": 30e5, "bypass": (4.0, 20.0), "min_displacement": 0.01}


@pytest.mark.parametrize(
    ("pumps", "valves", "share"),
    [
        ({}, {"flow_sharing": "parallel"}, 1e-3),
        ({}, {"flow_sharing": "compensated"}, 1e-3),
        # A block that senses loads unloads its pump at once when a spool closes, within fewer samples than are logged.
        (SENSING, {"flow_sharing": "pre_compensated", "compensator_drop": 20e5}, 4e-3),
    ],
)
def test_pump_work_is_piston_work_losses_and_compression(pumps, valves, share):
    plant, log = moving(pumps=pumps, **valves)
    pumps, pistons, losses, stored, least = balance(plant, log)
    assert pumps > 3e4
    assert pumps == pytest.approx(pistons + losses + stored, rel=share)
    assert least > 0.0


def test_compensated_sections_share_by_opening_not_by_load():
    """Boom up and arm in together: in parallel the lighter arm takes the oil, compensated it cannot."""

    def boom_speed(sharing):
        machine = load_machine("M22")
        valves = dataclasses.replace(machine.valves, flow_sharing=sharing)
        plant = Plant(dataclasses.replace(machine, valves=valves), np.array([0.2, 0.3, 0.5]))
        log = plant.run(np.tile([0.9, 0.9, 0.0], (120, 1)))
        return log[60:, at.LOG_VELOCITY].mean()

    assert boom_speed("compensated") > boom_speed("parallel") + 0.01


def test_unknown_flow_sharing_is_refused():
    machine = load_machine("M22")
    machine = dataclasses.replace(machine, valves=dataclasses.replace(machine.valves, flow_sharing="even"))
    with pytest.raises(Exception, match="flow_sharing = 'even' must be one of parallel, compensated"):
        Plant(machine, np.full(3, 0.5))


def test_a_cold_worn_machine_warms_up():
    plant = Plant(load_machine("C14"), np.full(3, 0.5))
    levers = np.outer(np.sin(np.arange(6000) * 2 * np.pi / 400), [0.8, 0.8, 0.8])
    log = plant.run(levers)
    oil = load_machine("C14").oil
    assert log[0, at.LOG_OIL] == oil.temperature
    assert 0.3 < log[-1, at.LOG_OIL] - log[0, at.LOG_OIL] < 10.0
    assert plant.plant[at.BULK_MODULUS] < oil.bulk_modulus * (1 - 0.004 * (oil.temperature - 45))
    assert plant.plant[at.THINNING] > np.exp(0.035 * (oil.temperature - 40))


# kN at the main relief: class sheets; bucket and arm
@pytest.mark.parametrize(("name", "axis", "class_kn"), [("M22", 2, 152.0), ("C14", 2, 103.5), ("C14", 1, 60.0)])
def test_digging_forces_are_those_of_the_class(name, axis, class_kn):
    machine = load_machine(name)
    plant = Plant(machine, np.full(3, 0.5))
    strokes = np.linspace(0.02, 0.98, 60) * plant.axes[axis, at.STROKE]
    levers = [
        abs(linkage.cylinder(axis, linkage.angle_at_stroke(axis, s, plant.axes, plant.plant), plant.plant)[1])
        for s in strokes
    ]
    push = machine.pumps.relief * plant.axes[axis, at.HEAD_AREA] * max(levers)
    radius = machine.bodies.length[2]
    if axis == 1:  # bucket turned to where its own force is greatest, as the standard asks
        bucket = [
            linkage.angle_at_stroke(2, s, plant.axes, plant.plant)
            for s in np.linspace(0.02, 0.98, 60) * plant.axes[2, at.STROKE]
        ]
        best = bucket[int(np.argmax([abs(linkage.cylinder(2, b, plant.plant)[1]) for b in bucket]))]
        radius = abs(machine.bodies.length[1] + machine.bodies.length[2] * np.exp(1j * best))
    assert push / radius / 1e3 == pytest.approx(class_kn, rel=0.15)
