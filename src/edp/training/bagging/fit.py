"""Fit an ensemble: a linear model, and learners of several kinds on its residuals, each with one left-out fold.

The prediction is the mean of the folds' linear models plus a non-negative combination of the learners (bagging:
Breiman, 1996; stacking: Wolpert, 1992, and Breiman, 1996). Each row of the training and validation parts is left out by
one fold: what that fold's models say of it is an honest prediction. These left-out predictions choose the linear model,
stop each learner, weigh the learners and tell the error to expect.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from edp.data.fold_ridge import FoldRidge, fold_ridge
from edp.data.lags import DoubleArray
from edp.data.prepared import Prepared
from edp.networks.predictor import ModelSpec, Predictor, build_model
from edp.storage.runs import Run
from edp.training.bagging.boosting import TreeLearner
from edp.training.bagging.dead_band import band, dead_bands
from edp.training.bagging.learner import FoldFit, HeadPart, Learner
from edp.training.bagging.perceptrons import CheckedErrors, PerceptronLearner, losses_of, record
from edp.training.bagging.radial import RadialLearner
from edp.training.bagging.spec import BaggingSpec
from edp.training.bagging.stacking import stacking_weights
from edp.training.bagging.table import BaggingTable, committee_of, table_of
from edp.training.outcome import Fitted, TrainingProgress
from edp.training.spec import TrainingSpec, check_training, thread_count

Event = Callable[[TrainingProgress], None]


@dataclass(frozen=True, eq=False)
class Bagged:
    """A committee fitted by bagging.

    Attributes:
        fitted: the predictor with its history.
        left_out: predictions of each row by what did not train on it, standardised, ``(row, output)``.
        linear: errors of the linear model alone.
        table: the rows.
    """

    fitted: Fitted
    left_out: DoubleArray
    linear: DoubleArray
    table: BaggingTable

    def predict_all(self, truth: Sequence[DoubleArray]) -> list[DoubleArray]:
        """Return left-out predictions of each segment at every sample, standardised ``(tick, output)``.

        Args:
            truth: targets of each segment of the training part, then of the validation part.
        """
        return self.table.predict_all(self.left_out - self.table.targets, truth)


def fit_bagged(data: Prepared, model: ModelSpec, spec: TrainingSpec, on_event: Event | None = None) -> Bagged:
    """Fit a committee on the training and validation parts; ``data.test`` is not touched.

    Args:
        data: prepared series.
        model: a network with the backbone ``committee`` and the head ``linear``.
        spec: settings of the training, which include `bagging`.
        on_event: called with progress.

    Raises:
        ConfigError: settings that contradict one another or need more memory than there is.
        DataError: too few rows for the folds.
        Diverged: the loss is not finite any more.
    """
    torch.set_num_threads(thread_count(spec))  # another number adds in another order: other bits
    check_training(data.task, model, spec)
    began = time.perf_counter()
    net = build_model(data.task, model, data.scaler(), spec.seed).eval()
    table = table_of(net, data, spec.ensemble or BaggingSpec())
    work = FoldFit(net, data, spec, table, _fit_linear(net, table), on_event or (lambda event: None))
    learners = _learners(work)
    for learner in learners:
        learner.fit()
    left_out = _combine(work, learners)
    if not work.history:
        _record_linear(work)
    seconds = time.perf_counter() - began
    for row in work.history:
        row["seconds"] = round(seconds * row["updates"] / max(1, work.history[-1]["updates"]), 3)
    speeds = [learner.rows_per_s for learner in learners if isinstance(learner, PerceptronLearner)]
    fitted = Fitted(net.eval(), work.history, seconds, sum(speeds), 0)
    return Bagged(fitted, left_out, work.linear.left_out, table)


def fit_in_folds(
    data: Prepared,
    model: ModelSpec,
    spec: TrainingSpec,
    run: Run | None,
    on_event: Event,
) -> Fitted:
    """Fit like `fit_bagged` and store the history in a run folder.

    There is no checkpoint: a stopped training restarts.
    """
    fitted = fit_bagged(data, model, spec, on_event).fitted
    if run is not None:
        run.write_history(fitted.history)
    return fitted


def _fit_linear(net: Predictor, table: BaggingTable) -> FoldRidge:
    """Fit the linear models: present values, then changes over more and more spans, then all columns."""
    bank = committee_of(net).bank
    counts = [*range(len(bank.lags) + 1), *([len(bank.spans)] if bank.smoothed else [])]
    sets = [np.arange(bank.width * (1 + spans)) for spans in counts]
    return fold_ridge(table.columns, table.targets, table.folds, sets)


def _learners(work: FoldFit) -> list[Learner]:
    """Create the learners for the parts of the ensemble, in the order of its representation."""
    committee = committee_of(work.net)
    learners: list[Learner] = []
    if committee.members:
        learners.append(PerceptronLearner(work, committee.members))
    learners += [RadialLearner(work, functions) for functions in committee.radials]
    if committee.trees is not None:
        learners.append(TreeLearner(work, committee.trees))
    return learners


def _combine(work: FoldFit, learners: Sequence[Learner]) -> DoubleArray:
    """Weigh all models, write everything into the network, and give the predictions of rows that were left out."""
    models = [list(learner.left_out()) for learner in learners]
    every = [one for each in models for one in each]
    residual = work.residual
    few = [isinstance(learner, RadialLearner) and learner.few for learner in learners]
    further = np.repeat(few, [len(each) for each in models]).tolist()
    shares = stacking_weights(every, residual, work.table.folds.owner, further)
    parts, first = [], 0
    for learner, own in zip(learners, models, strict=True):
        parts.append(learner.write(shares[first : first + len(own)]))
        first += len(own)
    _write_head(work, parts)
    weighted = (one * share for one, share in zip(every, shares, strict=True))
    return _write_band(work, np.asarray(work.linear.left_out + sum(weighted, np.zeros_like(residual))))


def _write_head(work: FoldFit, parts: Sequence[HeadPart]) -> None:
    """Write the linear model and every learner's part to the head of the network."""
    weight, intercept = work.linear.mean()
    remaining = 1.0 - sum((part.linear for part in parts), np.zeros(len(intercept)))
    full = np.concatenate([weight * remaining, *(part.weight for part in parts)])
    bias = intercept * remaining + sum((part.bias for part in parts), np.zeros(len(intercept)))
    # Outputs are horizon by horizon; heads are (target, in, horizon).
    task, heads = work.data.task, work.net.heads
    shape = (len(full), len(task.horizons), len(task.targets))
    with torch.no_grad():
        heads.weights[0].copy_(torch.from_numpy(full.reshape(shape).transpose(2, 0, 1).copy()))
        heads.biases[0].copy_(torch.from_numpy(bias.reshape(shape[1:]).T.copy()))


def _write_band(work: FoldFit, left_out: DoubleArray) -> DoubleArray:
    """Write the dead bands to the head if it has them; return the left-out predictions with them applied."""
    dead_band = work.net.heads.band
    if dead_band is None:
        return left_out
    widths = dead_bands(left_out, work.table.targets, work.table.folds.owner)
    dead_band.width.copy_(torch.from_numpy(widths).view_as(dead_band.width))
    return band(left_out, widths)


def _record_linear(work: FoldFit) -> None:
    """Record the single history row of a training without steps."""
    error = torch.from_numpy(work.linear.left_out - work.table.targets)
    validation = float(losses_of(work.spec)[0].penalty(error).mean())
    absolute = error.abs()
    each = absolute.mean(dim=0).numpy()
    record(work, CheckedErrors(1, 0, math.nan, validation, float(absolute.mean()), each, 0.0))
