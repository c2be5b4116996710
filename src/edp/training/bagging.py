"""Fit a committee: a linear model, and perceptrons on what it leaves, each trained with one fold left out (bagging).

The prediction is the mean of the folds' linear models plus a weighted mean of the members (Breiman, 1996). Each row of
the training and validation parts is left out by one fold: what that fold's linear model and members say of it is an
honest prediction. These left-out predictions choose the linear model, stop each member, weigh the groups of members
and tell the error to expect.
"""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import nnls

from edp.data.fold_ridge import FoldRidge, fold_ridge
from edp.data.folds import Folds, blocked_folds
from edp.data.lags import DoubleArray
from edp.data.prepared import Prepared
from edp.data.series import Series
from edp.errors import ConfigError, DataError
from edp.networks.committee import Committee, Members
from edp.networks.losses.base import Penalty
from edp.networks.predictor import ModelSpec, Predictor, build_model
from edp.signals import KINDS
from edp.storage.memory import check_setting
from edp.storage.runs import RunFolder
from edp.training.bagging_spec import BaggingSpec
from edp.training.members import MemberGroup
from edp.training.outcome import Diverged, Fitted, TrainingProgress
from edp.training.spec import TrainingSpec, check_training
from edp.training.validation import standard_targets

PIECE = 4096
"""Ticks of a stretch that go through the front end in one call."""
RISE = 0.1
"""Share of the updates over which the learning rate rises."""
FLOAT, DOUBLE = 4, 8
Event = Callable[[TrainingProgress], None]


@dataclass(frozen=True, eq=False)
class Table:
    """Rows of all stretches, laid end to end.

    Attributes:
        columns: the committee's changes over several spans, ``(row, column)``, float32.
        targets: standardised, ``(row, output)``; outputs are horizons times targets.
        folds: who is left out when.
        stride: ticks from row to row.
        starts: first row of each stretch, those of the training part first.
    """

    columns: NDArray[np.float32]
    targets: DoubleArray
    folds: Folds
    stride: int
    starts: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class Bagged:
    """A committee fitted by bagging.

    Attributes:
        fitted: the predictor with its history.
        left_out: predictions of each row by what did not train on it, standardised, ``(row, output)``.
        linear: those of the linear model alone.
        table: the rows.
    """

    fitted: Fitted
    left_out: DoubleArray
    linear: DoubleArray
    table: Table

    def at_every_tick(self, truth: Sequence[DoubleArray]) -> list[DoubleArray]:
        """Left-out predictions of each stretch at every tick, standardised ``(tick, output)``.

        Where rows were thinned out, the error of the row before a tick stands for that of the tick.

        Args:
            truth: what was to be predicted, of each stretch of the training part, then of the validation part.
        """
        error = self.left_out - self.table.targets
        rows = [
            first + np.arange(len(one)) // self.table.stride
            for first, one in zip(self.table.starts, truth, strict=True)
        ]
        return [one + error[chosen] for one, chosen in zip(truth, rows, strict=True)]


def fit_bagged(data: Prepared, model: ModelSpec, spec: TrainingSpec, on_event: Event | None = None) -> Bagged:
    """Fit a committee on the training and validation parts; ``data.test`` is not touched.

    Args:
        data: prepared series.
        model: a network with the backbone ``committee`` and the head ``linear``.
        spec: how to train; its `bagging` is given.
        on_event: called with progress.

    Raises:
        ConfigError: settings that contradict one another or need more memory than there is.
        DataError: too few rows for the folds.
        Diverged: the loss is not finite any more.
    """
    check_training(data.task, model, spec)
    began = time.perf_counter()
    net = build_model(data.task, model, data.scaler(), spec.seed).eval()
    table = _table(net, data, bagging_of(spec))
    linear = _fit_linear(net, table)
    training = _Training(net, table, linear, data, spec, on_event or (lambda event: None))
    left_out = training.run()
    seconds = time.perf_counter() - began
    for row in training.history:
        row["seconds"] = round(seconds * row["updates"] / max(1, training.history[-1]["updates"]), 3)
    fitted = Fitted(net.eval(), training.history, seconds, training.rows_per_s, 0)
    return Bagged(fitted, left_out, linear.left_out, table)


def fit_in_folds(
    data: Prepared, model: ModelSpec, spec: TrainingSpec, run: RunFolder | None, on_event: Event, strategy: object
) -> Fitted:
    """As `fit_bagged`, with its history in a run folder; there is no checkpoint: a stopped training begins anew.

    Raises:
        ConfigError: a strategy came with it.
    """
    if strategy is not None:
        raise ConfigError(
            "training.bagging trains from the recordings alone; leave it out, or train without a teacher or source"
        )
    fitted = fit_bagged(data, model, spec, on_event).fitted
    if run is not None:
        run.write_history(fitted.history)
    return fitted


def bagging_of(spec: TrainingSpec) -> BaggingSpec:
    """The settings of bagging of a training that has them."""
    return spec.bagging or BaggingSpec()


def penalty_of(spec: TrainingSpec) -> Penalty:
    """The loss of a training on folds; `check_training` refuses any other.

    Raises:
        TypeError: it reads more than an error.
    """
    if not isinstance(spec.loss, Penalty):
        raise TypeError("bagging trains with a loss that reads an error alone; check_training refuses any other")
    return spec.loss


def _committee(net: Predictor) -> Committee:
    if not isinstance(net.backbone, Committee):
        raise TypeError("bagging trains a committee; check_training refuses any other backbone")
    return net.backbone


def _groups(net: Predictor) -> list[Members]:
    return [group for group in _committee(net).groups if isinstance(group, Members)]


def _table(net: Predictor, data: Prepared, spec: BaggingSpec) -> Table:
    """Rows of both parts as the network sees them, and the gains that give each change unit spread."""
    stretches = [part for part in (*data.train, *data.validation) if part.samples > data.task.max_horizon]
    if not stretches:
        raise DataError(
            f"no stretch of the training and validation parts is longer than the largest horizon of "
            f"{data.task.max_horizon} ticks; give longer recordings"
        )
    bank = _committee(net).bank
    ticks = [part.samples - data.task.max_horizon for part in stretches]
    stride = max(1, math.ceil(sum(ticks) / spec.rows))
    outputs = len(data.task.horizons) * len(data.task.targets)
    rows = sum(ticks) // stride + len(ticks)
    check_setting(
        rows * (2 * FLOAT * bank.columns + 6 * DOUBLE * outputs),
        f"training: {rows:,} rows of {bank.columns:,} columns and {outputs:,} outputs",
        "make training.bagging.rows smaller, or the backbone's lags fewer",
    )
    columns = np.concatenate([_columns(net, part)[:count:stride] for part, count in zip(stretches, ticks, strict=True)])
    targets = np.concatenate([standard_targets(net, part)[0].flatten(1).numpy()[::stride] for part in stretches])
    spread = columns[:, bank.width :].std(axis=0, dtype=np.float64)
    gain = np.where(spread > 0, 1.0 / np.where(spread > 0, spread, 1.0), 1.0).astype(np.float32)
    columns[:, bank.width :] *= gain
    still = torch.from_numpy(np.ptp(columns, axis=0) == 0)
    with torch.no_grad():
        bank.gain.copy_(torch.from_numpy(gain).view_as(bank.gain))
        for group in _groups(net):
            # No gradient reaches these weights: random ones would answer a channel that moves later for the first time.
            group.weights[0][:, still] = 0.0
    # Rows within the longest lag and the largest horizon of a fold share samples with it.
    gap = math.ceil((bank.lags[-1] + data.task.max_horizon) / stride)
    lengths = [len(range(0, count, stride)) for count in ticks]
    gap = min(gap, max(1, sum(lengths) // (4 * spec.folds)))
    starts = np.cumsum([0, *lengths])[:-1]
    return Table(columns, targets, blocked_folds(lengths, spec.folds, gap), stride, tuple(map(int, starts)))


def _columns(net: Predictor, part: Series) -> NDArray[np.float32]:
    """What the bank gives of a whole stretch, ``(time, column)``."""
    bank = _committee(net).bank
    like = next(net.parameters())
    rows = []
    with torch.inference_mode():
        front, state = net.front.initial_state(1, like), bank.initial_state(1, like)
        for start in range(0, part.samples, PIECE):
            x = torch.from_numpy(part.inputs[start : start + PIECE]).unsqueeze(0).to(like)
            features, front = net.front(x, front)
            values, state = bank(net.front.scale(features), state)
            rows.append(values[0].float().numpy())
    return np.concatenate(rows)


def _fit_linear(net: Predictor, table: Table) -> FoldRidge:
    """The linear models: present values alone, then with changes over more and more spans."""
    bank = _committee(net).bank
    sets = [np.arange(bank.width * (1 + spans)) for spans in range(len(bank.lags) + 1)]
    return fold_ridge(table.columns, table.targets, table.folds, sets)


class _Training:
    """One training of all members, and what it leaves in the network."""

    def __init__(
        self, net: Predictor, table: Table, linear: FoldRidge, data: Prepared, spec: TrainingSpec, tell: Event
    ) -> None:
        self.net, self.table, self.linear, self.data, self.spec, self.tell = net, table, linear, data, spec, tell
        self.bagging = bagging_of(spec)
        self.history: list[dict[str, Any]] = []
        self.rows_per_s, self.rate = 0.0, 0.0
        outputs = table.targets.shape[1]
        self.columns = torch.from_numpy(table.columns)
        left = table.targets - linear.left_out
        # Members learn the residual in units of its spread; an output that a line predicts exactly leaves nothing.
        self.spread = np.sqrt(np.square(left).mean(axis=0))
        self.spread[self.spread <= 1e-9] = 1.0
        folds = range(table.folds.count)
        residuals = [table.targets - table.columns @ linear.weights[f] - linear.intercepts[f] for f in folds]
        self.residuals = torch.from_numpy(np.stack(residuals) / self.spread).float()
        draw = torch.Generator().manual_seed(spec.seed)
        self.groups = [MemberGroup(group, outputs, table.folds, spec, draw) for group in _groups(net)]
        self.loss = penalty_of(spec)

    def run(self) -> DoubleArray:
        """Train, set the network's weights, and give the predictions of left-out rows."""
        if not self.groups:
            self._note_linear()
            return self._finish()
        steps, checks = self.bagging.steps, min(self.bagging.checks, self.bagging.steps)
        edges = [round(steps * check / checks) for check in range(checks + 1)]
        # The linear model alone is a candidate: members count where they lower the error.
        for group in self.groups:
            group.judge(self.columns, self.residuals, self.loss)
        began = time.perf_counter()
        for check, (start, stop) in enumerate(itertools.pairwise(edges), start=1):
            total, shown = 0.0, time.perf_counter()
            for step in range(start, stop):
                total += self._step(step)
                if time.perf_counter() - shown > 0.5:
                    shown = time.perf_counter()
                    self._report(check, checks, step + 1 - start, stop - start, began, edges)
            self._check(check, stop, total / (stop - start))
            self._report(check, checks, stop - start, stop - start, began, edges, self.history[-1])
        self.rows_per_s = steps * self.bagging.batch / max(time.perf_counter() - began, 1e-9)
        return self._finish()

    def _note_linear(self) -> None:
        """The one row of the history where there are no members to train."""
        error = torch.from_numpy(self.linear.left_out - self.table.targets)
        absolute = float(error.abs().mean())
        self._record(1, 0, math.nan, float(self.loss.penalty(error).mean()), absolute, error.abs().mean(dim=0).numpy())

    def _step(self, step: int) -> float:
        share = step / self.bagging.steps
        rate = self.rate = self.bagging.learning_rate * min(1.0, share / RISE) * 0.5 * (1 + math.cos(math.pi * share))
        losses = [group.update(self.columns, self.residuals, self.loss, rate) for group in self.groups]
        value = float(np.mean(losses))
        if not math.isfinite(value):
            facts = {"epoch": len(self.history) + 1, "update": step + 1, "kept_epoch": None}
            raise Diverged(
                f"the training loss is {value} at update {step + 1}: the training diverged; nothing is kept. Lower "
                "training.bagging.learning_rate, or look for outliers with edp inspect",
                None,
                facts,
            )
        return value

    def _check(self, check: int, updates: int, loss: float) -> None:
        judged = [group.judge(self.columns, self.residuals, self.loss) for group in self.groups]
        validation, absolute = (float(np.mean(values)) for values in zip(*judged, strict=True))
        self._record(check, updates, loss, validation, absolute, absolute * self.spread)

    def _record(
        self, check: int, updates: int, loss: float, validation: float, absolute: float, each: DoubleArray
    ) -> None:
        """A row of the history; `each` is the absolute error of each output in standard deviations."""
        scale = self.net.code.width.flatten().numpy()
        factors = np.array([KINDS[kind].report_factor for kind in self.data.target_kinds])
        factors = np.tile(factors, len(self.data.task.horizons))
        best = all(validation <= row["validation_loss"] for row in self.history)
        for row in self.history if best else ():
            row["best"] = False
        self.history.append(
            {
                "epoch": check,
                "updates": updates,
                "train_loss": validation if math.isnan(loss) else loss,
                "validation_loss": validation,
                "validation_score": absolute,
                "validation_mae": float(np.mean(each * scale * factors)),
                "learning_rate": self.rate,
                "seconds": 0.0,
                "best": best,
            }
        )

    def _report(
        self,
        check: int,
        checks: int,
        update: int,
        updates: int,
        began: float,
        edges: Sequence[int],
        row: dict[str, Any] | None = None,
    ) -> None:
        done, seconds = edges[check - 1] + update, time.perf_counter() - began
        rate = done * self.bagging.batch / max(seconds, 1e-9)
        left = (self.bagging.steps - done) * seconds / max(1, done)
        self.tell(TrainingProgress(check, checks, update, updates, rate, left, row))

    def _finish(self) -> DoubleArray:
        """Weigh the groups, write everything into the network, and predict the rows that were left out."""
        target = self.table.targets - self.linear.left_out
        left_out = [group.left_out(self.columns, self.table.folds) * self.spread for group in self.groups]
        outputs = target.shape[1]
        shares = np.zeros((len(left_out), outputs))
        for output in range(outputs if left_out else 0):
            # Non-negative: members that only fit the noise get nothing, and none is played off against another.
            shares[:, output], _ = nnls(np.stack([one[:, output] for one in left_out], axis=1), target[:, output])
        self._write(shares)
        weighted = [one * share for one, share in zip(left_out, shares, strict=True)]
        return np.asarray(self.linear.left_out + sum(weighted, np.zeros_like(target)))

    def _write(self, shares: DoubleArray) -> None:
        """The best members' layers into the backbone; the linear model and the weighted mean of members in the head."""
        heads = self.net.heads
        weight, intercept = self.linear.mean()
        blocks, bias = [weight], intercept.copy()
        with torch.no_grad():
            for group, module, share in zip(self.groups, _groups(self.net), shares, strict=True):
                layers = len(module.weights)
                for layer in range(layers):
                    module.weights[layer].copy_(group.best[2 * layer])
                    module.biases[layer].copy_(group.best[2 * layer + 1].squeeze(1))
                scale = share * self.spread / len(group.fold)
                last = group.best[2 * layers].double().numpy() * scale
                blocks.append(last.reshape(-1, len(bias)))
                bias += (group.best[2 * layers + 1].double().numpy().squeeze(1) * scale).sum(axis=0)
            full = np.concatenate(blocks)
            # Outputs are horizon by horizon; heads are (target, in, horizon).
            shape = (len(full), len(self.data.task.horizons), len(self.data.task.targets))
            heads.weights[0].copy_(torch.from_numpy(full.reshape(shape).transpose(2, 0, 1).copy()))
            heads.biases[0].copy_(torch.from_numpy(bias.reshape(shape[1:]).T.copy()))
