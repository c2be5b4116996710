"""Feed-forward through the inverse static valve map, and a PI correction of each stroke."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from edp.control.base import CONTROLLERS, STROKES, Controller, PlantInterface
from edp.control.geometry import AXES
from edp.control.limits import LoopLimits
from edp.control.models import ControlModels
from edp.control.reference import TipReference
from edp.control.valve_map import ValveMap
from edp.settings.bounds import check_bounds, span

Array = NDArray[np.float64]
MAX_SUM = 0.1
"""Most speed (m/s) that an integral may add: a blocked cylinder must not wind it up."""


@CONTROLLERS.register("pi")
@dataclass(frozen=True, kw_only=True)
class ProportionalIntegral:
    """Gains of a PI loop with feed-forward; one set for all three cylinders.

    Attributes:
        proportional: speed by stroke error, 1/s.
        integral: speed by the integral of the stroke error, 1/s^2.
        lead_s: lead at which the speed of the reference is read, s: the response time of the machine.
        standstill_m_s: wanted speeds below this leave a lever at neutral.
    """

    needs: ClassVar[tuple[str, ...]] = ("valve_map",)
    space: ClassVar[Mapping[str, tuple[float, float]]] = {
        "proportional": (0.5, 10.0),
        "integral": (0.0, 10.0),
        "lead_s": (0.05, 0.35),
        "standstill_m_s": (0.0, 0.01),
    }

    proportional: float = 3.6
    integral: float = 4.0
    lead_s: float = 0.2
    standstill_m_s: float = 0.002

    def __post_init__(self) -> None:
        check_bounds(
            "controller 'pi'",
            self,
            proportional=span(0.0, 100.0),
            integral=span(0.0, 1000.0),
            lead_s=span(0.0, 5.0),
            standstill_m_s=span(0.0, 1.0),
        )

    def build(self, plant: PlantInterface, limits: LoopLimits, models: ControlModels) -> Controller:
        """Build the controller with the valve map of the plant.

        Raises:
            ConfigError: there is no map, or the plant does not measure its strokes.
        """
        return PiController(self, plant, limits, models.require_map("pi"))


class PiController(Controller):
    """See `ProportionalIntegral`."""

    def __init__(self, spec: ProportionalIntegral, plant: PlantInterface, limits: LoopLimits, valves: ValveMap) -> None:
        super().__init__(plant, limits, STROKES)
        self.spec, self._map = spec, valves
        self._strokes = self._speeds = np.zeros((0, AXES))
        self._sum = np.zeros(AXES)
        self._lead = round(spec.lead_s * plant.rate_hz)

    def begin(self, measured: Array, reference: TipReference) -> None:
        """Forget the integrals."""
        self._strokes, self._speeds, self._sum = reference.strokes, reference.speeds(), np.zeros(AXES)

    @property
    def memory(self) -> Array:
        """Sums of the integrals, m/s, shape (3,)."""
        return self._sum

    def levers(self, measured: Array, tick: int) -> Array:
        """Return the inverse map of the speed that the reference has ahead, corrected by the error now."""
        last = len(self._strokes) - 1
        error = self._strokes[min(tick, last)] - measured
        ahead = self._speeds[min(tick + self._lead, last)]
        speed = ahead + self.spec.proportional * error + self._sum
        asked = np.array([self._map.lever(i, float(speed[i]), self.spec.standstill_m_s) for i in range(AXES)])
        # No integration at a saturated lever, which could not follow.
        free = (asked > self.limits.lever_low) & (asked < self.limits.lever_high)
        total = self._sum + self.spec.integral * error / self.plant.rate_hz
        self._sum = np.where(free, np.clip(total, -MAX_SUM, MAX_SUM), self._sum)
        return asked

    def fallback(self, measured: Array, tick: int, reason: str) -> Array:
        """Continue to control, since this controller has no model."""
        return self.levers(measured, tick)
