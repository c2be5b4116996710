"""A recurrent twin that goes on with the recordings of another machine: `edp twin LOGS --start RUN`."""

from dataclasses import replace

import numpy as np
import pytest

from edp.config.twin import load_twin_experiment
from edp.data.series import Series
from edp.data.twin_channels import twin_channels
from edp.errors import ConfigError, DataError
from edp.logs import write_recording
from edp.logs.source import DataSource
from edp.networks.twin import fit_scales
from edp.networks.twin.recurrent import Recurrent, averaged
from edp.networks.twin.recurrent_members import replace_scales, scales_for, separated
from edp.recording import Recording
from edp.report.twin.candidates import read_candidates
from edp.testing.twins import sample_actuators, sample_twin
from edp.training.twin_bundle import load_twin, twin_hash
from edp.workflows.twin import continue_twin, train_twin

pytestmark = pytest.mark.processes

SPEC = ("twin.kind=recurrent", "twin.units=6", "twin.members=2", "twin.prefix_ticks=20")
SETTINGS = (
    *("training.batch=4", "training.lengths_s=[0.2]", "training.updates=[20]", "training.validate_every=10"),
    *("training.validation_s=2", "training.optimizer.learning_rate=0.01"),
    *(
        "evaluation.duration_s=4",
        "evaluation.starts=2",
        "evaluation.at_s=[1, 4]",
        "evaluation.baselines=[]",
        "evaluation.calibration_starts=4",
    ),
)


def slower(seed, factor=0.7):
    """A machine whose cylinders go slower and not as far."""
    recording = sample_actuators(ticks=500, seed=seed)
    values = recording.values.copy()
    values[:, 2:6] *= factor
    channels = recording.channels
    return Recording(f"other_{seed}", channels, values, recording.rate_hz, "sample")


def written(folder, recordings):
    folder.mkdir()
    for recording in recordings:
        write_recording(recording, folder / f"{recording.name}.parquet")
    return DataSource.from_path(folder)


@pytest.fixture(scope="module")
def base(tmp_path_factory):
    folder = tmp_path_factory.mktemp("base")
    source = written(folder / "logs", [sample_actuators(seed=seed) for seed in range(5)])
    train_twin(source, load_twin_experiment(None, (*SPEC, *SETTINGS)), folder / "run")
    return folder / "run"


@pytest.fixture(scope="module")
def other(tmp_path_factory):
    return written(tmp_path_factory.mktemp("other") / "logs", [slower(seed) for seed in range(10, 15)])


def gone_on(source, base, out, *changes):
    return train_twin(source, load_twin_experiment(None, (*SETTINGS, *changes)), out, start=base)


def test_it_keeps_formulation_and_numbers_and_says_where_it_comes_from(base, other, tmp_path):
    trained = gone_on(other, base, tmp_path / "run")
    before, after = load_twin(base), load_twin(tmp_path / "run")
    assert after.spec == before.spec
    assert after.provenance.more["from"]["hash"] == twin_hash(base)
    assert after.provenance.more["from"]["data"] == before.provenance.origin.digest
    assert np.array_equal(after.twin.scales.answer_width, before.twin.scales.answer_width)
    # The other machine's second stroke ends at 0.7, where it was more than once; the first was there once at most.
    assert after.twin.scales.high[2:4] == pytest.approx([1.0, 0.7], abs=0.02)
    assert after.intervals is not None
    rows = read_candidates(tmp_path / "run")
    assert rows[0].label == "the twin as it is"
    assert [row.chosen for row in rows].count(True) == 1
    assert min(row.error for row in rows) == next(row.error for row in rows if row.chosen)
    again = gone_on(other, base, tmp_path / "run")
    assert not trained.resumed
    assert again.resumed


def test_where_no_training_helps_it_stays_as_it_is(base, other, tmp_path, monkeypatch):
    errors = iter([0.5, 0.6])
    monkeypatch.setattr(continue_twin.ContinuedTwin, "_error", lambda self, twin: next(errors))
    gone_on(other, base, tmp_path / "run")
    before, after = load_twin(base).twin.arrays(), load_twin(tmp_path / "run").twin.arrays()
    assert all(np.array_equal(before[name], after[name]) for name in before if name not in ("low", "high"))


def test_longer_trainings_are_tried_while_they_help(base, other, tmp_path, monkeypatch):
    errors = iter([0.9, 0.5, 0.4, 0.3999])
    monkeypatch.setattr(continue_twin.ContinuedTwin, "_error", lambda self, twin: next(errors))
    gone_on(other, base, tmp_path / "run")
    rows = read_candidates(tmp_path / "run")
    assert [row.label for row in rows[1:]] == [f"{count} further updates" for count in (1, 3, 9)]
    assert rows[-1].chosen


@pytest.mark.parametrize("members", [1, 3])
@pytest.mark.parametrize("valve_map", [False, True])
def test_members_taken_apart_are_the_average_again(members, valve_map):
    twin, commands, measured = sample_twin(Recurrent(units=6, members=members, valve_map=valve_map, prefix_ticks=20))
    parts = separated(twin)
    assert len(parts) == members
    again = averaged(parts)
    state, same = (one.reset(commands[:, :20], measured[:, :20]) for one in (twin, again))
    answers, others = twin.rollout(commands[:, 20:], state)[0], again.rollout(commands[:, 20:], same)[0]
    assert others == pytest.approx(answers, rel=1e-4, abs=1e-4)
    replace_scales(twin, twin.scales).network.bias.data.add_(1.0)
    assert np.array_equal(twin.rollout(commands[:, 20:], state)[0], answers)


@pytest.mark.parametrize(
    ("ends", "low", "high"),
    [
        # Twice at the same lowest place, once at the highest.
        ([(0.4, 0.5), (0.4, 0.6)], 0.4, 1.0),
        # Beyond the stop that was known.
        ([(0.3, 1.2), (0.5, 1.0)], 0.0, 1.2),
        # Nowhere twice.
        ([(0.3, 0.7), (0.4, 0.8)], 0.0, 1.0),
    ],
)
def test_a_stroke_ends_where_it_came_twice_else_at_the_farther_end(ends, low, high):
    twin, _, _ = sample_twin(Recurrent(units=4, prefix_ticks=20))
    limits = replace(twin.scales, low=twin.scales.low.copy(), high=twin.scales.high.copy())
    limits.low[2:4], limits.high[2:4] = 0.0, 1.0
    twin = replace_scales(twin, limits)
    recording = sample_actuators(ticks=200)
    channels = twin_channels(recording)
    series = []
    for lowest, highest in ends:
        whole = channels.task().series(recording)
        targets = whole.targets.copy()
        targets[:, 2] = np.interp(
            np.arange(len(targets)), [0, 80, 120, len(targets) - 1], [0.55, lowest, 0.55, highest]
        )
        series.append(Series(whole.name, whole.inputs, targets))
    scales = scales_for(twin, fit_scales(channels, series), series)
    assert (scales.low[2], scales.high[2]) == pytest.approx((low, high), abs=1e-6)
    assert scales.high[0] >= limits.high[0]
    assert scales.high[4] >= limits.high[4]


@pytest.mark.parametrize(("push", "high"), [(0.9, 0.7), (0.2, 1.0), (-0.9, 1.0)], ids=["pushed", "resting", "away"])
def test_one_stay_at_an_outermost_place_is_an_end_stop_where_the_lever_pushes_on(push, high):
    twin, _, _ = sample_twin(Recurrent(units=4, prefix_ticks=20))
    limits = replace(twin.scales, low=twin.scales.low.copy(), high=twin.scales.high.copy())
    limits.low[2:4], limits.high[2:4] = 0.0, 1.0
    twin = replace_scales(twin, limits)
    channels = twin_channels(sample_actuators(ticks=300))
    whole = channels.task().series(sample_actuators(ticks=300))
    inputs, targets = whole.inputs.copy(), whole.targets.copy()
    ticks = np.arange(len(targets))
    targets[:, 2] = np.interp(ticks, [0, 80, 200, len(targets) - 1], [0.4, 0.7, 0.7, 0.4])
    inputs[:, 0] = np.where((ticks > 70) & (ticks < 200), push, np.where(ticks < 40, 1.0, -0.3))
    series = [Series(whole.name, inputs, targets)]
    assert scales_for(twin, fit_scales(channels, series), series).high[2] == pytest.approx(high, abs=1e-6)


def renamed(recording):
    channels = tuple(replace(c, name=c.name.replace("lever", "stick")) for c in recording.channels)
    return Recording(recording.name, channels, recording.values, recording.rate_hz, "sample")


def faster(recording):
    values = recording.values.copy()
    values[:, 2:4] *= 2.0
    return Recording(recording.name, recording.channels, values, 100.0, "sample")


def louder(recording):
    values = recording.values.copy()
    values[:, 6:] *= 1e5
    return Recording(recording.name, recording.channels, values, recording.rate_hz, "sample")


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (faster, "100 Hz.*50 Hz"),
        (renamed, "lever_1"),
        (louder, "pressures of the recordings .*pressure_1|pressures of the recordings .*pressure_2"),
    ],
)
def test_recordings_of_something_else_are_refused_before_anything_is_written(base, tmp_path, change, text):
    source = written(tmp_path / "logs", [change(sample_actuators(seed=seed)) for seed in range(4)])
    with pytest.raises((ConfigError, DataError), match=text):
        gone_on(source, base, tmp_path / "run")
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("changes", "text"),
    [(("twin.kind=static",), "leave out its settings"), (("channels.commands=['lever_2']",), "by a signal map")],
)
def test_settings_of_another_twin_are_refused(base, other, tmp_path, changes, text):
    with pytest.raises(ConfigError, match=text):
        gone_on(other, base, tmp_path / "run", *changes)


def test_a_twin_without_training_is_refused(other, tmp_path):
    settings = (
        "twin.kind=static",
        "twin.prefix_ticks=20",
        "evaluation.duration_s=4",
        "evaluation.at_s=[1, 4]",
        "evaluation.baselines=[]",
    )
    train_twin(other, load_twin_experiment(None, settings), tmp_path / "static")
    with pytest.raises(ConfigError, match=r"kind .static..*without --start"):
        gone_on(other, tmp_path / "static", tmp_path / "run")
