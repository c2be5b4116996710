"""Limits of a control loop: positions and speeds of the levers, strokes and pressures."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edp.errors import ConfigError
from edp.settings.bounds import above, below, check_bounds, span
from edp.wording import typed

Array = NDArray[np.float64]
Triple = tuple[float, float, float]


@dataclass(frozen=True)
class LoopLimits:
    """Limits of a loop; triples are boom, arm, bucket.

    Levers never leave theirs: `edp.control.base.Controller` cuts what a controller asks for. Strokes and pressures
    depend on the plant, so that violations are counted by the score.

    Attributes:
        lever_low: least lever positions, in [-1, 0].
        lever_high: largest lever positions, in [0, 1].
        slew_per_s: largest speed of a lever, in full positions per second.
        stroke_margin: fraction of the stroke at either end that must stay free.
        pressure_pa: largest cylinder pressure, Pa.

    Raises:
        ConfigError: a value out of its bounds, or lever limits between which a lever has no room.
    """

    lever_low: Triple = (-1.0, -1.0, -1.0)
    lever_high: Triple = (1.0, 1.0, 1.0)
    slew_per_s: Triple = (5.0, 5.0, 5.0)
    stroke_margin: float = 0.0
    pressure_pa: float = 40e6

    def __post_init__(self) -> None:
        check_bounds(
            "limits",
            self,
            # Neutral must be allowed: it is the safe command.
            lever_low=span(-1.0, 0.0),
            lever_high=span(0.0, 1.0),
            slew_per_s=above(0.0, 1e3),
            stroke_margin=below(0.0, 0.5),
            pressure_pa=above(0.0, 1e9),
        )
        for name in ("lever_low", "lever_high", "slew_per_s"):
            if len(getattr(self, name)) != 3:
                raise ConfigError(f"limits: {name} lists {len(getattr(self, name))}; boom, arm and bucket must hold")
        for axis, low, high in zip(("boom", "arm", "bucket"), self.lever_low, self.lever_high, strict=True):
            if low == high:
                raise ConfigError(
                    f"limits: lever_low and lever_high of the {axis} are both {typed(low)}, so that it cannot move; "
                    "low < high must hold"
                )

    def applied(self, levers: Array, before: Array, rate_hz: float) -> Array:
        """Return the levers within range and slew; the slew limit counts from the levers of the tick before.

        Args:
            levers: asked for, shape (3,), finite.
            before: levers of the previous sample, shape (3,).
            rate_hz: sampling rate in Hz.
        """
        step = np.array(self.slew_per_s) / rate_hz
        ranged = np.clip(levers, self.lever_low, self.lever_high)
        return np.asarray(np.clip(ranged, before - step, before + step))
