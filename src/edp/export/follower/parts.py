"""Content of a follower in C: a grey box, the adaptation of its parameters, and the corrected predictions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edp.networks.twin.adaptive_correction import TunedCorrection
from edp.networks.twin.adaptive_twin import AdaptiveTwin, TunedSpec
from edp.networks.twin.greybox import GreyTwin

Array = NDArray[np.float32]
GOLDEN_TICKS = 160
"""Number of samples of the self-test: the observer settles, and a few segments adapt the model."""
WORN = 0.2
"""Log factor, with alternating sign, by which the self-test's machine differs from the grey box in each parameter
group.
"""


@dataclass(frozen=True, eq=False)
class GoldenTicks:
    """Samples of a changed machine, and the results of the Python package for them.

    Attributes:
        inputs: commands, measured values and predictions ``(tick, number)``.
        forecasts: velocities ``(tick, horizon and velocity)``, NaN where there is none.
        factors: factors of the groups at the end ``(group,)``.
        taught: segments that have taught.
    """

    inputs: Array
    forecasts: Array
    factors: Array
    taught: int


@dataclass(frozen=True, eq=False)
class FollowerParts:
    """Content of a follower.

    Attributes:
        title: a line about it.
        twin: the grey box of the machine as it was.
        spec: settings of the parameter adaptation.
        targets: names of the predicted channels, velocities of the twin.
        horizons: prediction horizons in samples.
        limit: largest correction ``(horizon, target)``, SI units.
    """

    title: str
    twin: GreyTwin
    spec: TunedSpec
    targets: tuple[str, ...]
    horizons: tuple[int, ...]
    limit: NDArray[np.float64]

    def correction(self) -> TunedCorrection:
        """Return the correction in Python.

        Raises:
            ConfigError: a target that is no velocity of the twin, or a group that it has no number of.
        """
        return TunedCorrection(AdaptiveTwin(self.twin, self.spec), self.targets, self.horizons, self.limit)

    def golden(self) -> GoldenTicks:
        """Return samples of a machine whose parameter groups have changed."""
        correction, rng = self.correction(), np.random.default_rng(0)
        tuned, scales = correction.tuned, self.twin.scales
        signs = np.where(np.arange(len(tuned.labels)) % 2, -WORN, WORN)
        worn = self.twin.with_parameters(self.twin.numbers * np.exp(tuned.moves @ signs))
        levels = np.repeat(rng.normal(size=(GOLDEN_TICKS // 20, len(scales.command_offset))), 20, axis=0)
        commands = (scales.command_offset + scales.command_width * levels).astype(np.float32)
        start = np.clip(scales.answer_offset, scales.low, scales.high).astype(np.float32)[None]
        answers, _ = worn.rollout(commands[None, :-1], worn.initial_state(commands[:1], start))
        measured = np.concatenate([start, answers[0]])
        predictions = np.zeros((GOLDEN_TICKS, len(self.horizons), len(self.targets)), np.float32)
        forecasts = np.full((GOLDEN_TICKS, len(self.horizons), len(tuned.twin.channels.velocities)), np.nan, np.float32)
        for tick in range(GOLDEN_TICKS):
            correction.step(commands[tick], measured[tick], predictions[tick])
            for h, k in enumerate(self.horizons):
                forecast = tuned.forecast(k)
                if forecast is not None:
                    forecasts[tick, h] = forecast
        inputs = np.concatenate([commands, measured, predictions.reshape(GOLDEN_TICKS, -1)], axis=1)
        factors = np.array(list(tuned.factors.values()), np.float32)
        return GoldenTicks(inputs, forecasts.reshape(GOLDEN_TICKS, -1), factors, tuned.learned)
