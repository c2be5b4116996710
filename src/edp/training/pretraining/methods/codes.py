"""Machine codes: one network for all machines, and a few trained parameters per machine."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor, nn

from edp.data.episodes import group_by_machine
from edp.data.series import Series
from edp.data.task import Task
from edp.networks.blocks.machine_code import CodedChannels, MachineCode
from edp.networks.predictor import ModelSpec, Predictor
from edp.training.objective import Objective
from edp.training.pretraining.methods.base import PRETRAININGS
from edp.training.pretraining.spec import MetaSpec
from edp.training.spec import TrainingSpec
from edp.training.strategy import BatchContext, StreamStrategy, TrainingStrategy
from edp.training.warm_start import continue_from

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
    episodic: ClassVar[bool] = False

    def model(self, spec: ModelSpec) -> ModelSpec:
        """Return the network with a block that reads a code, after its other blocks."""
        if any(isinstance(block, MachineCode) for block in spec.blocks):
            return spec
        return replace(spec, blocks=(*spec.blocks, MachineCode()))

    def strategy(self, spec: MetaSpec, start: Predictor | None) -> TrainingStrategy:
        """Return the streams of machines, each with its code."""
        return WithCodes(start)


class WithCodes(StreamStrategy):
    """Trains the codes of the training machines together with the weights, and stores the weights only.

    Args:
        start: a network to begin with; None begins at random.
    """

    def __init__(self, start: Predictor | None = None) -> None:
        self.start, self.machines = start, 0
        self.block: CodedChannels | None = None
        self.told = self.size = torch.zeros(0)
        """Which streams have a code, and the mean square of the codes of the last chunk."""

    def series(self, task: Task, own_series: Sequence[Series]) -> list[Series]:
        """Return the training series, each with its machine number as the strategy column."""
        owned = group_by_machine(own_series)
        self.machines = len(owned)
        numbers = {name: np.float32(number) for number, name in enumerate(owned)}
        return [
            replace(part, strategy_columns=np.broadcast_to(numbers[part.machine], (part.samples, 1)))
            for part in own_series
        ]

    def begin(self, net: Predictor, spec: TrainingSpec) -> bool:
        """Take over the start, and give the block a table of codes, which the optimiser then learns."""
        if self.start is not None:
            continue_from(net, self.start)
        block, self.told = find_coded_block(net), torch.zeros(0)
        draws = torch.randn(self.machines * len(block.machine_code), generator=torch.Generator().manual_seed(spec.seed))
        # A vector: optimisers that precondition matrices would need the square of the number of machines.
        block.table = nn.Parameter(SPREAD * draws)
        return self.start is not None

    def tell(self, net: Predictor, strategy_columns: Tensor, reset: Tensor) -> None:
        """Set the code of each stream's machine, or no code for the whole stream."""
        self.block = block = find_coded_block(net)
        drawn = (torch.rand(len(reset), 1, device=reset.device) >= UNKNOWN).float()
        # Of another size only before the first chunk, with which all streams begin.
        self.told = torch.where(reset[:, None], drawn, self.told) if len(self.told) == len(reset) else drawn
        codes = block.table.view(self.machines, -1)[strategy_columns[:, 0, 0].long()]
        block.lanes, self.size = codes * self.told, codes.square().mean()

    def loss(self, objective: Objective, batch_context: BatchContext) -> Tensor:
        """Return the error plus a penalty on code size; the codes are removed from the network."""
        if self.block is not None:
            self.block.lanes = None
        error = objective.evaluate(
            batch_context.answer, batch_context.future, batch_context.features, batch_context.valid
        )
        return error + WEIGHT * self.size

    def end(self, net: Predictor) -> None:
        """Drop the table: the code of any machine is found from its logs."""
        del find_coded_block(net).table


def find_coded_block(net: Predictor) -> CodedChannels:
    """Return the block of a network that reads a code.

    Raises:
        StopIteration: it has none.
    """
    return next(part for part in net.modules() if isinstance(part, CodedChannels))
