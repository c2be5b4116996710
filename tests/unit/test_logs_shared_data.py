"""Real recordings read through maps alone; skipped where they are not at hand."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from edp.logs import inspect_log, read_recording
from edp.signals import ChannelMap, Kind, SignalMap

ROOT = Path(os.environ.get("EDP_SHARED_DATA") or Path(__file__).parents[2].parent / "shared" / "data")
pytestmark = [pytest.mark.processes, pytest.mark.shared_data]

VOLT, LENGTH, GENERIC = Kind.VOLTAGE, Kind.POSITION, Kind.GENERIC
BENCH = ("t", "reference", "position", "valve")

CASES = {
    "cascaded_tanks/dataBenchmark.csv": (
        SignalMap((ChannelMap("u", "uEst", "V", VOLT), ChannelMap("y", "yEst", "V", VOLT)), sample_time_s=4.0),
        (0.25, 1024, (3.2567, 5.205)),
    ),
    "emps/DATA_EMPS.mat": (
        SignalMap(
            (ChannelMap("u", "vir", "V", VOLT), ChannelMap("x", "qm", "m", LENGTH), ChannelMap("gain", "gtau")),
            rate_hz=100.0,
        ),
        (100.0, 2485, (2.538628, 7.45e-06, 35.15065)),
    ),
    "hydraulic_actuator_sjoberg/actuator.mat": (
        SignalMap((ChannelMap("u", "u"), ChannelMap("p", "p")), sample_time_s=1.0),
        (1.0, 1024, (-0.0068164, -0.0002624)),
    ),
    "hydraulic_bench_mataveid/HangingLoad.csv": (
        SignalMap((ChannelMap("u", "valve"), ChannelMap("y", "position")), header=False, columns=BENCH),
        (50.0, 16060, (-0.23687, 0.48107)),
    ),
    "hydraulic_bench_mataveid/MultivariableCylinders.csv": (
        SignalMap((ChannelMap("y", "y0"),), header=False, columns=("t", "r0", "r1", "y0", "y1")),
        (10.0, 2390, (2.53968,)),
    ),
    "fatigue_rig_faster/faster.csv": (
        SignalMap((ChannelMap("u", "u", "V", VOLT), ChannelMap("y", "y"), ChannelMap("d", "d", "mm", LENGTH))),
        (1 / 7.7531e-3, 21275, (-0.072276, -8.2771e-05, 0.0)),
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_real_log_reads_by_its_map(name):
    path = ROOT / name
    if not path.is_file():
        pytest.skip(f"'{path}' is not there; set EDP_SHARED_DATA to the folder of real recordings")
    signal_map, (rate, samples, first) = CASES[name]
    read = read_recording(path, signal_map)
    assert read.rate_hz == pytest.approx(rate, rel=1e-4)
    assert read.samples == samples
    np.testing.assert_allclose(read.values[0], first, rtol=1e-5, atol=1e-7)
    assert np.isfinite(read.values).all()
    assert inspect_log(path, signal_map).errors == ()
