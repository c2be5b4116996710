"""From machine to grey box and back: every number to rounding, bodies by inertia and gravity, files as read."""

from dataclasses import replace

import numpy as np
import pytest

from edp.data.twin_channels import TwinChannels
from edp.errors import ConfigError, DataError
from edp.networks.twin.grey import parameter_index as at
from edp.networks.twin.grey.equations import GAMMA
from edp.networks.twin.grey.parameters import number_table
from edp.networks.twin.grey.priors import Travel, opening_knots
from edp.networks.twin.parameters import posterior_deviations
from edp.signals import VOCABULARY, Channel, Kind
from edp.sim.machine.machine_files import load_machine, parse_machine
from edp.sim.machine.parameters import pack
from edp.sim.physics import dynamics
from edp.sim.physics.valve import opening, pilot_half_step, spool_filters, spool_half_step
from edp.training.identification.bodies import (
    Poses,
    base_parameters,
    grey_load,
    load_by_base,
    realise_bodies,
    solve_base,
)
from edp.training.identification.elements import check_strokes, excavator_elements, full_commands
from edp.training.identification.machine_numbers import MACHINE_NUMBERS, guesses, set_values
from edp.training.identification.machine_text import machine_text
from edp.training.identification.mapping import GreyParts, grey_numbers
from edp.training.identification.parametrisation import (
    CUSHIONS,
    MachineParametrisation,
    nearest_machine,
    reset_to_guess,
)

M22 = load_machine("M22")
PILOTS = ("BmUp", "BmDwn", "AmIn", "AmOut", "BktIn", "BktOut")
PRESSURES = tuple(f"CylPressures_{i}" for i in (1, 2, 3, 5, 6, 7))


def channels(commands=(*PILOTS, *(f"{name}Conf" for name in PILOTS)), pressures=(*PRESSURES, "PumpPressure_1")):
    named = [tuple(VOCABULARY[name] for name in names) for names in (commands, pressures)]
    speeds, strokes = (tuple(VOCABULARY[f"{name}_{i}"] for i in (1, 2, 3)) for name in ("CylVels", "CylStroke"))
    return TwinChannels(named[0], speeds, strokes, named[1], 100.0)


@pytest.fixture(scope="module")
def parts():
    elements = excavator_elements(channels(), M22)
    travels = [Travel(0.0, stroke, 0.3, (30.0, 30.0)) for stroke in M22.cylinders.stroke]
    table = number_table(elements, travels, [30.0, 30.0], (2, 4))
    return GreyParts(table, (0, 2, 4), (1, 3, 5), (1.0,) * 6, 52.0)


def other_machine(seed=0):
    """M22 with every identified number changed by up to some ten percent; no regeneration of its own is zero."""
    shift = np.minimum([number.width for number in MACHINE_NUMBERS], 0.5) * np.random.default_rng(seed).normal(
        size=len(MACHINE_NUMBERS)
    )
    # A pump that is asked for more than all gives no more.
    shift = [-abs(s) if "pump_demand" in n.key else s for n, s in zip(MACHINE_NUMBERS, shift, strict=True)]
    return set_values(M22, guesses(M22) * np.exp(0.3 * np.array(shift)))


@pytest.mark.long
def test_numbers_of_a_grey_box_made_from_a_machine_map_back_to_it(parts):
    machine = other_machine()
    own = MachineParametrisation.from_guess(M22, parts, parts.table.nominal[parts.load])
    numbers = grey_numbers(machine, parts, own.load)
    theta = nearest_machine(own, numbers, 1e4 * np.eye(len(numbers)), prior=0.0)
    again, truth = (np.array([n.read(m) for n in MACHINE_NUMBERS]) for m in (own.machine(theta), machine))
    assert np.abs(again / truth - 1.0).max() < 1e-9


def test_what_the_data_do_not_tell_stays_at_the_guess(parts):
    machine, own = other_machine(1), MachineParametrisation.from_guess(M22, parts, parts.table.nominal[parts.load])
    numbers = grey_numbers(machine, parts, own.load)
    # Only dead bands and openings of the boom are told.
    excited = np.zeros(len(numbers))
    excited[parts.table.valve_at[0, at.BAND] : parts.table.valve_at[0, at.BAND] + 12] = 1e6
    theta = nearest_machine(own, numbers, np.diag(excited))
    machine_found = {n.label: n.read(own.machine(theta)) for n in MACHINE_NUMBERS}
    truth = {n.label: n.read(machine) for n in MACHINE_NUMBERS}
    base = {n.label: n.read(M22) for n in MACHINE_NUMBERS}
    for label in ("valves.dead_band_extend[boom]", "valves.meter_in_extend[boom]", "valves.meter_out_extend[boom]"):
        assert machine_found[label] == pytest.approx(truth[label], rel=1e-3)
    for label in ("valves.meter_in_extend[arm]", "friction.viscous[boom]", "pumps.max_flow"):
        assert machine_found[label] == pytest.approx(base[label])


def test_a_number_set_back_moves_those_that_make_up_for_it():
    information = np.array([[50.0, 49.0], [49.0, 50.0]])
    theta = np.array([0.5, -0.5])
    moved = reset_to_guess(theta, information, np.array([False, True]))
    # What matters is the sum, which the first one now gives alone, but for what was thought before.
    assert moved == pytest.approx([0.5 + 49.0 / 51.0 * -0.5, 0.0])
    assert posterior_deviations(np.diag([0.0, 99.0])) == pytest.approx([1.0, 0.1])


def test_opening_curves_and_areas_are_those_of_the_simulator(parts):
    table, numbers = parts.table, grey_numbers(M22, parts, parts.table.nominal[parts.load])
    axes, _ = pack(M22)
    assert numbers[table.actuator_at + at.HEAD_AREA] == pytest.approx(axes[:, 5])
    first = table.valve_at[2, at.INTO]
    knots = opening_knots(table.stretches)
    curve = np.concatenate([[0.0], np.cumsum(numbers[first : first + table.stretches])])
    band = M22.valves.dead_band_extend[1]
    areas = [opening(band + (1.0 - band) * r, band) for r in knots]
    flow, bar = M22.valves.meter_in_extend[1]
    # L/min at bar to m^3/s/MPa^0.5
    full = flow / 6e4 / np.sqrt(bar * 1e5) * 1e3
    # The nearest polygon has corners below a convex curve, since its chords lie above.
    assert np.abs(curve / full - areas).max() < 0.02
    assert (curve[1:] / full < areas[1:]).all()


def test_commands_that_reach_half_of_the_full_pilot_see_half_of_the_curve(parts):
    half = replace(parts, reach=(0.5,) * 6)
    load = parts.table.nominal[parts.load]
    whole, part = (grey_numbers(M22, which, load) for which in (parts, half))
    table = parts.table
    band, first = table.valve_at[0, at.BAND], table.valve_at[0, at.INTO]
    assert part[band] == pytest.approx(2.0 * whole[band])
    total, share = (values[first : first + table.stretches].sum() for values in (whole, part))
    assert share / total == pytest.approx(opening(0.5, M22.valves.dead_band_extend[0]), rel=0.02)


@pytest.fixture(scope="module")
def poses():
    strokes = np.random.default_rng(3).uniform(0.05, 0.95, (60, 3)) * np.array(M22.cylinders.stroke)
    return Poses.from_strokes(M22, strokes)


def test_inertia_and_gravity_are_linear_in_the_nine_numbers(poses):
    by_torque, by_inertia = load_by_base(poses, M22.bodies.length, M22.gravity)
    nine, (axes, _) = base_parameters(M22.bodies), pack(M22)
    mass, torque = np.empty((3, 3)), np.empty(3)
    for i, psi in enumerate(poses.angles):
        dynamics.mass_matrix(psi, axes, mass)
        dynamics.gravity_torque(psi, axes, M22.gravity, torque)
        assert by_torque[i] @ nine == pytest.approx(torque, rel=1e-12, abs=1e-8)
        assert by_inertia[i] @ nine == pytest.approx(mass, rel=1e-12, abs=1e-8)


def test_bodies_come_back_from_inertia_and_gravity(poses):
    by_torque, by_inertia = load_by_base(poses, M22.bodies.length, M22.gravity)
    nine = base_parameters(M22.bodies)
    assert solve_base(by_torque @ nine, by_inertia @ nine, poses, M22) == pytest.approx(nine, rel=1e-9)
    bodies = realise_bodies(nine, M22)
    assert np.array(bodies.inertia) == pytest.approx(M22.bodies.inertia, rel=1e-6)
    heavy = replace(M22, bodies=replace(M22.bodies, mass=(2500.0, 700.0, 1200.0), com_y=(0.4, 0.2, 0.2)))
    # Other masses, the same motion; a guess that is far off changes what the poses tell by little.
    assert base_parameters(realise_bodies(nine, heavy)) == pytest.approx(nine)
    assert solve_base(by_torque @ nine, by_inertia @ nine, poses, heavy)[[0, 2, 4]] == pytest.approx(
        nine[[0, 2, 4]], rel=1e-3
    )
    with pytest.raises(ConfigError, match="no rigid bodies have the joint inertia and gravity torques of the logs"):
        realise_bodies(nine * np.array([1, 1, 1, 1, 1, 1, 1, 1, 0.05]), M22)


def test_the_load_of_a_grey_box_is_read_as_forces_and_masses(parts, poses):
    """One potential and one inertia whose values are known: U = 0.01 z_1, L = 0.1 on the diagonal."""
    table, middle = parts.table, np.array(M22.cylinders.stroke) / 2
    load = np.zeros(len(table.numbers) - table.inertia_at)
    for entry in (0, 2, 5):
        load[entry * table.inertia_terms] = 0.1
    load[table.potential_at - table.inertia_at] = 0.01
    torque, inertia = grey_load(table, load, (middle, 1.0 / middle), poses)
    assert torque[:, 0] == pytest.approx(1e4 / middle[0] * poses.levers[:, 0])
    assert np.abs(torque[:, 1:]).max() == 0.0
    assert np.diagonal(inertia, axis1=1, axis2=2) == pytest.approx(1e4 * poses.levers**2)


def test_the_text_of_a_machine_is_read_back_as_the_machine():
    machine = replace(other_machine(2), description='a "quoted" text')
    text = machine_text(machine, ["from logs\nname = 'x'"], {("pumps", "relief"): "1 to 2\n[valves]"})
    again = parse_machine(text, "text")
    values, truth = (np.array([n.read(m) for n in MACHINE_NUMBERS]) for m in (again, machine))
    assert values == pytest.approx(truth, rel=1e-5)
    assert again.description == machine.description
    assert "  # 1 to 2 [valves]\n" in text


def test_coordinates_are_plausible_deviations(parts):
    table = parts.table
    moved = table.priors.values(np.full(len(table.numbers), 0.5))
    assert table.priors.coordinates(moved) == pytest.approx(0.5)


def test_logs_without_second_spools_have_none():
    elements = excavator_elements(channels(PILOTS, PRESSURES), M22)
    assert [valve.name for valve in elements.valves] == ["boom", "arm", "bucket"]
    assert [pump.pressure for pump in elements.pumps] == ["", ""]


@pytest.mark.parametrize(
    ("logged", "message"),
    [
        (channels(pressures=PRESSURES[:5]), "1 pressures of the bucket cylinder; those of head and rod must be"),
        (channels(commands=PILOTS[:4]), "0 commands of the bucket cylinder"),
        (replace(channels(), strokes=()), "3 cylinders and no strokes"),
    ],
)
def test_logs_that_lack_a_channel_are_refused(logged, message):
    with pytest.raises(DataError, match=message):
        excavator_elements(logged, M22)


def test_commands_that_are_no_pilots_are_refused():
    logged = channels()
    logged = replace(logged, commands=(Channel("BmUp", Kind.CURRENT), *logged.commands[1:]))
    with pytest.raises(DataError, match="command 'BmUp' is of kind current"):
        full_commands(logged, excavator_elements(channels(), M22), M22)


def test_strokes_beyond_those_of_the_machine_are_refused():
    high = np.array([1.2, 1.6, 1.0])
    with pytest.raises(ConfigError, match=r"goes from 0 to 1\.6 m in the logs, but the arm cylinder of machine M22"):
        check_strokes(channels().strokes, np.zeros(3), high, M22)


def test_the_chain_of_lags_moves_as_the_spools_of_the_simulator(parts):
    """Steps of both, written out: the grey box's as its compiled code moves valves, the simulator's at 1 ms."""
    numbers, places = grey_numbers(M22, parts, parts.table.nominal[parts.load]), parts.table.valve_at[2]
    delay, first, second = (numbers[places[k]] for k in (at.DELAY, at.PILOT_LAG, at.SPOOL_LAG))
    ticks, whole = 40, int(delay / 0.01)
    state, grey = np.zeros(4), []
    for t in range(ticks):
        goal = float(t > whole) + (t == whole) * (1.0 - (delay / 0.01 - whole))
        for h in (GAMMA * 0.01, (1.0 - GAMMA) * 0.01):
            for k, lag in enumerate((first, first, second, second)):
                ahead = goal if k == 0 else state[k - 1]
                state[k] = ahead + (state[k] - ahead) * np.exp(-h / lag)
        grey.append(state[3])
    filters, valves, sim = spool_filters(M22, 5e-4), np.zeros((6, 5)), []
    no_play = pack(replace(M22, valves=replace(M22.valves, hysteresis=0.0)))[0]
    for n in range(10 * ticks):
        demand = np.full(6, float(n + 0.5 >= 1e3 * M22.valves.dead_time[1]))
        for _ in range(2):
            pilot_half_step(demand, filters, no_play, valves)
            spool_half_step(filters, valves)
        sim.append(valves[1, 3])
    apart = np.array(grey) - np.array(sim[9::10])
    assert np.abs(apart).max() < 0.02
    # The same delay: what lies between the two curves adds up to nothing.
    assert abs(apart.sum() * 0.01) < 5e-4


def test_no_cushion_of_an_identified_machine_reaches_the_middle_of_its_stroke(parts):
    """Logs that never meet an end stop may ask for any length; a machine file takes half of the stroke at most."""
    own = MachineParametrisation.from_guess(M22, parts, parts.table.nominal[parts.load])
    theta = np.zeros(len(own.begin))
    theta[CUSHIONS] = 8.0
    machine = own.machine(theta)
    for length, stroke in zip(machine.cylinders.cushion_length, machine.cylinders.stroke, strict=True):
        assert 0.49 * stroke < length < 0.5 * stroke
