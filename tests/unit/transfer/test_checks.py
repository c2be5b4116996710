"""Logs that do not go with a source are refused with what came, where and what to do."""

import dataclasses

import numpy as np
import pytest

from edp.errors import ConfigError, DataError
from edp.logs.source import DataSource
from edp.recording import Recording
from edp.signals import TABLE_A1, Channel, Kind
from edp.training.transfer.checks import CONVENTION, PilotPair, check_signs, check_units, correlation
from edp.workflows.transfer import FinetuneRequest, finetune
from edp.workflows.transfer.source import read_source

pytestmark = pytest.mark.processes


@pytest.fixture
def refused(run, small, written, tmp_path):
    """The message with which logs are refused before anything is written."""

    def message(*recordings, **changes):
        logs = DataSource.from_path(written(tmp_path / "logs", list(recordings)))
        with pytest.raises((DataError, ConfigError)) as caught:
            finetune(run, logs, FinetuneRequest(spec=small, **changes), tmp_path / "out")
        assert not (tmp_path / "out").exists()
        return str(caught.value)

    return message


def without(recording, *names):
    kept = [i for i, channel in enumerate(recording.channels) if channel.name not in names]
    channels = tuple(recording.channels[i] for i in kept)
    return Recording(recording.name, channels, recording.values[:, kept], recording.rate_hz, recording.source)


def test_every_missing_channel_of_every_log_is_named(refused, made_by):
    told = refused(*(without(made_by(name, 1, (0.3, -0.2)), "swing", "turn") for name in ("a", "b")))
    for name in ("a", "b"):
        assert f"'{name}'" in told
    assert told.count("lacks turn, swing") == 2
    assert "constant = 0.0" in told


def test_another_rate_is_refused_with_the_setting_that_mends_it(refused, made_by):
    slow = dataclasses.replace(made_by("a", 1, (0.3, -0.2)), rate_hz=50.0)
    assert "runs at 100 Hz, the logs have another rate: 'a' 50 Hz; set rate_hz = 100" in refused(slow)


@pytest.mark.parametrize(("columns", "factor"), [((0, 1), 1e-5), ((0,), 1e5), ((2, 3), 1e3)])
def test_another_unit_is_refused_by_channel(refused, made_by, columns, factor):
    recording = made_by("a", 1, (0.3, -0.2))
    recording.values[:, columns] *= factor
    told = refused(recording)
    assert "100 times" in told
    assert "unit =" in told
    for column, channel in enumerate(recording.channels):
        assert (f"{channel.name} up to" in told) == (column in columns)


def test_one_quiet_channel_is_no_other_unit(run, made_by):
    source = read_source(run)
    recording = made_by("a", 1, (0.3, -0.2))
    recording.values[:, 0] *= 1e-5
    series = source.bundle.task.series(recording)
    check_units(dataclasses.replace(source.data, train=[series]), source.predictor.front)


@pytest.mark.parametrize("samples", [30, 80])
def test_logs_that_are_too_short_are_named(refused, made_by, samples):
    told = refused(made_by("long", 1, (0.3, -0.2)), made_by("brief", 2, (0.3, -0.2), samples))
    assert "brief" in told
    assert "too short" in told


def test_targets_that_do_not_move_are_refused(refused, made_by):
    recording = made_by("a", 1, (0.3, -0.2))
    recording.values[:, 3] = 0.05
    told = refused(recording)
    assert "turn is 0.05 throughout in the train part" in told
    assert "rise is" not in told


def test_another_sign_is_found_by_correlation_with_the_pilot_pressure(refused, made_by):
    told = refused(made_by("a", 1, (0.3, 0.2)))
    assert "turn after swing: negative in the source, correlation +0." in told
    assert "scale = -1.0" in told
    assert "rise after" not in told


def test_logs_of_another_sign_are_taken_where_that_is_asked_for(run, small, made_by, written, tmp_path):
    logs = DataSource.from_path(written(tmp_path / "logs", [made_by("a", 1, (0.3, 0.2))]))
    spec = dataclasses.replace(small, check_signs=False)
    found = finetune(
        run, logs, FinetuneRequest(spec=spec, changes=("training.updates=2",)), tmp_path / "out"
    ).to_table()
    assert found["notes"] == []


def test_missing_values_are_refused_where_they_are(refused, made_by):
    recording = made_by("a", 1, (0.3, -0.2))
    recording.values[17, 0] = np.nan
    told = refused(recording)
    assert "lift" in told
    assert "17" in told


def test_without_recordings_of_the_source_the_convention_of_the_names_holds(run):
    """The built-in names: extension is positive, and each pilot pressure has one direction."""
    data = read_source(run).data
    names = ("BmUp", "CylVels_1")
    assert CONVENTION[names] == 1
    channels = (TABLE_A1["BmUp"], Channel("swing", Kind.PILOT_PRESSURE), *data.inputs[:2])
    order = [data.task.inputs.index(name) for name in ("lift", "swing", "rise", "turn")]
    features = dataclasses.replace(data.task.features, channels=("BmUp", "swing", "CylVels_1", "turn"))
    task = dataclasses.replace(data.task, features=features, targets=("CylVels_1", "turn"))

    def turned(part, sign):
        return dataclasses.replace(part, inputs=part.inputs[:, order], targets=part.targets * sign)

    for sign in (1, -1):
        made = dataclasses.replace(
            data, task=task, inputs=channels, train=[turned(part, np.float32([sign, 1])) for part in data.train]
        )
        assert np.sign(correlation(made, made.train, PilotPair(*names))) == sign
        if sign == 1:
            assert check_signs(made, None) == [
                "The sign of turn was not checked: no pilot pressure moves with it clearly (correlation of 0.3 or more "
                "within 0.5 s) in both the source and the logs."
            ]
        else:
            with pytest.raises(DataError, match="CylVels_1 after BmUp: positive by convention"):
                check_signs(made, None)
