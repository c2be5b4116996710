"""Every registered fault: nothing at its neutral size, nothing before its onset, the same bits in every form."""

import pickle

import numpy as np
import pytest

from edp.signals import EXTRA_CHANNELS, TABLE_A1
from edp.sim import Scenario, Simulation, Snapshot, load_machine, simulate
from edp.sim.environment import ExcavatorEnv, VectorExcavatorEnv
from edp.sim.environment.spec import EnvironmentSpec
from edp.sim.faults import FAULTS, FaultSpec, MachineFault, SensorFault, fault_text, insert_site, ladder, parse_fault
from edp.sim.faults.course import MachineCourse, SensorCourse, numbers_of, shares_at
from edp.sim.faults.shown import list_falsified
from edp.sim.machine import layout as at
from edp.sim.sensors import chain, draws, sensors
from edp.sim.start import seeds_of

ONSET_S, ONSET = 1.0, 100
CHANNELS = len(TABLE_A1) + len(EXTRA_CHANNELS)
OBSERVED = (*TABLE_A1, *EXTRA_CHANNELS)
SIZED = [name for name, kind in FAULTS.items() if kind.units]


def scenario_of(*faults, **changes):
    # Moves at full lever into the ends reach reliefs, power limit and checks within seconds.
    return Scenario(**{"excitation": "end_stops", "duration_s": 4.0, "seed": 4, "faults": faults, **changes})


def largest(name, **changes):
    """The largest size of a kind's ladder at its first site; random losses are made frequent."""
    kind = FAULTS[name]
    size = {"size": 20.0 if "dropouts" in name else kind.ladder[-1], "unit": kind.unit} if kind.units else {}
    return FaultSpec(name, (*kind.sites, "")[0], **size, **changes)


@pytest.fixture(scope="module")
def sound():
    return simulate(scenario_of())


@pytest.fixture(scope="module")
def faulty():
    """A recording with each kind at its largest size."""
    return {name: simulate(scenario_of(largest(name, onset_s=ONSET_S))) for name in FAULTS}


@pytest.mark.parametrize("name", SIZED)
def test_the_neutral_size_gives_the_bits_of_a_sound_machine(name, sound):
    kind = FAULTS[name]
    for site in kind.sites[:2] or ("",):
        fault = FaultSpec(name, site, kind.neutral, kind.unit, onset_s=0.5)
        np.testing.assert_array_equal(simulate(scenario_of(fault)).values[:, :CHANNELS], sound.values)


@pytest.mark.parametrize("name", list(FAULTS))
def test_a_fault_begins_at_its_onset_and_not_before(name, sound, faulty):
    values = faulty[name].values[:, :CHANNELS]
    np.testing.assert_array_equal(values[:ONSET], sound.values[:ONSET])
    # What changes the machine shows in its state one tick later at the earliest.
    assert (values[ONSET:] != sound.values[ONSET:]).any()


@pytest.mark.parametrize("name", [name for name in SIZED if len(FAULTS[name].ladder) > 1])
def test_a_larger_fault_shows_more(name, sound):
    kind = FAULTS[name]
    size = np.maximum(sound.values.std(axis=0), 1e-6)

    def effect(fault_size):
        fault = FaultSpec(name, (*kind.sites, "")[0], fault_size, kind.unit, ONSET_S)
        change = (simulate(scenario_of(fault)).values[ONSET:, :CHANNELS] - sound.values[ONSET:]) / size
        return np.square(change).sum()

    least, most = effect(kind.ladder[0]), effect(kind.bound.high if "dropouts" in name else kind.ladder[-1])
    assert least < most


@pytest.mark.parametrize("name", list(FAULTS))
def test_sensors_change_what_is_shown_and_machines_what_happens(name, sound, faulty):
    truth = [*(f"JointAngle_{i}" for i in (1, 2, 3)), *(f"SpoolPos_{j}" for j in range(1, 7))]
    same = (faulty[name].select(truth) == sound.select(truth)).all()
    assert same == isinstance(FAULTS[name], SensorFault) or name == "cooler"


@pytest.mark.parametrize("name", list(FAULTS))
def test_places_units_and_ladder_are_sound(name):
    kind = FAULTS[name]
    assert isinstance(kind, MachineFault | SensorFault)
    assert kind.text == kind.text.strip(" .")
    assert kind.text[0].islower()
    assert len(set(kind.sites)) == len(kind.sites)
    assert bool(kind.units) == bool(kind.ladder)
    assert list(kind.ladder) == sorted(set(kind.ladder))
    for fault in ladder([name], everywhere=True):
        assert parse_fault(fault_text(fault)) == fault
        assert FaultSpec(**fault.to_dict()) == fault
    if isinstance(kind, SensorFault):
        assert tuple(kind.channels) == (kind.sites or ("",))
        assert len(set(kind.channels.values())) == len(kind.channels)
        assert all(0 <= channel < chain.SENSED for pair in kind.channels.values() for channel in pair)


@pytest.mark.parametrize("name", list(FAULTS))
def test_parts_and_words_are_whole_sentences_at_every_site(name):
    kind = FAULTS[name]
    for site in kind.sites or ("",):
        words = insert_site(kind.words, site)
        assert "{" not in kind.component(site)
        # A size is reported where there is one, and its sign where it may have either.
        assert ("{size}" in words) == bool(kind.units)
        assert ("{high}" in words or "{large}" in words) == kind.signed
        for key in ("{size}", "{high}", "{large}"):
            words = words.replace(key, "x")
        assert "{" not in words
    parts = {kind.component(site) for site in kind.sites or ("",)}
    assert len(parts) > 1 or len(kind.sites) < 2 or name == "velocities_swapped"


@pytest.mark.parametrize("name", [name for name, kind in FAULTS.items() if isinstance(kind, MachineFault)])
def test_places_change_numbers_of_their_own(name):
    """Each site of a kind changes other numbers, and on both machines they stay usable."""
    for machine in ("M22", "C14"):
        sound_numbers = numbers_of(Simulation(scenario_of(machine=machine)).plant)
        seen = set()
        for site in FAULTS[name].sites or ("",):
            numbers = sound_numbers.copy()
            FAULTS[name].change(numbers, site, largest(name).full)
            pairs = zip(numbers.arrays, sound_numbers.arrays, strict=True)
            differ = tuple(tuple(np.flatnonzero(a.ravel() != b.ravel()).tolist()) for a, b in pairs)
            assert any(differ)
            assert all(np.isfinite(array).all() for array in numbers.arrays)
            seen.add(differ)
        assert len(seen) == len(FAULTS[name].sites or ("",))


def groups():
    """All kinds, at most eight a scenario, with every way to come and go."""
    names = list(FAULTS)
    times = [{}, {"on_s": 0.3, "off_s": 0.2}, {"ramp_s": 1.5}, {"ramp_s": 2.0, "on_s": 0.7, "off_s": 0.1}]
    for first in range(0, len(names), 8):
        faults = []
        for n, name in enumerate(names[first : first + 8]):
            how = dict(times[n % 4])
            if not FAULTS[name].units:
                how.pop("ramp_s", None)
            faults.append(largest(name, onset_s=0.2 * n, **how))
        yield tuple(faults)


GROUPS = list(groups())


def levers_of(simulation):
    return simulation.targets[:-1]


@pytest.mark.parametrize("number", range(len(GROUPS)))
def test_an_episode_is_the_recording_to_the_bit(number):
    """The machine of even groups has the full model of sensors, and soil."""
    where = {"machine": "C14", "material": "clay", "excitation": "dig"} if number % 2 else {"step_s": 2.5e-3}
    scenario = scenario_of(*GROUPS[number], **where)
    simulation = Simulation(scenario)
    log = simulation.run(scenario.samples)
    shifted = log.copy()
    demands = slice(at.LOG_DEMAND, at.LOG_DEMAND + at.SPOOLS)
    # An observation knows the lever before it.
    shifted[1:, demands], shifted[0, demands] = log[:-1, demands], 0.0
    seeds, faults = seeds_of(scenario), SensorCourse(scenario.faults)
    drawn = draws.draw(simulation.machine, len(log), 100.0, np.random.default_rng(seeds[2]))
    drawn = faults.drawn(drawn, 100.0, np.random.default_rng(seeds[4]))
    kelvin = log[:, at.LOG_OIL] + 273.15
    shown = sensors.observe_signals(shifted, simulation.machine, 100.0, True, drawn, kelvin, faults.table)
    truth = sensors.truth_signals(shifted) | {name: shown[:, n] for name, n in sensors.shown_names().items()}
    whole = np.column_stack((shown[:, : len(TABLE_A1)], *(truth[name] for name in EXTRA_CHANNELS)))

    keys = ("machine", "material", "duration_s", "step_s", "faults")
    settings = {key: getattr(scenario, key) for key in keys}
    env = ExcavatorEnv(**settings, observed=OBSERVED, hand=simulation.operator.by_hand)
    observation, info = env.reset(seed=scenario.seed)
    observations, shares = [observation], [[info["truth"][f"Fault_{n + 1}"] for n in range(len(scenario.faults))]]
    assert info["faults"] == "; ".join(map(fault_text, scenario.faults))
    for lever in levers_of(simulation):
        observation, *_, info = env.step(lever)
        observations.append(observation)
        shares.append([info["truth"][f"Fault_{n + 1}"] for n in range(len(scenario.faults))])
    np.testing.assert_array_equal(np.array(observations), whole.astype(np.float32))
    recording = simulation.recording()
    np.testing.assert_array_equal(np.array(shares, np.float32), recording.values[:, -len(scenario.faults) :])
    # A recording shows each pilot pressure a tick earlier, and nothing else.
    others = [n for n, name in enumerate(OBSERVED) if n not in range(chain.PILOTS, len(TABLE_A1))]
    rows = [recording.index(OBSERVED[n]) for n in others]
    np.testing.assert_array_equal(np.array(observations)[:, others], recording.values[:, rows])


def test_side_by_side_each_has_its_own_faults():
    each = [EnvironmentSpec(duration_s=1.0, faults=faults) for faults in ((), *GROUPS[:3])]
    together = VectorExcavatorEnv(4, each)
    alone = [ExcavatorEnv(settings) for settings in each]
    first, infos = together.reset(seed=3)
    np.testing.assert_array_equal(first, [env.reset(seed=3 + n)[0] for n, env in enumerate(alone)])
    assert infos["_faults"].tolist() == [False, True, True, True]
    levers = np.random.default_rng(1).uniform(-1, 1, (99, 4, 3))
    for rows in levers:
        observations, *_, infos = together.step(rows)
        steps = [env.step(lever) for env, lever in zip(alone, rows, strict=True)]
        np.testing.assert_array_equal(observations, [step[0] for step in steps])
        assert np.isnan(infos["truth"]["Fault_1"][0])
        assert infos["truth"]["Fault_3"][2] == steps[2][4]["truth"]["Fault_3"]
    # What is true travels between processes, and stays what it was.
    copy = pickle.loads(pickle.dumps(infos["truth"]))
    together.reset(seed=1)
    np.testing.assert_array_equal(copy["Fault_3"], infos["truth"]["Fault_3"])
    assert set(copy) == set(infos["truth"])


def test_snapshots_and_branches_carry_the_faults():
    env = ExcavatorEnv(duration_s=3.0, faults=GROUPS[1])
    levers = np.random.default_rng(2).uniform(-1, 1, (250, 3))
    env.reset(seed=7)
    for lever in levers[:120]:
        env.step(lever)
    moment = env.snapshot()
    rest = [env.step(lever)[0] for lever in levers[120:]]
    env.restore(moment)
    np.testing.assert_array_equal([env.step(lever)[0] for lever in levers[120:]], rest)
    # Another environment, whose settings have no faults, goes on with those of the moment.
    other = ExcavatorEnv(duration_s=3.0)
    other.restore(moment)
    np.testing.assert_array_equal([other.step(lever)[0] for lever in levers[120:]], rest)
    env.restore(moment)
    env.branch(seed=5)
    steps = [env.step(lever) for lever in levers[120:]]
    assert any((step[0] != row).any() for step, row in zip(steps, rest, strict=True))
    want = shares_at(GROUPS[1], np.arange(121, 251), 100.0)
    assert [[step[4]["truth"][f"Fault_{n + 1}"] for n in range(len(GROUPS[1]))] for step in steps] == want.tolist()


@pytest.mark.parametrize("material", ["", "clay"])
def test_a_simulation_goes_on_from_a_snapshot(material, tmp_path):
    faults = (largest("slow_spool", ramp_s=2.0), largest("valve_delay", onset_s=1.0), largest("attachment_mass"))
    scenario = scenario_of(*faults, material=material)
    whole, pieces = simulate(scenario), Simulation(scenario)
    pieces.run(133)
    moment = pieces.snapshot()
    rest = pieces.run(267)
    pieces.restore(moment)
    np.testing.assert_array_equal(pieces.run(267), rest)
    assert pieces.recording().digest == whole.digest
    again = Simulation.from_snapshot(Snapshot.load(moment.save(tmp_path / "moment.npz")))
    again.run(267)
    assert again.recording().digest == whole.digest
    assert again.recording().meta == whole.meta


def test_changes_of_an_episode_are_what_a_plant_is_given():
    """The table of changes, applied one after another, gives the numbers of every tick."""
    faults = GROUPS[0]
    plant = Simulation(scenario_of(*faults)).plant
    course = MachineCourse(faults, numbers_of(plant))
    changes, live, table = course.changes(300), numbers_of(plant).copy(), numbers_of(plant).copy()
    for tick in range(300):
        course.write(tick, live)
        for _, block, within, value in changes[changes[:, 0] == tick]:
            table.arrays[int(block)].reshape(-1)[int(within)] = value
        for one, other in zip(live.arrays, table.arrays, strict=True):
            np.testing.assert_array_equal(one, other)


def test_noise_grows_by_its_factor():
    machine = load_machine("C14")
    rng = np.random.default_rng(0)
    healthy = draws.draw(machine, 3000, 100.0, rng)
    faults = (FaultSpec("pressure_noise", "arm_rod", 10.0, "x"), FaultSpec("velocity_noise", "boom", 3.0, "x", 10.0))
    drawn = SensorCourse(faults).drawn(healthy, 100.0, rng)
    assert drawn.shape == healthy.shape
    ratio = drawn.std(axis=0)[chain.PRESSURE_ERROR :] / healthy.std(axis=0)[chain.PRESSURE_ERROR :]
    np.testing.assert_allclose(ratio, [1, 1, 1, 1, 10, 1])
    np.testing.assert_array_equal(drawn[:1000, chain.RATE_ERROR], healthy[:1000, chain.RATE_ERROR])
    np.testing.assert_allclose(drawn[1000:, chain.RATE_ERROR], 3.0 * healthy[1000:, chain.RATE_ERROR])


def test_channels_of_a_sensor_fault_are_those_that_change():
    """What a fault is said to falsify differs from a sound recording, and no other sensor's value does."""
    sound = simulate(Scenario(duration_s=2.0, seed=3))
    for kind, site, size in (("pressure_bias", "arm_rod", "10bar"), ("velocity_noise", "bucket", "10x")):
        faulty = simulate(Scenario(duration_s=2.0, seed=3, faults=[f"{kind}:{site}:{size}@0s"]))
        names = [name for name in sound.channel_names if not name.startswith("CylAcc")]
        changed = {name for name in names if not np.array_equal(sound.column(name), faulty.column(name))}
        assert changed == set(list_falsified(kind, site))
    assert list_falsified("head_rod_swapped", "boom") == ("CylPressures_1", "CylPressures_5")
    assert list_falsified("temperature_offset", "") == ("OilTemperature",)
    assert list_falsified("internal_leak", "boom") == ()
