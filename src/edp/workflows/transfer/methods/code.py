"""The code of a machine: of a network over many machines only the few numbers learn that say which one it is."""

from __future__ import annotations

from typing import ClassVar

from edp.networks.blocks.machine_code import CODE
from edp.networks.predictor import Predictor
from edp.training.optimizers import AdamW
from edp.training.warm_start import WarmStart
from edp.workflows.transfer.case import TransferCase
from edp.workflows.transfer.methods.base import METHODS, Made, of_network, size_of

RATE = 0.05
"""Of the code, whose numbers are of the order of one: a hundred times that of weights."""


def code_names(network: Predictor) -> list[str]:
    """Names of the parameters that are a machine's code; none where the network reads no code."""
    return [name for name, _ in network.named_parameters() if name.rpartition(".")[2] == CODE]


@METHODS.register("code")
class MachineCodeAlone:
    """Find the code of the target's machine; all weights stay those of the fleet."""

    label: ClassVar[str] = "Code alone"
    trains: ClassVar[bool] = True
    needs_source: ClassVar[bool] = False
    needs_code: ClassVar[bool] = True

    def make(self, case: TransferCase) -> Made:
        """Train the code."""
        source = case.source.predictor
        names = code_names(source)
        frozen = [name for name, _ in source.named_parameters() if name not in names]
        training = case.tuning(AdamW(learning_rate=RATE, weight_decay=0.0))
        network = case.train("code", training, lambda: WarmStart(source, frozen), centred=False)
        return of_network(network, size_of(network, names))
