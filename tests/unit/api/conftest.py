"""A rig whose speed follows a lever, and a predictor of it that is trained in a second."""

from __future__ import annotations

import numpy as np
import pytest

import edp

TINY = {
    "training.epochs": 1,
    "training.updates": 4,
    "training.threads": 1,
    "training.optimizer": {"kind": "adamw"},
    "training.chunks": {"regime": "chunk", "length": 32, "batch": 4, "burn_in": 10},
    "model.backbone": {"kind": "hybrid", "channels": [4], "kernel": 3, "units": 4},
    "model.window": 12,
    "evaluation.history": 5,
}


def rig_drive(seed: int, ticks: int = 400) -> np.ndarray:
    """Lever in % and speed in mm/s, ``(time, 2)``."""
    lever = np.repeat(np.random.default_rng(seed).uniform(-100, 100, size=ticks // 20), 20)
    speed = np.zeros(ticks)
    for t in range(1, ticks):
        speed[t] = 0.9 * speed[t - 1] + 0.5 * lever[t - 1]
    return np.column_stack([lever, speed])


def rig_recordings(count: int = 4, **options: object) -> edp.Recordings:
    chosen = {"rate_hz": 100, "names": ["lever", "speed"], "units": ["%", "mm/s"], **options}
    return edp.Recordings.from_arrays([rig_drive(seed) for seed in range(count)], **chosen)


@pytest.fixture(scope="session")
def tiny_settings() -> dict[str, object]:
    return dict(TINY)


@pytest.fixture
def rig() -> edp.Recordings:
    return rig_recordings()


@pytest.fixture(scope="session")
def rig_model(tmp_path_factory: pytest.TempPathFactory) -> edp.TrainedPredictor:
    """Trained in a folder that stays, with intervals, on three recordings; a fourth one tests."""
    data = rig_recordings()
    return edp.train(
        data[:3],
        targets=["speed"],
        horizons=[2, 5],
        test=data[3:],
        out=tmp_path_factory.mktemp("api") / "run",
        preset="quick",
        settings=TINY | {"model.output": {"kind": "quantiles"}, "training.loss": {"kind": "quantile"}},
    )
