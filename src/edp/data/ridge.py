"""Ridge regression of each horizon and target on the last samples of all inputs, with its map in SI units."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from edp.data.lags import DoubleArray, LagTask, origins, target_means
from edp.data.ridge_moments import RidgeMoments, Standard, moments_of, standard_of
from edp.data.series import Series
from edp.errors import ConfigError
from edp.recording import FloatArray
from edp.wording import typed

PENALTIES = tuple(10.0**power for power in range(-6, 2))
"""Ridge penalties per training row on standardised features, from almost none to strong."""

HISTORIES = (5, 20)
"""History lengths in samples that are tried in addition to the length in the task."""

CROSSED_HISTORIES = (3, 5, 10, 20)
"""History lengths in samples that cross-validation tries in addition to the length in the task."""

BLOCK_ROWS = 16_384
"""Number of rows converted to double precision at a time, so that memory does not grow with the recording."""


@dataclass(frozen=True, eq=False)
class RidgeSolution:
    """A linear map in SI units: y[t + horizon] = intercept + sum over lags of inputs[t - lag] @ weights[lag].

    Attributes:
        weights: ``(history, input, horizon, target)``; index 0 is the present sample. Lags that an output does not
            use are zero.
        intercept: ``(horizon, target)``.
        penalty: chosen penalty per output ``(horizon, target)``.
        history: chosen history per output ``(horizon, target)``, in samples.
    """

    weights: DoubleArray
    intercept: DoubleArray
    penalty: DoubleArray
    history: NDArray[np.int64]

    def predict(self, inputs: FloatArray) -> DoubleArray:
        """Return the predictions at ticks ``history - 1`` and later: ``(time - history + 1, horizon, target)``."""
        lags, channels, horizons, targets = self.weights.shape
        maps = self.weights.reshape(lags, channels, horizons * targets)
        used = int(self.history.max())
        prediction = np.tile(self.intercept.ravel(), (len(inputs) - lags + 1, 1))
        for start in range(lags - 1, len(inputs), BLOCK_ROWS):
            stop = min(start + BLOCK_ROWS, len(inputs))
            block = inputs[start - used + 1 : stop].astype(np.float64)
            for lag in range(used):
                part = block[used - 1 - lag : len(block) - lag] @ maps[lag]
                prediction[start - lags + 1 : stop - lags + 1] += part
        return prediction.reshape(-1, horizons, targets)


def ridge_solution(
    train: Sequence[Series],
    task: LagTask,
    validation: Sequence[Series] = (),
    penalties: Sequence[float] = PENALTIES,
    histories: Sequence[int] | None = None,
) -> RidgeSolution:
    """Return the ridge-regularised least squares for every horizon and target, in physical units.

    If an input measures the target, the map predicts the change from the present value, so a strong penalty leads to
    persistence. The memory is a few Gram matrices of ``(history * input)`` squared, independent of the series length.

    Args:
        train: training series; at least one has a full history and the longest horizon.
        task: channels to read and to predict.
        validation: data on which the squared error selects penalty and history; without a usable sample, the smallest
            penalty and the longest history are used.
        penalties: penalties per row on standardised features, each above 0.
        histories: histories to choose from, in samples; cut to the task's. By default 5, 20 and the task's.

    Raises:
        ConfigError: a penalty too small for inputs that are copies of each other.
    """
    tried = sorted({min(history, task.history) for history in (histories or (*HISTORIES, task.history))})
    standard = standard_of(train, target_means(train))
    fitted, held_out = moments_of(train, task, standard), moments_of(validation, task, standard)
    inputs, outputs = len(standard.centre), task.outputs
    best = np.full(outputs, np.inf)
    weights = np.zeros((task.history * inputs, outputs))
    penalty, history = np.zeros(outputs), np.zeros(outputs, dtype=np.int64)
    # Start with the longest history and the smallest penalty, which remain if validation cannot distinguish the
    # candidates.
    for samples in reversed(tried):
        for relative in sorted(penalties):
            candidate = _solve(fitted, samples * inputs, relative)
            loss = _compute_squared_error(held_out, fitted, candidate)
            better = loss < best
            best[better], penalty[better], history[better] = loss[better], relative, samples
            weights[:, better] = 0.0
            weights[: samples * inputs, better] = candidate[:, better]
    return _physical(weights, fitted, standard, task, penalty, history)


def cross_validate_ridge(
    parts: Sequence[Series],
    task: LagTask,
    folds: int = 5,
    penalties: Sequence[float] = PENALTIES,
    histories: Sequence[int] = CROSSED_HISTORIES,
) -> RidgeSolution:
    """Return the ridge regression on all of `parts`; penalty and history by cross-validation over contiguous folds.

    Use this function for small data sets, where one held-out segment is too short for a selection and is needed for the
    fit.

    Args:
        parts: all segments for training.
        task: channels to read and to predict.
        folds: segments of nearly equal duration. Neighbouring segments share history and future samples.
        penalties: penalties to try, see `ridge_solution`.
        histories: histories to choose from, in samples; cut to the task's.

    Raises:
        ConfigError: a penalty too small for inputs that are copies of each other.
    """
    standard = standard_of(parts, target_means(parts))
    inputs, outputs = len(standard.centre), task.outputs
    best = np.full(outputs, np.inf)
    weights = np.zeros((task.history * inputs, outputs))
    penalty, history = np.zeros(outputs), np.zeros(outputs, dtype=np.int64)
    for samples in sorted({min(entry, task.history) for entry in (*histories, task.history)}, reverse=True):
        # The number of rows depends on the history: a short history can use more rows.
        tried = replace(task, history=samples)
        folded = [moments_of(fold, tried, standard) for fold in _folds(parts, tried, folds)]
        whole = _sum(folded)
        pairs = [(_sum([other for other in folded if other is not fold]), fold) for fold in folded if fold.rows]
        for relative in sorted(penalties):
            loss = np.zeros(outputs)
            for rest, fold in pairs:
                if rest.rows:
                    loss += (
                        fold.rows
                        / whole.rows
                        * _compute_squared_error(fold, rest, _solve(rest, samples * inputs, relative))
                    )
            better = loss < best
            if better.any():
                solved = _solve(whole, samples * inputs, relative)
                best[better], penalty[better], history[better] = loss[better], relative, samples
                weights[:, better] = 0.0
                weights[: samples * inputs, better] = solved[:, better]
    # Intercepts come from the rows that all histories share.
    longest = _sum([moments_of(fold, task, standard) for fold in _folds(parts, task, folds)])
    return _physical(weights, longest, standard, task, penalty, history)


def _folds(parts: Sequence[Series], task: LagTask, folds: int) -> list[list[Series]]:
    """Divide the series into contiguous folds of nearly equal size; each sample is the origin in one fold."""
    ticks = [origins(part, task) for part in parts]
    edges = np.linspace(0, sum(len(own) for own in ticks), folds + 1).round().astype(int)
    pieces: list[list[Series]] = [[] for _ in range(folds)]
    begin = 0
    for part, own in zip(parts, ticks, strict=True):
        for piece, low, high in zip(pieces, edges[:-1] - begin, edges[1:] - begin, strict=True):
            chosen = own[max(0, low) : max(0, high)]
            if chosen:
                rows = slice(chosen.start - task.history + 1, chosen.stop + max(task.horizons))
                piece.append(Series(part.name, part.inputs[rows], part.targets[rows]))
        begin += len(own)
    return pieces


def _sum(parts: Sequence[RidgeMoments]) -> RidgeMoments:
    return RidgeMoments(*(sum(getattr(part, entry.name) for part in parts) for entry in fields(RidgeMoments)))


def _solve(fitted: RidgeMoments, size: int, relative: float) -> DoubleArray:
    """Return weights ``(size, output)`` on the first `size` standardised features, with an unpenalised intercept."""
    x, y = fitted.x[:size] / fitted.rows, fitted.y / fitted.rows
    covariance = fitted.xx[:size, :size] / fitted.rows - np.outer(x, x)
    # The penalty also makes the matrix definite when inputs are constant or copies of each other.
    covariance[np.diag_indices(size)] += relative
    cross = fitted.xy[:size] / fitted.rows - np.outer(x, y)
    try:
        # Cholesky: half the work of a general solution, and it fails where the matrix is not definite.
        factor = linalg.cho_factor(covariance, overwrite_a=True, check_finite=False)
    except linalg.LinAlgError as error:
        raise ConfigError(
            f"ridge penalty {typed(relative)} is too small for these inputs, which depend on one another; use 1e-9 "
            "or above"
        ) from error
    return np.asarray(linalg.cho_solve(factor, cross, check_finite=False))


def _compute_squared_error(held_out: RidgeMoments, fitted: RidgeMoments, weights: DoubleArray) -> DoubleArray:
    """Return the mean squared validation error per output from the moments; zero without validation rows."""
    if held_out.rows == 0:
        return np.zeros(weights.shape[1])
    size, rows = len(weights), held_out.rows
    # Use the intercept of the training rows, not an intercept fitted to the held-out rows.
    offset = (fitted.y - fitted.x[:size] @ weights) / fitted.rows
    x, y, xy = held_out.x[:size] / rows, held_out.y / rows, held_out.xy[:size] / rows
    quadratic = np.einsum("io,io->o", weights, (held_out.xx[:size, :size] / rows) @ weights)
    linear = offset * (2.0 * (x @ weights) - 2.0 * y + offset) - 2.0 * np.einsum("io,io->o", weights, xy)
    result: DoubleArray = held_out.yy / rows + linear + quadratic
    return result


def _physical(
    weights: DoubleArray,
    fitted: RidgeMoments,
    standard: Standard,
    task: LagTask,
    penalty: DoubleArray,
    history: NDArray[np.int64],
) -> RidgeSolution:
    """Undo the standardisation and add the anchors; penalty and history are per output."""
    shape = (len(task.horizons), len(task.present))
    offset = (fitted.y - fitted.x @ weights) / fitted.rows
    maps = weights.reshape(task.history, len(standard.centre), task.outputs) / standard.scale[:, None]
    intercept = (offset - np.einsum("i,hio->o", standard.centre, maps)).reshape(shape)
    maps = maps.reshape(task.history, len(standard.centre), *shape)
    for target, column in enumerate(task.present):
        if column is None:
            intercept[:, target] += standard.means[target]
        else:
            # The map was fitted to the change from the present value, which is added here.
            maps[0, column, :, target] += 1.0
    return RidgeSolution(maps, intercept, penalty.reshape(shape), history.reshape(shape))
