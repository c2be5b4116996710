"""Which channel is what in a twin: by Table A.1, by kind, or by name; nothing is hard-coded to an excavator."""

import numpy as np
import pytest

from edp.data.twin_channels import TwinChannelSettings, same_channels, twin_channels
from edp.errors import ConfigError, DataError
from edp.recording import Recording
from edp.signals import EXTRA_CHANNELS, TABLE_A1, Channel, Kind


def recording(*channels):
    return Recording("log", channels, np.zeros((5, len(channels)), np.float32), 100.0, "log.csv")


def names(channels):
    return [channel.name for channel in channels]


RIG = (
    Channel("u", Kind.RATIO),
    Channel("v", Kind.VELOCITY),
    Channel("x", Kind.POSITION),
    Channel("pA", Kind.PRESSURE),
    Channel("pB", Kind.PRESSURE),
)


def test_an_excavator_by_its_names_without_positions_that_are_no_strokes():
    channels = twin_channels(recording(*TABLE_A1.values(), *EXTRA_CHANNELS.values()))
    assert names(channels.commands)[:6] == ["BmUp", "BmDwn", "AmIn", "AmOut", "BktIn", "BktOut"]
    assert len(channels.commands) == 12
    assert names(channels.velocities) == ["CylVels_1", "CylVels_2", "CylVels_3"]
    assert names(channels.strokes) == ["CylStroke_1", "CylStroke_2", "CylStroke_3"]
    assert names(channels.pressures)[-2:] == ["PumpPressure_1", "PumpPressure_2"]
    assert len(channels.pressures) == 8


def test_one_actuator_by_its_kinds():
    channels = twin_channels(recording(*RIG))
    assert names(channels.commands) == ["u"]
    assert names(channels.answers) == ["v", "x", "pA", "pB"]
    task = channels.task()
    assert task.inputs == ("u",)
    assert task.targets == ("v", "x", "pA", "pB")


def test_a_motor_turns_and_a_machine_without_positions_has_no_strokes():
    motor = (Channel("i", Kind.CURRENT), Channel("w", Kind.ANGULAR_VELOCITY), Channel("q", Kind.ANGLE))
    assert names(twin_channels(recording(*motor)).strokes) == ["q"]
    assert twin_channels(recording(*RIG[:2])).strokes == ()


def test_names_of_the_settings_come_before_kinds():
    settings = TwinChannelSettings(commands=("pA",), pressures=("pB",))
    channels = twin_channels(recording(*RIG), settings)
    assert names(channels.commands) == ["pA"]
    assert names(channels.pressures) == ["pB"]


@pytest.mark.parametrize(
    ("settings", "error", "message"),
    [
        ({"commands": ("uu",)}, DataError, "input 'uu' is not a channel of 'log'.*did you mean 'u'"),
        (
            {"velocities": ("pA",), "pressures": ("pB",)},
            ConfigError,
            "'pA' is of kind pressure; velocity, angular_velocity or generic must",
        ),
        ({"strokes": ("pA",), "pressures": ("pB",)}, ConfigError, r"strokes are pA \(pressure\); one for each"),
        ({"pressures": ("x",), "strokes": ("x",)}, ConfigError, "x is named twice"),
        ({"pressures": ("x",)}, ConfigError, "'x' is of kind position; a pressure must hold"),
    ],
)
def test_channels_that_do_not_fit_are_refused(settings, error, message):
    with pytest.raises(error, match=message):
        twin_channels(recording(*RIG), TwinChannelSettings(**settings))


def test_a_machine_without_commands_or_velocities_is_refused_with_what_to_name():
    with pytest.raises(ConfigError, match=r"no commands; name them in the settings, channels\.commands"):
        twin_channels(recording(*RIG[1:3]))
    with pytest.raises(ConfigError, match=r"no velocities; name them in the settings, channels\.velocities"):
        twin_channels(recording(RIG[0], RIG[3]))


def test_a_log_of_another_kind_is_refused():
    channels = twin_channels(recording(*RIG))
    other = recording(RIG[0], Channel("v", Kind.ANGULAR_VELOCITY), *RIG[2:])
    with pytest.raises(DataError, match="'v' is of kind angular_velocity, the twin was trained on velocity"):
        same_channels(channels, other)
