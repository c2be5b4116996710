"""Nonlinear model predictive control of the tip on a twin: one Gauss-Newton step a tick (real-time iteration).

Variables are the speeds that the cylinders are asked for, a few blocks a horizon; the inverse valve map makes levers of
them. Their effect on the strokes comes from runs of the twin that differ in one variable each, so any twin will do. The
quadratic program (M. Diehl et al., 2005, for the scheme) is solved by DAQP, whose bounds are the levers' ranges; stroke
and pressure limits are soft, so that it always has a solution.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from edp.control.base import CONTROLLERS, Controller, ControlFault
from edp.control.controllers.pi import PiController, ProportionalIntegral
from edp.control.geometry import AXES
from edp.control.limits import LoopLimits
from edp.control.models import ControlModels
from edp.control.nmpc.model import TwinModel
from edp.control.nmpc.moves import Moves, SpeedToLever
from edp.control.nmpc.tip import TipTable
from edp.control.plant import STROKES, PlantInterface
from edp.control.reference import TipReference
from edp.errors import ConfigError
from edp.settings.bounds import above, check_bounds, check_count, integer, span

Array = NDArray[np.float64]
MOST_BLOCKS, MOST_BLOCK_TICKS = 30, 1_000
STEP_M_S = 0.01
"""By which a speed is changed to see its effect: far above single precision, far below what bends the valve curves."""
NEAR_LIMIT = 0.1
"""Share of a range or pressure within which its limit takes part in the program; others cannot be met in a horizon."""
SOFT = 8
"""DAQP's mark of a constraint that may be violated at a price."""
FAST_TIP_M_S = 0.02
"""Reference speed above which a tip error has a direction along the path and one across."""


@CONTROLLERS.register("nmpc")
@dataclass(frozen=True, kw_only=True)
class PredictiveControl:
    """Weights are of squares: of tip errors in m^2, of changes of the asked speeds in (m/s)^2.

    Attributes:
        blocks: ticks of the blocks of the horizon.
        along: weight of the tip error along the path, beside 1 across it.
        attitude_m: length of arm (m) by which an error of the attitude in rad counts like one of the tip.
        change: weight of changes of the asked speeds, from block to block and from tick to tick.
        window_s: time over which the twin's predictions are compared with what came, for the disturbance.
        smoothing: share of a new error that the disturbance takes over in a tick; 0: offsets stay.
        fallback: whether a PI loop answers where the program has no solution; otherwise the levers go to neutral.
    """

    needs: ClassVar[tuple[str, ...]] = ("twin", "valve_map")

    blocks: tuple[int, ...] = (2, 3, 4, 6, 10, 15)
    along: float = 0.5
    attitude_m: float = 1.0
    change: float = 0.2
    window_s: float = 0.2
    smoothing: float = 0.05
    fallback: bool = True

    def __post_init__(self) -> None:
        check_count("controller 'nmpc'", "blocks", self.blocks, MOST_BLOCKS, least=1)
        check_bounds(
            "controller 'nmpc'",
            self,
            blocks=integer(1, MOST_BLOCK_TICKS),
            along=above(0.0, 1e3),
            attitude_m=span(0.0, 1e3),
            change=above(0.0, 1e6),
            window_s=above(0.0, 10.0),
            smoothing=span(0.0, 1.0),
        )

    def build(self, plant: PlantInterface, limits: LoopLimits, models: ControlModels) -> Controller:
        """The controller, with the twin and the valve map of the plant.

        Raises:
            ConfigError: one of them is missing or does not fit, or DAQP is not installed.
        """
        window = max(1, round(self.window_s * plant.rate_hz))
        model = TwinModel(models.needed_twin("nmpc"), plant, window, self.smoothing)
        valves = models.needed_map("nmpc")
        fallback = PiController(ProportionalIntegral(), plant, limits, valves) if self.fallback else None
        return NmpcController(self, limits, model, SpeedToLever(valves, limits), fallback)


class NmpcController(Controller):
    """See `PredictiveControl`."""

    def __init__(
        self,
        spec: PredictiveControl,
        limits: LoopLimits,
        model: TwinModel,
        valves: SpeedToLever,
        fallback: PiController | None,
    ) -> None:
        super().__init__(model.plant, limits, model.reads)
        self.spec, self.model, self._valves, self._fallback = spec, model, valves, fallback
        self._daqp = _daqp()
        self._moves, self._table = Moves(spec.blocks), TipTable(model.plant.geometry)
        self._stroke_columns = np.array([self.reads.index(name) for name in STROKES])
        self._slew = np.array(limits.slew_per_s) / model.plant.rate_hz
        self._reference: TipReference | None = None
        self._directions = np.zeros((0, 3, 3))
        self._speeds = np.zeros((self._moves.blocks, AXES))
        self._latest = np.zeros(AXES)
        self._row: Array | None = None
        self._tick = -1

    def begin(self, measured: Array, reference: TipReference) -> None:
        """Form the twin's memory at rest; forget plan and disturbance."""
        self.model.begin(measured)
        self._reference, self._directions = reference, _directions(reference, self.spec)
        self._speeds[:], self._latest[:], self._row, self._tick = 0.0, 0.0, None, -1
        if self._fallback is not None:
            self._fallback.begin(measured[self._stroke_columns], reference)

    def levers(self, measured: Array, tick: int) -> Array:
        """Levers of the first block of the plan, or those of the PI loop where there is none."""
        if self._row is not None:
            # After the limits: what was given, not what was asked for.
            self.model.advance(self._row, self.before)
        self._row, self._tick = measured, tick
        self.model.look_back(measured)
        spare = None if self._fallback is None else self._fallback.levers(measured[self._stroke_columns], tick)
        try:
            self._improve(measured, tick)
        except ControlFault as fault:
            self._speeds[:], self._latest[:] = 0.0, 0.0
            if spare is None:
                raise
            self._log(tick, f"{fault}: the PI loop answers")
            return spare
        return self._valves.levers(self._latest)

    def missed(self, tick: int) -> None:
        """Where no row came, the ports of the twin run free."""
        super().missed(tick)
        if self._tick != tick:
            if self._row is not None:
                self.model.advance(self._row, self.before)
            self._row, self._tick = None, tick
            self.model.advance(None, self.before)

    def _improve(self, measured: Array, tick: int) -> None:
        """One Gauss-Newton step on the plan, and its first speeds as those that are asked for."""
        moves, spec = self._moves, self.spec
        targets = self._valves.levers(moves.runs(self._speeds, STEP_M_S))
        levers = moves.levers(targets, self.before, self._slew)
        strokes, pressures = self.model.predicted(levers, measured, moves.first)
        error, by_speeds = self._errors(strokes, tick)
        turn = moves.difference.T @ moves.difference * spec.change
        begin = np.diff(np.concatenate((self._latest[None], self._speeds)), axis=0).ravel()
        hessian = by_speeds.T @ by_speeds + turn
        gradient = by_speeds.T @ error + spec.change * moves.difference.T @ begin
        rows, low, high = self._limits(strokes, pressures)
        solution, iterations = self._solved(hessian, gradient, rows, low, high)
        self._speeds += solution.reshape(self._speeds.shape)
        self._latest = self._speeds[0].copy()
        self.info = {"iterations": float(iterations), "constraints": float(len(rows))}
        self.info |= {f"disturbance_{i + 1}": float(v) for i, v in enumerate(self.model.disturbance)}

    def _errors(self, strokes: Array, tick: int) -> tuple[Array, Array]:
        """Weighted tip errors of the base, shape (3 ticks,), and their derivatives by the variables."""
        assert self._reference is not None  # noqa: S101  for the type checker: `begin` comes first
        rows = self._reference.rows(tick + 1, self._moves.ticks)
        tips, jacobians = self._table.poses(strokes[0])
        error = tips - self._reference.tip[rows]
        error[:, 2] = (error[:, 2] + np.pi) % (2.0 * np.pi) - np.pi
        by_strokes = self._directions[rows] @ jacobians
        changes = (strokes[1:] - strokes[0]) / STEP_M_S
        by_speeds = np.einsum("tij,vtj->tiv", by_strokes, changes)
        weighted = np.einsum("tij,tj->ti", self._directions[rows], error)
        return weighted.ravel(), by_speeds.reshape(-1, self._moves.count)

    def _limits(self, strokes: Array, pressures: Array) -> tuple[Array, Array, Array]:
        """Soft rows of the program at the ends of the blocks: strokes and pressures that come near a limit."""
        ends, full = self._moves.last_ticks, self.plant.geometry.full_m
        margin, most = self.limits.stroke_margin * full, self.limits.pressure_pa
        values = np.concatenate((strokes[:, ends] / full, pressures[:, ends] / most), axis=2)
        values = values.reshape(len(values), -1)
        base = values[0]
        least = np.tile(np.concatenate((margin / full, np.full(pressures.shape[2], -np.inf))), len(ends))
        largest = np.tile(np.concatenate((1.0 - margin / full, np.ones(pressures.shape[2]))), len(ends))
        near = (base < least + NEAR_LIMIT) | (base > largest - NEAR_LIMIT)
        slopes = (values[1:, near] - base[near]).T / STEP_M_S
        return slopes, least[near] - base[near], largest[near] - base[near]

    def _solved(
        self, hessian: Array, gradient: Array, rows: Array, low: Array, high: Array
    ) -> tuple[Array, int]:
        """The step of the plan, within the speeds that the levers' ranges give.

        Raises:
            ControlFault: the program has no solution, or a number in it is not finite.
        """
        now, blocks = self._speeds.ravel(), self._moves.blocks
        upper = np.concatenate((np.tile(self._valves.fastest, blocks) - now, high))
        lower = np.concatenate((np.tile(self._valves.slowest, blocks) - now, low))
        if not (np.isfinite(hessian).all() and np.isfinite(gradient).all() and np.isfinite(rows).all()):
            raise ControlFault("the model's predictions are not finite")
        sense = np.zeros(len(upper), np.int32)
        sense[self._moves.count :] = SOFT
        lower = np.maximum(lower, -1e30)
        solution, _, flag, info = self._daqp.solve(hessian, gradient, np.ascontiguousarray(rows), upper, lower, sense)
        # 1: optimal; 2: optimal with soft constraints violated.
        if flag not in (1, 2) or not np.isfinite(solution).all():
            raise ControlFault(f"the quadratic program has no solution (DAQP says {flag})")
        return np.asarray(solution), int(info["iterations"])


def _directions(reference: TipReference, spec: PredictiveControl) -> Array:
    """Rows that turn tip errors (x, y, attitude) to weighted ones across and along the path, shape (ticks, 3, 3)."""
    velocity = np.gradient(reference.tip[:, :2], 1.0 / reference.rate_hz, axis=0)
    speed = np.hypot(*velocity.T)
    moving = speed > FAST_TIP_M_S
    unit = velocity / np.where(moving, speed, 1.0)[:, None]
    rows = np.zeros((reference.ticks, 3, 3))
    rows[:, 0, 0] = rows[:, 1, 1] = 1.0
    rows[moving, 0, 0], rows[moving, 0, 1] = -unit[moving, 1], unit[moving, 0]
    rows[moving, 1, :2] = np.sqrt(spec.along) * unit[moving]
    rows[:, 2, 2] = spec.attitude_m
    return rows


def _daqp() -> Any:
    """The solver's module.

    Raises:
        ConfigError: it is not installed.
    """
    try:
        import daqp
    except ImportError as error:
        raise ConfigError(
            "controller 'nmpc' needs the package daqp: pip install 'excavator-dynamics-predictor[control]'"
        ) from error
    return daqp
