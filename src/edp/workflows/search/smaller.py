"""One network of phase 6: trained by its recipe and evaluated in its number formats, from a plain request to a record.

A network rests on those that it is made of: a student on the teacher, a rounded one on a student. What it is made of
comes with the state of an earlier order, or is trained again from the same order to the same bits.
"""

from __future__ import annotations

import base64
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace

from safetensors.torch import load, save
from torch import Tensor

from edp.config.experiment import Experiment, build
from edp.data.prepared import Prepared
from edp.data.task import Task
from edp.errors import DataError
from edp.evaluation.controller import Budget
from edp.evaluation.footprint import footprint
from edp.networks.predictor import ModelSpec, Predictor
from edp.training.bundle import blank_scaler
from edp.training.checkpoint import pack, unpack
from edp.training.fit import fit
from edp.training.spec import TrainingSpec
from edp.workflows.compression.bench import TUNING_EPOCHS, Bench, CompressionRequest
from edp.workflows.compression.pipeline import TEACHER, Evaluator, formats_of
from edp.workflows.compression.variants import make_rounded_request
from edp.workflows.search.trainings import (
    TrainedPart,
    TrainingRequest,
    experiment_of,
    mean_scores,
    prepared,
    session_scores,
)

Weights = dict[str, Tensor]


@dataclass(frozen=True)
class Recipe:
    """Recipe that turns the network of a request into a smaller network.

    Attributes:
        updates: training steps of a smaller network over all epochs, 0 for passes over the data; one that is trained
            on with rounded weights has a third.
        formats: number formats in which it is evaluated.
        budget: limits of the controller.
        validation: sessions on which networks are compared; none of them trains.
        units: width; None for the teacher itself.
        pruned: begin with what pruning leaves of the teacher.
        rounded: trained on with rounded weights.
        final: the format in which it is evaluated on the second sealed test set; empty for the comparison.
    """

    updates: int
    formats: tuple[str, ...]
    budget: Budget
    validation: tuple[str, ...]
    units: int | None = None
    pruned: bool = False
    rounded: bool = False
    final: str = ""

    def order(self) -> CompressionRequest | None:
        """Return the request that makes it from the teacher; None for the teacher."""
        if self.units is None:
            return None
        # Rounded networks are made of plain ones, whose order comes first.
        name = f"{'p' if self.pruned else 'u'}{self.units}"
        plain = CompressionRequest(name=name, units=self.units, pruned=self.pruned)
        return make_rounded_request(plain) if self.rounded else plain

    def experiment(self, experiment: Experiment) -> Experiment:
        """Return the experiment of the network's last training, given the teacher's."""
        order = self.order()
        if order is None:
            return experiment
        training = shortened(order, experiment.training, self.updates)
        return replace(experiment, model=order.model(experiment.model), training=training)

    def to_json(self) -> dict[str, object]:
        """Return the plain values."""
        lists = {"formats": list(self.formats), "validation": list(self.validation)}
        return {**vars(self), **lists, "budget": asdict(self.budget)}

    @staticmethod
    def from_json(plain: Mapping[str, object]) -> Recipe:
        """Return the recipe from the result of `to_json`.

        Raises:
            ConfigError: a value of another kind.
        """
        return build(Recipe, plain, "of an order", "recipe")


def before(order: TrainingRequest) -> list[TrainingRequest]:
    """Return requests of phase 6 whose state can start this request, the most useful first."""
    if order.recipe is None:
        return []
    recipe = Recipe.from_json(order.recipe)
    # From what saves most: the network itself, the one that it was rounded from, the teacher.
    chain = [recipe] if recipe.final else []
    if recipe.rounded:
        chain.append(replace(recipe, rounded=False))
    if recipe.units is not None:
        chain.append(replace(recipe, rounded=False, pruned=False, units=None))
    return [replace(order, judged=one.validation, recipe=replace(one, final="").to_json()) for one in chain]


def make_smaller(order: TrainingRequest, start: bytes | None = None) -> TrainedPart:
    """Make the network of an order with a recipe, and evaluate it.

    Args:
        order: request with a recipe.
        start: the state of one of the orders of `before`; it saves time and changes nothing else.

    Returns:
        The result has the parts of `edp.workflows.compression.pipeline.NetworkResult`, too, and for a recipe with
        `final` ``weights``: its tensors as base64 of safetensors. A recipe with `final` leaves no state.

    Raises:
        ConfigError: settings that contradict one another or the data, or a network that cannot be pruned.
        DataError: a session is missing or cannot be read, or one that compares would train.
        Diverged: the loss was not finite any more.
    """
    recipe = Recipe.from_json(order.recipe or {})
    # Checked again here: an order may come from anywhere.
    both = sorted(set(order.train) & {*recipe.validation, *order.judged})
    if both:
        raise DataError(f"phase 6: {', '.join(both)} would train and judge; each session must do one of the two")
    experiment = experiment_of(order)
    data = prepared(order, experiment)
    weights: dict[str, Weights] = {} if start is None else unpack(start)
    bench = _StateBench(recipe.updates, experiment, data, weights)
    request = recipe.order()
    network = bench.teacher if request is None else bench.network(request)
    formats = [recipe.final] if recipe.final else formats_of(request, recipe.formats)
    evaluated = Evaluator(data, recipe.budget).evaluate(network, formats)
    sessions = session_scores(evaluated.recordings.get(recipe.final, evaluated.recordings["float32"]))
    counted = footprint(network)
    result = {
        "sessions": sessions,
        "scores": mean_scores(sessions),
        "parameters": counted.parameters,
        "macs_tick": counted.macs_tick,
        **evaluated.to_json(),
    }
    if recipe.final:
        return TrainedPart({**result, "weights": base64.b64encode(save(_weights(network))).decode()})
    return TrainedPart(result, pack(weights))


def network_of(weights: str, task: Task, model: ModelSpec) -> Predictor:
    """Return the network of a result with ``weights``."""
    return _restore_network(load(base64.b64decode(weights)), task, model)


class _StateBench(Bench):
    """Bench that keeps the weights of its networks by name, so that later orders continue from them.

    Args:
        updates: training steps of a smaller network (`Recipe.updates`).
        experiment: experiment of the teacher.
        data: training data.
        weights: weights of existing networks; new ones are added.
    """

    def __init__(self, updates: int, experiment: Experiment, data: Prepared, weights: dict[str, Weights]) -> None:
        self.updates, self.weights = updates, weights
        if TEACHER not in weights:
            weights[TEACHER] = _weights(fit(data, experiment.model, experiment.training).predictor)
        super().__init__(_restore_network(weights[TEACHER], data.task, experiment.model), data, experiment.training)

    def training_of(self, order: CompressionRequest) -> TrainingSpec:
        """Return the training of a smaller network for the steps of the recipe."""
        return shortened(order, self.training, self.updates)

    def train(self, order: CompressionRequest, start: Predictor | None) -> Predictor:
        """Train the network of an order, unless its weights are there."""
        if order.name not in self.weights:
            self.weights[order.name] = _weights(super().train(order, start))
        # Always through its weights, so that a network that was kept and one that was trained just now are the same.
        return _restore_network(self.weights[order.name], self.data.task, order.model(self.teacher.spec))


def shortened(order: CompressionRequest, training: TrainingSpec, updates: int) -> TrainingSpec:
    """Return how a smaller network is trained in `updates` steps, where its teacher has `training`."""
    if order.rounding is not None and training.epochs == 1:
        # Tuning is a third of the training (see `bench`); of several epochs the epochs are fewer instead.
        updates = max(1, round(TUNING_EPOCHS * updates))
    each = max(1, updates // training.epochs) if updates else 0
    return order.training(replace(training, updates=each))


def _weights(network: Predictor) -> Weights:
    return {name: tensor.detach().cpu().clone().contiguous() for name, tensor in network.state_dict().items()}


def _restore_network(weights: Weights, task: Task, model: ModelSpec) -> Predictor:
    network = Predictor(task, model, blank_scaler(task))
    network.load_state_dict(weights)
    return network.eval()
