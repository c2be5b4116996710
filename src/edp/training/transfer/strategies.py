"""The training strategy of low-rank changes to the weights of a trained network."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from edp.data.series import Series
from edp.data.task import Task
from edp.networks.matrices import Matrix, matrices_of
from edp.networks.predictor import Predictor
from edp.training.objective import Objective
from edp.training.spec import TrainingSpec
from edp.training.strategy import BatchContext
from edp.training.warm_start import WarmStart


class LowRank:
    """Training of a low-rank change for each weight matrix, ``W + B A`` (Hu et al. 2021, arXiv 2106.09685).

    A begins random, B at zero, so the first network is the start. Everything else is held. At the end the changes are
    added to the weights: what is left is an ordinary network.

    Args:
        start: a trained network of the specs to train.
        rank: rank of each change; a matrix with fewer rows or columns has a change of full rank.
    """

    def __init__(self, start: Predictor, rank: int) -> None:
        self.rank, self.base = rank, WarmStart(start)
        self._handles: list[torch.utils.hooks.RemovableHandle] = []
        self._changes: list[tuple[Matrix, _Change]] = []
        self._frozen: list[nn.Parameter] = []

    def series(self, task: Task, own_series: Sequence[Series]) -> list[Series]:
        """Return the training series unchanged."""
        return list(own_series)

    def begin(self, net: Predictor, spec: TrainingSpec) -> bool:
        """Copy weights and scaling, freeze them, and insert the low-rank changes.

        Raises:
            ConfigError: the start has other specs.
        """
        self.base.begin(net, spec)
        self._frozen = [parameter for parameter in net.parameters() if parameter.requires_grad]
        # Weights are held: only the changes learn.
        for parameter in self._frozen:
            parameter.requires_grad_(False)
        # A generator of its own: adapters do not move the draws of the network's dropout.
        draw = torch.Generator().manual_seed(spec.seed)
        self._changes = [(matrix, _Change(matrix, self.rank, draw)) for matrix in matrices_of(net)]
        net.add_module("adapters", nn.ModuleList(change for _, change in self._changes))
        for part in dict.fromkeys(matrix.part for matrix, _ in self._changes):
            self._swap([both for both in self._changes if both[0].part is part], part)
        return True

    def loss(self, objective: Objective, batch_context: BatchContext) -> Tensor:
        """Return the loss of the base strategy, without a teacher."""
        return self.base.loss(objective, batch_context)

    def end(self, net: Predictor) -> None:
        """Add the changes to the weights and take them out."""
        for handle in self._handles:
            handle.remove()
        with torch.no_grad():
            for matrix, change in self._changes:
                matrix.values.add_(change())
                # The LSTM keeps flat copies of the tensors it was last called with.
                if isinstance(matrix.part, nn.LSTM):  # it holds what it was last called with
                    matrix.part._init_flat_weights()
        del net.adapters
        for parameter in self._frozen:
            parameter.requires_grad_(True)
        self.base.end(net)
        self._handles, self._changes = [], []

    def _swap(self, changes: list[tuple[Matrix, _Change]], part: nn.Module) -> None:
        """Let a part compute with changed weights whenever it is called."""
        replaced = [(matrix.holder._parameters, matrix.key, matrix.values, change) for matrix, change in changes]

        def enter(*_: object) -> None:
            for parameters, key, weight, change in replaced:
                parameters[key] = weight + change()

        def leave(*_: object) -> None:
            for parameters, key, weight, _change in replaced:
                parameters[key] = weight  # type: ignore[assignment]

        self._handles.append(part.register_forward_pre_hook(enter))
        self._handles.append(part.register_forward_hook(leave, always_call=True))


class _Change(nn.Module):
    """``B A`` in the shape of a weight."""

    def __init__(self, matrix: Matrix, rank: int, draw: torch.Generator) -> None:
        super().__init__()
        weight = matrix.values
        others = [axis for axis in range(weight.ndim) if axis not in matrix.axes]
        # Outputs first, so that any weight becomes a matrix of outputs by inputs.
        order = [*matrix.axes, *others]
        self.shape = [weight.shape[axis] for axis in order]
        self.back = [order.index(axis) for axis in range(weight.ndim)]
        rows = int(torch.tensor(self.shape[: len(matrix.axes)]).prod())
        columns = weight.numel() // rows
        rank = min(rank, rows, columns)
        # A random, B zero: the change begins at nothing and still has a gradient.
        self.a = nn.Parameter(torch.randn(rank, columns, generator=draw).to(weight) / columns**0.5)
        self.b = nn.Parameter(weight.new_zeros(rows, rank))

    def forward(self) -> Tensor:
        return (self.b @ self.a).reshape(self.shape).permute(self.back)
