"""From scratch: the same network on the target's logs alone."""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar

from edp.workflows.transfer.case import TransferCase, walked_again
from edp.workflows.transfer.methods.base import METHODS, Made, of_network, size_of

TIMES = 2
"""Epochs over those of a fine-tuning: weights that begin at random have farther to go."""


@METHODS.register("scratch")
class Scratch:
    """The source's network and way of training, new weights, scaling fitted on the target."""

    label: ClassVar[str] = "From scratch"
    trains: ClassVar[bool] = True
    needs_source: ClassVar[bool] = False
    needs_code: ClassVar[bool] = False

    def make(self, case: TransferCase) -> Made:
        """Train as ``edp train`` would, with the early stopping of the fine-tuning."""
        training, spec = case.experiment.training, case.spec
        chunks = walked_again(training.chunks)
        training = replace(training, chunks=chunks, epochs=TIMES * spec.rounds, patience=spec.patience, refit="none")
        network = case.train("scratch", training, None)
        return of_network(network, size_of(network))
