"""Fitting a grey box to free runs: Gauss-Newton with exact tangents, from measured starts everywhere, several starts.

A grey box has some hundred numbers of very different influence. Gauss-Newton steps, damped by Levenberg and Marquardt's
rule, find the valleys between them in tens of iterations, where steps along a gradient take thousands. Each round draws
new stretches, first short, then longer: a bad start cannot carry a long run astray at once.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from edp.data.series import Series
from edp.errors import DataError
from edp.networks.twin.grey.parameters import coarse_by_fine
from edp.networks.twin.grey.priors import STRETCHES
from edp.networks.twin.grey.rollouts import RunBatch
from edp.networks.twin.greybox import GreyTwin, RunTarget
from edp.storage.reading import Table
from edp.training.blas import one_blas_thread
from edp.training.free_run import FreeRunProgress, FreeRunValidation

Doubles = NDArray[np.float64]
FINEST = 0.02
"""Error in deviations that a fit is taken to leave: it weighs the data against what is plausible."""
LEAST_DAMPING, MOST_DAMPING = 1e-6, 1e6
FARTHEST = 1.5
"""Plausible deviations that one step may move a number: beyond it a linear model says nothing."""
APART = 0.3
"""Spread of the further starts in plausible deviations: far enough for another valley, near enough to be simulated."""
LEAST_GAIN = 0.01
"""Share of the validation error by which finer curves must be better."""
TRIES = 4
"""Steps, each damped more, after which a round gives up and draws other stretches."""


@dataclass(eq=False)
class GreyRound:
    """Stretches of one round, in units of the grey box."""

    demands: Doubles
    measured: Doubles
    target: RunTarget


@dataclass(frozen=True, eq=False)
class GreyFit:
    """A fitted grey box.

    Attributes:
        twin: with the numbers of the best validation.
        history: a row per validation.
        seconds: processor time.
        information: of the coordinates in which it was fitted: inverse covariance by the data that the last rounds
            saw, without what was thought plausible before ``(number, number)``.
        theta: where the fit ended in these coordinates, each in plausible deviations.
        error: of the free runs of the validation part, see `FreeRunValidation.error`.
    """

    twin: GreyTwin
    history: list[dict[str, object]]
    seconds: float
    information: Doubles
    theta: Doubles
    error: float


class Tie(Protocol):
    """Parametrisation: fewer coordinates for all grey-box parameters, in prior standard deviations from zero.

    Attributes:
        begin: where a fit begins ``(coordinate,)``.
    """

    @property
    def begin(self) -> Doubles:
        """Return the initial coordinates of a fit ``(coordinate,)``."""
        ...

    def numbers(self, theta: Doubles) -> Doubles:
        """Numbers of the grey box, in its units ``(number,)``."""
        ...

    def slopes(self, theta: Doubles) -> Doubles:
        """Their derivatives ``(number, coordinate)``."""
        ...


class GreyProblem:
    """Free-run losses as a function of the parameter coordinates.

    Args:
        twin: the grey box.
        train: training stretches, of `ticks` together.
        tie: other coordinates than one of each number.
        carried: information of the coordinates from a fit before, whose end is the start: only final rounds are left.
    """

    def __init__(
        self, twin: GreyTwin, train: Sequence[Series], tie: Tie | None = None, carried: Doubles | None = None
    ) -> None:
        stroke_weight, delta = twin.spec.fit.stroke_weight, twin.spec.fit.delta
        self.twin, self.tie, self.delta = twin, tie, delta / FINEST
        # Coordinates begin at the start of the twin, which knows more than the nominal numbers.
        self.begin = twin.numbers.copy()
        channels = twin.channels
        counts = (len(channels.velocities), len(channels.strokes), len(channels.pressures))
        each = np.repeat([1.0, stroke_weight, 1.0], counts)
        self.weight = each * twin.units / twin.scales.answer_width.astype(np.float64) / FINEST
        self.series = [part for part in train if part.samples > twin.prefix_ticks + 2]
        self.ticks = max(1, sum(part.samples for part in self.series))
        self.plausible = np.where(twin.table.positive, twin.table.width, 1.0)
        self.first = np.zeros(len(self.begin)) if tie is None else tie.begin
        self.carried = carried

    def draw(self, ticks: int, lanes: int, rng: np.random.Generator) -> GreyRound:
        """Stretches with starts everywhere."""
        prefix = self.twin.prefix_ticks
        usable = [part for part in self.series if part.samples > prefix + ticks]
        if not usable:
            raise DataError(
                f"no stretch is longer than prefix and free run, {prefix + ticks} ticks; give longer recordings, or "
                "shorter free runs (twin.lengths_s)"
            )
        starts = np.array([part.samples - prefix - ticks for part in usable], dtype=np.float64)
        which = rng.choice(len(usable), lanes, p=starts / starts.sum())
        length = prefix + ticks
        commands, answers = [], []
        for part in (usable[i] for i in which):
            first = int(rng.integers(0, part.samples - length))
            commands.append(part.inputs[first : first + length])
            answers.append(part.targets[first : first + length + 1])
        values = np.stack(answers) / self.twin.units
        measured = values[:, :-1].copy()
        measured[:, prefix + 1 :] = np.nan
        # Rows that count lie apart: neighbouring errors of a run say the same.
        followed = prefix if self.twin.wiring.whole else 0
        truth, stride = np.ascontiguousarray(values[:, 1:]), max(1, ticks // 10)
        target = RunTarget(truth, self.weight, self.delta, prefix, followed, stride)
        return GreyRound(self.twin.demands(np.stack(commands)), measured, target)

    @property
    def final_memory(self) -> float:
        """Return the memory of the final rounds, limited by the samples, since repeated ones add nothing."""
        fit = self.twin.spec.fit
        return min(fit.final_memory, max(0.0, 1.0 - fit.final_ticks / self.ticks))

    def numbers(self, theta: Doubles) -> Doubles:
        """Numbers by coordinates in plausible deviations."""
        if self.tie is not None:
            return self.tie.numbers(theta)
        table = self.twin.table
        grown = self.begin * np.exp(np.clip(theta * self.plausible, -12.0, 12.0))
        return np.where(table.positive, grown, self.begin + table.width * theta)[table.leader]

    def slope(self, numbers: Doubles) -> Doubles:
        """Return the derivative of each parameter by its own coordinate, or by its leader's."""
        table = self.twin.table
        return np.where(table.positive, numbers * self.plausible, table.width)[table.leader]

    def losses(self, theta: Doubles, drawn: GreyRound, full: bool) -> tuple[Doubles, Doubles, Doubles]:
        """Return matrix and gradient by the coordinates, and the loss of each run."""
        twin, numbers = self.twin, self.numbers(theta)
        rest = twin.rest(drawn.demands[:, 0], (drawn.measured[:, 0] * twin.units).astype(np.float32))
        state = (np.ascontiguousarray(values, dtype=np.float64) for values in (drawn.measured[:, 0], *rest))
        batch = RunBatch(drawn.demands, drawn.measured, *state)
        normal = twin.evaluate_runs(numbers, batch, drawn.target, full)
        matrix, gradient = normal.matrix, normal.gradient
        if full and self.tie is not None:
            slopes = self.tie.slopes(theta)
            matrix, gradient = slopes.T @ matrix @ slopes, slopes.T @ gradient
        elif full:
            slope = self.slope(numbers)
            matrix, gradient = _tie_derivatives(
                matrix * slope * slope[:, None], gradient * slope, self.twin.table.leader
            )
        return matrix, gradient, np.nan_to_num(normal.losses, nan=1e12, posinf=1e12)


def _tie_derivatives(matrix: Doubles, gradient: Doubles, leader: NDArray[np.int64]) -> tuple[Doubles, Doubles]:
    """Move derivatives of parameters tied to a leader to the leader's coordinate."""
    for index in np.flatnonzero(leader != np.arange(len(leader))):
        matrix[leader[index]] += matrix[index]
        matrix[:, leader[index]] += matrix[:, index]
        gradient[leader[index]] += gradient[index]
        matrix[index], matrix[:, index], gradient[index] = 0.0, 0.0, 0.0
    return matrix, gradient


@dataclass(eq=False)
class _Progress:
    """Progress over all rounds of a fit, reported after each one."""

    total: int
    on_event: Callable[[FreeRunProgress], None] | None
    began: float = field(default_factory=time.process_time)
    done: int = 0

    @property
    def seconds(self) -> float:
        """Processor time so far."""
        return time.process_time() - self.began

    def tell(self, length_s: float, error: float, better: bool) -> None:
        """Report the validation of the last round."""
        if self.on_event is not None:
            left = self.seconds * (self.total - self.done) / self.done
            self.on_event(FreeRunProgress(self.done, self.total, length_s, left, error, better))


@one_blas_thread()
def fit_grey_box(
    twin: GreyTwin,
    train: Sequence[Series],
    validation: Sequence[Series],
    seed: int,
    on_event: Callable[[FreeRunProgress], None] | None = None,
    tie: Tie | None = None,
) -> GreyFit:
    """Fit the parameters of a grey box to free runs; free runs on the validation data select the best round.

    Where the settings leave the stretches of opening curves open, the fewest are fitted first. Then each one is halved,
    which changes no curve, and final rounds follow: as often as the validation part gains by it.

    Args:
        twin: with the numbers to start from.
        train: training stretches.
        validation: stretches that choose.
        seed: of the stretches and of the further starts.
        on_event: called after each round.
        tie: coordinates to fit in place of one of each number.

    Raises:
        DataError: stretches that are too short.
    """
    fit, parts = twin.spec.fit, (train, validation)
    progress = _Progress(sum(fit.rounds) + (fit.starts - 1) * fit.rounds[0] + fit.final_rounds, on_event)
    if tie is not None or twin.spec.stretches or not fit.final_rounds:
        return _fit_form(GreyProblem(twin, train, tie), parts, seed, progress)
    coarse = GreyProblem(twin.with_stretches(STRETCHES[0]), train)
    stages = _fit_form(coarse, parts, seed, progress, final=False)
    # Final rounds of a coarser form remember too well what it made of the logs: a finer one begins before them.
    begin, share, best = stages, 1.0 - fit.memory, stages
    for stretches in STRETCHES:
        tried = _refine(begin, stretches, (share, parts, seed), progress)
        progress.total += fit.final_rounds
        history, better = best.history + tried.history, tried.error < (1.0 - LEAST_GAIN) * best.error
        best = replace(tried if better else best, history=history, seconds=progress.seconds)
        if stretches == STRETCHES[0]:
            continue
        if not better:
            break
        begin, share = best, 1.0 - coarse.final_memory
    return best


def _refine(before: GreyFit, stretches: int, how: tuple[float, Any, int], progress: _Progress) -> GreyFit:
    """Run the final rounds with a finer curve; `how`: weight of the earlier information, parts and seed.

    Rounds that remember one another know several times what one does; the share makes it one round's.
    """
    share, parts, seed = how
    begun = before.twin.with_stretches(stretches)
    by_finer = coarse_by_fine(before.twin.table, begun.table)
    problem = GreyProblem(begun, parts[0], carried=share * by_finer.T @ before.information @ by_finer)
    return _fit_form(problem, parts, seed + stretches, progress)


def _fit_form(
    problem: GreyProblem,
    parts: tuple[Sequence[Series], Sequence[Series]],
    seed: int,
    progress: _Progress,
    final: bool = True,
) -> GreyFit:
    """Fit the parameters of one form; `parts` train and select; `final`: whether final rounds follow the stages."""
    twin, spec, (_, validation) = problem.twin, problem.twin.spec.fit, parts
    judge = FreeRunValidation(twin, validation, round(spec.validation_s * twin.channels.rate_hz), spec.validation_runs)
    rounds = [length for length, count in zip(spec.lengths_s, spec.rounds, strict=True) for _ in range(count)]
    history: list[Table] = []

    def advance(path: _Path, lengths: Sequence[float], last: bool = False) -> None:
        for number, length_s in enumerate(lengths, 1):
            progress.done += 1
            before = path.theta
            path.step(length_s, last)
            # The last round of a stage is judged, whatever its number.
            if number != len(lengths) and number % spec.validate_every and length_s == lengths[number]:
                continue
            judge.twin = twin.with_parameters(problem.numbers(path.theta))
            better = path.judge(judge.error()) and path.least <= min(other.least for other in paths)
            moved = float(np.sqrt(np.mean((path.theta - before) ** 2)))
            row = {"update": progress.done, "start": path.number, "length_s": length_s, "validation": path.error}
            row |= {"stretches": twin.table.stretches, "best": better, "moved": moved, "damping": path.damping}
            history.append(row | {"seconds": round(progress.seconds, 2)})
            progress.tell(length_s, path.error, better)

    paths = [_Path(problem, number, seed) for number in range(spec.starts if problem.carried is None else 1)]
    chosen = paths[0]
    if problem.carried is None:
        for path in paths:
            advance(path, rounds[: spec.rounds[0]])
        # Which valley a start lies in shows after short runs; long ones of every start would cost as much again.
        chosen = min(paths, key=lambda path: path.least)
        advance(chosen, rounds[spec.rounds[0] :])
    advance(chosen, rounds[-1:] * (spec.final_rounds if final else 0), True)
    end = twin.with_parameters(problem.numbers(chosen.best))
    return GreyFit(end, history, progress.seconds, chosen.information, chosen.best, chosen.least)


class _Path:
    """The way of one start through the rounds.

    Attributes:
        theta: where it stands, in plausible deviations of the numbers; `best` where its validation was least.
        least: that validation's error.
        information: of the numbers at `best`, as `GreyFit` has it.
    """

    def __init__(self, problem: GreyProblem, number: int, seed: int) -> None:
        self.problem, self.number = problem, number
        # Each start has stretches of its own; the first one begins at the balance of forces.
        self.rng = np.random.default_rng([seed, number] if number else seed)
        size = len(problem.first)
        self.theta = problem.first + (APART * self.rng.normal(size=size) if number else 0.0)
        self.best, self.least, self.error = self.theta, np.inf, np.inf
        self.damping, self.matrix = 1.0, np.zeros((size, size))
        self.information = np.zeros((size, size))
        self.memory = np.zeros((size, size)) if problem.carried is None else problem.carried

    def step(self, length_s: float, final: bool = False) -> None:
        """One round on free runs of a length."""
        spec = self.problem.twin.spec.fit
        ticks = max(1, round(length_s * self.problem.twin.channels.rate_hz))
        lanes = max(8, min(spec.lanes, (spec.final_ticks if final else spec.ticks) // ticks))
        drawn = self.problem.draw(ticks, lanes, self.rng)
        steps = 1 if final else spec.steps
        self.theta, self.damping, self.matrix = _improve(
            self.problem, self.theta, drawn, self.damping, steps, self.memory
        )
        memory = self.problem.final_memory if final else spec.memory
        # The first stage begins far away, where a linear model says little about the end.
        far = length_s == spec.lengths_s[0] and not final
        self.memory = self.memory if far else memory * (self.memory + self.matrix)

    def judge(self, error: float) -> bool:
        """Store a validation error of the present position; return whether it is the least so far."""
        self.error = error
        if error >= self.least:
            return False
        self.least, self.best, self.information = error, self.theta, self.memory + self.matrix
        return True


def _improve(
    problem: GreyProblem, theta: Doubles, drawn: GreyRound, damping: float, steps: int, memory: Doubles
) -> tuple[Doubles, float, Doubles]:
    """Damped Gauss-Newton steps on one round; the matrix of the last one comes back as well.

    `memory` is what earlier rounds knew: without it each round would fit its own few stretches, noise included.
    """
    begin = theta

    def known_cost(tried: Doubles) -> float:
        return 0.5 * float(tried @ tried + (tried - begin) @ memory @ (tried - begin))

    matrix, gradient, losses = problem.losses(theta, drawn, True)
    cost = float(losses.sum()) + known_cost(theta)
    for step in range(steps):
        if step:
            matrix, gradient, losses = problem.losses(theta, drawn, True)
        pull = gradient + theta + memory @ (theta - begin)
        system = matrix + memory + np.eye(len(theta))
        for _ in range(TRIES):
            change = -np.linalg.solve(system + np.diag(damping * np.diag(system)), pull)
            change *= min(1.0, FARTHEST / max(float(np.abs(change).max()), 1e-12))
            tried = theta + change
            new = float(problem.losses(tried, drawn, False)[2].sum()) + known_cost(tried)
            if new < cost:
                theta, cost, damping = tried, new, max(damping / 4.0, LEAST_DAMPING)
                break
            damping = min(damping * 5.0, MOST_DAMPING)
        else:
            break
    return theta, damping, matrix
