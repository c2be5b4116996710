"""What a baseline is: fitted on whole series, it predicts every horizon at every tick from rows up to that tick."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edp.data.series import Series
from edp.errors import ConfigError, DataError
from edp.recording import FloatArray
from edp.registry import Registry

DoubleArray = NDArray[np.float64]


@dataclass(frozen=True)
class BaselineTask:
    """What to predict from what.

    Attributes:
        horizons: ticks ahead, each 0 or more; 0 estimates the target at the tick itself.
        present: per target the input column with its present value, or None when no input measures it.
        history: samples up to and including the present one that a prediction may use.
        seed: of row sampling and initial weights.

    Raises:
        ConfigError: no or negative or repeated horizons, no targets, no history, or a horizon of 0 for a target
            that the inputs already hold.
    """

    horizons: tuple[int, ...]
    present: tuple[int | None, ...]
    history: int
    seed: int

    def __post_init__(self) -> None:
        if not self.horizons or min(self.horizons) < 0 or len(set(self.horizons)) != len(self.horizons):
            raise ConfigError(f"baseline horizons are {self.horizons}; give one or more distinct values, 0 or above")
        if not self.present:
            raise ConfigError("the baseline task has no targets; name at least one")
        if self.history < 1:
            raise ConfigError(f"baseline history is {self.history} samples; it must be at least 1 (the present one)")
        held = [target for target, column in enumerate(self.present) if column is not None]
        if 0 in self.horizons and held:
            raise ConfigError(
                f"horizon 0 asks for target {held[0]} at the very tick at which input column "
                f"{self.present[held[0]]} holds it; drop that input or predict from horizon 1"
            )

    @property
    def outputs(self) -> int:
        """Number of predicted values per tick: horizons times targets."""
        return len(self.horizons) * len(self.present)


class Baseline(ABC):
    """A simple predictor with the tick-by-tick meaning of the networks; all quantities are in SI units.

    Every baseline leaves the same ticks NaN (those before a full history), so that all are scored on equal ticks.
    """

    def __init__(self, task: BaselineTask) -> None:
        self.task = task
        self._inputs: int | None = None

    def fit(self, train: Sequence[Series], validation: Sequence[Series]) -> None:
        """Learn from `train`; `validation` (may be empty) only chooses sizes and stopping points.

        Raises:
            DataError: columns do not fit the task, values are not finite, or no series in `train` is long enough
                for one history and the longest horizon.
        """
        if not train:
            raise DataError("no training series came for the baseline; give at least one")
        inputs = train[0].inputs.shape[1]
        for series in (*train, *validation):
            self._check_columns(series, inputs)
            if series.targets.shape != (series.samples, len(self.task.present)):
                raise DataError(
                    f"series '{series.name}' has targets of shape {series.targets.shape}; the task needs "
                    f"({series.samples}, {len(self.task.present)}): one row per tick, one column per target"
                )
            _check_finite(series.name, "target", series.targets)
        if not any(len(origins(series, self.task)) for series in train):
            needed = self.task.history + max(self.task.horizons)
            raise DataError(
                f"the longest training series has {max(series.samples for series in train)} ticks; history and "
                f"longest horizon together need {needed}: give longer recordings or shorten either"
            )
        self._fit(train, validation)
        self._inputs = inputs

    def predict(self, series: Series) -> FloatArray:
        """Predictions made at each tick t for t + horizon, from rows up to t: float32 ``(time, horizon, target)``.

        The first ``history - 1`` ticks are NaN. ``series.targets`` is not read.

        Raises:
            ConfigError: called before `fit`.
            DataError: the inputs have other columns than in training, or values that are not finite.
        """
        if self._inputs is None:
            raise ConfigError(f"{type(self).__name__} has not been fitted; call fit before predict")
        self._check_columns(series, self._inputs)
        shape = (series.samples, len(self.task.horizons), len(self.task.present))
        prediction = np.full(shape, np.nan, dtype=np.float32)
        first = self.task.history - 1
        if series.samples > first:
            prediction[first:] = self._predict(series.inputs)
        return prediction

    @abstractmethod
    def _fit(self, train: Sequence[Series], validation: Sequence[Series]) -> None:
        """Learn from checked series."""

    @abstractmethod
    def _predict(self, inputs: FloatArray) -> DoubleArray:
        """Predictions at ticks ``history - 1`` and later: ``(time - history + 1, horizon, target)``."""

    def _check_columns(self, series: Series, inputs: int) -> None:
        if series.inputs.ndim != 2 or series.inputs.shape[1] != inputs:
            raise DataError(
                f"series '{series.name}' has inputs of shape {series.inputs.shape}; all series must have the "
                f"{inputs} input columns of the first training series"
            )
        for target, column in enumerate(self.task.present):
            if column is not None and not 0 <= column < inputs:
                raise DataError(
                    f"target {target} has its present value in input column {column}, but series '{series.name}' "
                    f"has columns 0 to {inputs - 1}"
                )
        _check_finite(series.name, "input", series.inputs)


def origins(series: Series, task: BaselineTask) -> range:
    """Ticks with a full history behind them and the longest horizon before them: the same ones for all horizons."""
    return range(task.history - 1, max(task.history - 1, series.samples - max(task.horizons)))


def future(series: Series, task: BaselineTask, ticks: NDArray[np.int64]) -> DoubleArray:
    """What is to be predicted at `ticks`: targets at tick + horizon, ``(tick, horizon, target)``."""
    return np.stack([series.targets[ticks + horizon] for horizon in task.horizons], axis=1).astype(np.float64)


def target_means(series: Sequence[Series]) -> DoubleArray:
    """Mean of each target over all ticks, ``(target,)``."""
    total = sum(one.targets.sum(axis=0, dtype=np.float64) for one in series)
    return np.asarray(total / sum(one.samples for one in series), dtype=np.float64)


def anchors(inputs: FloatArray, task: BaselineTask, means: DoubleArray) -> DoubleArray:
    """Value that each prediction starts from: the present value, or the training mean where none is measured.

    Args:
        inputs: ``(row, input)``.
        task: says which column holds which target's present value.
        means: training means ``(target,)``.

    Returns:
        ``(row, target)``.
    """
    starts = np.tile(means, (len(inputs), 1))
    for target, column in enumerate(task.present):
        if column is not None:
            starts[:, target] = inputs[:, column]
    return starts


def _check_finite(name: str, what: str, values: FloatArray) -> None:
    """Refuse NaN and infinity; min and max carry both without a mask of the array's size."""
    if values.size == 0 or (np.isfinite(values.min()) and np.isfinite(values.max())):
        return
    row, column = np.argwhere(~np.isfinite(values))[0]
    raise DataError(
        f"series '{name}' has {values[row, column]} in row {row} of {what} column {column}; "
        "fill or cut out such rows before fitting or predicting"
    )


BASELINES: Registry[type[Baseline]] = Registry("baseline")
