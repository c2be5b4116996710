"""Combination of network predictions with forecasts of an adapted grey box, weighted by their recent errors."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from edp.errors import ConfigError, closest
from edp.networks.twin.adaptive_twin import REST, AdaptiveTwin

Array = NDArray[np.float32]
Doubles = NDArray[np.float64]
JUDGED_S = 10.0
"""Time of motion over which the errors with and without correction are averaged, s. The correction is zero before."""


class TunedCorrection:
    """Moves predictions towards the forecasts of a grey box that follows the machine.

    Let y be the network's prediction, f the grey box's forecast, and e their errors, which are known when a prediction
    comes due and are averaged over the last `JUDGED_S` of motion. The corrected prediction is ``y + w (f - y)`` with
    the weight that minimises the squared error::

        w = (mean e_y^2 - mean e_y e_f) / (mean e_y^2 + mean e_f^2 - 2 mean e_y e_f), within 0 and 1

    for each horizon and target. The correction is at most `limit`. A grey box with larger, uncorrelated errors has the
    weight 0, so predictions are unchanged.

    Args:
        tuned: grey box that is updated by the correction.
        targets: names of the predicted channels, velocities of the twin.
        horizons: horizons in samples.
        limit: largest correction ``(horizon, target)``, SI units.

    Attributes:
        weight: w ``(horizon, target)``.
        columns: index of the twin's velocity for each target.
        limit: largest correction ``(horizon, target)``, SI units.

    Raises:
        ConfigError: a target that is no velocity of the twin, a horizon below 1, or a limit that is not positive.
    """

    def __init__(self, tuned: AdaptiveTwin, targets: Sequence[str], horizons: Sequence[int], limit: Doubles) -> None:
        names = [channel.name for channel in tuned.twin.channels.velocities]
        for name in targets:
            if name not in names:
                raise ConfigError(
                    f"'{name}' is predicted, but no velocity of the twin{closest(name, names)}; a grey box corrects "
                    f"{', '.join(names)}: train the network on these, or the twin on its channels"
                )
        if not horizons or min(horizons) < 1:
            raise ConfigError(f"horizons {tuple(horizons)}; at least one, each of 1 tick or more, must hold")
        shape = (len(horizons), len(targets))
        if np.shape(limit) != shape or not (np.isfinite(limit) & (limit > 0)).all():
            raise ConfigError(f"limit of shape {np.shape(limit)}; positive numbers of shape {shape} must hold")
        self.tuned, self._horizons, self.limit = tuned, tuple(horizons), np.asarray(limit, np.float64)
        self.columns = [names.index(name) for name in targets]
        self._rate = 1.0 / (JUDGED_S * tuned.twin.channels.rate_hz)
        self.reset()

    def reset(self) -> None:
        """Forget the machine and all that was learned."""
        self.tuned.reset()
        self.weight = np.zeros(self.limit.shape)
        self._products = np.zeros((3, *self.limit.shape))
        self._judged = np.zeros(len(self._horizons), np.int64)
        self.interrupt()

    def interrupt(self) -> None:
        """Report missing samples: earlier predictions are not compared; learned weights stay."""
        self.tuned.interrupt()
        self._rows: list[list[tuple[Doubles, Doubles]]] = [[] for _ in self._horizons]

    def step(self, command: Array, measured: Array, prediction: Array, oil_c: float = math.nan) -> Array:
        """Process one sample and correct the prediction made from it.

        Args:
            command: commands of the twin ``(command,)``; a missing value stops the correction.
            measured: measured outputs of the twin ``(output,)``, NaN for a missing sensor.
            prediction: prediction of the network ``(horizon, target)``, SI units; values that are not finite are
                returned unchanged.
            oil_c: temperature of the oil (degC); NaN: not measured.
        """
        if not np.isfinite(command).all():
            self.interrupt()
        self.tuned.step(command, measured, oil_c)
        self._judge(np.asarray(measured, np.float64)[self.columns])
        base = np.asarray(prediction, np.float64)
        moved = base.copy()
        for h, k in enumerate(self._horizons):
            forecast = self.tuned.forecast(k)
            ahead = np.full(base.shape[1], np.nan) if forecast is None else forecast[self.columns]
            self._rows[h].append((base[h], ahead))
            step = np.clip(self.weight[h] * (ahead - base[h]), -self.limit[h], self.limit[h])
            moved[h] += np.where(np.isfinite(step), step, 0.0)
        return moved.astype(np.float32)

    def _judge(self, present: Doubles) -> None:
        """Update the weights from the errors of predictions and forecasts for this sample."""
        for h, k in enumerate(self._horizons):
            if len(self._rows[h]) < k:
                continue
            # Shares of the limit, so that one spike of a sensor weighs no more than the largest correction.
            ours, theirs = (np.clip((present - row) / self.limit[h], -1.0, 1.0) for row in self._rows[h].pop(0))
            products = np.stack([ours * ours, theirs * theirs, ours * theirs])
            if not np.isfinite(products).all() or (np.abs(present) <= REST).all():
                continue
            self._judged[h] += 1
            self._products[:, h] += (products - self._products[:, h]) * max(self._rate, 1.0 / self._judged[h])
            if self._judged[h] * self._rate >= 1.0:
                own, other, both = self._products[:, h]
                apart = own + other - 2.0 * both
                self.weight[h] = np.where(
                    apart > 0.0, np.clip((own - both) / np.where(apart > 0.0, apart, 1.0), 0, 1), 0.0
                )
