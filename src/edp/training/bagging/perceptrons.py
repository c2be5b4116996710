"""The perceptrons of a committee as learners: trained side by side, each stopped by the fold that it leaves out."""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from edp.data.lags import DoubleArray
from edp.networks.committee import Members
from edp.networks.losses.base import Penalty
from edp.networks.losses.huber import Huber
from edp.signals import KINDS
from edp.training.bagging.learner import FoldFit, HeadPart
from edp.training.bagging.members import MemberGroup
from edp.training.bagging.spec import BaggingSpec
from edp.training.outcome import Diverged, TrainingProgress
from edp.training.spec import TrainingSpec

RISE = 0.1
"""Share of the updates over which the learning rate rises."""


def losses_of(spec: TrainingSpec) -> tuple[Penalty, ...]:
    """Return the losses of the members; `check_training` refuses other losses.

    Raises:
        TypeError: one reads more than an error.
    """
    if not isinstance(spec.loss, Penalty):
        raise TypeError("bagging trains with a loss that reads an error alone; check_training refuses any other")
    width = (spec.ensemble or BaggingSpec()).huber_delta
    return (spec.loss, Huber(delta=width)) if width else (spec.loss,)


class PerceptronLearner:
    """Trains all groups of members together on the residuals of each fold's linear model, keeping each at its best."""

    def __init__(self, work: FoldFit, modules: Sequence[Members]) -> None:
        self.work, self.modules, self.bagging = work, modules, work.bagging
        table, linear = work.table, work.linear
        outputs = table.targets.shape[1]
        self.columns = torch.from_numpy(table.columns)
        # Members learn the residual in units of its spread; an output that a line predicts exactly leaves nothing.
        self.spread = np.sqrt(np.square(work.residual).mean(axis=0))
        self.spread[self.spread <= 1e-9] = 1.0
        folds = range(table.folds.count)
        residuals = [table.targets - table.columns @ linear.weights[f] - linear.intercepts[f] for f in folds]
        self.residuals = torch.from_numpy(np.stack(residuals) / self.spread).float()
        draw, self.losses = torch.Generator().manual_seed(work.spec.seed), losses_of(work.spec)
        self.groups = [MemberGroup(group, outputs, table.folds, work.spec, self.losses, draw) for group in modules]
        self.rate = self.rows_per_s = 0.0

    def fit(self) -> None:
        """Run all updates with checks in between; each check stores the members that have improved.

        Raises:
            Diverged: the loss is not finite any more.
        """
        steps, checks = self.bagging.steps, min(self.bagging.validations, self.bagging.steps)
        edges = [round(steps * check / checks) for check in range(checks + 1)]
        # The linear model alone is a candidate: members count where they lower the error.
        for group in self.groups:
            group.judge(self.columns, self.residuals)
        began = time.perf_counter()
        for check, (start, stop) in enumerate(itertools.pairwise(edges), start=1):
            total, shown = 0.0, time.perf_counter()
            for step in range(start, stop):
                total += self._step(step)
                if time.perf_counter() - shown > 0.5:
                    shown = time.perf_counter()
                    self._report(check, checks, step + 1 - start, stop - start, began, edges)
            self._check(check, stop, total / (stop - start))
            self._report(check, checks, stop - start, stop - start, began, edges, self.work.history[-1])
        self.rows_per_s = steps * self.bagging.batch / max(time.perf_counter() - began, 1e-9)

    def _step(self, step: int) -> float:
        share = step / self.bagging.steps
        rate = self.rate = self.bagging.learning_rate * min(1.0, share / RISE) * 0.5 * (1 + math.cos(math.pi * share))
        losses = [group.update(self.columns, self.residuals, rate) for group in self.groups]
        value = float(np.mean(losses))
        if not math.isfinite(value):
            facts = {"epoch": len(self.work.history) + 1, "update": step + 1, "kept_epoch": None}
            raise Diverged(
                f"the training loss is {value} at update {step + 1}: the training diverged; nothing is kept. Lower "
                "training.ensemble.learning_rate, or look for outliers with edp data check",
                None,
                facts,
            )
        return value

    def _check(self, check: int, updates: int, loss: float) -> None:
        judged = [group.judge(self.columns, self.residuals) for group in self.groups]
        validation, absolute = (float(np.mean(values)) for values in zip(*judged, strict=True))
        each = absolute * self.spread
        record(self.work, CheckedErrors(check, updates, loss, validation, absolute, each, self.rate))

    def _report(
        self,
        check: int,
        checks: int,
        update: int,
        updates: int,
        began: float,
        edges: Sequence[int],
        row: dict[str, object] | None = None,
    ) -> None:
        done, seconds = edges[check - 1] + update, time.perf_counter() - began
        rate = done * self.bagging.batch / max(seconds, 1e-9)
        left = (self.bagging.steps - done) * seconds / max(1, done)
        self.work.tell(TrainingProgress(check, checks, update, updates, rate, left, row))

    def left_out(self) -> Sequence[DoubleArray]:
        """Return one model per group and loss: the mean of the members that left out a row."""
        folds = self.work.table.folds
        kinds = range(len(self.losses))
        return [group.left_out(self.columns, folds, kind) * self.spread for group in self.groups for kind in kinds]

    def write(self, shares: DoubleArray) -> HeadPart:
        """Write the best members' layers to the backbone, and the weighted mean of their last layers to the head."""
        blocks, bias = [], np.zeros(shares.shape[1])
        of_group = shares.reshape(len(self.groups), len(self.losses), -1)
        with torch.no_grad():
            for group, module, share in zip(self.groups, self.modules, of_group, strict=True):
                layers = len(module.weights)
                for layer in range(layers):
                    module.weights[layer].copy_(group.best[2 * layer])
                    module.biases[layer].copy_(group.best[2 * layer + 1].squeeze(1))
                # A member's part of the mean of those with its loss, ``(member, 1, output)``.
                counts = np.array([len(group.of_kind(kind)) for kind in range(len(self.losses))])
                scale = (share * self.spread / counts[:, None])[group.kind.numpy()][:, None]
                last = group.best[2 * layers].double().numpy() * scale
                blocks.append(last.reshape(-1, len(bias)))
                bias += (group.best[2 * layers + 1].double().numpy() * scale).sum(axis=(0, 1))
        return HeadPart(np.concatenate(blocks), bias, np.zeros(len(bias)))


@dataclass(frozen=True)
class CheckedErrors:
    """Errors of the rows left out at one check of a training on folds.

    Attributes:
        check: number of the check, from 1.
        updates: done so far.
        loss: training loss; NaN if nothing was trained.
        validation: loss on the rows left out.
        absolute: absolute error on them, in standard deviations, mean over outputs.
        each: error of each output.
        rate: learning rate.
    """

    check: int
    updates: int
    loss: float
    validation: float
    absolute: float
    each: DoubleArray
    rate: float


def record(work: FoldFit, checked: CheckedErrors) -> None:
    """Add a row to the history."""
    scale = work.net.code.width.flatten().numpy()
    factors = np.array([KINDS[kind].report_factor for kind in work.data.target_kinds])
    factors = np.tile(factors, len(work.data.task.horizons))
    best = all(checked.validation <= row["validation_loss"] for row in work.history)
    for row in work.history if best else ():
        row["best"] = False
    work.history.append(
        {
            "epoch": checked.check,
            "updates": checked.updates,
            "train_loss": checked.validation if math.isnan(checked.loss) else checked.loss,
            "validation_loss": checked.validation,
            "validation_score": checked.absolute,
            "validation_mae": float(np.mean(checked.each * scale * factors)),
            "learning_rate": checked.rate,
            "seconds": 0.0,
            "best": best,
        }
    )
