"""Damaged files of every format: only EDP's errors come out, in bounded time and memory, and no wrong numbers.

The cases run in a process of their own, so that a crash, a hang or an exhausted memory of a library fails the test and
not the tests. The cases are written by EDP, whose facts tell whether values are still its own, and by each library
itself. 2,000 damaged files of each format are read by the slow test.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import asammdf
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import scipy.io

from edp.logs import FORMATS, WriteOptions, write_recording
from edp.recording import Recording
from edp.signals import TABLE_A1, Channel, Kind

WORKER = Path(__file__).parent / "worker.py"
SAMPLES = 60
PEAK_MB = 1500.0
TIME = np.arange(SAMPLES) / 100


def recording() -> Recording:
    channels = (*(TABLE_A1[name] for name in ("BmUp", "CylVels_1")), Channel("Extra", Kind.GENERIC))
    values = np.random.default_rng(0).standard_normal((SAMPLES, 3)).astype(np.float32)
    return Recording("R1", channels, values, 100.0, "sim:fuzz", {"seed": 1})


def own(name: str, options: WriteOptions | None = None) -> Callable[[Path], None]:
    return lambda folder: write_recording(recording(), folder / name, options)  # type: ignore[return-value]


def foreign_parquet(folder: Path) -> None:
    lists = pa.array([[float(k), 1.0] for k in range(SAMPLES)])
    pq.write_table(pa.table({"time": TIME, "BmUp": TIME, "CylVels": lists}), folder / "foreign.parquet")


def foreign_mdf(folder: Path) -> None:
    with asammdf.MDF(version="4.10") as log:
        for rate, names in ((1, ("BmUp", "BmDwn")), (2, ("CylVels_1",))):
            stamps = TIME[::rate]
            log.append([asammdf.Signal(stamps * 2, stamps, name=name) for name in names])
        log.save(folder / "foreign.mf4", overwrite=True)


def foreign_mat(folder: Path) -> None:
    scipy.io.savemat(folder / "foreign.mat", {"t": TIME, "BmUp": TIME, "s": {"time": TIME, "CylVels_1": TIME}})


OF_EVERY_FORMAT = {f"own{part.suffixes[0]}": own(f"own{part.suffixes[0]}") for part in FORMATS.values()}
CASES: dict[str, Callable[[Path], None]] = OF_EVERY_FORMAT | {
    "dataset.mat": own("dataset.mat", WriteOptions("dataset")),
    "struct73.mat": own("struct73.mat", WriteOptions(mat_version="v7.3")),
    "dataset73.mat": own("dataset73.mat", WriteOptions("dataset", "v7.3")),
    "foreign.parquet": foreign_parquet,
    "foreign.mf4": foreign_mdf,
    "foreign.mat": foreign_mat,
}


def run(folder: Path, cases: list[str], first: int, count: int) -> None:
    """Read `count` damaged copies of each case and hold what is found to the promise."""
    for case in cases:
        CASES[case](folder)
    command = [sys.executable, str(WORKER), str(folder), ",".join(cases), str(first), str(count)]
    done = subprocess.run(command, capture_output=True, text=True, env=os.environ, check=False)
    assert done.returncode == 0, f"the reader died after {done.stderr[-1500:]}"
    found = json.loads(done.stdout.splitlines()[-1])
    assert found.pop("peak_mb") < PEAK_MB
    assert {case: result["faults"] for case, result in found.items() if result["faults"]} == {}
    assert {case: result["read"] + result["refused"] for case, result in found.items()} == dict.fromkeys(cases, count)
    assert all(result["refused"] > 0 for result in found.values())


def test_damaged_files_give_edps_errors_only(tmp_path):
    run(tmp_path, list(CASES), 0, 20)


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_two_thousand_damaged_files_of_each_format(tmp_path, case):
    run(tmp_path, [case], 1000, 2000)
