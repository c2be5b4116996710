"""A data set and a network so small that a training takes a second."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from edp.data.chunks import ChunkSpec
from edp.data.features import Derived, FeatureSet
from edp.data.prepared import Prepared
from edp.data.series import Series
from edp.data.task import TargetMode, Task
from edp.logs import write_recording
from edp.logs.source import DataSource
from edp.networks.backbones import HybridSpec
from edp.networks.blocks import LinearBypass, TemporalDifference
from edp.networks.heads import MlpHead
from edp.networks.predictor import ModelSpec
from edp.recording import Recording
from edp.signals import Channel, Kind
from edp.training.fit import TrainingSpec

SPEEDS = ("boom", "arm", "bucket")
TASK = Task(
    FeatureSet("tiny", (*SPEEDS, "lever"), (Derived("dlever", "lever"),)), SPEEDS, (1, 3), TargetMode.DELTA, 100.0
)
MODEL = ModelSpec(backbone=HybridSpec(channels=(8,), kernel=3, units=8, dropout=0.1), head=MlpHead(hidden=8), window=10)
TRAINING = TrainingSpec(
    chunks=ChunkSpec(length=32, batch=4, burn_in=20), epochs=5, updates=30, seed=3, threads=1, device="cpu"
)
WITH_BYPASS = ModelSpec(
    backbone=MODEL.backbone, head=MODEL.head, window=10, blocks=(TemporalDifference(), LinearBypass(taps=5))
)


def linear_series(seed: int, samples: int) -> Series:
    """Three linear lags of one lever that moves in steps."""
    rng = np.random.default_rng(seed)
    lever = np.repeat(rng.normal(size=samples // 25 + 1), 25)[:samples]
    speeds = np.zeros((samples, 3))
    poles, gains = np.array([0.9, 0.8, 0.95]), np.array([0.02, -0.05, 0.01])
    for t in range(3, samples):
        speeds[t] = poles * speeds[t - 1] + gains * lever[t - 3]
    inputs = np.column_stack([speeds, lever]).astype(np.float32)
    return Series(f"linear {seed}", inputs, inputs[:, :3].copy())


def prepared() -> Prepared:
    """Two recordings that train, one that validates, one that tests."""
    channels = (*(Channel(name, Kind.VELOCITY, f"{name} speed") for name in SPEEDS), Channel("lever", Kind.GENERIC))
    return Prepared(
        task=TASK,
        train=[linear_series(1, 700), linear_series(2, 600)],
        validation=[linear_series(3, 400)],
        test=[linear_series(4, 400)],
        inputs=channels,
        feature_kinds=(*[Kind.VELOCITY] * 3, Kind.GENERIC, Kind.GENERIC),
        target_kinds=(Kind.VELOCITY,) * 3,
        descriptions=tuple(channel.description for channel in channels[:3]),
        digest="0" * 32,
    )


@pytest.fixture(scope="session")
def tiny() -> Prepared:
    """A small linear data set."""
    return prepared()


@pytest.fixture(scope="session")
def tiny_model() -> ModelSpec:
    """A small hybrid with dropout."""
    return MODEL


@pytest.fixture(scope="session")
def tiny_bypass() -> ModelSpec:
    """The same with two blocks, one of them started from ridge regression."""
    return WITH_BYPASS


@pytest.fixture(scope="session")
def tiny_training() -> TrainingSpec:
    """Five short epochs on one thread."""
    return TRAINING


@pytest.fixture(scope="session")
def lever_sessions(tmp_path_factory: pytest.TempPathFactory) -> DataSource:
    """Five logs of a speed that follows a lever, on disk, for parts that read recordings themselves."""
    return write_sessions(tmp_path_factory.mktemp("sessions"), 5)


@pytest.fixture(scope="session")
def six_sessions(tmp_path_factory: pytest.TempPathFactory) -> DataSource:
    """Six logs of the same kind: for a search with both sealed test sets."""
    return write_sessions(tmp_path_factory.mktemp("six"), 6)


def write_sessions(folder: Path, count: int) -> DataSource:
    for number in range(count):
        rng = np.random.default_rng(number)
        lever = np.repeat(rng.normal(size=20), 15)
        speed = np.zeros(300)
        for t in range(1, 300):
            speed[t] = 0.9 * speed[t - 1] + 0.01 * lever[t - 1]
        channels = (Channel("lever", Kind.GENERIC), Channel("speed", Kind.VELOCITY))
        values = np.column_stack([lever, speed]).astype(np.float32)
        write_recording(Recording(f"s{number}", channels, values, 100.0), folder / f"s{number}.parquet")
    return DataSource.from_path(folder)
