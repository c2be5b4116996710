"""Files whose meaning is hostile, drawn by seeds: a sound value or one of EDP's errors, in bounded time and memory."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

WORKER = Path(__file__).with_name("meanings_worker.py")
KINDS = (
    "mdf",
    "mat",
    "mat73",
    "parquet",
    "own_parquet",
    "csv",
    "bag",
    "bag_folder",
    "bundle",
    "settings",
    "signal_map",
)
PEAK_MB = 1600.0
"""The honest files take 600 MB with all libraries loaded; 1 GB more is allowed."""


def run(folder: Path, kinds: tuple[str, ...], first: int, count: int) -> dict[str, dict[str, object]]:
    command = [sys.executable, str(WORKER), str(folder), ",".join(kinds), str(first), str(count)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"the reader died after {done.stderr[-3000:]}"
    found = json.loads(done.stdout.splitlines()[-1])
    assert found.pop("peak_mb") < PEAK_MB
    assert not found.pop("marker")
    assert {kind: result["faults"] for kind, result in found.items() if result["faults"]} == {}
    assert {kind: result["read"] + result["refused"] for kind, result in found.items()} == dict.fromkeys(kinds, count)
    return found


def test_hostile_meanings_give_edps_errors_only(tmp_path):
    found = run(tmp_path, KINDS, 0, 12)
    assert all(result["refused"] > 0 for result in found.values())


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("kind", KINDS)
def test_two_thousand_hostile_meanings_of_each_kind(tmp_path, kind):
    run(tmp_path, (kind,), 1000, 2000)
