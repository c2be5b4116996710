"""A machine whose two speeds follow levers, a second one that follows them otherwise, and a network of the first."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from edp.config.experiment import load_experiment
from edp.logs import write_recording
from edp.logs.source import DataSource
from edp.recording import Recording
from edp.signals import Channel, Kind
from edp.workflows.train_evaluate import train
from edp.workflows.transfer import FinetuneSpec

CHANNELS = (
    Channel("lift", Kind.PILOT_PRESSURE),
    Channel("swing", Kind.PILOT_PRESSURE),
    Channel("rise", Kind.VELOCITY, "Rise"),
    Channel("turn", Kind.VELOCITY, "Turn"),
)
SETTINGS = (
    'task.features={name="levers", channels=["rise", "turn", "lift", "swing"]}',
    'task.targets=["rise", "turn"]',
    "task.horizons=[2, 5]",
    "training.epochs=3",
    "training.updates=25",
    'training.optimizer={kind="adamw",learning_rate=2e-2}',
    'training.chunks={regime="chunk",length=32,batch=4,burn_in=10}',
    'model.backbone={kind="hybrid",channels=[8],kernel=2,units=8}',
    "model.head.hidden=8",
    "model.blocks=[]",
    "model.window=10",
    "evaluation.history=4",
    'evaluation.baselines=["persistence"]',
)


def machine(name: str, seed: int, gains: tuple[float, float], samples: int = 500) -> Recording:
    rng = np.random.default_rng(seed)
    levers = 1e6 * np.repeat(rng.uniform(0, 3, (samples // 20 + 1, 2)), 20, axis=0)[:samples]
    speeds = np.zeros((samples, 2))
    for t in range(3, samples):
        wanted = np.array(gains) * (levers[t - 3] / 1e6 - 1.5)
        speeds[t] = 0.9 * speeds[t - 1] + 0.1 * wanted
    return Recording(name, CHANNELS, np.hstack([levers, speeds]).astype(np.float32), 100.0, source="test")


def write(folder: Path, recordings: list[Recording]) -> Path:
    folder.mkdir(parents=True)
    for recording in recordings:
        write_recording(recording, folder / f"{recording.name}.parquet")
    return folder


@pytest.fixture(scope="session")
def made_by() -> Callable[..., Recording]:
    """Recordings of a machine by its gains."""
    return machine


@pytest.fixture(scope="session")
def written() -> Callable[[Path, list[Recording]], Path]:
    """A folder of logs."""
    return write


@pytest.fixture(scope="session")
def settings() -> tuple[str, ...]:
    """Settings of a small network."""
    return SETTINGS


@pytest.fixture(scope="session")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run on the first machine; tests leave it as it is."""
    folder = tmp_path_factory.mktemp("source")
    logs = write(folder / "logs", [machine(f"s{i}", i, (0.2, -0.1)) for i in range(5)])
    train(DataSource.from_path(logs), load_experiment(preset="quick", overrides=SETTINGS), folder / "run")
    return folder / "run"


@pytest.fixture(scope="session")
def target(tmp_path_factory: pytest.TempPathFactory) -> DataSource:
    """Logs of the second machine."""
    folder = tmp_path_factory.mktemp("target") / "logs"
    return DataSource.from_path(write(folder, [machine(f"t{i}", 50 + i, (0.3, -0.2)) for i in range(2)]))


@pytest.fixture(scope="session")
def small() -> FinetuneSpec:
    """A fine-tuning of a second."""
    return FinetuneSpec(
        head_epochs=2,
        epochs=2,
        single_phase_epochs=4,
        batch=4,
        head_learning_rate=2e-2,
        backbone_learning_rate=4e-3,
        learning_rate=2e-2,
        rank=2,
        patience=0,
    )
