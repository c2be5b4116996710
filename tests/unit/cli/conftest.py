"""The command line in this process, and recordings and a run small enough for every test."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from edp.cli import app
from edp.cli.console import run_app
from edp.logs import write_recording
from edp.recording import Recording
from edp.signals import TABLE_A1

SMALL = (
    "training.epochs=2",
    "training.updates=5",
    'training.optimizer={kind="adamw"}',
    'training.chunks={regime="chunk",length=32,batch=4,burn_in=10}',
    'model.backbone={kind="hybrid",channels=[6],kernel=3,units=6}',
    "model.head.hidden=6",
    "model.window=12",
    "evaluation.history=5",
)


@dataclass(frozen=True)
class Ended:
    """How a command ended."""

    code: int
    out: str
    err: str

    @property
    def json(self) -> Any:
        """Standard output as one JSON document; anything else there fails."""
        return json.loads(self.out)


@pytest.fixture
def edp(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., Ended]:
    """Run a command line: ``edp("data", "check", folder)``."""
    monkeypatch.setenv("TERM", "dumb")

    def run(*args: object) -> Ended:
        monkeypatch.setattr(sys, "argv", ["edp", *map(str, args)])
        capsys.readouterr()
        code = run_app(app)
        text = capsys.readouterr()
        return Ended(code, text.out, text.err)

    return run


@pytest.fixture(scope="session")
def small() -> list[str]:
    """Options of ``edp train`` for a training of a second."""
    return ["--preset", "quick", *(word for change in SMALL for word in ("--set", change))]


@pytest.fixture(scope="session")
def recording_of() -> Callable[..., Recording]:
    """Recordings with the 24 logged channels: slow velocities that follow slow levers, pressures beside them."""

    def make(name: str, seed: int = 0, samples: int = 600, rate_hz: float = 100.0) -> Recording:
        rng = np.random.default_rng([seed, samples])
        time_s = np.arange(samples) / rate_hz
        waves = np.sin(2 * np.pi * rng.uniform(0.1, 0.6, 24) * time_s[:, None] + rng.uniform(0, 6, 24))
        size = np.array([{"m/s": 0.2, "m/s^2": 1.0}.get(channel.unit, 2e6) for channel in TABLE_A1.values()])
        offset = np.where(size > 1e5, 3e6, 0.0)
        noisy = offset + size * (waves + 0.02 * rng.normal(size=waves.shape))
        return Recording(name, tuple(TABLE_A1.values()), noisy.astype(np.float32), rate_hz, source="test")

    return make


@pytest.fixture(scope="session")
def logs(tmp_path_factory: pytest.TempPathFactory, recording_of: Callable[..., Recording]) -> Path:
    """A folder of five short logs; tests leave it as it is."""
    folder = tmp_path_factory.mktemp("logs")
    for i in range(5):
        write_recording(recording_of(f"drive_{i}", seed=i), folder / f"drive_{i}.parquet")
    return folder


@pytest.fixture(scope="session")
def _trained(tmp_path_factory: pytest.TempPathFactory, logs: Path) -> Path:
    from edp.config.experiment import load_experiment
    from edp.workflows.train_evaluate import DataSource, evaluate, train

    run = tmp_path_factory.mktemp("trained") / "run"
    train(DataSource.from_path(logs), load_experiment(preset="quick", overrides=SMALL), run)
    evaluate(run, baselines=["persistence"])
    return run


@pytest.fixture
def trained(_trained: Path, tmp_path: Path) -> Path:
    """A copy of a judged run on `logs`, free to be changed."""
    return Path(shutil.copytree(_trained, tmp_path / "trained"))


def _start(*args: object) -> subprocess.Popen[str]:
    """A process of its own group, as a terminal starts one."""
    return subprocess.Popen(
        [sys.executable, "-m", "edp", *map(str, args)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        # Tests may run in the background, where a shell has Ctrl-C ignored; children would inherit that.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )


def _stop_once(process: subprocess.Popen[str], ready: Callable[[], bool], how: int) -> tuple[int, str]:
    """Send a signal to the group as soon as `ready()`; returns exit code and standard error."""
    until = time.monotonic() + 120
    while not ready() and process.poll() is None and time.monotonic() < until:
        time.sleep(0.02)
    if process.poll() is None:
        os.killpg(process.pid, how)
    _, err = process.communicate(timeout=60)
    return process.returncode, err


@pytest.fixture
def start() -> Callable[..., subprocess.Popen[str]]:
    """Start a command line as a terminal does."""
    return _start


@pytest.fixture
def stop_once() -> Callable[..., tuple[int, str]]:
    """Stop a process as soon as something holds; exit code and standard error."""
    return _stop_once
