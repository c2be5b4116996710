"""Reward of a task sample: mainly the error to the reference at the same time, not the path error alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edp.settings.bounds import above, check_bounds, span

Array = NDArray[np.float64]


@dataclass(frozen=True)
class RewardWeights:
    """Weights of a tick's reward.

    ``1 / (1 + e / position_m) + attitude / (1 + a / attitude_rad) - travel * l - limit * v``, where e is the distance
    of the tip to where the reference is at that time, a the error of its attitude, l the sum of the changes of the
    three levers (full positions), and v whether a stroke or a pressure is beyond its limit. The distance to the path
    does not occur: a tip that never moves has none. An episode that ends since the tip is lost costs `lost` once,
    which is more than what ending it could save.

    Attributes:
        position_m: position error at which its part is halved.
        attitude: weight of the attitude.
        attitude_rad: error at which its part is halved.
        travel: cost of a full movement of one lever.
        limit: cost of a tick beyond a limit.
        lost: cost of losing the tip.
    """

    position_m: float = 0.02
    attitude: float = 0.2
    attitude_rad: float = 0.01
    travel: float = 0.5
    limit: float = 1.0
    lost: float = 50.0

    def __post_init__(self) -> None:
        check_bounds(
            "reward",
            self,
            position_m=above(0.0, 100.0),
            attitude=span(0.0, 1e3),
            attitude_rad=above(0.0, 10.0),
            travel=span(0.0, 1e3),
            limit=span(0.0, 1e3),
            lost=span(0.0, 1e6),
        )

    def compute_reward(
        self, position_m: Array, attitude_rad: Array, travel: Array, violated: NDArray[np.bool_]
    ) -> Array:
        """Return the reward from position and attitude errors, lever travel and limits, shape (environment,) each."""
        near = 1.0 / (1.0 + position_m / self.position_m)
        upright = self.attitude / (1.0 + np.abs(attitude_rad) / self.attitude_rad)
        return np.asarray(near + upright - self.travel * travel - self.limit * violated)
