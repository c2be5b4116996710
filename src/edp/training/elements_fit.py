"""Fit of element parameters to free runs: Gauss-Newton steps with complex-step derivatives, exact to rounding."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from edp.data.series import Series
from edp.errors import DataError
from edp.networks.twin.descent import DescentLimits, NormalEquations, descend
from edp.networks.twin.elements import PRIOR, ElementsTwin
from edp.networks.twin.parameters import Priors, datasheet_rows, posterior_deviations
from edp.networks.twin.windows import MeasuredWindows, WindowStart
from edp.training.fitted_twin import FitHistory, FittedTwin, FreeRunProgress
from edp.training.free_run import FreeRunValidation
from edp.wording import typed

Doubles = NDArray[np.float64]
NOISE = 0.02
"""Plausible error of a free run, as a share of the spread of an output: what the plausible numbers weigh against."""
APART = 0.5
"""Standard deviation of further starts, in prior standard deviations."""
STEP = 1e-20
"""Imaginary step: so small that its square is nothing beside one."""
MOST_TICKS = 4096
"""Of a run where no length is set: each tick of a pass is interpreted, some tenth of a millisecond."""
MAX_VALUES = 20_000_000
"""Maximum number of complex outputs in one pass (0.3 GB); evenly chosen runs are fitted if there are more."""
FTOL = 1e-5
"""Relative decrease of the cost in the last step."""


class LumpedProblem:
    """Free runs from measured starts; unmeasured levels are free coordinates at each start.

    Coordinates are those of the parameters, then the levels of each run.

    Args:
        twin: twin with nominal parameters.
        train: training segments.

    Raises:
        DataError: no segment is long enough.
    """

    def __init__(self, twin: ElementsTwin, train: Sequence[Series]) -> None:
        self.twin, self.priors, self.hidden = twin, Priors.from_parameters(twin.table), len(twin.hidden)
        longest = max(series.samples for series in train) - 1
        asked = round(twin.spec.length_s * twin.channels.rate_hz)
        ticks = asked or min(longest, MOST_TICKS)
        # Whole recordings are as long as they are; asked lengths hold for every run.
        shortest = ticks if asked else 2
        windows = [
            WindowStart(part, first)
            for part in train
            for first in range(0, part.samples - 1, ticks)
            if part.samples - 1 - first >= shortest
        ]
        if not windows or ticks < 2:
            raise DataError(
                f"elements: no training stretch has a free run of {typed(ticks / twin.channels.rate_hz)} s, the "
                "longest has "
                f"{typed(longest / twin.channels.rate_hz)} s; shorten twin.length_s, to no less than two ticks"
            )
        lanes = len(twin.table) + self.hidden
        affordable = max(1, MAX_VALUES // (lanes * ticks * len(twin.channels.answers)))
        if len(windows) > affordable:
            windows = [windows[i] for i in np.linspace(0, len(windows) - 1, affordable).round().astype(int)]
        runs = MeasuredWindows.read(windows, ticks)
        self.commands, outputs = runs.commands.astype(np.float64), runs.outputs.astype(np.float64)
        self.first, self.truth = outputs[:, 0], outputs[:, 1:]
        count, strokes = len(twin.channels.velocities), len(twin.channels.strokes)
        weight = 1.0 / (NOISE * twin.scales.answer_width.astype(np.float64))
        # A velocity whose integral is measured says the same again, with more noise.
        weight[: count if strokes else 0] = 0.0
        self.weight = weight

    @property
    def size(self) -> int:
        """Number of coordinates."""
        return len(self.twin.table) + self.hidden * len(self.first)

    def normal_equations(self, theta: Doubles, full: bool) -> NormalEquations:
        """Return the losses of the runs, with gradient and Gauss-Newton matrix if `full`."""
        parameters, runs = len(self.twin.table), len(self.first)
        own = parameters + self.hidden
        each = np.concatenate(
            [np.tile(theta[:parameters], (runs, 1)), theta[parameters:].reshape(runs, self.hidden)], axis=1
        )
        if not full:
            with np.errstate(all="ignore"):
                errors = self._errors(each)
            return NormalEquations(np.zeros((0, 0)), np.zeros(0), 0.5 * np.square(errors).sum(axis=1))
        errors = self._errors(np.repeat(each, own, axis=0) + 1j * STEP * np.tile(np.eye(own), (runs, 1)))
        errors = errors.reshape(runs, own, -1)
        matrix, gradient = np.zeros((self.size, self.size)), np.zeros(self.size)
        for run in range(runs):
            slopes = errors[run].imag / STEP
            at = np.r_[np.arange(parameters), parameters + self.hidden * run + np.arange(self.hidden)]
            matrix[np.ix_(at, at)] += slopes @ slopes.T
            gradient[at] += slopes @ errors[run, 0].real
        return NormalEquations(matrix, gradient, 0.5 * np.square(errors[:, 0].real).sum(axis=1))

    def _errors(self, theta: NDArray[np.inexact]) -> NDArray[np.inexact]:
        """Return weighted errors ``(run, tick * output)`` for coordinates ``(run, own)``, several per window."""
        repeats = len(theta) // len(self.first)
        parameters = self.priors.values(theta[:, : len(self.twin.table)])
        hidden = np.zeros((len(theta), 0), theta.dtype)
        if self.hidden:
            hidden = self.twin.starting_levels(parameters) * np.exp(PRIOR * theta[:, len(self.twin.table) :])
        commands, first, truth = (np.repeat(a, repeats, axis=0) for a in (self.commands, self.first, self.truth))
        errors = (self.twin.free_run(parameters, commands, first.astype(theta.dtype), hidden) - truth) * self.weight
        errors[np.isnan(truth)] = 0.0
        return np.asarray(errors.reshape(len(theta), -1))


def fit_elements(
    twin: ElementsTwin,
    train: Sequence[Series],
    validation: Sequence[Series],
    seed: int,
    on_event: Callable[[FreeRunProgress], None] | None = None,
) -> FittedTwin:
    """Fit from several starts; free runs of the validation part choose among them.

    Args:
        twin: twin with nominal parameters.
        train: training segments.
        validation: segments that choose.
        seed: seed of the further starts.
        on_event: called after each start.

    Raises:
        DataError: segments that are too short.
    """
    spec, problem, parameters = twin.spec, LumpedProblem(twin, train), len(twin.table)
    history, limits = FitHistory(spec.starts, on_event), DescentLimits(spec.rounds, ftol=FTOL)
    longest = max(series.samples for series in validation) - 1 - twin.prefix_ticks
    judge = FreeRunValidation(twin, validation, longest, 8)
    best, least, information = twin, np.inf, np.zeros((problem.size, problem.size))
    for start in range(spec.starts):
        rng = np.random.default_rng([seed, start])
        begin = APART * rng.normal(size=problem.size) if start else np.zeros(problem.size)
        descent = descend(problem.normal_equations, begin, limits, damping=1e-2)
        fitted = judge.twin = twin.with_parameters(problem.priors.values(descent.theta[:parameters]))
        error = judge.error()
        better = bool(error < least)
        if better:
            best, least, information = fitted, error, descent.matrix
        history.done += 1
        row = {"cost": descent.cost, "validation": error, "best": better}
        history.add(row, problem.commands.shape[1] / twin.channels.rate_hz, error, better)
    rows = datasheet_rows(twin.table, best.numbers, posterior_deviations(information)[:parameters])
    return FittedTwin(best, history.rows, history.seconds, tuple(rows))
