"""Members of an ensemble during training: batched weights, each member with its own fold."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from edp.data.folds import Folds
from edp.data.lags import DoubleArray
from edp.networks.committee import Members
from edp.networks.losses.base import Penalty
from edp.training.bagging.spec import BaggingSpec
from edp.training.eager import EagerAdamW
from edp.training.spec import TrainingSpec

JUDGED_ROWS = 4000
"""Left-out rows of a fold by which its members are stopped: an error known within two in a hundred."""
AVERAGE = 0.02
"""Step of the average of the weights towards the weights: some fifty updates long."""
PIECE = 4096
"""Rows that are predicted in one call."""


class MemberGroup:
    """The members of one activation while they train: weights of all of them side by side."""

    def __init__(
        self,
        members: Members,
        outputs: int,
        folds: Folds,
        spec: TrainingSpec,
        losses: Sequence[Penalty],
        draw: torch.Generator,
    ) -> None:
        self.members, self.losses, self.draw = members, losses, draw
        self.fold = torch.arange(members.members) % folds.count
        # Dealt out like the folds: every loss has members that leave each fold out.
        self.kind = torch.arange(members.members) // folds.count % len(losses)
        last = torch.zeros(members.members, members.units, outputs)
        self.parameters = [
            parameter.detach().clone().requires_grad_()
            for pair in zip(members.weights, members.biases, strict=True)
            for parameter in (pair[0], pair[1].unsqueeze(1))
        ]
        self.parameters += [last.requires_grad_(), torch.zeros(members.members, 1, outputs).requires_grad_()]
        bagging = spec.ensemble or BaggingSpec()
        self.optimizer = EagerAdamW(self.parameters, lr=bagging.learning_rate, weight_decay=bagging.weight_decay)
        self.average = [parameter.detach().clone() for parameter in self.parameters]
        self.best = [parameter.clone() for parameter in self.average]
        self.least = torch.full((members.members,), math.inf)
        self.batch = bagging.batch
        self.training = [torch.from_numpy(rows) for rows in folds.training]
        sample = np.random.default_rng(spec.seed)
        self.judged = []
        for number in range(folds.count):
            rows = folds.left_out(number)
            chosen = sample.choice(rows, JUDGED_ROWS, replace=False) if len(rows) > JUDGED_ROWS else rows
            self.judged.append(torch.from_numpy(np.sort(chosen)))

    def forward(self, x: Tensor, parameters: list[Tensor], dropping: bool = False) -> Tensor:
        """Return ``(member, row, column)`` to ``(member, row, output)``."""
        rate = self.members.dropout.p if dropping else 0.0
        for weight, bias in zip(parameters[:-2:2], parameters[1:-2:2], strict=True):
            x = self.members.function(torch.baddbmm(bias, x, weight))
            if rate:
                x = x * (torch.rand(x.shape, generator=self.draw) >= rate) / (1 - rate)
        return torch.baddbmm(parameters[-1], x, parameters[-2])

    def _penalty(self, error: Tensor, kind: Tensor) -> Tensor:
        """Return mean penalty of each member by its own loss; error ``(member, row, output)``, kind ``(member,)``."""
        each = torch.zeros(len(error))
        for number, loss in enumerate(self.losses):
            mine = torch.nonzero(kind == number).flatten()
            each = each.index_put((mine,), loss.penalty(error[mine]).mean(dim=(1, 2)))
        return each

    def update(self, columns: Tensor, residuals: Tensor, rate: float) -> float:
        """Update every member on its own rows, and return the mean loss."""
        for group in self.optimizer.param_groups:
            group["lr"] = rate
        rows = torch.stack([self._draw_rows(int(fold)) for fold in self.fold])
        error = self.forward(columns[rows], self.parameters, dropping=True) - residuals[self.fold[:, None], rows]
        # The sum over members: each has its own gradient, as if it were trained alone.
        each = self._penalty(error, self.kind)
        self.optimizer.zero_grad(set_to_none=True)
        each.sum().backward()
        self.optimizer.step()
        with torch.no_grad():
            torch._foreach_lerp_(self.average, self.parameters, AVERAGE)
        return float(each.mean().detach())

    def _draw_rows(self, fold: int) -> Tensor:
        rows = self.training[fold]
        return rows[torch.randint(len(rows), (self.batch,), generator=self.draw)]

    def judge(self, columns: Tensor, residuals: Tensor) -> tuple[float, float]:
        """Keep each member's average if it is the best so far; return mean loss and absolute error on left-out rows."""
        losses, absolute = torch.zeros(len(self.fold)), 0.0
        with torch.no_grad():
            for fold, rows in enumerate(self.judged):
                mine = torch.nonzero(self.fold == fold).flatten()
                if not len(mine):
                    continue
                x = columns[rows].expand(len(mine), -1, -1)
                error = self.forward(x, [value[mine] for value in self.average]) - residuals[fold, rows]
                losses[mine] = self._penalty(error, self.kind[mine])
                absolute += float(error.abs().mean()) * len(mine) / len(self.fold)
            better = losses < self.least
            self.least = torch.where(better, losses, self.least)
            for best, value in zip(self.best, self.average, strict=True):
                best[better] = value[better]
        return float(losses.mean()), absolute

    def of_kind(self, kind: int) -> Tensor:
        """Return the indices of the members trained with the given kind of loss."""
        return torch.nonzero(self.kind == kind).flatten()

    def left_out(self, columns: Tensor, folds: Folds, kind: int) -> DoubleArray:
        """Return the mean prediction of each row by the members that left it out, ``(row, output)``.

        Zero without any.
        """
        predicted = np.zeros((len(columns), self.best[-1].shape[-1]))
        with torch.no_grad():
            for fold in range(folds.count):
                mine = torch.nonzero((self.fold == fold) & (self.kind == kind)).flatten()
                rows = folds.left_out(fold)
                for start in range(0, len(rows) if len(mine) else 0, PIECE):
                    piece = rows[start : start + PIECE]
                    x = columns[torch.from_numpy(piece)].expand(len(mine), -1, -1)
                    predicted[piece] = self.forward(x, [value[mine] for value in self.best]).mean(dim=0).numpy()
        return predicted
