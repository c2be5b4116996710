"""Fit of a grey box to free runs: Gauss-Newton steps with exact tangents, from several starts.

A grey box has some hundred parameters of very different influence. Gauss-Newton steps, damped by Levenberg and
Marquardt's rule, find the valleys between them in tens of iterations, where steps along a gradient take thousands. Each
round draws new windows, first short, then longer: a bad start cannot carry a long run astray at once.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from edp.data.series import Series
from edp.errors import DataError
from edp.networks.twin.descent import DescentLimits, NormalEquations, descend
from edp.networks.twin.grey.datasheet import datasheet
from edp.networks.twin.grey.parameters import coarse_by_fine
from edp.networks.twin.grey.priors import STRETCHES
from edp.networks.twin.grey.rollouts import RunBatch
from edp.networks.twin.greybox import GreyTwin, RunTarget
from edp.networks.twin.parameters import Parametrisation, Priors
from edp.networks.twin.windows import MeasuredWindows, random_windows
from edp.training.blas import one_blas_thread
from edp.training.fitted_twin import FitHistory, FittedTwin, FreeRunProgress
from edp.training.free_run import FreeRunValidation

Doubles = NDArray[np.float64]
FINEST = 0.02
"""Error in deviations that a fit is taken to leave: it weighs the data against what is plausible."""
APART = 0.3
"""Spread of the further starts in prior standard deviations: far enough for another valley, near enough to simulate."""
MIN_GAIN = 0.01
"""Share of the validation error by which finer curves must be better."""
TRIES = 4
"""Steps, each damped more, after which a round gives up and draws other windows."""


@dataclass(eq=False)
class GreyRound:
    """Windows of one round, in units of the grey box."""

    demands: Doubles
    measured: Doubles
    target: RunTarget


@dataclass(frozen=True, eq=False, kw_only=True)
class GreyFit(FittedTwin):
    """A fitted grey box.

    Attributes:
        twin: grey box with the parameters of the best validation.
        information: inverse covariance of the coordinates by the windows of the last rounds, without the prior
            ``(coordinate, coordinate)``.
        theta: coordinates at which the fit ended, in prior standard deviations ``(coordinate,)``.
        error: error of the free runs of the validation part, see `FreeRunValidation.error`.
    """

    twin: GreyTwin
    information: Doubles
    theta: Doubles
    error: float


class GreyProblem:
    """Free-run losses of a grey box as a function of coordinates.

    Args:
        twin: grey box, whose parameters are the origin of the coordinates.
        train: training segments.
        parametrisation: coordinates of the fit, by default one of each parameter.
        carried: information of the coordinates from an earlier fit, whose end is the start: only final rounds are left.
    """

    def __init__(
        self,
        twin: GreyTwin,
        train: Sequence[Series],
        parametrisation: Parametrisation | None = None,
        carried: Doubles | None = None,
    ) -> None:
        stroke_weight, delta = twin.spec.fit.stroke_weight, twin.spec.fit.delta
        self.twin, self.delta, self.carried = twin, delta / FINEST, carried
        # Coordinates begin at the start of the twin, which knows more than the nominal parameters.
        self.parametrisation = parametrisation or replace(twin.table.priors, origin=twin.numbers.copy())
        channels = twin.channels
        counts = (len(channels.velocities), len(channels.strokes), len(channels.pressures))
        each = np.repeat([1.0, stroke_weight, 1.0], counts)
        self.weight = each * twin.units / twin.scales.answer_width.astype(np.float64) / FINEST
        self.series = [part for part in train if part.samples > twin.prefix_ticks + 2]
        self.ticks = max(1, sum(part.samples for part in self.series))

    def draw(self, ticks: int, lanes: int, rng: np.random.Generator) -> GreyRound:
        """Draw windows with starts everywhere.

        Raises:
            DataError: no segment is long enough.
        """
        prefix = self.twin.prefix_ticks
        length = prefix + ticks
        if not any(part.samples > length for part in self.series):
            raise DataError(
                f"no stretch is longer than prefix and free run, {length} ticks; give longer recordings, or "
                "shorter free runs (twin.lengths_s)"
            )
        windows = MeasuredWindows.read(random_windows(self.series, length, lanes, rng), length)
        values = windows.outputs / self.twin.units
        measured = values[:, :-1].copy()
        measured[:, prefix + 1 :] = np.nan
        # Rows that count lie apart: neighbouring errors of a run say the same.
        followed = prefix if self.twin.wiring.whole else 0
        truth, stride = np.ascontiguousarray(values[:, 1:]), max(1, ticks // 10)
        target = RunTarget(truth, self.weight, self.delta, prefix, followed, stride)
        return GreyRound(self.twin.demands(windows.commands), measured, target)

    @property
    def final_memory(self) -> float:
        """Return the memory of the final rounds, limited by the number of samples."""
        fit = self.twin.spec.fit
        return min(fit.final_memory, max(0.0, 1.0 - fit.final_ticks / self.ticks))

    def twin_at(self, theta: Doubles) -> GreyTwin:
        """Return the grey box at coordinates."""
        return self.twin.with_parameters(self.parametrisation.values(theta))

    def normal_equations(self, theta: Doubles, windows: GreyRound, full: bool) -> NormalEquations:
        """Return the loss of each run, with gradient and Gauss-Newton matrix by the coordinates if `full`."""
        twin = self.twin
        rest = twin.rest(windows.demands[:, 0], (windows.measured[:, 0] * twin.units).astype(np.float32))
        state = (np.ascontiguousarray(values, dtype=np.float64) for values in (windows.measured[:, 0], *rest))
        batch = RunBatch(windows.demands, windows.measured, *state)
        equations = twin.evaluate_runs(self.parametrisation.values(theta), batch, windows.target, full)
        return self.parametrisation.transform(equations, theta) if full else equations


@one_blas_thread()
def fit_grey_box(
    twin: GreyTwin,
    train: Sequence[Series],
    validation: Sequence[Series],
    seed: int,
    on_event: Callable[[FreeRunProgress], None] | None = None,
    parametrisation: Parametrisation | None = None,
) -> GreyFit:
    """Fit the parameters of a grey box to free runs; free runs on the validation data select the best round.

    Where the settings leave the segments of opening curves open, the fewest are fitted first. Then each one is halved,
    which changes no curve, and final rounds follow: as often as the validation part gains by it.

    Args:
        twin: grey box with initial parameters.
        train: training segments.
        validation: segments that choose.
        seed: seed of the windows and of the further starts.
        on_event: called after each round.
        parametrisation: coordinates of the fit, by default one of each parameter.

    Raises:
        DataError: segments that are too short.
    """
    spec = twin.spec.fit
    history = FitHistory(sum(spec.rounds) + (spec.starts - 1) * spec.rounds[0] + spec.final_rounds, on_event)
    if parametrisation is not None or twin.spec.curve_segments or not spec.final_rounds:
        return _Stages(GreyProblem(twin, train, parametrisation), validation, seed, history).fit()
    coarse = GreyProblem(twin.with_stretches(STRETCHES[0]), train)
    begin = best = _Stages(coarse, validation, seed, history).fit(final=False)
    # Start a finer form before the final rounds of the coarser one, whose accumulated information suits its own curves.
    # Scale the accumulated information of several rounds to the information of a single round.
    share = 1.0 - spec.memory
    for stretches in STRETCHES:
        finer = begin.twin.with_stretches(stretches)
        by_finer = coarse_by_fine(begin.twin.table, finer.table)
        problem = GreyProblem(finer, train, carried=share * by_finer.T @ begin.information @ by_finer)
        fit = _Stages(problem, validation, seed + stretches, history).fit()
        history.updates += spec.final_rounds
        better = fit.error < (1.0 - MIN_GAIN) * best.error
        best = fit if better else best
        if stretches == STRETCHES[0]:
            continue
        if not better:
            break
        begin, share = best, 1.0 - coarse.final_memory
    return replace(best, history=history.rows, seconds=history.seconds)


class _Stages:
    """Stages and final rounds of the fit of one form."""

    def __init__(self, problem: GreyProblem, validation: Sequence[Series], seed: int, history: FitHistory) -> None:
        self.problem, self.history, twin = problem, history, problem.twin
        spec = self.spec = twin.spec.fit
        ticks = round(spec.validation_s * twin.channels.rate_hz)
        self.judge = FreeRunValidation(twin, validation, ticks, spec.validation_runs)
        self.paths = [_Path(problem, n, seed) for n in range(spec.starts if problem.carried is None else 1)]

    def fit(self, final: bool = True) -> GreyFit:
        """Return the best round; `final`: whether final rounds follow the stages."""
        spec, chosen = self.spec, self.paths[0]
        lengths = [length for length, count in zip(spec.lengths_s, spec.rounds, strict=True) for _ in range(count)]
        if self.problem.carried is None:
            for path in self.paths:
                self._advance(path, lengths[: spec.rounds[0]])
            # Which valley a start lies in shows after short runs; long ones of every start would cost as much again.
            chosen = min(self.paths, key=lambda path: path.least)
            self._advance(chosen, lengths[spec.rounds[0] :])
        if final:
            self._advance(chosen, lengths[-1:] * spec.final_rounds, final)
        twin, history, information = self.problem.twin_at(chosen.best), self.history, chosen.information
        by_parameters = isinstance(self.problem.parametrisation, Priors)
        return GreyFit(
            twin=twin, history=history.rows, seconds=history.seconds,
            datasheet=datasheet(twin.table, twin.numbers, information) if by_parameters else (),
            information=information, theta=chosen.best, error=chosen.least,
        )  # fmt: skip

    def _advance(self, path: _Path, lengths: Sequence[float], final: bool = False) -> None:
        """Run rounds on free runs of these lengths, and validate at intervals."""
        for number, length_s in enumerate(lengths, 1):
            self.history.done += 1
            before = path.theta
            path.step(length_s, final)
            # The last round of a stage is validated, whatever its number.
            if number != len(lengths) and number % self.spec.validate_every and length_s == lengths[number]:
                continue
            self.judge.twin = self.problem.twin_at(path.theta)
            error = self.judge.error()
            better = path.judge(error) and path.least <= min(other.least for other in self.paths)
            moved = float(np.sqrt(np.mean((path.theta - before) ** 2)))
            row = {"start": path.number, "length_s": length_s, "validation": error}
            row |= {"stretches": self.problem.twin.table.stretches, "best": better, "moved": moved}
            self.history.add(row | {"damping": path.damping}, length_s, error, better)


class _Path:
    """The way of one start through the rounds.

    Attributes:
        theta: coordinates now; `best` with the least validation error.
        least: least validation error.
        information: information on the coordinates at `best`, as `GreyFit` has it.
    """

    def __init__(self, problem: GreyProblem, number: int, seed: int) -> None:
        self.problem, self.number = problem, number
        # Each start has windows of its own; the first one begins at the balance of forces.
        self.rng = np.random.default_rng([seed, number] if number else seed)
        self.theta = problem.parametrisation.begin
        size = len(self.theta)
        if number:
            self.theta = self.theta + APART * self.rng.normal(size=size)
        self.best, self.least, self.damping = self.theta, np.inf, 1.0
        self.matrix, self.information = np.zeros((size, size)), np.zeros((size, size))
        # Without what earlier rounds knew each round would fit its own few windows, noise included.
        self.memory = np.zeros((size, size)) if problem.carried is None else problem.carried

    def step(self, length_s: float, final: bool) -> None:
        """Run one round on free runs of a length."""
        problem, spec = self.problem, self.problem.twin.spec.fit
        ticks = max(1, round(length_s * problem.twin.channels.rate_hz))
        lanes = max(8, min(spec.batch, (spec.final_ticks if final else spec.ticks) // ticks))
        windows = problem.draw(ticks, lanes, self.rng)
        descent = descend(
            lambda theta, full: problem.normal_equations(theta, windows, full),
            self.theta, DescentLimits(1 if final else spec.steps, TRIES), self.damping, self.memory,
        )  # fmt: skip
        self.theta, self.damping, self.matrix = descent.theta, descent.damping, descent.matrix
        memory = problem.final_memory if final else spec.memory
        # The first stage begins far away, where a linear model says little about the end.
        far = length_s == spec.lengths_s[0] and not final
        self.memory = self.memory if far else memory * (self.memory + self.matrix)

    def judge(self, error: float) -> bool:
        """Store the validation error of the present position; return whether it is the least until now."""
        if error >= self.least:
            return False
        self.least, self.best, self.information = error, self.theta, self.memory + self.matrix
        return True
