"""The benchmark of fine-tuning on recordings made by others; skipped where they are not at hand."""

import importlib.util
import os
import sys
from pathlib import Path

import numpy as np
import pytest

from edp.logs import read_recording
from edp.storage import read_json
from edp.workflows.train_evaluate import DataSource

ROOT = Path(__file__).parents[2]
SHARED = Path(os.environ.get("EDP_SHARED_DATA") or ROOT.parent / "shared" / "data")


@pytest.fixture(scope="module")
def bench():
    folder = str(ROOT / "benchmarks")
    sys.path.insert(0, folder)
    try:
        spec = importlib.util.spec_from_file_location("bench_transfer_real", ROOT / "benchmarks/transfer_real.py")
        module = importlib.util.module_from_spec(spec)
        sys.modules[spec.name] = module
        spec.loader.exec_module(module)
        yield module
    finally:
        sys.path.remove(folder)


def test_rows_and_verdicts_are_those_of_the_transfer(bench):
    def worlds(*rmse):
        return {"domains": {"target": {str(k): {"y": {"rmse": e}} for k, e in zip((1, 5), rmse, strict=True)}}}

    methods = {"full": worlds(1.0, 4.0), "direct": worlds(2.0, 4.0), "scratch": worlds(0.5, 2.0)}
    found = {"task": {"horizons": [1, 5]}, "targets": [{"name": "y"}], "methods": methods}
    rows = list(bench.rows_of(bench.SETS[0], found))
    assert [(row["horizon"], row["rmse"]["direct"]) for row in rows] == [(1, 2.0), (5, 4.0)]
    over_direct, over_scratch = bench.verdicts_of(rows)
    assert over_direct.ratio == pytest.approx(0.5**0.5)
    assert over_scratch.ratio == pytest.approx(2.0)
    assert (over_direct.is_met, over_scratch.is_met) == (True, False)


@pytest.mark.shared_data
def test_a_network_of_the_first_part_is_trained_on_with_the_second(bench, tmp_path, monkeypatch):
    if not SHARED.is_dir():
        pytest.skip(f"no real recordings in {SHARED}")
    monkeypatch.setenv("EDP_SHARED_DATA", str(SHARED.resolve()))
    regimes = bench.SETS[0]
    found = bench.transferred(regimes, tmp_path, quick=True, seed=0)
    assert set(found["methods"]) == {bench.OURS, *bench.RIVALS}
    # The two parts are of one log and share no row.
    parts = [read_recording(next((tmp_path / name).glob("*.parquet"))) for name in ("source", "target")]
    whole = DataSource.from_path(bench.EXAMPLES / regimes.data).read()
    assert [part.samples for part in parts] == [recording.samples for recording in whole]
    for part, recording in zip(parts, whole, strict=True):
        np.testing.assert_allclose(part.values, recording.values, rtol=1e-6)
    rows = list(bench.rows_of(regimes, found))
    assert {row["target"] for row in rows} == {"y0", "y1", "v0", "v1"}
    assert all(np.isfinite(value) and value > 0 for row in rows for value in row["rmse"].values())
    written = read_json(tmp_path / "tuned_0" / "transfer.json")
    assert set(written.pop("files")) == {"transfer_predictions.safetensors"}  # the hash of the arrays next to it
    assert written | {"files": found["files"]} == found
