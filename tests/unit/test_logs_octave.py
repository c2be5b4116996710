"""MAT files that GNU Octave 7.3 wrote (`tests/fixtures/octave.m`)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from edp.errors import DataError
from edp.logs import read_recording
from edp.signals import ChannelMap, SignalMap

pytestmark = pytest.mark.processes

FIXTURES = Path(__file__).parents[1] / "fixtures"
TIME = np.arange(60) / 100
EXPECTED = {
    "octave_v4.mat": {"BmUp": TIME * 2e6},
    "octave_v6.mat": {"CylVels_1": TIME, "CylVels_2": -TIME, "BmUp": TIME * 2e6},
    "octave_v7.mat": {"CylVels_1": TIME, "CylVels_2": -TIME, "BmUp": TIME * 2e6},
    "octave_structure_with_time.mat": {
        "CylVels_1": TIME,
        "CylVels_2": 2 * TIME,
        "CylVels_3": 3 * TIME,
        "BmUp": TIME * 2e6,
    },
}


@pytest.mark.parametrize("name", EXPECTED)
def test_files_of_octave(name):
    read = read_recording(FIXTURES / name)
    assert read.rate_hz == 100.0
    assert read.channel_names == tuple(EXPECTED[name])
    for channel, values in EXPECTED[name].items():
        np.testing.assert_allclose(read.column(channel), values, rtol=1e-6, atol=1e-9)


def test_single_numbers_fill_a_channel_where_a_map_names_them():
    wanted = SignalMap((ChannelMap("BmUp", "BmUp"), ChannelMap("gain", "gain")))
    assert set(read_recording(FIXTURES / "octave_v7.mat", wanted).column("gain").tolist()) == {3.5}


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("octave_text.mat", "Octave's own text format.*save -v7"),
        ("octave_hdf5.mat", "HDF5 that is not a MAT v7.3 file"),
    ],
)
def test_octaves_own_formats_are_named(name, message):
    with pytest.raises(DataError, match=message):
        read_recording(FIXTURES / name)
