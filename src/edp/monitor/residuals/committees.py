"""Networks that residuals train for themselves: a linear map and a few perceptrons on changes over several spans.

Without recurrence they are trained on drawn ticks in seconds, and run along hours of logs side by side.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from edp.data.prepared import Prepared
from edp.data.series import Series
from edp.data.task import Task
from edp.errors import ConfigError
from edp.monitor.residuals.base import FitMaterial
from edp.networks.backbones import CommitteeSpec
from edp.networks.heads import LinearHead
from edp.networks.losses.mse import MeanSquared
from edp.networks.predictor import ModelSpec
from edp.settings.bounds import MAX_ROWS, MAX_UNITS, above, check_bounds, check_count, integer
from edp.settings.provenance import Provenance
from edp.training.bagging.spec import BaggingSpec
from edp.training.bundle import Bundle, make_bundle
from edp.training.fit import TrainingSpec, fit

FOLDS = 2
"""Each member leaves out half of the rows, and stops where its error there is least."""
BATCH = 512
STEPS_PER_MINUTE, MIN_STEPS, MAX_STEPS = 12_000, 200, 6_000
"""Training steps per minute on one core, and their range. The time of a fit is a target, not a bound."""
VALIDATED_TICKS = 120_000
"""Number of samples for selecting among weights: twenty minutes at 100 Hz suffice."""


@dataclass(frozen=True, kw_only=True)
class CommitteeOptions:
    """Options of such networks.

    Attributes:
        lags_s: spans of the changes of each channel that are read beside it, s; those shorter than a tick are a tick.
        members: perceptrons of a network.
        units: hidden units of each of their two layers.
        rows: ticks that train at most.

    Raises:
        ConfigError: a value is out of its bounds.
    """

    lags_s: tuple[float, ...] = (0.01, 0.04, 0.16, 0.64)
    members: int = 2
    units: int = 48
    rows: int = 150_000

    def __post_init__(self) -> None:
        object.__setattr__(self, "lags_s", tuple(self.lags_s))
        check_bounds(
            "residuals",
            self,
            lags_s=above(0.0, 60.0),
            members=integer(2, 1000),
            units=integer(1, MAX_UNITS),
            rows=integer(100, MAX_ROWS),
        )
        check_count("residuals", "lags_s", self.lags_s, 16, least=1)
        if self.members % FOLDS:
            raise ConfigError(f"residuals: members = {self.members}; a multiple of {FOLDS} must hold")

    def trained(self, task: Task, material: FitMaterial, minutes: float) -> tuple[Bundle, Prepared]:
        """Train a network for a task and return it with its training data."""
        data = _prepare_data(task, material)
        lags = sorted({max(1, round(span * material.rate_hz)) for span in self.lags_s})
        backbone = CommitteeSpec(
            lags=tuple(lags), members=self.members, units=self.units, layers=2, activations=("tanh",)
        )
        model = ModelSpec(backbone=backbone, head=LinearHead(), window=max(2, lags[-1]))
        steps = max(MIN_STEPS, min(MAX_STEPS, round(minutes * STEPS_PER_MINUTE)))
        bagging = BaggingSpec(folds=FOLDS, steps=steps, batch=BATCH, max_rows=self.rows, validations=5)
        training = TrainingSpec(loss=MeanSquared(), ensemble=bagging, seed=material.seed, device="cpu")
        fitted = fit(data, model, training)
        return make_bundle(fitted.predictor, data, Provenance(seconds=fitted.seconds)), data


def constant_channels(material: FitMaterial) -> set[str]:
    """Return channels that never change, which can be neither monitored nor used as inputs."""
    rows = [session.select(material.names) for session in material.train]
    low, high = (np.stack([f(part, axis=0) for part in rows]) for f in (np.min, np.max))
    still = low.min(axis=0) == high.max(axis=0)
    return {name for name, constant in zip(material.names, still, strict=True) if constant}


def _prepare_data(task: Task, material: FitMaterial) -> Prepared:
    channels = {channel.name: channel for channel in material.channels}
    inputs = tuple(channels[name] for name in task.inputs)
    return Prepared(
        task=task,
        train=[task.series(recording) for recording in material.train],
        validation=_shorten_series([task.series(recording) for recording in material.validation]),
        test=[],
        inputs=inputs,
        feature_kinds=tuple(channel.kind for channel in inputs),
        target_kinds=tuple(channels[name].kind for name in task.targets),
        descriptions=tuple(channels[name].description for name in task.targets),
        digest="",
    )


def _shorten_series(series: Sequence[Series]) -> list[Series]:
    """Shorten the series in equal proportion to `VALIDATED_TICKS` samples in total."""
    share = min(1.0, VALIDATED_TICKS / max(1, sum(part.samples for part in series)))
    cut = [part.samples if share == 1.0 else max(1000, int(part.samples * share)) for part in series]
    return [Series(p.name, p.inputs[:n], p.targets[:n]) for p, n in zip(series, cut, strict=True)]
