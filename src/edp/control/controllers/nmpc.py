"""Nonlinear model predictive control of the tip on a twin: one Gauss-Newton step a tick (real-time iteration).

Variables are the speeds that the cylinders are asked for, a few blocks a horizon; the inverse valve map makes levers of
them. Their effect on the strokes comes from runs of the twin that differ in one variable each, so any twin will do. The
quadratic program (M. Diehl et al., 2005, for the scheme) is solved by DAQP, whose bounds are the levers' ranges; stroke
and pressure limits are soft, so that it always has a solution.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from edp.control.base import CONTROLLERS, ControlFault, Controller
from edp.control.controllers.pi import PiController, ProportionalIntegral
from edp.control.geometry import AXES
from edp.control.limits import LoopLimits
from edp.control.models import ControlModels
from edp.control.nmpc.compiled import fill_limits, fill_normal
from edp.control.nmpc.model import TwinModel
from edp.control.nmpc.moves import Moves, SpeedToLever
from edp.control.nmpc.response import response
from edp.control.nmpc.tip import TipTable
from edp.control.plant import STROKES, PlantInterface
from edp.control.reference import TipReference
from edp.errors import ConfigError
from edp.networks.twin import Twin
from edp.settings.bounds import above, check_bounds, check_count, integer, span
from edp.wording import typed

Array = NDArray[np.float64]
MAX_BLOCKS, MAX_BLOCK_TICKS = 30, 1_000
STEP_M_S = 0.01
"""Speed step for finite differences, m/s: far above rounding, and small relative to the curvature of the valve maps."""
NEAR_LIMIT = 0.1
"""Distance from a limit, as a fraction of the range, within which the limit becomes a constraint of the QP."""
NO_LIMIT = -1e30
"""Value that DAQP interprets as no lower bound."""
SOFT = 8
"""Flag of DAQP for a soft constraint."""
MIN_ANSWER, GOOD_ANSWER = 0.1, 0.5
"""Minimum and sufficient fraction of a speed step that must be visible at the end of the prediction horizon."""
ATTITUDE_M, LOADED_ATTITUDE_M = 1.0, 2.0
"""Weight of the attitude in m per rad, without and with a force model in the twin. On lines that were not evaluated, 2
held the attitude in loam better on the grey boxes of M22 and C14, and increased both errors of a poor network
(docs/journal).
"""
FAST_TIP_M_S = 0.02
"""Reference speed above which the tip error is divided into components along and across the path, m/s."""


@CONTROLLERS.register("nmpc")
@dataclass(frozen=True, kw_only=True)
class PredictiveControl:
    """Model predictive controller. Weights apply to squares: tip errors in m^2, changes of requested speeds in (m/s)^2.

    Attributes:
        blocks: length of each block of the horizon in samples.
        along: weight of the tip error along the path, beside 1 across it.
        attitude_m: length of arm (m) by which an error of the attitude in rad counts like one of the tip; None: 2 with
            a twin that is told of forces against the cylinders, as a grey box is, else 1 (`attitude_with`).
        change: weight of changes of the asked speeds, from block to block and from tick to tick.
        feedforward: weight of the asked speeds' distance from those of the reference: where the model says that a
            speed has no effect, as into an end stop, the plan goes there.
        trust_m_s: most by which a tick may change a speed of the plan: linear models hold near it only.
        window_s: time over which the twin's predictions are compared with what came, for the disturbance.
        smoothing: share of a new error that the disturbance takes over in a tick; 0: offsets stay.
        load: the fraction for forces against the cylinders, which only a twin with a load (`greybox`) has.
        fallback: whether a PI loop outputs where the program has no solution, or a guard asks for it; otherwise the
            levers go to neutral.
    """

    needs: ClassVar[tuple[str, ...]] = ("twin", "valve_map")
    space: ClassVar[Mapping[str, tuple[float, float]]] = {
        "along": (0.1, 2.0),
        "change": (0.02, 2.0),
        "smoothing": (0.005, 0.2),
    }

    blocks: tuple[int, ...] = (2, 3, 4, 6, 10, 15)
    along: float = 0.5
    attitude_m: float | None = None
    change: float = 0.2
    feedforward: float = 0.01
    trust_m_s: float = 0.1
    window_s: float = 0.2
    smoothing: float = 0.02
    load: float = 0.15
    fallback: bool = True

    def __post_init__(self) -> None:
        check_count("controller 'nmpc'", "blocks", self.blocks, MAX_BLOCKS, least=1)
        check_bounds(
            "controller 'nmpc'",
            self,
            blocks=integer(1, MAX_BLOCK_TICKS),
            along=above(0.0, 1e3),
            change=above(0.0, 1e6),
            feedforward=span(0.0, 1e6),
            trust_m_s=above(0.0, 100.0),
            window_s=above(0.0, 10.0),
            smoothing=span(0.0, 1.0),
            load=span(0.0, 1.0),
        )
        if self.attitude_m is not None:
            check_bounds("controller 'nmpc'", self, attitude_m=span(0.0, 1e3))

    def attitude_with(self, twin: Twin) -> float:
        """Return `attitude_m` with this twin."""
        if self.attitude_m is not None:
            return self.attitude_m
        return LOADED_ATTITUDE_M if twin.runner().resistance is not None else ATTITUDE_M

    def build(self, plant: PlantInterface, limits: LoopLimits, models: ControlModels) -> Controller:
        """Build the controller with the twin and the valve map of the plant.

        Raises:
            ConfigError: one of them is missing or does not fit, or DAQP is not installed.
        """
        window = max(1, round(self.window_s * plant.rate_hz))
        model = TwinModel(models.require_twin("nmpc"), plant, window, self.smoothing, self.load)
        valves = models.require_map("nmpc")
        fallback = PiController(ProportionalIntegral(), plant, limits, valves) if self.fallback else None
        return NmpcController(self, limits, model, SpeedToLever(valves, limits), fallback)


class NmpcController(Controller):
    """See `PredictiveControl`.

    Attributes:
        attitude_m: length of arm by which the attitude counts with this twin, m.
    """

    def __init__(
        self,
        spec: PredictiveControl,
        limits: LoopLimits,
        model: TwinModel,
        valves: SpeedToLever,
        fallback: PiController | None,
    ) -> None:
        # Ports of the twin that nothing measures run free, so that the plan goes on without any one channel.
        super().__init__(model.plant, limits, model.reads, spared=model.reads)
        self.spec, self.model, self._valves, self._fallback = spec, model, valves, fallback
        self.attitude_m = spec.attitude_with(model.twin)
        self._daqp = _daqp()
        self._moves, self._table = Moves(spec.blocks), TipTable(model.plant.geometry)
        self._stroke_columns = np.array([self.reads.index(name) for name in STROKES])
        self._slew = np.array(limits.slew_per_s) / model.plant.rate_hz
        self._directions, self._tips, self._ahead = np.zeros((0, 3, 3)), np.zeros((0, 3)), np.zeros((0, 0))
        count, blocks = self._moves.count, self._moves.blocks
        turn = self._moves.difference.T @ self._moves.difference
        self._smooth = spec.change * turn + spec.feedforward * np.eye(count)
        self._fastest, self._slowest = np.tile(valves.fastest, blocks), np.tile(valves.slowest, blocks)
        pressures, margin = model.pressures, limits.stroke_margin
        self._unit = np.concatenate((model.plant.geometry.full_m, np.full(pressures, limits.pressure_pa)))
        least = np.concatenate((np.full(AXES, margin), np.full(pressures, NO_LIMIT)))
        self._ends = (least, np.concatenate((np.full(AXES, 1.0 - margin), np.ones(pressures))), NEAR_LIMIT)
        most = blocks * (AXES + pressures)
        self._room, self._near = (np.empty((most, count)), np.empty(most), np.empty(most)), 0
        self._speeds = np.zeros((blocks, AXES))
        self._latest = np.zeros(AXES)
        self._row: Array | None = None
        self._tick = -1

    def check(self, measured: Array) -> None:
        """Raise an error for a plan shorter than the machine's response time, simulated by the twin from steady state.

        Raises:
            ConfigError: less than `MIN_ANSWER` of a speed is reached at the end of the plan, so that it would diverge.
        """
        self.model.begin(measured)
        shares = response(self.model, measured, self._valves, self._slew)
        if shares is None:
            return
        weakest, ticks = shares.min(axis=1), self._moves.ticks
        if weakest[min(ticks, len(weakest)) - 1] >= MIN_ANSWER:
            return
        # From then on it stays.
        enough = len(weakest) + 1 - int(np.argmax(weakest[::-1] < GOOD_ANSWER))
        tick_ms, first = 1e3 / self.model.plant.rate_hz, PredictiveControl.blocks
        longer = [*first[:-1], max(first[-1], enough - sum(first[:-1]))]
        raise ConfigError(
            f"controller.blocks = {list(self.spec.blocks)} plans {typed(ticks * tick_ms)} ms ahead, but by its twin "
            "the "
            f"machine takes {typed(enough * tick_ms)} ms from rest to half the speed that a lever asks for; plan "
            f"{enough} "
            f"ticks or more, such as {longer}"
        )

    def begin(self, measured: Array, reference: TipReference) -> None:
        """Initialise the twin memory in steady state; reset plan and disturbance."""
        self.model.begin(measured)
        # Behind its last row a reference stays, for as long as a horizon.
        rows = reference.rows(0, reference.ticks + self._moves.ticks)
        self._directions = np.ascontiguousarray(_directions(reference, self.spec.along, self.attitude_m)[rows])
        self._tips = np.ascontiguousarray(reference.tip[rows])
        self._ahead = _speeds_ahead(reference, self._moves)
        self._speeds[:], self._latest[:], self._row, self._tick = 0.0, 0.0, None, -1
        if self._fallback is not None:
            self._fallback.begin(measured[self._stroke_columns], reference)

    def levers(self, measured: Array, tick: int) -> Array:
        """Return the levers of the first block of the plan, or of the PI loop if there is no plan."""
        spare = self._update_models(measured, tick)
        try:
            self._improve(measured, tick)
        except ControlFault as fault:
            return self._give_up(spare, tick, fault)
        return self._valves.levers(self._latest)

    def fallback(self, measured: Array, tick: int, reason: str) -> Array:
        """Return the levers of the PI loop, while the twin's memory follows."""
        fault = ControlFault(f"a guard does not trust the model{f' ({reason})' if reason else ''}")
        return self._give_up(self._update_models(measured, tick), tick, fault)

    def _update_models(self, measured: Array, tick: int) -> Array | None:
        """Update twin, disturbance and PI loop, and return the levers of the PI loop; None without one."""
        if self._row is not None:
            # After the limits: what was given, not what was asked for.
            self.model.advance(self._row, self.before)
        self._row, self._tick = measured, tick
        self.model.look_back(measured)
        strokes = measured[self._stroke_columns]
        if self._fallback is None or not np.isfinite(strokes).all():
            return None
        return self._fallback.levers(strokes, tick)

    def _give_up(self, spare: Array | None, tick: int, fault: ControlFault) -> Array:
        """Discard the plan and return the output of the PI loop.

        Raises:
            ControlFault: `fault`, where it says nothing.
        """
        self._speeds[:], self._latest[:] = 0.0, 0.0
        if spare is None:
            raise fault
        self._log(tick, f"{fault}: the PI loop answers")
        return spare

    @property
    def memory(self) -> Array:
        """Speeds of the plan (m/s) by block, the last requested ones, sums of the PI loop, disturbance, load (N)."""
        sums = np.zeros(AXES) if self._fallback is None else self._fallback.memory
        return np.concatenate((self._speeds.ravel(), self._latest, sums, self.model.disturbance, self.model.load))

    def missed(self, tick: int) -> None:
        """Let the twin run free if no row was received."""
        super().missed(tick)
        if self._tick != tick:
            if self._row is not None:
                self.model.advance(self._row, self.before)
            self._row, self._tick = None, tick
            self.model.advance(None, self.before)

    def _improve(self, measured: Array, tick: int) -> None:
        """Apply one Gauss-Newton step to the plan, and request its first speeds."""
        moves, speeds = self._moves, self._speeds
        # Away from the fastest speed, beyond which a lever has no more to give and a step would show no effect.
        steps = np.where(speeds + STEP_M_S > self._valves.fastest, -STEP_M_S, STEP_M_S)
        levers = moves.levers(self._valves.levers(moves.runs(speeds, steps)), self.before, self._slew)
        strokes, pressures = self.model.predicted(levers, measured, moves.first)
        normal = self._normal(strokes, steps.ravel(), tick)
        hessian = normal[:, :-1] + self._smooth
        gradient = normal[:, -1] + self._smooth @ speeds.ravel()
        gradient -= self.spec.feedforward * self._ahead[min(tick, len(self._ahead) - 1)]
        # The first change is from what was asked for last.
        gradient[:AXES] -= self.spec.change * self._latest
        solution, iterations = self._solve_step(hessian, gradient, *self._limits(strokes, pressures, steps.ravel()))
        self._speeds += solution.reshape(speeds.shape)
        self._latest = self._speeds[0].copy()
        first, second, third = self.model.disturbance.tolist()
        self.info = {"iterations": float(iterations), "constraints": float(self._near)}
        self.info |= {"disturbance_1": first, "disturbance_2": second, "disturbance_3": third}

    def _normal(self, strokes: Array, steps: Array, tick: int) -> Array:
        """Return the products of the derivatives of weighted tip errors by the variables, and of these with the errors.

        Args:
            strokes: strokes of all runs, the base first, m, shape (variable + 1, tick, 3).
            steps: step of each variable in its run, m/s, shape (variable,).
            tick: now.

        Returns:
            Shape (variable, variable + 1), errors last.
        """
        tips, jacobians = self._table.poses(strokes[0])
        now = min(tick + 1, len(self._ahead) - 1)
        rows = slice(now, now + self._moves.ticks)
        directions, goals = self._directions[rows], self._tips[rows]
        normal = np.empty((self._moves.count, self._moves.count + 1))
        fill_normal(strokes, steps, tips, jacobians, directions, goals, normal)
        return normal

    def _limits(self, strokes: Array, pressures: Array, steps: Array) -> tuple[Array, Array, Array]:
        """Return the soft rows of the program at the ends of the blocks: strokes and pressures that come near a limit.

        Args:
            strokes: strokes of all runs, the base first, m, shape (variable + 1, tick, 3).
            pressures: pressures of all runs, Pa, shape (variable + 1, tick, number).
            steps: step of each variable in its run, m/s, shape (variable,).

        Returns:
            Slopes by the variables, shape (row, variable), least and largest change, shape (row,) each.
        """
        ends = self._moves.last_ticks
        values = np.concatenate((strokes[:, ends], pressures[:, ends]), axis=2)
        self._near = rows = fill_limits(values, steps, self._unit, self._ends, self._room)
        slopes, low, high = self._room
        return slopes[:rows], low[:rows], high[:rows]

    def _solve_step(self, hessian: Array, gradient: Array, rows: Array, low: Array, high: Array) -> tuple[Array, int]:
        """Return the step of the plan, within the speeds allowed by the lever ranges.

        Raises:
            ControlFault: the program has no solution, or a number in it is not finite.
        """
        now, reach = self._speeds.ravel(), self.spec.trust_m_s
        upper = np.concatenate((np.minimum(self._fastest - now, reach), high))
        lower = np.concatenate((np.maximum(self._slowest - now, -reach), low))
        # Whatever is not finite makes a sum that is not.
        if not math.isfinite(float(hessian.sum() + gradient.sum() + rows.sum())):
            raise ControlFault("the model's predictions are not finite")
        sense = np.zeros(len(upper), np.int32)
        sense[self._moves.count :] = SOFT
        solution, _, flag, info = self._daqp.solve(hessian, gradient, np.ascontiguousarray(rows), upper, lower, sense)
        # 1: optimal; 2: optimal with soft constraints violated.
        if flag not in (1, 2) or not np.isfinite(solution).all():
            raise ControlFault(f"the quadratic program has no solution (DAQP says {flag})")
        return np.asarray(solution), int(info["iterations"])


def _speeds_ahead(reference: TipReference, moves: Moves) -> Array:
    """Return the mean speeds of the reference's strokes in each block, for a plan from each tick, m/s.

    Shape (tick, variable).
    """
    strokes, last = reference.strokes, reference.ticks - 1
    now = np.arange(reference.ticks)[:, None]
    ends = now + 1 + moves.last_ticks
    begins = np.concatenate((now, ends[:, :-1]), axis=1)
    moved = strokes[np.minimum(ends, last)] - strokes[np.minimum(begins, last)]
    return np.asarray(moved * reference.rate_hz / (ends - begins)[..., None]).reshape(len(now), moves.count)


def _directions(reference: TipReference, along: float, attitude_m: float) -> Array:
    """Return the rows that turn tip errors (x, y, attitude) to weighted ones across and along the path.

    Shape (ticks, 3, 3).
    """
    velocity = np.gradient(reference.tip[:, :2], 1.0 / reference.rate_hz, axis=0)
    speed = np.hypot(*velocity.T)
    moving = speed > FAST_TIP_M_S
    unit = velocity / np.where(moving, speed, 1.0)[:, None]
    rows = np.zeros((reference.ticks, 3, 3))
    rows[:, 0, 0] = rows[:, 1, 1] = 1.0
    rows[moving, 0, 0], rows[moving, 0, 1] = -unit[moving, 1], unit[moving, 0]
    rows[moving, 1, :2] = np.sqrt(along) * unit[moving]
    rows[:, 2, 2] = attitude_m
    return rows


def _daqp() -> Any:
    """Import the solver.

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
