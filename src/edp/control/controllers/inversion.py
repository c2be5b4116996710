"""Inversion of a learned model: the levers whose predicted velocities are those that the reference has ahead."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from edp.control.ahead import PredictorAhead, TwinAhead, VelocityModel
from edp.control.base import CONTROLLERS, Controller
from edp.control.geometry import AXES
from edp.control.limits import LoopLimits
from edp.control.models import ControlModels
from edp.control.plant import STROKES, PlantInterface
from edp.control.reference import TipReference
from edp.errors import ConfigError
from edp.settings.bounds import above, check_bounds, integer, span

Array = NDArray[np.float64]
MAX_SUM = 0.1
"""Most speed (m/s) that an integral may add: a blocked cylinder must not wind it up."""


@CONTROLLERS.register("inversion")
@dataclass(frozen=True, kw_only=True)
class ModelInversion:
    """Velocities ahead are solved for the levers, axis by axis, by trying levers around the last solution.

    Attributes:
        lead_s: prediction horizon of the model, and lead at which the speed of the reference is read, s.
        proportional: speed by stroke error, 1/s.
        integral: speed by the integral of the stroke error, 1/s^2.
        standstill_m_s: wanted speeds below this leave a lever at neutral.
        reach: farthest lever that is tried, from the last solution.
        points: levers tried an axis and side of the last solution.
    """

    needs: ClassVar[tuple[str, ...]] = ("predictor or twin",)
    space: ClassVar[Mapping[str, tuple[float, float]]] = {
        "proportional": (0.5, 10.0),
        "integral": (0.0, 10.0),
        "standstill_m_s": (0.0, 0.01),
    }

    lead_s: float = 0.2
    proportional: float = 3.0
    integral: float = 1.0
    standstill_m_s: float = 0.004
    reach: float = 0.15
    points: int = 4

    def __post_init__(self) -> None:
        check_bounds(
            "controller 'inversion'",
            self,
            lead_s=above(0.0, 5.0),
            proportional=span(0.0, 100.0),
            integral=span(0.0, 1000.0),
            standstill_m_s=span(0.0, 1.0),
            reach=above(0.0, 1.0),
            points=integer(1, 100),
        )

    def build(self, plant: PlantInterface, limits: LoopLimits, models: ControlModels) -> Controller:
        """Build the controller with a predictor, otherwise with a twin.

        Raises:
            ConfigError: there is neither, it does not fit, or the plant does not measure what it reads.
        """
        ticks = max(1, round(self.lead_s * plant.rate_hz))
        if models.predictor is None and models.twin is None:
            raise ConfigError(
                "controller 'inversion' needs a look-ahead predictor or a twin; name a run folder of edp train with "
                "--predictor, or one of edp twin with --twin"
            )
        model: VelocityModel
        if models.predictor is not None:
            model = PredictorAhead(models.predictor, ticks)
        else:
            model = TwinAhead(models.require_twin("inversion"), ticks, [channel.name for channel in plant.channels])
        return InversionController(self, plant, limits, model)


class InversionController(Controller):
    """See `ModelInversion`."""

    def __init__(self, spec: ModelInversion, plant: PlantInterface, limits: LoopLimits, model: VelocityModel) -> None:
        # The model's channels first, strokes behind: some models read strokes, too.
        super().__init__(plant, limits, (*model.reads, *STROKES))
        self.spec, self.model = spec, model
        self._strokes = self._speeds = np.zeros((0, AXES))
        self._sum, self._solution = np.zeros(AXES), np.zeros(AXES)
        self._row: Array | None = None
        self._tick = -1
        steps = spec.reach * (np.arange(1, spec.points + 1) / spec.points) ** 2
        # Denser around the last solution, where the next one most often lies.
        self._offsets = np.concatenate((-steps[::-1], [0.0], steps))

    def begin(self, measured: Array, reference: TipReference) -> None:
        """Initialise the model memory in steady state and reset the integrals."""
        self._strokes, self._speeds = reference.strokes, reference.speeds()
        self._sum, self._solution, self._row, self._tick = np.zeros(AXES), np.zeros(AXES), None, -1
        self.model.begin(measured[: len(self.model.reads)], self.plant.commands(np.zeros(AXES)))

    def levers(self, measured: Array, tick: int) -> Array:
        """Return the levers whose velocities ahead are the reference's, corrected by the error now."""
        if self._row is not None:
            # After the limits: what was given, not what was asked for.
            self.model.advance(self._row, self.plant.commands(self.before))
        self._row, self._tick = measured[: len(self.model.reads)], tick
        last = len(self._strokes) - 1
        error = self._strokes[min(tick, last)] - measured[len(self.model.reads) :]
        ahead = self._speeds[min(tick + self.model.ticks, last)]
        speed = ahead + self.spec.proportional * error + self._sum
        asked = np.where(np.abs(speed) > self.spec.standstill_m_s, self._solve_levers(speed, self._row), 0.0)
        free = (asked > self.limits.lever_low) & (asked < self.limits.lever_high)
        total = self._sum + self.spec.integral * error / self.plant.rate_hz
        self._sum = np.where(free, np.clip(total, -MAX_SUM, MAX_SUM), self._sum)
        self._solution = asked
        return asked

    def missed(self, tick: int) -> None:
        """Update the model memory with the last row if no row was received."""
        super().missed(tick)
        # A tick at which the solution failed has brought the memory up to date before it failed.
        if self._row is not None and self._tick != tick:
            self.model.advance(self._row, self.plant.commands(self.before))

    def _solve_levers(self, speed: Array, row: Array) -> Array:
        """Return the levers for wanted speeds, each axis with the others at the last solution."""
        low, high = np.array(self.limits.lever_low), np.array(self.limits.lever_high)
        tried = np.clip(self._solution[:, None] + self._offsets, low[:, None], high[:, None])
        candidates = np.repeat(self._solution[None], tried.size, axis=0)
        width = tried.shape[1]
        for axis in range(AXES):
            candidates[axis * width : (axis + 1) * width, axis] = tried[axis]
        tried_first = np.concatenate((self._solution[None], candidates))
        answers = self.model.ahead(row, self.plant.commands(tried_first))[1:]
        solution = np.empty(AXES)
        for axis in range(AXES):
            # A lever that goes farther never gives less; what a model says otherwise is its error.
            speeds = np.maximum.accumulate(answers[axis * width : (axis + 1) * width, axis])
            solution[axis] = np.interp(speed[axis], speeds + 1e-9 * np.arange(width), tried[axis])
        return solution
