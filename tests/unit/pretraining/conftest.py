"""Recordings of several machines that differ in their gains, on disk and prepared."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from edp.config.experiment import Experiment, load_experiment
from edp.data.prepared import Prepared
from edp.logs import write_recording
from edp.logs.source import DataSource
from edp.recording import Recording
from edp.signals import Channel, Kind
from edp.workflows.train_evaluate import prepare_data

CHANNELS = (Channel("lever", Kind.PILOT_PRESSURE), Channel("speed", Kind.VELOCITY, "Speed"))
SETTINGS = (
    'split.kind="machines"',
    'task.features={name="lever", channels=["speed", "lever"]}',
    'task.targets=["speed"]',
    "task.horizons=[2]",
    "training.epochs=3",
    "training.updates=6",
    'training.optimizer={kind="adamw",learning_rate=1e-2}',
    'training.chunks={regime="chunk",length=40,batch=8,burn_in=10}',
    'model.backbone={kind="hybrid",channels=[6],kernel=2,units=6}',
    "model.head.hidden=6",
    "model.blocks=[]",
    "model.window=10",
    'evaluation.baselines=["persistence"]',
)


def drive(machine: int, seed: int, samples: int = 900) -> Recording:
    """A speed that follows a lever; its gain is the machine's."""
    rng = np.random.default_rng(100 * machine + seed)
    lever = 1e6 * np.repeat(rng.uniform(0, 3, samples // 20 + 1), 20)[:samples]
    speed, gain = np.zeros(samples), 0.1 + 0.05 * machine
    for t in range(3, samples):
        speed[t] = 0.9 * speed[t - 1] + 0.1 * gain * (lever[t - 3] / 1e6 - 1.5)
    values = np.column_stack([lever, speed]).astype(np.float32)
    meta = {"machine": f"Press-{machine}", "mass_t": 10.0 + machine}
    return Recording(f"press{machine}_{seed}", CHANNELS, values, 100.0, source="test", meta=meta)


@pytest.fixture(scope="session")
def machines(tmp_path_factory: pytest.TempPathFactory) -> DataSource:
    """Two logs of each of six machines."""
    folder: Path = tmp_path_factory.mktemp("machines")
    for machine in range(6):
        for seed in range(2):
            recording = drive(machine, seed)
            write_recording(recording, folder / f"{recording.name}.parquet")
    return DataSource.from_path(folder)


@pytest.fixture(scope="session")
def experiment() -> Experiment:
    """A training of a second, machines apart."""
    return load_experiment(preset="quick", overrides=SETTINGS)


@pytest.fixture(scope="session")
def prepared_machines(machines: DataSource, experiment: Experiment) -> Prepared:
    """The logs, divided by machine."""
    return prepare_data(machines, experiment)
