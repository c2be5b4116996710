"""The monitor as a whole: streams, alarms, silence, refusals, its folder."""

import json
import re
import sys
from dataclasses import replace

import numpy as np
import pytest

from edp.config.monitor import load_monitor_experiment
from edp.errors import BundleError, ConfigError, DataError, EdpError
from edp.monitor.monitor_file import HEADER, load_monitor, save_monitor
from edp.monitor.watches import _average_blocks, _averages
from edp.recording import Recording
from edp.storage.seals import HASH, content_digest
from edp.testing.monitor import rig_sessions
from edp.workflows.monitor import fit_to_recordings
from edp.workflows.monitor.fit_monitor import _healthy_sessions

from .conftest import EXPERIMENT, TICKS

pytestmark = pytest.mark.long


def with_bias(recording: Recording, channel: str, size: float, onset: int) -> Recording:
    values = recording.values.copy()
    values[onset:, recording.index(channel)] += np.float32(size)
    return replace(recording, values=values)


def statistics_of(verdicts) -> np.ndarray:
    return np.array([verdict.statistics for verdict in verdicts])


@pytest.mark.parametrize(
    ("channel", "size"), [("pressure_a", 1.5e6), ("pressure_b", -1.5e6), ("velocity", 0.02), ("stroke", 0.02)]
)
def test_a_fault_of_each_sensor_is_found_soon_and_not_before(fitted, fresh, channel, size):
    onset = 1200
    found = 0
    for recording in fresh[:4]:
        alarms = fitted.monitor.run(with_bias(recording, channel, size, onset))
        after = [alarm for alarm in alarms if alarm.raised_s > onset / 100.0]
        found += bool(after)
        if after:
            assert after[0].since_s <= after[0].raised_s
            assert any(channel in name for name, _ in after[0].evidence)
    assert found >= 3


def test_healthy_sessions_are_silent_mostly(fitted, fresh):
    alarms = sum(len(fitted.monitor.run(recording)) for recording in fresh)
    assert alarms <= 3


def test_ticks_chunks_and_whole_give_the_same(fitted, fresh):
    monitor, recording = fitted.monitor, with_bias(fresh[0], "pressure_a", 2e6, 300).rows(0, 900)
    whole = list(monitor.verdicts(recording))
    stream = monitor.stream()
    ticks = [stream.step(row) for row in recording.select(monitor.inputs)]
    ends = [tick for tick in ticks if tick.block_ended]
    np.testing.assert_allclose(statistics_of(ends), statistics_of(whole), rtol=1e-3, atol=1e-3)
    assert [bool(tick.alarm) for tick in ends] == [verdict.alarm is not None for verdict in whole]
    state, chunks, rows = monitor.initial_state(), [], recording.select(monitor.inputs)
    for start in range(0, len(rows), 130):
        verdicts, state = monitor.advance(rows[start : start + 130], state)
        chunks += verdicts
    np.testing.assert_allclose(statistics_of(chunks), statistics_of(whole), rtol=1e-3, atol=1e-3)


def test_a_row_by_name_is_the_row_in_order(fitted, fresh):
    monitor = fitted.monitor
    one, two = monitor.stream(), monitor.stream()
    for row in fresh[0].select(monitor.inputs)[:250]:
        a = one.step(row)
        b = two.step(dict(zip(monitor.inputs, row.tolist(), strict=True)))
        assert a == b


def test_a_missing_channel_is_silent_and_the_others_watch(fitted, fresh):
    monitor, onset = fitted.monitor, 1200
    lacking = fresh[1]
    keep = [i for i, name in enumerate(lacking.channel_names) if name != "pressure_b"]
    lacking = Recording("lacking", tuple(lacking.channels[i] for i in keep), lacking.values[:, keep], 100.0)
    assert monitor.check(lacking) == ("pressure_b",)
    rows = monitor.conditioned_rows(lacking)
    silent = np.array(["pressure_b" in name for name in monitor.summary_names])
    assert np.isnan(rows[:, silent]).all()
    # What reads the channel is silent as well; balances of stroke and velocity do not, and go on.
    assert np.isfinite(rows[-1]).any()
    assert not monitor.run(lacking)
    assert monitor.run(with_bias(lacking, "stroke", 0.05, onset))
    stream = monitor.stream()
    row = dict(zip(lacking.channel_names, lacking.values[0].tolist(), strict=True))
    assert stream.step(row).silent == ("pressure_b",)


def test_broken_numbers_spoil_nothing(fitted, fresh):
    recording = fresh[2]
    values = recording.values.copy()
    values[500:520, 1], values[700, 3], values[800:803, 0] = np.inf, 1e30, np.nan
    monitor = fitted.monitor
    broken = monitor.conditioned_rows(replace(recording, values=values))
    sound = monitor.conditioned_rows(recording)
    np.testing.assert_allclose(broken[12:], sound[12:], atol=0.5)


def test_an_unknown_channel_or_shape_of_a_row_is_refused(fitted):
    stream = fitted.monitor.stream()
    with pytest.raises(DataError, match="did you mean 'velocity'"):
        stream.step({"velocty": 0.1})
    with pytest.raises(DataError, match="shape"):
        stream.step([0.0])
    with pytest.raises(DataError, match="numbers"):
        stream.step(["a"] * 5)


def test_another_machine_and_another_rate_are_refused(fitted, fresh):
    recording = fresh[0]
    other = replace(recording, values=(recording.values * 40.0 + 3.0).astype(np.float32))
    with pytest.raises(DataError, match="not of the monitor's machine"):
        fitted.monitor.run(other)
    with pytest.raises(DataError, match="rate_hz"):
        fitted.monitor.run(replace(recording, rate_hz=50.0))


def test_too_few_hours_name_the_rate_that_they_support(healthy):
    with pytest.raises(ConfigError, match=r"supports one in 0\.\d+ h") as ended:
        fit_to_recordings(healthy, load_monitor_experiment(None, (), {"hours_per_false_alarm": 8.0}))
    # What is advised must hold after minutes of training, too, when doubtful sessions are left out.
    advised = float(re.search(r"--hours-per-false-alarm ([\d.]+)", str(ended.value)).group(1))
    experiment = load_monitor_experiment(None, (), {"hours_per_false_alarm": advised})
    rest = _healthy_sessions(healthy, experiment).rest
    assert 0.0 < advised < 0.85 * sum(session.duration_s for session in rest) / 3600.0


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (("chain.block_s=15",), "too few for an operating point"),
        (("chain.block_s=1.1", "chain.folds=2", "train_fraction=0.8"), "too few for a covariance"),
        (
            ("dictionary.machine=M22", "chain.block_s=0.8"),
            "0 stretches of 40 healthy blocks are too few",
        ),
        (("dictionary.machine=M22", "chain.block_s=0.2"), "'M22' has none of the monitor's channels"),
    ],
)
def test_what_no_monitor_can_be_made_from_is_refused_before_a_residual_is_fitted(
    healthy, monkeypatch, changes, message
):
    def called(job):
        pytest.fail("a residual is fitted before the refusal")

    monkeypatch.setattr(sys.modules["edp.workflows.monitor.fit_monitor"], "fit_source", called)
    experiment = load_monitor_experiment(None, changes, {"hours_per_false_alarm": 0.02})
    sessions = healthy if any("M22" in change for change in changes) else healthy[:8]
    with pytest.raises(EdpError, match=message):
        fit_to_recordings(sessions, experiment)


@pytest.mark.parametrize("blocks", [1, 2, 3, 7])
def test_averages_are_counted_as_they_are_made(blocks):
    for length in range(40):
        assert _averages(length, blocks) == len(_average_blocks(np.zeros((length, 2)), blocks))


def test_a_healthy_log_with_a_fault_is_named(healthy, fitted):
    spoilt = list(healthy)
    trained = fitted.monitor.provenance["trained_on"]
    # One that trains residuals, and one that sets the limit.
    faulty = [next(i for i, s in enumerate(spoilt) if (s.name in trained) == training) for training in (True, False)]
    for place in faulty:
        spoilt[place] = with_bias(spoilt[place], "pressure_a", 8e6, 0)
    # Two sessions fewer support a little less.
    doubtful = fit_to_recordings(spoilt, replace(EXPERIMENT, hours_per_false_alarm=0.09)).doubtful
    named = {spoilt[place].name for place in faulty}
    assert {*doubtful} == named


def test_the_folder_gives_the_same_monitor(fitted, fresh, tmp_path):
    folder = save_monitor(fitted.monitor, tmp_path / "monitor")
    loaded = load_monitor(folder)
    assert loaded.inputs == fitted.monitor.inputs
    assert loaded.limit == fitted.monitor.limit
    np.testing.assert_array_equal(loaded.conditioned_rows(fresh[0]), fitted.monitor.conditioned_rows(fresh[0]))
    before = sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*"))
    save_monitor(loaded, folder)
    assert sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*")) == before


@pytest.fixture
def saved(fitted, tmp_path):
    return save_monitor(fitted.monitor, tmp_path / "monitor")


def resealed(folder, change):
    """Change a header and give it a hash that fits: what an attacker would do."""
    header = json.loads((folder / HEADER).read_text())
    change(header)
    header[HASH] = content_digest(header)
    (folder / HEADER).write_text(json.dumps(header))


CHANGES = {
    "schema": lambda h: h.update(schema=99),
    "schema true": lambda h: h.update(schema=True),
    "rate": lambda h: h.update(rate_hz=-1.0),
    "no channels": lambda h: h.update(channels=[]),
    "channel twice": lambda h: h["channels"].append(h["channels"][0]),
    "unit": lambda h: h["channels"][0].update(unit="furlong"),
    "source": lambda h: h["sources"][0].update(kind="evil"),
    "no sources": lambda h: h.update(sources=[]),
    "path out": lambda h: [n.update(folder="../../etc") for n in h["sources"][0]["networks"].values()],
    "block": lambda h: h["chain"]["summaries"].update(block=10**15),
    "settle": lambda h: h["chain"].update(settle=-1),
    "clip": lambda h: h["chain"].update(clip="a"),
    "detector": lambda h: h["chain"]["watches"][0].update(detector={"kind": "glr", "window": 10**12}),
    "watches": lambda h: h["chain"].update(watches=[]),
    "scale": lambda h: h["chain"]["watches"][0].update(scale=0.0),
    "limit": lambda h: h["limit"].update(alarms="many"),
    "nested": lambda h: h.update(chain=[[[[]]]]),
    "arrays": lambda h: h["arrays"].update(file="../../other.safetensors"),
}


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES)
def test_hostile_headers_end_in_one_message(saved, change):
    resealed(saved, change)
    with pytest.raises(BundleError) as error:
        load_monitor(saved)
    assert str(saved) in str(error.value)
    assert len(str(error.value)) < 2000


def test_flipped_bytes_are_refused(saved):
    rng = np.random.default_rng(0)
    for file in [path for path in saved.rglob("*") if path.is_file()]:
        data = file.read_bytes()
        for place in rng.integers(0, len(data), 3).tolist():
            flipped = bytearray(data)
            flipped[place] ^= 1 << int(rng.integers(0, 8))
            file.write_bytes(bytes(flipped))
            with pytest.raises(BundleError):
                load_monitor(saved)
        file.write_bytes(data)
    load_monitor(saved)


def test_a_folder_that_is_no_monitor(tmp_path):
    with pytest.raises(BundleError, match="edp monitor fit"):
        load_monitor(tmp_path)
    (tmp_path / HEADER).write_text("[" * 100_000)
    with pytest.raises(BundleError):
        load_monitor(tmp_path)


def test_a_rig_of_three_channels_and_one_hertz():
    """Other machines: few channels, a slow rate, sessions of a minute."""
    sessions = []
    for session in rig_sessions(60, 6000, seed=9):
        values = session.values[::100][:, [0, 1, 3]]
        sessions.append(Recording(session.name, tuple(session.channels[i] for i in (0, 1, 3)), values, 1.0))
    experiment = load_monitor_experiment(None, (), {"hours_per_false_alarm": 0.3, "minutes": 0.05})
    monitor = fit_to_recordings(sessions, experiment).monitor
    assert monitor.chain.summaries.block >= 2
    assert np.isfinite(monitor.conditioned_rows(sessions[0])[-1]).any()


def test_a_fit_is_repeatable(healthy):
    one, two = (fit_to_recordings(healthy[:16], replace(EXPERIMENT, hours_per_false_alarm=0.07)) for _ in range(2))
    assert one.monitor.chain.limit == two.monitor.chain.limit
    assert healthy[0].samples == TICKS
