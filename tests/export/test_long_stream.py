"""Exported C over long streams against PyTorch in double precision: the error at the end is that of the beginning."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest

FOLDER = Path(__file__).parents[2] / "benchmarks"


@pytest.fixture(scope="module")
def bench():
    sys.path.insert(0, str(FOLDER))
    try:
        spec = importlib.util.spec_from_file_location("bench_long_stream", FOLDER / "long_stream.py")
        module = importlib.util.module_from_spec(spec)
        sys.modules[spec.name] = module
        spec.loader.exec_module(module)
    finally:
        sys.path.remove(str(FOLDER))
    return module


def test_lanes_meet_and_the_error_stays(c, bench, bundle_of, program_of):
    predictor = bundle_of("hybrid").predictor
    drift = bench.measure(predictor, program_of("hybrid"), bench.Signal(predictor, 1, pieces=20), lanes=4)
    assert drift.seam < 1e-9
    assert drift.worst < 1e-5 * (1 + drift.largest)
    assert drift.last < 1.5 * drift.first


def test_a_piece_of_the_signal_is_the_same_by_itself(bench, bundle_of):
    """Pieces join without a step, and a piece does not depend on what was asked for before."""
    signal = bench.Signal(bundle_of("lstm").predictor, 3, pieces=5)
    rows = np.concatenate([signal.piece(number) for number in range(3)])
    np.testing.assert_array_equal(rows[1000:2000], signal.piece(1))
    steps = np.abs(np.diff(rows / signal.spread, axis=0)).max(axis=1)
    assert steps[[999, 1999]].max() < steps.max()


def test_whole_numbers_stay_as_near(c, bench, bundle_of, tmp_path):
    c.need("gcc")
    bundle = bundle_of("hybrid")
    signal = bench.Signal(bundle.predictor, 1, pieces=20)
    program = bench.program_of(bench.FORMATS["w8a16"](bundle, signal), tmp_path)
    drift = bench.measure(bundle.predictor, program, signal, lanes=4)
    assert 1e-5 < drift.first < 0.1
    assert drift.last < 1.5 * drift.first


def test_a_drift_would_be_seen(c, bench, bundle_of, program_of):
    """A program whose predictions run away by a millionth of a standard deviation a second."""
    predictor = bundle_of("hybrid").predictor
    program = program_of("hybrid")
    source = (program.parent / "predictor.c").read_text()
    wrong = source.replace("return finite;", "out->prediction[0][0] += 1e-8f * (float)s->ticks;\n    return finite;")
    (program.parent / "predictor.c").write_text(wrong)
    sources = ("predictor.c", "host_test.c", "edp_runtime.c", "edp_memory.c")
    c.run("gcc", *c.flags, "-O1", *sources, "-lm", "-o", "drifts", folder=program.parent)
    drift = bench.measure(predictor, program.parent / "drifts", bench.Signal(predictor, 1, pieces=20), lanes=4)
    assert drift.last > 5 * drift.first


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("network", ["hybrid+all", "gru1", "hybrid8"])
def test_a_day_does_not_drift(c, network, bench, bundle_of, program_of):
    predictor = bundle_of(network).predictor
    signal = bench.Signal(predictor, 0, pieces=bench.DAY)
    drift = bench.measure(predictor, program_of(network, "gcc", "-O2"), signal, lanes=64)
    assert drift.seam < 1e-9
    assert drift.last < 1.1 * drift.first
    assert drift.worst < 1e-5 * (1 + drift.largest)
