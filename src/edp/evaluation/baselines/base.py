"""Interface of baselines: fitted on whole series, they predict every horizon at every sample from rows up to it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from edp.data.lags import DoubleArray, LagTask, origins
from edp.data.series import Series
from edp.errors import ConfigError, DataError
from edp.recording import FloatArray
from edp.registry import Registry


@dataclass(frozen=True)
class BaselineTask(LagTask):
    """Task of a baseline: a `LagTask` with a seed.

    Attributes:
        seed: seed of row sampling and initial weights.
    """

    seed: int


class Baseline(ABC):
    """A simple predictor with the tick-by-tick meaning of the networks; all quantities are in SI units.

    Every baseline leaves the same ticks NaN (those before a full history), so that all are scored on equal ticks.
    """

    label: ClassVar[str]
    """Name in tables and figures."""
    effort: ClassVar[int] = 2
    """Relative fitting time; 0 without fitting. The evaluation starts with the fastest baseline."""

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
        """Return the predictions made at each tick t for t + horizon, from rows up to t.

        Float32 ``(time, horizon, target)``.

        The first ``history - 1`` ticks are NaN. ``series.targets`` is not read.

        Raises:
            ConfigError: called before `fit`.
            DataError: the inputs have other columns than in training, or values that are not finite.
        """
        if self._inputs is None:
            raise ConfigError(f"{type(self).__name__} has not been fitted; call fit before predict")
        self._check_columns(series, self._inputs)
        shape = (series.samples, len(self.task.horizons), len(self.task.present))
        # NaN marks ticks without a full history; the judge then leaves them out for all models.
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
        """Return the predictions at ticks ``history - 1`` and later: ``(time - history + 1, horizon, target)``."""

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


def _check_finite(name: str, what: str, values: FloatArray) -> None:
    """Refuse NaN and infinity; min and max carry both without a mask of the array's size."""
    # Extremes of the array are finite exactly if all entries are: NaN and infinity pass through both.
    if values.size == 0 or (np.isfinite(values.min()) and np.isfinite(values.max())):
        return
    row, column = np.argwhere(~np.isfinite(values))[0]
    raise DataError(
        f"series '{name}' has {values[row, column]} in row {row} of {what} column {column}; "
        "fill or cut out such rows before fitting or predicting"
    )


BASELINES: Registry[type[Baseline]] = Registry("baseline")
