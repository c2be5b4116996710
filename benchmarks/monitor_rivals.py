"""What the monitor is measured against: PyOD's detectors, PCA with T2 and SPE, and residuals of a linear predictor.

All see the measured channels of the same sessions, a block a second, and get their limits from the same held-out
healthy sessions for the same rate of false alarms (`edp.monitor.calibration`).
"""

from __future__ import annotations

import importlib
from abc import ABC, abstractmethod
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from edp.errors import DataError
from edp.monitor.calibration import AlarmLimit, calibrated
from edp.monitor.detectors import CusumSpec, EwmaSpec
from edp.monitor.detectors.base import DetectorSpec, alarms
from edp.monitor.whitening import Whitening

Floats = NDArray[np.float64]
PYOD = {"CBLOF": {"random_state": 0}, "GMM": {"n_components": 8, "random_state": 0}}
"""Detectors that were the best of ten, with options where the defaults are random or of one component."""
MAX_ROWS = 5_000
"""Blocks that a PyOD detector is fitted to: neighbours of more take hours."""
CHARTS: dict[str, DetectorSpec] = {"ewma": EwmaSpec(), "cusum": CusumSpec(slack=0.25)}


def blocks_of(values: NDArray[np.float32], ticks: int) -> Floats:
    """Mean and spread of each channel in each block, shape (blocks, 2 * channels)."""
    whole = len(values) // ticks * ticks
    blocks = values[:whole].astype(float).reshape(-1, ticks, values.shape[1])
    return np.concatenate([blocks.mean(axis=1), blocks.std(axis=1)], axis=1)


def white_of(sessions: Sequence[Floats]) -> Whitening:
    """Whitening; where there are too few rows for a covariance, each column is scaled alone."""
    try:
        return Whitening.fit(sessions)
    except DataError:
        rows = np.concatenate(list(sessions))
        size = rows.std(axis=0)
        return Whitening(rows.mean(axis=0), np.diag(1.0 / np.where(size > 0.0, size, 1.0)))


class Rival(ABC):
    """A way to turn a session into rows that a chart watches."""

    @abstractmethod
    def fit(self, sessions: Sequence[NDArray[np.float32]], ticks: int) -> None:
        """Learn from healthy sessions, shape (time, channels) each; `ticks` of them a block."""

    @abstractmethod
    def rows(self, values: NDArray[np.float32]) -> Floats:
        """White rows of a session, shape (blocks, statistics)."""


class OfBlocks(Rival):
    """Scores of standardised blocks, made white on the training sessions."""

    def fit(self, sessions: Sequence[NDArray[np.float32]], ticks: int) -> None:
        """See `Rival.fit`."""
        self.ticks = ticks
        raw = [blocks_of(values, ticks) for values in sessions]
        rows = np.concatenate(raw)
        self.mean, size = rows.mean(axis=0), rows.std(axis=0)
        self.size = np.where(size > 0.0, size, 1.0)
        self.learn((rows - self.mean) / self.size)
        self.white = white_of([self.scores((blocks - self.mean) / self.size) for blocks in raw])

    def rows(self, values: NDArray[np.float32]) -> Floats:
        """See `Rival.rows`."""
        return self.white(self.scores((blocks_of(values, self.ticks) - self.mean) / self.size))

    @abstractmethod
    def learn(self, rows: Floats) -> None:
        """From standardised blocks."""

    @abstractmethod
    def scores(self, rows: Floats) -> Floats:
        """Shape (blocks, statistics)."""


class Pyod(OfBlocks):
    """A detector of PyOD by the name of its class."""

    def __init__(self, name: str, seed: int = 0) -> None:
        module = importlib.import_module(f"pyod.models.{name.lower()}")
        self.model, self.seed = getattr(module, name)(**PYOD[name]), seed

    def learn(self, rows: Floats) -> None:
        """On a draw of the blocks."""
        rng = np.random.default_rng(self.seed)
        self.model.fit(rows[rng.permutation(len(rows))[:MAX_ROWS]])

    def scores(self, rows: Floats) -> Floats:
        """Its score; the logarithm where it spans decades, as charts are made for bells."""
        score = np.asarray(self.model.decision_function(rows), dtype=float)
        return np.sign(score)[:, None] * np.log1p(np.abs(score))[:, None]


class Pca(OfBlocks):
    """Hotelling's T2 of the components that explain `SHARE` of the variance, and the squared prediction error."""

    SHARE = 0.95

    def learn(self, rows: Floats) -> None:
        """Components."""
        variances, vectors = np.linalg.eigh(np.cov(rows, rowvar=False))
        order = np.argsort(variances)[::-1]
        kept = int(np.searchsorted(np.cumsum(variances[order]) / variances.sum(), self.SHARE)) + 1
        self.vectors, self.variances = vectors[:, order[:kept]], variances[order[:kept]]

    def scores(self, rows: Floats) -> Floats:
        """Logarithms of T2 and SPE."""
        parts = rows @ self.vectors
        t2 = (parts**2 / self.variances).sum(axis=1)
        spe = ((rows - parts @ self.vectors.T) ** 2).sum(axis=1)
        return np.log(np.stack([t2, spe], axis=1) + 1e-9)


class Linear(Rival):
    """Ridge predictors of every channel some ticks ahead, from the last ticks of all; residuals by block."""

    LAGS = (0, 1, 4)
    RIDGE = 1e-6
    STEPS = (1, 10)

    def _past(self, values: NDArray[np.float32]) -> tuple[NDArray[np.float32], list[NDArray[np.float32]]]:
        # In single precision: hours at 100 Hz are many rows.
        scaled = ((values - self.mean) / self.size).astype(np.float32)
        first, last = max(self.LAGS), len(scaled) - max(self.STEPS)
        past = [scaled[first - lag : last - lag] for lag in self.LAGS]
        ahead = [scaled[first + steps : last + steps] for steps in self.STEPS]
        return np.concatenate([*past, np.ones((last - first, 1), np.float32)], axis=1), ahead

    def _residual_blocks(self, values: NDArray[np.float32]) -> Floats:
        past, ahead = self._past(values)
        residuals = np.zeros((len(values), len(ahead) * values.shape[1]), np.float32)
        expected = past @ self.weights.astype(np.float32)
        residuals[len(values) - len(past) :] = np.concatenate(ahead, axis=1) - expected
        blocks = blocks_of(residuals, self.ticks)
        width = residuals.shape[1]
        return np.concatenate([blocks[:, :width], np.log(blocks[:, width:] + 1e-6)], axis=1)

    def fit(self, sessions: Sequence[NDArray[np.float32]], ticks: int) -> None:
        """See `Rival.fit`; residuals are made white on the second half, which the predictor has not seen."""
        self.ticks = ticks
        half = max(1, len(sessions) // 2)
        rows = np.concatenate([values[::10] for values in sessions[:half]]).astype(float)
        self.mean, size = rows.mean(axis=0), rows.std(axis=0)
        self.size = np.where(size > 0.0, size, 1.0)
        width = len(self.LAGS) * rows.shape[1] + 1
        square, product = np.zeros((width, width)), np.zeros((width, len(self.STEPS) * rows.shape[1]))
        count = 0
        for values in sessions[:half]:
            past, ahead = self._past(values)
            square += past.T @ past
            product += past.T @ np.concatenate(ahead, axis=1)
            count += len(past)
        self.weights = np.linalg.solve(square + self.RIDGE * (1 + count) * np.eye(width), product)
        self.white = white_of([self._residual_blocks(values) for values in sessions[half:] or sessions])

    def rows(self, values: NDArray[np.float32]) -> Floats:
        """See `Rival.rows`."""
        return self.white(self._residual_blocks(values))


def rivals_of(pyod: Sequence[str]) -> dict[str, Rival]:
    """All rivals by name; of PyOD these."""
    made: dict[str, Rival] = {f"PyOD {name}": Pyod(name) for name in pyod}
    return made | {"PCA T2 + SPE": Pca(), "linear residuals, k = 1 and 10": Linear()}


def has_pyod() -> bool:
    """Whether PyOD is installed; says what is left out where it is not."""
    try:
        importlib.import_module("pyod.models.base")
    except ImportError:
        print("PyOD is not installed: its detectors are left out; pip install pyod==3.6.7")
        return False
    return True


def limit_of(chart: DetectorSpec, sessions: Sequence[Floats], rows_per_s: float, hours: float) -> AlarmLimit:
    """Fit the limit of a chart on held-out healthy sessions."""
    return calibrated(chart, sessions, rows_per_s, hours)


def raised(chart: DetectorSpec, limit: float, rows: Floats, rows_per_s: float) -> list[float]:
    """When alarms are raised in a session, s: at the end of their block."""
    found = alarms(chart.build(rows.shape[1]), rows[:, None, :], limit)
    return [(alarm.row + 1) / rows_per_s for alarm in found]
