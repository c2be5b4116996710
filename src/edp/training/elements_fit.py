"""Fit of element parameters to free runs: Gauss-Newton steps with complex-step derivatives, exact to rounding."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edp.data.series import Series
from edp.errors import DataError
from edp.networks.twin.elements import PRIOR, ElementsTwin
from edp.storage.reading import Table
from edp.training.free_run import FreeRunProgress, FreeRunValidation
from edp.wording import typed

Doubles = NDArray[np.float64]
NOISE = 0.02
"""Plausible error of a free run, as a share of the spread of an answer: what the plausible numbers weigh against."""
APART = 0.5
"""Deviation of further starts, in plausible deviations of the numbers."""
STEP = 1e-20
"""Imaginary step: so small that its square is nothing beside one."""
TRIES = 8
FARTHEST = 1.5
"""Largest change of a number in a step, in plausible deviations: the linear model holds no farther."""
MOST_TICKS = 4096
"""Of a run where no length is set: each tick of a pass is interpreted, some tenth of a millisecond."""
MOST_VALUES = 20_000_000
"""Complex answers of all lanes that are kept in a pass, 0.3 GB; with more runs, evenly chosen ones are fitted."""
STILL = 1e-5
"""Share by which the cost falls in the last step."""


@dataclass(frozen=True, eq=False)
class ElementsFit:
    """Fitted elements: the twin, a row of history for each start, processor seconds, and rows of the datasheet."""

    twin: ElementsTwin
    history: list[dict[str, object]]
    seconds: float
    rows: list[dict[str, object]]


class _Problem:
    """Free runs from measured starts; unmeasured levels are free parameters at each start."""

    def __init__(self, twin: ElementsTwin, train: Sequence[Series]) -> None:
        self.twin, table = twin, twin.table
        self.nominal = np.array([n.nominal for n in table])
        self.width = np.array([n.width for n in table])
        self.positive = np.array([n.positive for n in table])
        self.hidden = len(twin.hidden)
        longest = max(series.samples for series in train) - 1
        asked = round(twin.spec.length_s * twin.channels.rate_hz)
        ticks = asked or min(longest, MOST_TICKS)
        # Whole recordings are as long as they are; asked lengths hold for every run.
        shortest = ticks if asked else 2
        cuts = [
            (part, at)
            for part in train
            for at in range(0, part.samples - 1, ticks)
            if part.samples - 1 - at >= shortest
        ]
        if not cuts or ticks < 2:
            raise DataError(
                f"elements: no training stretch has a free run of {typed(ticks / twin.channels.rate_hz)} s, the "
                "longest has "
                f"{typed(longest / twin.channels.rate_hz)} s; shorten twin.length_s, to no less than two ticks"
            )
        lanes = len(twin.table) + self.hidden
        affordable = max(1, MOST_VALUES // (lanes * ticks * len(twin.channels.answers)))
        if len(cuts) > affordable:
            cuts = [cuts[i] for i in np.linspace(0, len(cuts) - 1, affordable).round().astype(int)]
        # A run that ends early keeps its last command; what would be judged behind its end is not a number.
        self.commands = np.stack([_pad_rows(part.inputs[at : at + ticks], ticks, "edge") for part, at in cuts])
        rows = np.stack([_pad_rows(part.targets[at : at + ticks + 1], ticks + 1, "nan") for part, at in cuts])
        self.first, self.truth = rows[:, 0], rows[:, 1:]
        count, strokes = len(twin.channels.velocities), len(twin.channels.strokes)
        weight = 1.0 / (NOISE * twin.scales.answer_width.astype(np.float64))
        # A velocity whose integral is measured says the same again, with more noise.
        weight[: count if strokes else 0] = 0.0
        self.weight = weight

    def size(self) -> tuple[int, int]:
        """Return the number of parameter coordinates, and of all coordinates."""
        return len(self.nominal), len(self.nominal) + self.hidden * len(self.first)

    def numbers(self, theta: NDArray[Any]) -> NDArray[Any]:
        """Numbers by coordinates in plausible deviations."""
        bent = self.width * theta
        return np.asarray(
            np.where(
                self.positive, np.abs(self.nominal) * np.exp(np.where(self.positive, bent, 0)), self.nominal + bent
            )
        )

    def errors(self, theta: NDArray[Any], levels: NDArray[Any]) -> NDArray[Any]:
        """Return weighted errors ``(run, tick * answer)`` of runs with coordinates ``(run, number)``."""
        repeats = len(theta) // len(self.first)
        numbers = self.numbers(theta)
        hidden = np.zeros((len(theta), 0))
        if self.hidden:
            hidden = self.twin.starting_levels(numbers) * np.exp(PRIOR * levels)
        commands = np.repeat(self.commands, repeats, axis=0)
        first = np.repeat(self.first, repeats, axis=0).astype(theta.dtype)
        answers = self.twin.free_run(numbers, commands, first, hidden.astype(theta.dtype))
        missed = (answers - np.repeat(self.truth, repeats, axis=0)) * self.weight
        missed[np.isnan(np.repeat(self.truth, repeats, axis=0))] = 0.0
        return np.asarray(missed.reshape(len(theta), -1))

    def cost(self, point: Doubles) -> float:
        """Half the sum of squares, with the plausible deviations."""
        size, _ = self.size()
        runs = len(self.first)
        with np.errstate(all="ignore"):
            missed = self.errors(np.tile(point[:size], (runs, 1)), point[size:].reshape(runs, self.hidden))
        total = 0.5 * float((missed**2).sum() + point @ point)
        return total if np.isfinite(total) else np.inf

    def normal(self, point: Doubles) -> tuple[Doubles, Doubles]:
        """Gauss-Newton matrix and gradient of the data alone."""
        size, every = self.size()
        runs, own = len(self.first), size + self.hidden
        shifts = 1j * STEP * np.tile(np.eye(own), (runs, 1))
        theta = np.repeat(np.tile(point[:size], (runs, 1)), own, axis=0) + shifts[:, :size]
        levels = np.repeat(point[size:].reshape(runs, self.hidden), own, axis=0) + shifts[:, size:]
        missed = self.errors(theta, levels).reshape(runs, own, -1)
        matrix, gradient = np.zeros((every, every)), np.zeros(every)
        for run in range(runs):
            slopes = missed[run].imag / STEP
            at = np.r_[np.arange(size), size + self.hidden * run + np.arange(self.hidden)]
            matrix[np.ix_(at, at)] += slopes @ slopes.T
            gradient[at] += slopes @ missed[run, 0].real
        return matrix, gradient


def _pad_rows(rows: NDArray[np.float32], ticks: int, by: str) -> Doubles:
    """Extend rows to the given number of samples as doubles, with the last one ("edge") or NaN ("nan")."""
    short, values = ticks - len(rows), rows.astype(np.float64)
    if by == "edge":
        return np.pad(values, ((0, short), (0, 0)), mode="edge")
    return np.pad(values, ((0, short), (0, 0)), constant_values=np.nan)


def _descend(problem: _Problem, point: Doubles, rounds: int) -> tuple[Doubles, Doubles]:
    """Damped Gauss-Newton steps; the matrix of the last one comes back as well."""
    damping, cost = 1e-2, problem.cost(point)
    matrix, gradient = problem.normal(point)
    for _ in range(rounds):
        system = matrix + np.eye(len(point))
        for _ in range(TRIES):
            change = -np.linalg.solve(system + damping * np.diag(np.diag(system)), gradient + point)
            change *= min(1.0, FARTHEST / max(float(np.abs(change).max()), 1e-12))
            new = problem.cost(point + change)
            if new < cost:
                break
            damping *= 4.0
        else:
            break
        fallen, point, cost, damping = cost - new, point + change, new, max(damping / 5.0, 1e-7)
        matrix, gradient = problem.normal(point)
        if fallen < STILL * cost:
            break
    return point, matrix


def fit_elements(
    twin: ElementsTwin,
    train: Sequence[Series],
    validation: Sequence[Series],
    seed: int,
    on_event: Callable[[FreeRunProgress], None] | None = None,
) -> ElementsFit:
    """Fit from several starts; free runs of the validation part choose among them.

    Args:
        twin: with plausible numbers.
        train: training stretches.
        validation: stretches that choose.
        seed: of the further starts.
        on_event: called after each start.

    Raises:
        DataError: stretches that are too short.
    """
    began, problem = time.process_time(), _Problem(twin, train)
    longest = max(series.samples for series in validation) - 1 - twin.prefix_ticks
    judge = FreeRunValidation(twin, validation, longest, 8)
    size, every = problem.size()
    history: list[Table] = []
    best, least, length_s = twin, np.inf, problem.commands.shape[1]
    information: Doubles = np.zeros((size, size))
    for start in range(twin.spec.starts):
        rng = np.random.default_rng([seed, start])
        point, matrix = _descend(
            problem, APART * rng.normal(size=every) if start else np.zeros(every), twin.spec.rounds
        )
        fitted = twin.with_parameters(problem.numbers(point[:size]))
        judge.twin = fitted
        error = judge.error()
        better = bool(error < least)
        if better:
            best, least = fitted, error
            information = np.asarray(np.linalg.inv(matrix + np.eye(every))[:size, :size])
        seconds = time.process_time() - began
        row = {"update": start + 1, "cost": problem.cost(point), "validation": error, "best": better}
        history.append(row | {"seconds": round(seconds, 2)})
        if on_event is not None:
            left = seconds * (twin.spec.starts - start - 1) / (start + 1)
            run_s = length_s / twin.channels.rate_hz
            on_event(FreeRunProgress(start + 1, twin.spec.starts, run_s, left, error, better))
    return ElementsFit(best, history, time.process_time() - began, _sheet(best, problem, information))


def _sheet(twin: ElementsTwin, problem: _Problem, covariance: Doubles) -> list[dict[str, object]]:
    """Return one row per parameter with unit and interval, like `edp.networks.twin.grey.datasheet`."""
    rows = []
    deviations = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    for number, value, deviation in zip(twin.table, twin.numbers, deviations, strict=True):
        reach = 1.96 * float(deviation) * number.width
        ends = (value * np.exp(-reach), value * np.exp(reach)) if number.positive else (value - reach, value + reach)
        row = {"element": number.element, "name": number.name, "unit": number.unit, "value": float(value)}
        # Where more than 0.7 of the plausible deviation is left, the data say little.
        rows.append(row | {"low": float(ends[0]), "high": float(ends[1]), "excited": bool(deviation < 0.7)})
    return rows
