"""Faults: their notation, their course in time, what they change, and what is refused."""

import contextlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from edp.errors import ConfigError
from edp.signals import FAULT_CHANNELS
from edp.sim import DataSetSpec, Scenario, Simulation, load_machine, read_scenario_file, simulate
from edp.sim.environment import EnvironmentSpec, ExcavatorEnv
from edp.sim.faults import FAULTS, FaultSpec, MachineFault, faults_of, ladder, parse_fault
from edp.sim.faults.base import MAX_FAULTS
from edp.sim.faults.course import numbers_of, shares_at
from edp.sim.machine import layout as at
from edp.sim.machine.parameters import pack
from edp.sim.physics import hydraulics, integrator
from edp.sim.physics.plant import Plant
from edp.sim.predictability import LimitSpec, plan_limit

BAR, PER_MINUTE = 1e5, 6e4
TICKS = np.arange(1000)


def faulty_numbers(text, machine="M22"):
    """Numbers of a machine without and with one fault."""
    plant = Plant(load_machine(machine), np.full(3, 0.5))
    sound, fault = numbers_of(plant), parse_fault(text)
    numbers = sound.copy()
    FAULTS[fault.kind].change(numbers, fault.site, fault.full)
    return sound, numbers


def test_the_registry_has_the_kinds_of_machines_and_of_sensors():
    of_machine = [name for name, kind in FAULTS.items() if isinstance(kind, MachineFault)]
    assert (len(of_machine), len(FAULTS)) == (18, 38)
    assert len(FAULT_CHANNELS) == MAX_FAULTS
    every = list(ladder())
    assert {fault.kind for fault in every} == set(FAULTS)
    assert len(every) == sum(max(1, len(kind.ladder)) for kind in FAULTS.values())
    assert [fault.size for fault in ladder(["internal_leak"], onset_s=5.0)] == [0.3, 1.0, 3.0, 10.0]
    assert len(list(ladder(["pilot_bias"], everywhere=True))) == 3 * 12


def test_texts_and_tables_say_the_same():
    fault = parse_fault("internal_leak:boom:3L/min@2min,ramp=500ms,on=2s,off=8s")
    assert fault == FaultSpec("internal_leak", "boom", 3.0, "L/min", 120.0, 0.5, 2.0, 8.0)
    assert fault.full == pytest.approx(3.0 / PER_MINUTE)
    assert parse_fault("cooler:80%") == FaultSpec("cooler", size=80.0, unit="%")
    assert parse_fault("pressure_stuck:arm_rod@1h") == FaultSpec("pressure_stuck", "arm_rod", onset_s=3600.0)
    assert parse_fault("pressure_bias:arm_rod:-1.5e1 bar").size == -15.0
    table = {"kind": "friction", "site": "arm", "size": 2, "unit": "x"}
    assert faults_of([table, "friction:arm:2x"], "here") == (FaultSpec("friction", "arm", 2, "x"),) * 2


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "write KIND"),
        ("internal_leek:boom:3L/min", "unknown kind of fault; did you mean 'internal_leak'.*there are attachment_mass"),
        ("internal_leak", "nothing came behind the kind; write internal_leak:SITE:SIZE; sites are boom, arm, bucket"),
        ("internal_leak:boom", "write internal_leak:SITE:SIZE.*sizes are in L/min"),
        ("internal_leak:boom:3L/min:x", "write internal_leak:SITE:SIZE"),
        ("internal_leak:leg:3L/min", "site 'leg' is unknown.*there are boom, arm, bucket"),
        ("internal_leak:boom:3bar", "size = '3bar'; write a number and its unit, one of L/min, m\\^3/s"),
        ("internal_leak:boom:3", "write a number and its unit"),
        ("internal_leak:boom:nanL/min", "write a number and its unit"),
        ("internal_leak:boom:-3L/min", "0 <= size <= 100 L/min must hold"),
        ("internal_leak:boom:1e999L/min", "must be a finite number"),
        ("internal_leak:boom:3L/min@soon", "onset = 'soon'; write a number and its unit, one of s, ms, min, h"),
        ("internal_leak:boom:3L/min@120", "one of s, ms, min, h"),
        ("internal_leak:boom:3L/min@-1s", "0 <= onset_s"),
        ("internal_leak:boom:3L/min,rump=3s", "option 'rump' is unknown; did you mean 'ramp'"),
        ("internal_leak:boom:3L/min,ramp=3s,ramp=4s", "came twice"),
        ("internal_leak:boom:3L/min,on=3s", "needs both"),
        ("internal_leak:boom:3L/min,on=1ms,off=1s", "0.05 s at least"),
        ("pressure_stuck:boom_head:3bar", "write pressure_stuck:SITE"),
        ("pressure_stuck:boom_head,ramp=3s", "must be 0: this kind is there or not"),
        ("cooler:boom:50%", "write cooler:SIZE"),
        ("friction:boom:0.5x", "1 <= size <= 20 x must hold"),
        ("internal_leak:boom:3L/min\x00", "write KIND"),
        ("x" * 100_000, "write KIND"),
    ],
)
def test_hostile_texts_are_refused_in_one_line(text, words):
    with pytest.raises(ConfigError, match=words) as refused:
        parse_fault(text)
    assert len(str(refused.value)) < 1200


@pytest.mark.long
@given(st.one_of(st.text(), st.from_regex(r"[a-z_]{1,20}(:[a-z_]{0,9}){0,2}(:[0-9.e+-]{0,6}[A-Za-z%/]{0,5})?(@.*)?")))
def test_any_text_is_a_fault_or_one_error(text):
    with contextlib.suppress(ConfigError):
        assert isinstance(parse_fault(text), FaultSpec)


@pytest.mark.parametrize(
    ("faults", "words"),
    [
        ("friction:arm:2x", "must be a list of faults"),
        (7, "must be a list of faults"),
        ([7], "write a text such as"),
        ([{}], "say which with kind"),
        ([{"kind": 3}], "say which with kind"),
        ([{"kind": "friction", "sight": "arm"}], "key 'sight' is unknown; did you mean 'site'"),
        ([{"kind": "friction", "site": 3, "size": 2.0, "unit": "x"}], "site 3 is unknown"),
        ([{"kind": "friction", "site": "arm", "size": "2", "unit": "x"}], "must be a finite number"),
        ([{"kind": "friction", "site": "arm", "size": True, "unit": "x"}], "must be a finite number"),
        ([{"kind": "friction", "site": "arm", "size": 2.0, "unit": ["x"]}], "unit .* of the size is unknown"),
        ([{"kind": "friction", "site": "arm", "unit": "x"}], "it needs a size, such as 1.3x"),
        ([{"kind": "pressure_stuck", "site": "arm_rod", "size": 2.0}], "size = 2.0 '' must be left out"),
        ([{"kind": "cooler", "size": 50.0, "unit": "%", "onset_s": "now"}], "onset_s = 'now'"),
        (["cooler:50%"] * 9, "faults has 9 entries; 0 to 8 must hold"),
    ],
)
def test_what_is_no_fault_is_refused(faults, words):
    for build in (Scenario, DataSetSpec, EnvironmentSpec):
        with pytest.raises(ConfigError, match=words):
            build(faults=faults)


def test_a_fault_comes_and_goes_as_its_course_says():
    steady, ramp, loose, both = (
        parse_fault(f"friction:arm:2x{how}")
        for how in ("@1.004s", "@2s,ramp=4s", "@1s,on=0.5s,off=1.5s", "@0s,ramp=5s,on=1s,off=1s")
    )
    shares = shares_at((steady, ramp, loose, both), TICKS, 100.0)
    np.testing.assert_array_equal(shares[:, 0], TICKS >= 101)
    np.testing.assert_allclose(shares[:, 1], np.clip((TICKS - 200) / 400, 0, 1), atol=1 / 1024)
    assert (np.diff(shares[:, 1]) >= 0).all()
    np.testing.assert_array_equal(shares[:, 2], (TICKS >= 100) & ((TICKS - 100) % 200 < 50))
    np.testing.assert_array_equal(shares[:, 3] > 0, (TICKS % 200 < 100) & (TICKS > 0))
    np.testing.assert_array_equal(shares[450], shares_at((steady, ramp, loose, both), TICKS[450:451], 100.0)[0])


def test_a_recording_says_what_is_wrong_with_it():
    faults = ("friction:arm:2x@1s,ramp=1s", "pressure_dropouts:boom_head:50%@0.5s,on=0.2s,off=0.3s")
    recording = simulate(Scenario(duration_s=3.0, faults=faults))
    assert tuple(FaultSpec(**table) for table in recording.meta["faults"]) == faults_of(faults, "here")
    want = shares_at(faults_of(faults, "here"), np.arange(300), 100.0).astype(np.float32)
    np.testing.assert_array_equal(recording.select(["Fault_1", "Fault_2"]), want)
    lost = recording.column("CylPressures_1") == 0.0
    assert not lost[want[:, 1] == 0].any()
    assert 0.2 < lost[want[:, 1] == 1].mean() < 0.8
    sound = simulate(Scenario(duration_s=3.0))
    assert "faults" not in sound.meta
    assert not set(FAULT_CHANNELS) & set(sound.channel_names)


@pytest.mark.parametrize(
    "text", ["internal_leak:arm:3L/min", "external_leak:arm_head:3L/min", "external_leak:arm_rod:3L/min"]
)
def test_leaks_have_their_size_at_200_bar(text):
    """The flow that a leak adds at 40 degC and 200 bar across it is its size, and leaves where it should."""
    both = faulty_numbers(text)
    flows = []
    for numbers in both:
        plant = numbers.plant.copy()
        plant[at.THINNING] = 1.0
        tank, closed = plant[at.TANK], np.zeros((3, at.OPENINGS))
        low = tank if "external" in text else 30 * BAR
        high = low + 200 * BAR
        pressures = (low, high, 0.0, 0.0) if text.startswith("external_leak:arm_rod") else (high, low, 0.0, 0.0)
        flows.append(hydraulics.cylinder_flows(1, pressures, (-1e9, -1e9), closed, numbers.axes, plant)[0])
    head, rod, *_ = (np.array(flows[1]) - flows[0]) * PER_MINUTE
    want = {"internal_leak:arm": (-3, 3), "external_leak:arm_head": (-3, 0), "external_leak:arm_rod": (0, -3)}
    assert (head, rod) == pytest.approx(want[text.rpartition(":")[0]], abs=1e-9)


def test_a_leaking_load_check_lets_its_share_back():
    sound, numbers = faulty_numbers("check_leak:boom:10%")
    area, back = 1e-7, []
    for each in (sound, numbers):
        back.append(hydraulics.section(area, 100 * BAR, 200 * BAR, -1e9, each.axes[0, at.CHECK], 1e12)[0])
    forward = hydraulics.section(area, 200 * BAR, 100 * BAR, -1e9, 1.0, 1e12)[0]
    assert (back[1] - back[0]) / forward == pytest.approx(-0.1)
    assert numbers.axes[1, at.CHECK] == sound.axes[1, at.CHECK]
    assert numbers.plant[at.REGEN_CHECK] == sound.plant[at.REGEN_CHECK]


def test_a_stuck_spool_loses_its_share_of_the_opening():
    from edp.sim.physics import valve

    _, numbers = faulty_numbers("stuck_spool:arm:40%")
    assert valve.opening(1.0, 0.13, numbers.axes[1, at.WIDEST]) == pytest.approx(0.6)
    assert valve.opening(0.3, 0.13, numbers.axes[1, at.WIDEST]) == valve.opening(0.3, 0.13)
    assert faulty_numbers("stuck_spool:arm:100%")[1].axes[1, at.WIDEST] == 0.0


def test_a_spool_that_is_twice_as_slow_takes_twice_the_time():
    sound, numbers = faulty_numbers("slow_spool:boom:2x")
    # Two half steps of a spool of half the frequency are one of the sound one, but for the unit of its rate.
    once = sound.coarse[0, 1].reshape(2, 2)
    twice = np.linalg.matrix_power(numbers.coarse[0, 1].reshape(2, 2), 2)
    scale = np.diag([1.0, 2.0])
    np.testing.assert_allclose(scale @ twice @ np.linalg.inv(scale), once, rtol=1e-9)
    np.testing.assert_array_equal(numbers.coarse[1:], sound.coarse[1:])


def test_an_attachment_weighs_more_with_and_without_a_load():
    for material in ("", "clay"):
        simulation = Simulation(
            Scenario(material=material, excitation="dig", duration_s=1.0, faults=["attachment_mass:300kg"])
        )
        simulation.run(50)
        own = load_machine("M22").bodies.mass[2]
        mass = simulation.plant.axes[2, at.MASS]
        assert mass == pytest.approx(own + 300.0 + simulation.plant.payload_kg)


def test_a_cooler_that_fails_warms_the_oil_by_what_it_does_not_take():
    """Heat balance: the oil gains what the cooler no longer takes, C dT = hA (T - T_ambient) dt."""
    kelvin = [simulate(Scenario(duration_s=20.0, faults=f)).column("OilTemperature") for f in ((), ("cooler:100%",))]
    machine = load_machine("M22")
    power = machine.oil.cooling * (machine.oil.temperature - machine.oil.ambient)
    gained = float(kelvin[1][-1]) - float(kelvin[0][-1])
    assert gained == pytest.approx(power * 20.0 / machine.oil.heat_capacity, rel=0.05)


def test_sensors_show_what_their_faults_say():
    def shown(*faults):
        return simulate(Scenario(duration_s=3.0, seed=2, faults=faults, sensor_noise=False))

    sound = shown()
    bias = shown("pressure_bias:arm_rod:-10bar@1s").column("CylPressures_6") - sound.column("CylPressures_6")
    np.testing.assert_allclose(bias, -10 * BAR * (np.arange(300) >= 100), atol=2.0)
    stuck = shown("velocity_stuck:boom@1s").column("CylVels_1")
    assert (stuck[99:] == sound.column("CylVels_1")[99]).all()
    late = shown("velocity_delay:boom:50ms@1s").column("CylVels_1")
    np.testing.assert_array_equal(late[100:], sound.column("CylVels_1")[95:295])
    swapped = shown("head_rod_swapped:bucket@1s")
    np.testing.assert_array_equal(swapped.column("CylPressures_3")[100:], sound.column("CylPressures_7")[100:])
    np.testing.assert_array_equal(swapped.column("CylPressures_7")[100:], sound.column("CylPressures_3")[100:])
    two = shown("velocities_swapped:boom_bucket")
    np.testing.assert_array_equal(two.select(["CylVels_1", "CylAcc_3"]), sound.select(["CylVels_3", "CylAcc_1"]))
    scaled = shown("stroke_scale:arm:10%").column("CylStroke_2") / sound.column("CylStroke_2")
    np.testing.assert_allclose(scaled, 1.1, rtol=1e-6)
    pressure = sound.column("CylPressures_1").astype(float)
    lagging, want = shown("pressure_lag:boom_head:150ms").column("CylPressures_1"), pressure.copy()
    for k in range(1, 300):
        want[k] = pressure[k] + np.exp(-1 / 15) * (want[k - 1] - pressure[k])
    np.testing.assert_allclose(lagging, want, rtol=1e-5, atol=10.0)


def test_the_truth_of_an_environment_stays_true_where_a_sensor_lies():
    faults = ["stroke_bias:boom:20mm", "pump_pressure_bias:pump_2:10bar"]
    observed = ("CylStroke_1", "PumpPressure_2")
    env = ExcavatorEnv(duration_s=1.0, sensor_noise=False, faults=faults, observed=observed)
    observation, info = env.reset(seed=1)
    true = [info["truth"]["CylStroke_1"] + 0.02, info["truth"]["PumpPressure_2"] + 10 * BAR]
    np.testing.assert_allclose(observation, true, rtol=1e-6)
    sound, info = env.reset(seed=1, options={"faults": ()})
    assert "faults" not in info
    assert observation[0] - sound[0] == pytest.approx(0.02, abs=1e-6)


def test_a_scenario_file_takes_tables(tmp_path):
    file = tmp_path / "faulty.toml"
    file.write_text(
        "minutes = 0.1\nrecordings = 2\n"
        '[[faults]]\nkind = "internal_leak"\nsite = "boom"\nsize = 3\nunit = "L/min"\nonset_s = 1.5\n'
        '[[faults]]\nkind = "pressure_stuck"\nsite = "arm_rod"\non_s = 0.5\noff_s = 2\n'
    )
    faults = read_scenario_file(file)["faults"]
    assert faults == faults_of(["internal_leak:boom:3L/min@1.5s", "pressure_stuck:arm_rod,on=0.5s,off=2s"], "here")
    assert all(
        scenario.faults == faults for scenario in DataSetSpec(minutes=0.1, recordings=2, faults=faults).scenarios()
    )
    file.write_text('[[faults]]\nkind = "internal_leak"\nsite = "leg"\nsize = 3\nunit = "L/min"\n')
    with pytest.raises(ConfigError, match=r"faults\[0\].*site 'leg' is unknown"):
        read_scenario_file(file)


def test_the_limit_of_predictability_is_that_of_a_sound_machine():
    plan = DataSetSpec(minutes=1.0, recordings=2, faults=("friction:arm:2x",)).scenarios()
    with pytest.raises(ConfigError, match="has faults, and the limit is that of a sound machine"):
        plan_limit(plan, LimitSpec())


def test_what_a_fault_adds_to_the_dead_time_has_room():
    machine = load_machine("M22")
    scenario = Scenario(duration_s=2.0, excitation="reversals", faults=["valve_delay:boom:500ms"])
    late, sound = simulate(scenario), simulate(Scenario(duration_s=2.0, excitation="reversals"))
    moved = [int(np.argmax(np.abs(r.column("SpoolPos_1")) > 0.01)) for r in (late, sound)]
    assert moved[0] - moved[1] == 50
    assert len(Plant(machine, np.full(3, 0.5), spare_s=0.5).past) == len(Plant(machine, np.full(3, 0.5)).past) + 50


def test_a_sound_machine_is_packed_as_before():
    axes, plant = pack(load_machine("C14"))
    assert (axes[:, at.HEAD_LEAK] == axes[:, at.ROD_LEAK]).all()
    assert plant[at.EFFICIENCY] == plant[at.EFFICIENCY_2]
    assert (axes[:, [at.WIDEST, at.CONFLUX_WIDEST]] == 1.0).all()
    assert len(integrator.new_work()) == 11
