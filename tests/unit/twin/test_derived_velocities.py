"""Logs that hold positions alone: velocities are their changes, in training as in everything that reads a twin."""

import numpy as np
import pytest

from edp.data.derived_velocities import complete_velocities, matched
from edp.data.twin_channels import TwinChannelSettings, twin_channels
from edp.errors import ConfigError, DataError
from edp.recording import Recording
from edp.signals import Channel, Kind

CHANNELS = (Channel("u", Kind.RATIO), Channel("boom", Kind.POSITION), Channel("swing", Kind.ANGLE))


def recording(channels=CHANNELS, seed=0):
    values = np.random.default_rng(seed).normal(size=(50, len(channels))).astype(np.float32)
    return Recording("log", tuple(channels), values, 20.0, "log.csv")


def test_every_position_gets_its_change_per_second():
    log = recording()
    (completed,), settings = complete_velocities([log], TwinChannelSettings())
    channels = twin_channels(completed, settings)
    assert [c.name for c in channels.answers] == ["boom_velocity", "swing_velocity", "boom", "swing"]
    assert [c.kind for c in channels.velocities] == [Kind.VELOCITY, Kind.ANGULAR_VELOCITY]
    change = completed.column("boom_velocity")
    assert change[0] == 0.0
    np.testing.assert_allclose(change[1:], np.diff(log.column("boom").astype(float)) * 20.0, rtol=1e-6)
    np.testing.assert_array_equal(completed.values[:, :3], log.values)


def test_named_strokes_alone_get_one():
    (completed,), settings = complete_velocities([recording()], TwinChannelSettings(strokes=("swing",)))
    assert [c.name for c in twin_channels(completed, settings).answers] == ["swing_velocity", "swing"]


def test_recordings_with_a_velocity_or_without_a_position_stay_as_they_are():
    for channels in ((*CHANNELS, Channel("v", Kind.VELOCITY)), CHANNELS[:1]):
        log, asked = recording(channels), TwinChannelSettings()
        (same,), settings = complete_velocities([log], asked)
        assert same is log
        assert settings is asked
    with pytest.raises(ConfigError, match="no velocities"):
        twin_channels(recording(CHANNELS[:1]))


def test_a_missing_value_stays_missing():
    log = recording()
    log.values[7, 1] = np.nan
    (completed,), _ = complete_velocities([log], TwinChannelSettings())
    assert np.flatnonzero(np.isnan(completed.column("boom_velocity"))).tolist() == [7, 8]


def test_a_channel_of_the_name_is_not_written_over():
    log = recording((*CHANNELS, Channel("boom_velocity", Kind.GENERIC)))
    with pytest.raises(DataError, match="there is a channel 'boom_velocity' of kind generic; name the velocities"):
        complete_velocities([log], TwinChannelSettings())


def test_a_later_log_is_matched_with_the_channels_of_the_twin():
    (completed,), settings = complete_velocities([recording()], TwinChannelSettings())
    channels = twin_channels(completed, settings)
    later = recording(seed=1)
    np.testing.assert_array_equal(
        matched(channels, later).values, complete_velocities([later], TwinChannelSettings())[0][0].values
    )
    with pytest.raises(DataError, match="swing"):
        matched(channels, recording(CHANNELS[:2]))
    measured = recording((*CHANNELS, Channel("boom_velocity", Kind.VELOCITY)))
    assert matched(channels, measured).column("boom_velocity") is not None
    np.testing.assert_array_equal(matched(channels, measured).column("boom_velocity"), measured.column("boom_velocity"))
