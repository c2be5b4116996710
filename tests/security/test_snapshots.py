"""Snapshots of a simulation that unpack to more than they hold, carry objects, or lie about their arrays."""

from __future__ import annotations

import io
import json
import os
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from edp.errors import StorageError
from edp.sim import Scenario, Simulation, Snapshot

Members = dict[str, bytes]
ENDLESS = json.dumps({"schema": 2, "scenario": {}, "state": {}, "samples": "1e999"})


@pytest.fixture(scope="module")
def honest(tmp_path_factory: pytest.TempPathFactory) -> Members:
    """Members of a snapshot's file."""
    simulation = Simulation(Scenario(excitation="isolated", duration_s=2.0, seed=1))
    simulation.run(50)
    path = simulation.snapshot().save(tmp_path_factory.mktemp("snapshot") / "a.npz")
    assert Snapshot.load(path).samples == 50
    with zipfile.ZipFile(path) as packed:
        return {name: packed.read(name) for name in packed.namelist()}


def written(path: Path, members: Members, how: int = zipfile.ZIP_STORED) -> Path:
    with zipfile.ZipFile(path, "w", how) as packed:
        for name, data in members.items():
            packed.writestr(name, data)
    return path


def array(values: object, **options: object) -> bytes:
    data = io.BytesIO()
    np.save(data, values, **options)  # type: ignore[arg-type]
    return data.getvalue()


def text(value: str) -> bytes:
    return array(np.frombuffer(value.encode(), np.uint8))


class Marked:
    """Unpickling it would make a file."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[object, ...]:
        return Path.touch, (self.path,)


LIES: dict[str, Callable[[Members], Members]] = {
    "an array of petabytes": lambda m: m | {"log.npy": m["log.npy"][:10] + _header((1 << 40, 1 << 10))},
    "a negative size": lambda m: m | {"log.npy": m["log.npy"][:10] + _header((-5, 3))},
    "no facts": lambda m: {name: data for name, data in m.items() if name != "facts.npy"},
    "facts that are a number": lambda m: m | {"facts.npy": text("5")},
    "facts nested deep": lambda m: m | {"facts.npy": text("[" * 100_000)},
    "facts that are not UTF-8": lambda m: m | {"facts.npy": array(np.array([255, 254, 0], np.uint8))},
    "samples without end": lambda m: m | {"facts.npy": text(ENDLESS)},
    "a missing array": lambda m: {name: data for name, data in m.items() if name != "a0.npy"},
    "something else as an array": lambda m: m | {"a0.npy": b"#!/bin/sh"},
}  # fmt: skip


def _header(shape: tuple[int, ...]) -> bytes:
    return repr({"descr": "<f8", "fortran_order": False, "shape": shape}).ljust(117).encode() + b"\n"


@pytest.mark.parametrize("lie", LIES)
def test_what_no_simulation_wrote_is_refused(lie, honest, tmp_path):
    with pytest.raises(StorageError):
        Snapshot.load(written(tmp_path / "a.npz", LIES[lie](honest)))


def test_nothing_is_unpacked_or_unpickled(honest, tmp_path):
    marker = tmp_path / "marker"
    objects = array(np.array([Marked(marker)], dtype=object), allow_pickle=True)
    with pytest.raises(StorageError, match="not a snapshot"):
        Snapshot.load(written(tmp_path / "a.npz", honest | {"a0.npy": objects}))
    assert not marker.exists()
    bomb = honest | {"log.npy": array(np.zeros((1 << 22, 1)))}
    with pytest.raises(StorageError, match="packed arrays"):
        Snapshot.load(written(tmp_path / "bomb.npz", bomb, zipfile.ZIP_DEFLATED))


def test_a_pipe_and_a_missing_file_are_refused(tmp_path):
    os.mkfifo(tmp_path / "pipe.npz")
    with pytest.raises(StorageError, match="regular file"):
        Snapshot.load(tmp_path / "pipe.npz")
    with pytest.raises(StorageError, match="No such file"):
        Snapshot.load(tmp_path / "none.npz")
