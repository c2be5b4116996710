"""Hidden-feature hints: how well a student's hidden features predict the hidden features of its teachers."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

RIDGE = 1e-3  # of the student's mean square: keeps the map small where features repeat one another


@dataclass(frozen=True, eq=False)
class Components:
    """Principal components of hidden features, scaled to a mean square of 1.

    Attributes:
        mean: ``(width,)``.
        map: ``(width, component)``.
    """

    mean: NDArray[np.float64]
    map: NDArray[np.float64]

    @classmethod
    def fitted(cls, parts: Iterable[NDArray[np.float32]], components: int) -> Components:
        """Fit to the features ``(time, width)`` of the training series; components are at most as many as features."""
        count, total, squares = 0, np.zeros(()), np.zeros(())
        for part in parts:
            values = part.astype(np.float64)
            count, total, squares = count + len(values), total + values.sum(axis=0), squares + values.T @ values
        mean = total / count
        # Moments in one pass: hidden features of all recordings would not fit in memory.
        variances, vectors = np.linalg.eigh(squares / count - np.outer(mean, mean))
        strongest = np.argsort(variances)[::-1][:components]
        # One scale for all components: weak ones must not count as much as strong ones.
        scale = np.sqrt(max(float(variances[strongest].mean()), 1e-12))
        return cls(mean, vectors[:, strongest] / scale)

    def project(self, values: NDArray[np.float32]) -> NDArray[np.float64]:
        """Return the components ``(time, component)`` of features ``(time, width)``."""
        return (values - self.mean) @ self.map


def hint_error(hidden: Tensor, teacher_components: Tensor, valid: Tensor) -> Tensor:
    """Return the mean square residual of the best linear map from the student's hidden features to the wanted ones.

    The map (ridge regression with a constant) is found again in each batch and held fixed for the gradient, which is
    then that of the error with the best map; it adds nothing to train or to store. Zero where fewer than four ticks a
    feature count.

    Args:
        hidden: hidden features of the student, ``(batch, time, width)``.
        teacher_components: components of the teachers' features, ``(batch, time, component)``.
        valid: ``(batch, time)``.
    """
    rows = hidden[valid]
    if len(rows) < 4 * rows.shape[1]:
        # Zero with a gradient path: too few ticks give no hint, and the optimiser needs no special case.
        return hidden.sum() * 0.0
    # The constant column lets the map have an offset.
    rows = torch.cat([rows, rows.new_ones(len(rows), 1)], dim=1)
    goal = teacher_components[valid]
    # The best map is a constant for the gradient: at its optimum the envelope theorem makes its own change vanish.
    with torch.no_grad():
        # Double precision: normal equations square the condition number.
        student_features = rows.double()
        gram = student_features.T @ student_features
        gram += RIDGE * gram.diagonal().mean() * torch.eye(len(gram), dtype=gram.dtype, device=gram.device)
        best = torch.linalg.solve(gram, student_features.T @ goal.double()).to(rows)
    error: Tensor = (rows @ best - goal).square().mean()
    return error
