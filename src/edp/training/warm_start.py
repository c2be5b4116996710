"""Training that begins with the weights of another network."""

from __future__ import annotations

from collections.abc import Collection, Sequence

from torch import Tensor, nn

from edp.data.series import Series
from edp.data.task import Task
from edp.errors import ConfigError
from edp.networks.predictor import Predictor
from edp.training.objective import Objective
from edp.training.spec import TrainingSpec
from edp.training.strategy import BatchContext


class WarmStart:
    """Training strategy that starts from a trained network, with its scaling; some parameters may be frozen.

    The start is a candidate itself: training must improve on it to be kept.

    Args:
        start: a trained network of the specs to train.
        frozen: names of parameters that do not learn.
        unfreeze: let parameters learn that the network itself does not train, such as a skip connection that kept its
            regression in the start's training: it describes the data of the start.
    """

    def __init__(self, start: Predictor, frozen: Collection[str] = (), unfreeze: bool = True) -> None:
        self.start, self.frozen_names, self.unfreeze = start, frozenset(frozen), unfreeze
        self._frozen: list[nn.Parameter] = []
        self._unfrozen: list[nn.Parameter] = []

    def series(self, task: Task, own_series: Sequence[Series]) -> list[Series]:
        """Return the training series unchanged."""
        return list(own_series)

    def begin(self, net: Predictor, spec: TrainingSpec) -> bool:
        """Copy weights and scaling, freeze the named parameters, and unfreeze the others if requested.

        Raises:
            ConfigError: the start has other specs, or nothing is left to learn.
        """
        continue_from(net, self.start)
        named = dict(net.named_parameters())
        self._frozen = [p for name, p in named.items() if name in self.frozen_names and p.requires_grad]
        still = [p for name, p in named.items() if name not in self.frozen_names and not p.requires_grad]
        self._unfrozen = still if self.unfreeze else []
        for parameter in (*self._frozen, *self._unfrozen):
            parameter.requires_grad_(not parameter.requires_grad)
        if not any(parameter.requires_grad for parameter in named.values()):
            raise ConfigError("fine-tuning: every parameter is frozen, so nothing can learn; freeze fewer")
        return True

    def loss(self, objective: Objective, batch_context: BatchContext) -> Tensor:
        """Return the objective on the recorded targets."""
        return objective.evaluate(
            batch_context.answer, batch_context.future, batch_context.features, batch_context.valid
        )

    def end(self, net: Predictor) -> None:
        """Undo the freezing and the unfreezing."""
        for parameter in (*self._frozen, *self._unfrozen):
            parameter.requires_grad_(not parameter.requires_grad)


def continue_from(net: Predictor, start: Predictor) -> None:
    """Copy weights and scaling from another network with the same specs.

    Raises:
        ConfigError: the specs differ.
    """
    check_same_ends(net.task, start.task, "the network", "the one to begin with")
    if net.spec != start.spec or net.task != start.task:
        raise ConfigError(
            "the network to begin with has other specs or features than the one to train; train with its own: "
            "model = start.spec"
        )
    net.load_state_dict(start.state_dict())


def check_same_ends(task: Task, other: Task, name: str, other_name: str) -> None:
    """Refuse tasks that do not read the same channels and predict the same values.

    Raises:
        ConfigError: every difference.
    """
    pairs = {
        "inputs": (task.inputs, other.inputs),
        "targets": (task.targets, other.targets),
        "horizons": (task.horizons, other.horizons),
        "rate_hz": (task.rate_hz, other.rate_hz),
    }
    different = [f"{what} {own} and {its}" for what, (own, its) in pairs.items() if own != its]
    if different:
        raise ConfigError(f"{name} and {other_name} have {'; '.join(different)}; these must be equal")
