"""Interface and registry of pretraining methods."""

from __future__ import annotations

from typing import ClassVar, Protocol, runtime_checkable

from edp.networks.predictor import ModelSpec, Predictor
from edp.registry import Registry
from edp.training.pretraining.spec import MetaSpec
from edp.training.strategy import TrainingStrategy


class Pretraining(Protocol):
    """A way to train one network over many machines."""

    label: ClassVar[str]
    """How tables call it."""
    episodic: ClassVar[bool]
    """Whether it adapts to machines within an update; the others walk carried chunks."""

    def strategy(self, spec: MetaSpec, start: Predictor | None) -> TrainingStrategy | None:
        """Return the training strategy; None without one.

        Raises:
            ConfigError: options that the method has no use for.
        """
        ...


@runtime_checkable
class HasModel(Protocol):
    """A method that needs parts which the network may lack."""

    def model(self, spec: ModelSpec) -> ModelSpec:
        """Return the network with the additional parts.

        Raises:
            ConfigError: it has no place for them.
        """
        ...


PRETRAININGS: Registry[type[Pretraining]] = Registry("pretraining")
