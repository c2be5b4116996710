"""Fault sessions, a small dictionary through a small monitor, traces and the folder of a run."""

import json
from dataclasses import replace

import numpy as np
import pytest

from edp.config.monitor import DictionarySpec, load_monitor_experiment
from edp.errors import ConfigError, StorageError
from edp.monitor.diagnosis.causes import Cause
from edp.monitor.diagnosis.diagnose import onset_of
from edp.monitor.monitor_file import load_monitor, save_monitor
from edp.monitor.traces import RecordingTrace, RunTraces, pooled, read_traces, write_traces
from edp.recording import Recording
from edp.signals import VOCABULARY
from edp.sim import Scenario, simulate
from edp.workflows.monitor import build_dictionary, fit_to_recordings
from edp.workflows.monitor.dictionary import machine_of
from edp.workflows.monitor.fault_sessions import add_noise, cases_of, fault_classes, mirrors, noise_of, simulated
from edp.workflows.monitor.report_monitor import read_alarms, read_run

KINDS = ("velocity_bias", "velocities_swapped")
NAMES = ("BmUp", "BmDwn", "CylVels_1", "CylVels_2", "CylVels_3", "CylStroke_1", "CylStroke_2", "CylStroke_3")


def test_the_largest_sizes_are_simulated_and_negative_ones_mirror_them():
    classes = fault_classes(["velocity_bias", "velocity_stuck"])
    assert [fault.name for fault in classes[:2]] == ["velocity_bias:boom", "velocity_bias:boom:-"]
    assert cases_of(classes)[:3] == [(0, 2.0), (0, 10.0), (2, 2.0)]
    assert mirrors(classes) == {0: 1, 2: 3, 4: 5}
    assert cases_of(classes)[-1] == (8, 0.0)


def test_a_fault_session_is_its_sound_twin_before_the_onset_and_with_sensor_faults_but_for_the_channel():
    sessions = list(simulated(fault_classes(["velocity_bias"])[:1], "M22", (2.0, 3.0), (0, 0), 100.0))
    sound = {session.base: session.recording for session in sessions if session.fault < 0}
    for session in sessions[len(sound) :]:
        twin = sound[session.base].select(NAMES)
        values = session.recording.select(NAMES)
        assert np.array_equal(values[:200], twin[:200])
        off = values[200:] - twin[200:]
        assert off[:, 2] == pytest.approx(session.size * 1e-3, abs=1e-4)
        assert not np.delete(off, 2, axis=1).any()
    again = list(simulated(fault_classes(["velocity_bias"])[:1], "M22", (2.0, 3.0), (0, 0), 100.0))
    assert [one.recording.digest for one in again] == [one.recording.digest for one in sessions]


def test_noise_of_a_log_is_measured_and_added():
    recording = simulate(Scenario(duration_s=12.0, seed=3))
    assert noise_of(recording, ["CylStroke_1"])["CylStroke_1"] < 2e-5
    noisy = add_noise(recording, {"CylStroke_1": 1e-4, "CylStroke_2": 0.0}, [1])
    assert noise_of(noisy, ["CylStroke_1"])["CylStroke_1"] == pytest.approx(1e-4, rel=0.2)
    assert np.array_equal(noisy.column("CylStroke_2"), recording.column("CylStroke_2"))


def test_the_machine_is_that_of_the_settings_or_of_the_logs():
    recording = simulate(Scenario(duration_s=0.1))
    named = replace(recording, meta={"machine": "M22"})
    assert machine_of(DictionarySpec(), [named, named]) == "M22"
    assert machine_of(DictionarySpec(), [named, replace(recording, meta={"machine": "C14"})]) == ""
    # A log does not lead to files.
    assert machine_of(DictionarySpec(), [replace(recording, meta={"machine": "/etc/passwd.toml"})]) == ""
    assert machine_of(DictionarySpec(machine="none"), [named]) == ""
    assert machine_of(DictionarySpec(machine="C14"), [named]) == "C14"
    with pytest.raises(ConfigError, match="draws"):
        DictionarySpec(draws=1)


@pytest.fixture(scope="module")
def machine_logs():
    """Healthy sessions of the simulator, a few channels of them."""
    channels = tuple(VOCABULARY[name] for name in NAMES)
    sessions = []
    for seed in range(14):
        recording = simulate(Scenario(duration_s=60.0, seed=100 + seed))
        sessions.append(Recording(f"s{seed}", channels, recording.select(NAMES), 100.0, meta={"machine": "M22"}))
    return sessions


@pytest.fixture(scope="module")
def monitor(machine_logs):
    options = {
        "hours_per_false_alarm": 0.1, "minutes": 0.1,
        "dictionary": {"kinds": list(KINDS), "draws": 2, "before_s": 8.0, "after_s": 24.0},
    }  # fmt: skip
    return fit_to_recordings(machine_logs, load_monitor_experiment(None, (), options)).monitor


@pytest.mark.long
def test_a_monitor_of_a_known_machine_has_a_dictionary_that_comes_back(monitor, machine_logs, tmp_path):
    known = monitor.diagnosis
    assert {fault.kind for fault in known.classes} == set(KINDS)
    assert known.provenance["draws"] == 2
    loaded = load_monitor(save_monitor(monitor, tmp_path / "m"))
    assert np.allclose(loaded.diagnosis.signatures, known.signatures, atol=1e-5)
    # A monitor without one leaves no old dictionary behind.
    assert load_monitor(save_monitor(replace(monitor, diagnosis=None), tmp_path / "m")).diagnosis is None


@pytest.mark.long
def test_an_alarm_is_named_in_batch_and_in_a_stream(monitor):
    recording = simulate(Scenario(duration_s=60.0, seed=300, faults=["velocity_bias:boom:10mm/s@30s"]))
    alarms = [alarm for alarm in monitor.watch(recording).alarms if alarm.raised_s > 30.0]
    assert alarms
    assert alarms[0].causes[0].component == "sensor of boom velocity"
    assert f"since 0:00:{round(alarms[0].since_s):02d}" in alarms[0].sentence
    assert sum(cause.probability for cause in alarms[0].causes) <= 1.0 + 1e-9
    stream = monitor.stream()
    raised = [step.alarm for step in map(stream.step, recording.select(monitor.inputs)) if step.alarm is not None]
    assert [alarm.raised_s for alarm in raised if alarm.raised_s > 30.0] == [alarm.raised_s for alarm in alarms]
    assert all(alarm.causes for alarm in raised)


@pytest.mark.long
def test_another_machine_without_the_channels_is_refused(fitted, healthy):
    with pytest.raises(ConfigError, match="has none of the monitor's channels"):
        build_dictionary(fitted.monitor, healthy, "M22", DictionarySpec())


def test_a_fault_that_stays_is_known_since_its_first_alarm():
    assert onset_of(50, [(10, 20), (20, 50)]) == 10
    assert onset_of(55, [(10, 20), (20, 50)]) == 55
    assert onset_of(5, []) == 5


def traces():
    rng = np.random.default_rng(0)
    recording = RecordingTrace(
        "a", "", 30.0, rng.random((30, 2)).astype(np.float32), np.full((30, 1), np.nan, np.float32), ("g",)
    )
    return RunTraces(1.0, ("cusum 1", "ewma 2"), ("g",), (recording,))


def test_traces_come_back_and_damage_is_refused(tmp_path):
    write_traces(tmp_path, traces())
    back = read_traces(tmp_path)
    assert np.array_equal(back.recordings[0].ratios, traces().recordings[0].ratios)
    assert np.isnan(back.recordings[0].groups).all()
    assert back.recordings[0].silent == ("g",)
    data = (tmp_path / "traces.safetensors").read_bytes()
    (tmp_path / "traces.safetensors").write_bytes(data[:-4])
    with pytest.raises(StorageError, match="does not match its hash"):
        read_traces(tmp_path)


def test_pools_keep_the_largest_value():
    values = np.zeros((1001, 1), np.float32)
    values[700] = 5.0
    small, factor = pooled(values, 100)
    assert len(small) <= 100
    assert small.max() == 5.0
    assert small[700 // factor, 0] == 5.0


def alarm_line(**changes):
    cause = Cause("k", "s", "part", "sensor", 1.0, "bar", 0.9, "reads 1 bar too high", 0.5).to_dict()
    entry = {
        "recording": "a", "raised_s": 3.0, "since_s": 1.0, "detector": "cusum 1", "statistic": 2.0, "limit": 1.0,
        "evidence": [["x.mean", 2.0]], "causes": [cause], "sentence": "x", "severity": "note",
    }  # fmt: skip
    return json.dumps(entry | changes)


@pytest.mark.parametrize(
    "changes",
    [
        {"raised_s": "soon"}, {"severity": "fatal"}, {"evidence": [["x"]]}, {"causes": [{"site": "s"}]},
        {"causes": [1] * 99}, {"sentence": 5}, {"recording": "x" * 9999},
    ],
)  # fmt: skip
def test_a_damaged_line_of_the_alarm_log_is_one_message_with_its_number(changes, tmp_path):
    file = tmp_path / "alarms.jsonl"
    file.write_text(alarm_line() + "\n")
    assert read_alarms(file)[0].causes[0].component == "part"
    file.write_text(alarm_line() + "\n" + alarm_line(**changes) + "\n")
    with pytest.raises(StorageError, match="line 2"):
        read_alarms(file)


def test_a_folder_that_is_no_run_is_refused(tmp_path):
    with pytest.raises(StorageError, match=r"is not a run of edp monitor run: it has no alarms\.jsonl"):
        read_run(tmp_path)
