"""Commands beyond those that taught a twin: what is said, and of what."""

from dataclasses import replace

import numpy as np
import pytest

from edp.data.twin_channels import twin_channels
from edp.evaluation.beyond import command_ranges, commands_beyond, describe_excess
from edp.testing.twins import sample_actuators


@pytest.fixture(scope="module")
def machine():
    log = sample_actuators(seed=0)
    channels = twin_channels(log)
    return channels, channels.task().series(log)


def test_only_commands_that_leave_their_range_by_more_than_noise_are_named(machine):
    channels, series = machine
    ranges = command_ranges(channels, [series])
    assert commands_beyond(ranges, channels, [series.inputs]) == {}
    low, high = ranges["lever_2"]
    inputs = series.inputs.copy()
    inputs[:10, 1] = high + 0.01 * (high - low)
    assert commands_beyond(ranges, channels, [inputs]) == {}
    inputs[:10, 1] = high + 0.5
    found = commands_beyond(ranges, channels, [inputs])
    assert set(found) == {"lever_2"}
    assert found["lever_2"].share == pytest.approx(10 / len(inputs))
    assert found["lever_2"].largest == pytest.approx(high + 0.5)
    assert "lever_2" in describe_excess(found)
    assert describe_excess({}) == ""


def test_a_twin_that_went_on_knows_the_commands_of_both(machine):
    channels, series = machine
    wider = command_ranges(channels, [series], {"lever_1": [-9.0, 0.0], "lever_2": "wide", "other": [0.0, 1.0]})
    own = command_ranges(channels, [replace(series, inputs=series.inputs)])
    assert wider == own | {"lever_1": [-9.0, own["lever_1"][1]]}


@pytest.mark.parametrize("ranges", [None, "all", {"lever_1": 3}, {"lever_1": [1.0, -1.0]}, {"lever_1": [np.nan, 1.0]}])
def test_ranges_of_a_damaged_file_say_nothing(machine, ranges):
    channels, series = machine
    assert commands_beyond(ranges, channels, [99.0 + series.inputs]) == {}
