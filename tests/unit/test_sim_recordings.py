import dataclasses

import numpy as np
import pytest

from edp.data.splits import ByRecording
from edp.errors import ConfigError
from edp.recording import Recording
from edp.signals import EXTRA_CHANNELS, MOTOR_CHANNELS, TABLE_A1
from edp.sim import (
    EXCITATIONS,
    Scenario,
    load_machine,
    machine_names,
    plan,
    plan_data_set,
    simulate,
    simulate_many,
)
from edp.sim.machine.family import member_mass
from edp.sim.machine.machine_files import parse_machine
from edp.sim.plan import hand_out
from edp.sim.sensors.filters import filtered_derivative

pytestmark = pytest.mark.processes

SHORT = 4.0


def test_unknown_machine_offers_the_closest():
    with pytest.raises(ConfigError, match="did you mean 'M22'"):
        load_machine("M2")
    assert "M22" in machine_names()
    assert load_machine("m22") is load_machine("m22")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("name = ", "not valid TOML"),
        ("name = 'x'", "'arm_cylinder' is missing"),
        ("[oil]\nviscosity = 1", "'oil.air_fraction' is missing"),
    ],
)
def test_bad_machine_files_say_what_is_wrong(text, message):
    with pytest.raises(ConfigError, match=message):
        parse_machine(text, "x.toml")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"excitation": "combine"}, "did you mean 'combined'"),
        ({"machine": "M99"}, "unknown machine"),
        ({"duration_s": 0.0}, "duration_s = 0.0 must be a positive number"),
        ({"duration_s": float("nan")}, "must be a positive number"),
        ({"duration_s": 0.01}, "less than two samples"),
        ({"step_s": 0.01}, "above 0.0025"),
        ({"seed": -1}, "must not be negative"),
    ],
)
def test_scenarios_refuse_bad_values(change, message):
    with pytest.raises(ConfigError, match=message):
        Scenario(**change)


def test_a_step_must_divide_the_sample_time():
    with pytest.raises(ConfigError, match="does not divide the sample time"):
        simulate(Scenario(step_s=3e-4))


def test_a_recording_of_a_family_knows_its_machine_and_mass():
    recording = simulate(Scenario(machine="family-3-1-12-14", duration_s=0.5))
    assert recording.meta["machine"] == "family-3-1-12-14"
    assert recording.meta["mass_t"] == round(member_mass(3, 1, 12.0, 14.0), 3)
    assert "mass_t" not in simulate(Scenario(duration_s=0.5)).meta


@pytest.mark.parametrize("excitation", list(EXCITATIONS))
def test_recording_has_table_a1_first_in_si_units(excitation):
    seen = []
    recording = simulate(Scenario(excitation=excitation, duration_s=20.0, seed=5), seen.append)
    motors = MOTOR_CHANNELS if EXCITATIONS[excitation].swings else ()
    assert recording.channel_names == (*TABLE_A1, *EXTRA_CHANNELS, *motors)
    assert recording.samples == 2000
    assert recording.source == "sim:M22"
    assert recording.meta["excitation"] == excitation
    assert recording.meta["clamps"] >= 0
    assert np.isfinite(recording.values).all()
    assert seen == sorted(seen)
    assert seen[-1] == 1.0
    pilots = recording.select([name for name, c in TABLE_A1.items() if c.kind == "pilot_pressure"])
    assert pilots.min() == 0.0
    assert 10e5 < pilots.max() <= 35e5 * (1 + 1e-6)
    for up, down in (("BmUp", "BmDwn"), ("AmIn", "AmOut"), ("BktIn", "BktOut")):
        assert not (recording.column(up) * recording.column(down)).any()
    strokes = recording.select(["CylStroke_1", "CylStroke_2", "CylStroke_3"])
    assert strokes.min() > -0.02
    np.testing.assert_allclose(
        np.diff(strokes, axis=0).mean(axis=0), recording.values[:, :3].mean(axis=0) / 100, atol=2e-5
    )


def test_extension_follows_up_in_in_and_retraction_the_others():
    recording = simulate(Scenario(duration_s=120, seed=2))
    for i, (extend, retract) in enumerate((("BmUp", "BmDwn"), ("AmIn", "AmOut"), ("BktIn", "BktOut"))):
        later = recording.column(f"CylVels_{i + 1}")[15:]
        assert later[recording.column(extend)[:-15] > 15e5].mean() > 0.02
        assert later[recording.column(retract)[:-15] > 15e5].mean() < -0.02


def test_noise_is_light_white_and_optional():
    noisy, clean = (simulate(Scenario(duration_s=SHORT, sensor_noise=on)) for on in (True, False))
    sensors = load_machine("M22").sensors
    error = noisy.values[:, :3] - clean.values[:, :3]
    assert error.std() == pytest.approx(sensors.velocity, rel=0.15)
    assert abs(np.mean(error[1:] * error[:-1])) < 0.15 * error.var()
    names = [name for name in TABLE_A1 if name.startswith("CylPressures")]
    assert (noisy.select(names) - clean.select(names)).std() == pytest.approx(sensors.pressure, rel=0.15)
    np.testing.assert_array_equal(noisy.select(list(EXTRA_CHANNELS)), clean.select(list(EXTRA_CHANNELS)))


def test_acceleration_is_the_delayed_derivative():
    time = np.arange(400) / 100
    values = np.sin(2 * np.pi * time)[:, None]
    derivative = filtered_derivative(values, 9.0, 100.0)[200:, 0]
    truth = 2 * np.pi * np.cos(2 * np.pi * time)[200:]
    assert np.abs(derivative).max() == pytest.approx(2 * np.pi, rel=0.02)
    late = np.argmax([derivative[10:] @ truth[10 - k : len(truth) - k] for k in range(10)])
    assert 1 <= late <= 4


def test_plan_spreads_the_mix_and_the_seeds():
    scenarios = plan_data_set("M22", 60.0, 20, seed=3)
    assert sum(s.duration_s for s in scenarios) == pytest.approx(3600)
    assert len({s.seed for s in scenarios}) == 20
    assert scenarios[3].name == f"m22_003_{scenarios[3].excitation}"
    kinds = [s.excitation for s in scenarios]
    assert [kinds.count(name) for name in plan.DEFAULT_MIX] == [4, 5, 3, 3, 2, 2, 1]
    assert scenarios == plan_data_set("M22", 60.0, 20, seed=3)
    assert scenarios != plan_data_set("M22", 60.0, 20, seed=4)
    only = plan_data_set("M22", 1.0, 2, seed=0, mix={"isolated": 2.0})
    assert [s.excitation for s in only] == ["isolated", "isolated"]


def test_families_are_handed_out_in_proportion_from_the_first_recording_on():
    whole = hand_out(plan.DEFAULT_MIX, 100)
    assert {name: whole.count(name) / 100 for name in plan.DEFAULT_MIX} == plan.DEFAULT_MIX
    assert whole[:2] == ["combined", "isolated"]
    assert set(whole[:7]) == set(plan.DEFAULT_MIX)
    for count in range(7, 100):
        assert whole[:count] == hand_out(plan.DEFAULT_MIX, count)
        for name, share in plan.DEFAULT_MIX.items():
            assert abs(whole[:count].count(name) - count * share) < 1
    assert hand_out({"a": 0.0, "b": 1.0}, 2) == ["b", "b"]


def test_a_held_out_fifth_has_every_family():
    empty = np.zeros((100, 0), np.float32)
    scenarios = plan_data_set("M22", 60.0, 60, seed=1)
    logged = [Recording(s.name, (), empty, 100.0, meta={"excitation": s.excitation}) for s in scenarios]
    for seed in range(10):
        split = ByRecording(seed=seed).split(logged, 10)
        assert len(split.test) == 12
        for part in (split.train, split.validation, split.test):
            assert {logged[s.recording].meta["excitation"] for s in part} == set(plan.DEFAULT_MIX)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"recordings": 0}, "recordings = 0; integers, 1 <= recordings <= 100,000 must hold"),
        ({"minutes": -1.0}, "minutes = -1.0; 0.0001 <= minutes <= 1,000,000 must hold"),
        ({"mix": {"isolatd": 1.0}}, "did you mean 'isolated'"),
        ({"mix": {"isolated": -1.0}}, "must not be negative"),
        ({"mix": {"isolated": 0.0}}, "add up to nothing"),
    ],
)
def test_plan_refuses_bad_values(change, message):
    with pytest.raises(ConfigError, match=message):
        plan_data_set(**{"machine": "M22", "minutes": 1.0, "recordings": 2, "seed": 0, **change})


def test_the_same_seed_gives_the_same_bits_for_any_number_of_workers():
    scenarios = [dataclasses.replace(s, duration_s=SHORT) for s in plan_data_set("M22", 1.0, 3, seed=9)]
    done = []
    alone = list(simulate_many(scenarios, 1, done.append))
    together = list(simulate_many(scenarios, 2))
    assert [r.name for r in together] == [s.name for s in scenarios] == [r.name for r in done]
    assert [r.digest for r in alone] == [r.digest for r in together]
    assert len({r.digest for r in alone}) == 3


def test_mean_strokes_stay_near_the_middle():
    runs = [simulate(Scenario(duration_s=150, seed=seed)) for seed in range(3)]
    strokes = np.concatenate([r.select(["CylStroke_1", "CylStroke_2", "CylStroke_3"]) for r in runs])
    share = strokes.mean(axis=0) / load_machine("M22").cylinders.stroke
    assert (np.abs(share - 0.5) < 0.17).all(), share
