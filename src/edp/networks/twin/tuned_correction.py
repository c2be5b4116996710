"""What a grey box that follows the machine adds to a network's predictions, judged tick by tick."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from edp.errors import ConfigError, closest
from edp.networks.twin.tuned import TunedTwin

Array = NDArray[np.float32]
Doubles = NDArray[np.float64]
JUDGED_S = 10.0
"""Over which errors without and with the correction are compared."""
WORSE, BETTER = 1.05, 0.99
"""Shares of the error without it at which a correction is taken back, and let out again."""


class TunedCorrection:
    """Moves predictions by what the change of the machine is worth to a grey box: tuned less plain forecast.

    The network knows the machine as it was, and so does the grey box with its first numbers; what the tuned numbers say
    otherwise of the next ticks is added, at most `limit`. A correction that does worse than none over the last
    `JUDGED_S` is taken back, number by number, until it would do better.

    Args:
        tuned: the grey box; the correction feeds it.
        targets: names of the predicted channels, velocities of the twin.
        horizons: ticks ahead.
        limit: largest correction ``(horizon, target)``, SI units.

    Attributes:
        fallback: which numbers go out as they came ``(horizon, target)``.

    Raises:
        ConfigError: a target that is no velocity of the twin, a horizon below 1, or a limit that is not positive.
    """

    def __init__(self, tuned: TunedTwin, targets: Sequence[str], horizons: Sequence[int], limit: Doubles) -> None:
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
        self.tuned, self._horizons, self._limit = tuned, tuple(horizons), np.asarray(limit, np.float64)
        self._columns = [names.index(name) for name in targets]
        self._rate = 1.0 - math.exp(-1.0 / (JUDGED_S * tuned.twin.channels.rate_hz))
        self.reset()

    def reset(self) -> None:
        """Forget the machine and all that was learned."""
        self.tuned.reset()
        shape = self._limit.shape
        self.fallback = np.zeros(shape, dtype=bool)
        self._plain, self._corrected = np.zeros(shape), np.zeros(shape)
        self.interrupt()

    def interrupt(self) -> None:
        """Tell that ticks are missing: what was predicted before them is not judged; what was learned stays."""
        self.tuned.interrupt()
        self._rows: list[list[tuple[Doubles, Doubles]]] = [[] for _ in self._horizons]

    def step(self, command: Array, measured: Array, prediction: Array, oil_c: float = math.nan) -> Array:
        """Take a tick in and correct what was predicted from it.

        Args:
            command: of the twin ``(command,)``, finite.
            measured: what the twin answers ``(answer,)``, NaN where a sensor is missing.
            prediction: the network's ``(horizon, target)``, SI units; as it is where it is not finite.
            oil_c: temperature of the oil (degC); NaN: not measured.
        """
        self.tuned.step(command, measured, oil_c)
        base = np.asarray(prediction, np.float64)
        self._judge(np.asarray(measured, np.float64)[self._columns])
        added = np.zeros_like(base)
        for h, k in enumerate(self._horizons):
            forecasts = self.tuned.forecast(k)
            if forecasts is not None:
                added[h] = (forecasts[1] - forecasts[0])[self._columns]
        added = np.where(np.isfinite(added), np.clip(added, -self._limit, self._limit), 0.0)
        for h, rows in enumerate(self._rows):
            rows.append((base[h], base[h] + added[h]))
        return np.where(self.fallback, base, base + added).astype(np.float32)

    def _judge(self, present: Doubles) -> None:
        """Compare what was said of this tick, without and with the correction."""
        for h, k in enumerate(self._horizons):
            if len(self._rows[h]) < k:
                continue
            plain, corrected = (np.abs(present - expected) for expected in self._rows[h].pop(0))
            usable = np.isfinite(plain) & np.isfinite(corrected)
            self._plain[h][usable] += self._rate * (plain - self._plain[h])[usable]
            self._corrected[h][usable] += self._rate * (corrected - self._corrected[h])[usable]
        worse = self._corrected > WORSE * self._plain
        better = self._corrected < BETTER * self._plain
        self.fallback = (self.fallback | worse) & ~better
