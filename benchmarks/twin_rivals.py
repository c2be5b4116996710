"""A NARX model run free: what a textbook on system identification would try next to ARX and subspace models.

Polynomials of second degree and perceptrons with one hidden layer read the last commands and answers, are fitted one
tick ahead, and are fed with their own answers. Lags and form are chosen by a free run through the last fifth of the
estimation data, then the choice is fitted to all of it. Answers are kept within the range that was seen, widened by a
quarter to each side, as a twin's velocities are.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Doubles = NDArray[np.float64]
FORMS = (("polynomial", 2), ("polynomial", 4), ("perceptron", 4), ("perceptron", 10))
"""Form and lags that are tried."""
CHOOSES = 0.2
"""Share of the estimation data that chooses."""
PENALTY = 1e-4
HIDDEN = 16


@dataclass(frozen=True, eq=False)
class Narx:
    """A fitted model: ``say`` maps scaled rows of lags to the scaled answer one tick later."""

    label: str
    lags: int
    say: Callable[[Doubles], Doubles]
    offset: Doubles
    width: Doubles
    low: float
    high: float

    def free_run(self, commands: Doubles, answers: Doubles) -> Doubles:
        """Answers from tick `lags` on, by commands ``(tick, command)`` and the first answers ``(lags,)``."""
        said = list(answers[: self.lags])
        u = (commands - self.offset[:-1]) / self.width[:-1]
        for t in range(self.lags, len(commands)):
            y = (np.array(said[-self.lags :]) - self.offset[-1]) / self.width[-1]
            row = np.concatenate([u[t - self.lags : t].ravel(), y])
            value = float(self.say(row[None])[0]) * self.width[-1] + self.offset[-1]
            said.append(min(max(value, self.low), self.high))
        return np.array(said[self.lags :])


def fit_narx(commands: Doubles, answers: Doubles, prefix: int, seed: int) -> Narx:
    """The form with the least error of a free run through the last fifth, fitted to everything."""
    cut = round((1.0 - CHOOSES) * len(answers))
    errors = {}
    for form, lags in FORMS:
        if lags > prefix:
            continue
        model = _fitted(form, lags, commands[:cut], answers[:cut], seed)
        with np.errstate(all="ignore"):
            said = model.free_run(commands[cut:], answers[cut:])
        errors[form, lags] = float(np.square(said - answers[cut + lags :]).mean())
    form, lags = min(errors, key=lambda one: errors[one])
    return _fitted(form, lags, commands, answers, seed)


def _fitted(form: str, lags: int, commands: Doubles, answers: Doubles, seed: int) -> Narx:
    whole = np.concatenate([commands, answers[:, None]], axis=1)
    offset, width = whole.mean(axis=0), np.maximum(whole.std(axis=0), 1e-9)
    scaled = (whole - offset) / width
    ticks = range(lags, len(answers))
    rows = np.stack([np.concatenate([scaled[t - lags : t, :-1].ravel(), scaled[t - lags : t, -1]]) for t in ticks])
    say = (_polynomial if form == "polynomial" else _perceptron)(rows, scaled[lags:, -1], seed)
    reach = 0.25 * float(np.ptp(answers))
    return Narx(f"{form}, {lags} lags", lags, say, offset, width, answers.min() - reach, answers.max() + reach)


def _polynomial(rows: Doubles, goal: Doubles, seed: int) -> Callable[[Doubles], Doubles]:
    first, second = np.triu_indices(rows.shape[1])

    def spread(x: Doubles) -> Doubles:
        return np.concatenate([np.ones((len(x), 1)), x, x[:, first] * x[:, second]], axis=1)

    matrix = spread(rows)
    weights = np.linalg.solve(matrix.T @ matrix + PENALTY * len(rows) * np.eye(matrix.shape[1]), matrix.T @ goal)
    return lambda x: spread(x) @ weights


def _perceptron(rows: Doubles, goal: Doubles, seed: int) -> Callable[[Doubles], Doubles]:
    from sklearn.neural_network import MLPRegressor

    network = MLPRegressor(
        hidden_layer_sizes=(HIDDEN,), activation="tanh", solver="lbfgs", alpha=1e-3, max_iter=600, random_state=seed
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        network.fit(rows, goal)
    (w1, w2), (b1, b2) = network.coefs_, network.intercepts_

    def say(x: Doubles) -> Doubles:
        said: Any = np.tanh(x @ w1 + b1) @ w2 + b2
        return np.asarray(said)[:, 0]

    return say
