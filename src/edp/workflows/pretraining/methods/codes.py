"""A code for each machine: one network for all of them, and a few numbers that say which one it is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor, nn

from edp.data.chunks import Piece, Sampler
from edp.data.episodes import EpisodeSampler
from edp.data.prepared import Prepared
from edp.data.series import Series
from edp.data.task import Task
from edp.networks.blocks.machine_code import CodedChannels, MachineCode
from edp.networks.predictor import ModelSpec, Predictor
from edp.training.objective import Objective
from edp.training.spec import TrainingSpec
from edp.training.strategy import BatchContext, EpisodicStrategy, TrainingStrategy
from edp.training.validation import validation_scores
from edp.training.warm_start import continue_from
from edp.workflows.pretraining.methods.base import PRETRAININGS
from edp.workflows.pretraining.spec import MetaSpec

UNKNOWN = 0.15
"""Share of the streams of an update with the code of an unknown machine, zero: the network must do without, too."""
SPREAD = 0.3
"""Deviation of the first codes; at zero the maps from code to gains would have no gradient."""
WEIGHT = 1e-4
"""Of the mean square of the codes in the loss: codes of machines stay near zero, where those of new ones begin."""


@PRETRAININGS.register("codes")
class Codes:
    """Minimise the mean error over all machines, each with a code of its own that is learned with the weights."""

    label: ClassVar[str] = "With codes"
    episodic: ClassVar[bool] = True

    def model(self, spec: ModelSpec) -> ModelSpec:
        """The network with the block that reads a code, behind the blocks that it has."""
        if any(isinstance(block, MachineCode) for block in spec.blocks):
            return spec
        return replace(spec, blocks=(*spec.blocks, MachineCode()))

    def strategy(self, spec: MetaSpec, start: Predictor | None) -> TrainingStrategy:
        """Pieces of machines, each with its code."""
        return WithCodes(spec, start)


class MachineSampler(EpisodeSampler):
    """Episodes whose inputs have one more column: the number of the machine, constant over a piece."""

    def _episode(self, machine: str, rng: np.random.Generator) -> list[Piece]:
        number = list(self.owned).index(machine)
        return [
            (np.column_stack([inputs, np.full(len(inputs), number, np.float32)]), *rest)
            for inputs, *rest in super()._episode(machine, rng)
        ]


class WithCodes(EpisodicStrategy):
    """Learns the codes of the machines that train beside the weights, and keeps the weights alone.

    Args:
        spec: `shots`, pieces of a machine in an update, counts here; no step is taken.
        start: a network to begin with; None begins at random.
    """

    def __init__(self, spec: MetaSpec, start: Predictor | None = None) -> None:
        self.spec, self.start = spec, start
        self.machines: tuple[str, ...] = ()

    def series(self, task: Task, own_series: Sequence[Series]) -> list[Series]:
        """The training series as they are; their machines are noted."""
        self.machines = tuple(dict.fromkeys(part.machine for part in own_series))
        return list(own_series)

    def sampler(self, series: Sequence[Series], task: Task, spec: TrainingSpec) -> Sampler:
        """Pieces of as many machines as a batch holds."""
        return MachineSampler(series, task.horizons, spec.chunks, self.spec.shots, spec.seed)

    def begin(self, net: Predictor, spec: TrainingSpec) -> bool:
        """Take over the start, and give the block a table of codes, which the optimiser then learns."""
        if self.start is not None:
            continue_from(net, self.start)
        block, self.training = coded_block(net), spec
        draws = torch.randn(
            len(self.machines) * len(block.machine_code), generator=torch.Generator().manual_seed(spec.seed)
        )
        # A vector: optimisers that precondition matrices would need the square of the number of machines.
        block.table = nn.Parameter(SPREAD * draws)
        return self.start is not None

    def episode(self, net: Predictor, objective: Objective, batch: tuple[Tensor, Tensor, Tensor]) -> Tensor:
        """The loss of pieces from reset, each with the code of its machine or none."""
        x, future, valid = batch
        block = coded_block(net)
        codes = block.table.view(len(self.machines), -1)[x[:, 0, -1].long()]
        block.lanes = codes * (torch.rand(len(x), 1, device=x.device) >= UNKNOWN)
        try:
            answer, features, _, _ = net.forward_features(x[..., :-1], net.initial_state(len(x), x))
        finally:
            block.lanes = None
        return objective.evaluate(answer, future, features, valid) + WEIGHT * codes.square().mean()

    def judge(self, net: Predictor, objective: Objective, data: Prepared) -> tuple[float, float, float]:
        """Errors on machines that did not train, without a code."""
        return validation_scores(net, data.validation, self.training, data)

    def loss(self, objective: Objective, batch_context: BatchContext) -> Tensor:
        """Not asked: `episode` gives the loss."""
        return objective.evaluate(
            batch_context.answer, batch_context.future, batch_context.features, batch_context.valid
        )

    def end(self, net: Predictor) -> None:
        """Drop the table: the code of any machine is found from its logs."""
        del coded_block(net).table


def coded_block(net: Predictor) -> CodedChannels:
    """The block of a network that reads a code.

    Raises:
        StopIteration: it has none.
    """
    return next(part for part in net.modules() if isinstance(part, CodedChannels))
