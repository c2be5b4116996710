"""What a method of transfer is, and their registry."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from edp.data.prepared import Prepared
from edp.networks.predictor import Predictor
from edp.networks.running import stream_predictions
from edp.registry import Registry
from edp.workflows.transfer.case import TransferCase

Predictions = list[NDArray[np.float32]]


@dataclass(frozen=True, eq=False)
class Made:
    """What a method came to.

    Attributes:
        predict: predictions ``(time, horizon, target)``, SI units, on ``data.test`` of the target, or of the source,
            whose inputs are the same.
        learned: how many parameters learned from the target.
        network: the network; None where it is none.
    """

    predict: Callable[[Prepared], Predictions]
    learned: int
    network: Predictor | None = None


def of_network(network: Predictor, learned: int) -> Made:
    """What a method that gives a network came to."""
    return Made(lambda data: stream_predictions(network, data.test), learned, network)


def size_of(network: Predictor, names: Sequence[str] | None = None) -> int:
    """Parameters of a network, or those of them that are named."""
    return sum(value.numel() for name, value in network.named_parameters() if names is None or name in names)


class Method(Protocol):
    """A way from a source to a predictor of the target."""

    label: ClassVar[str]
    """How tables and pictures call it."""
    trains: ClassVar[bool]
    """Whether it leaves a run, which can be judged, reported and exported."""
    needs_source: ClassVar[bool]
    """Whether it needs the recordings of the source."""
    needs_code: ClassVar[bool]
    """Whether the source's network must read the code of a machine."""

    def make(self, case: TransferCase) -> Made:
        """Carry it out, or go on where it was stopped."""
        ...


METHODS: Registry[type[Method]] = Registry("method")
