"""One network of phase 6: trained as its recipe says, judged in its number formats; a plain order in, a record out.

A network rests on those that it is made of: a student on the teacher, a rounded one on a student. What it is made of
comes with the state of an earlier order, or is trained again from the same order to the same bits.
"""

from __future__ import annotations

import base64
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

from safetensors.torch import load, save
from torch import Tensor

from edp.config.experiment import Experiment
from edp.data.prepared import Prepared
from edp.data.task import Task
from edp.errors import DataError, ExportError
from edp.evaluation.controller import Budget
from edp.evaluation.footprint import footprint
from edp.evaluation.judge import score_predictions
from edp.evaluation.scores_file import ModelScores, metric
from edp.networks.predictor import ModelSpec, Predictor
from edp.networks.running import stream_predictions
from edp.training.bundle import blank_scaler
from edp.training.checkpoint import pack, unpack
from edp.training.fit import fit
from edp.workflows.compression import FORMATS, CompressionRequest, deploy
from edp.workflows.compression.bench import TUNING_EPOCHS
from edp.workflows.compression.variants import rounded_order
from edp.workflows.search.trainings import SCORES, TrainingRequest, experiment_of, mean_scores, prepared

TEACHER = "teacher"
Weights = dict[str, Tensor]


@dataclass(frozen=True)
class Recipe:
    """What is made of the network of an order.

    Attributes:
        updates: training steps of a smaller network over all epochs, 0 for passes over the data; one that is trained
            on with rounded numbers has a third.
        formats: number formats in which it is judged.
        budget: what the controller grants.
        validation: sessions on which networks are compared; none of them trains.
        units: width; None for the teacher itself.
        pruned: begin with what pruning leaves of the teacher.
        rounded: trained on with rounded numbers.
        final: the format in which it is judged on the second sealed test set; empty for the comparison.
    """

    updates: int
    formats: tuple[str, ...]
    budget: Budget
    validation: tuple[str, ...]
    units: int | None = None
    pruned: bool = False
    rounded: bool = False
    final: str = ""

    @property
    def name(self) -> str:
        """Of the network."""
        return TEACHER if self.units is None else f"{'p' if self.pruned else 'u'}{self.units}{'_qat' * self.rounded}"

    def order(self) -> CompressionRequest | None:
        """How it is made of the teacher; None for the teacher."""
        if self.units is None:
            return None
        # Rounded networks are made of plain ones, whose order comes first.
        plain = CompressionRequest(
            name=f"{'p' if self.pruned else 'u'}{self.units}", units=self.units, pruned=self.pruned
        )
        return rounded_order(plain) if self.rounded else plain

    def model(self, experiment: Experiment) -> ModelSpec:
        """Settings of the network."""
        order = self.order()
        return experiment.model if order is None else order.model(experiment.model)

    def experiment(self, experiment: Experiment) -> Experiment:
        """The experiment of the last training that makes the network, where `experiment` is the teacher's."""
        order = self.order()
        if order is None:
            return experiment
        epochs, steps = experiment.training.epochs, self.updates
        if order.rounding is not None and epochs == 1:
            # Tuning is a third of the training (see `bench`); of several epochs the epochs are fewer instead.
            steps = max(1, round(TUNING_EPOCHS * steps))  # of several epochs a third is left
        each = max(1, steps // epochs) if steps else 0
        training = order.training(replace(experiment.training, updates=each))
        return replace(experiment, model=self.model(experiment), training=training)

    def to_json(self) -> dict[str, Any]:
        """Plain values."""
        lists = {"formats": list(self.formats), "validation": list(self.validation)}
        return {**vars(self), **lists, "budget": asdict(self.budget)}

    @staticmethod
    def from_json(plain: Mapping[str, Any]) -> Recipe:
        """The recipe that `to_json` gave."""
        lists = {name: tuple(plain[name]) for name in ("formats", "validation")}
        return Recipe(**{**plain, **lists, "budget": Budget(**plain["budget"])})


def before(order: TrainingRequest) -> list[TrainingRequest]:
    """Orders whose state an order of phase 6 can go on from, the one that saves most first; none in other phases."""
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


def make_smaller(plain: Mapping[str, Any], start: bytes | None = None) -> tuple[dict[str, Any], bytes | None]:
    """Make the network of an order with a recipe, and judge it.

    Args:
        plain: of `CompressionRequest.to_json`.
        start: the state of one of the orders of `before`; it saves time and changes nothing else.

    Returns:
        What `edp.workflows.search.trainings.train_order` returns, with ``formats``: by name the scores on the judging
        sessions by horizon (``mae``, ``composite``), what the network takes and which limits it exceeds; ``plain``: the
        scores in float32; ``left_out``: why a format is not there; for a recipe with `final`, ``weights``: its tensors
        as base64 of safetensors. And the state that later orders go on from; None for one with `final`.

    Raises:
        ConfigError: settings that contradict one another or the data, or a network that cannot be pruned.
        DataError: a session is missing or cannot be read, or one that compares would train.
        Diverged: the loss was not finite any more.
    """
    order = TrainingRequest.from_json(plain)
    recipe = Recipe.from_json(plain["recipe"])
    # Checked again here: an order may come from anywhere.
    both = sorted(set(order.train) & {*recipe.validation, *order.judged})
    if both:
        raise DataError(f"phase 6: {', '.join(both)} would train and judge; each session must do one of the two")
    began = time.perf_counter()
    experiment = experiment_of(order)
    data = prepared(order, experiment)
    weights_by_name: dict[str, Weights] = {} if start is None else unpack(start)
    network = _made(recipe, experiment, data, weights_by_name)
    result = _judged(recipe, network, data) | {"seconds": round(time.perf_counter() - began, 3)}
    if recipe.final:
        return result | {"weights": base64.b64encode(save(_weights(network))).decode()}, None
    return result, pack(weights_by_name)


def network_of(weights: str, task: Task, model: ModelSpec) -> Predictor:
    """The network of a result with ``weights``."""
    return _restored(load(base64.b64decode(weights)), task, model)


def _made(recipe: Recipe, experiment: Experiment, data: Prepared, weights_by_name: dict[str, Weights]) -> Predictor:
    """The network of a recipe; it and all that it is made of are in `weights_by_name` afterwards."""
    if recipe.name not in weights_by_name:
        own = recipe.experiment(experiment)
        order, strategy = recipe.order(), None
        if order is not None:
            plain = replace(recipe, rounded=False)
            teacher = _made(replace(plain, pruned=False, units=None), experiment, data, weights_by_name)
            begun = _made(plain, experiment, data, weights_by_name) if recipe.rounded else None
            strategy = order.strategy([teacher], data, begun)
        weights_by_name[recipe.name] = _weights(fit(data, own.model, own.training, strategy=strategy).predictor)
    # Always through its weights, so that a network that was kept and one that was trained just now are the same.
    return _restored(weights_by_name[recipe.name], data.task, recipe.model(experiment))


def _judged(recipe: Recipe, network: Predictor, data: Prepared) -> dict[str, Any]:
    skip = network.spec.window
    plain = score_predictions(stream_predictions(network, data.test), data, skip)
    formats, left_out, shown = {}, {}, plain
    for name in [recipe.final] if recipe.final else recipe.formats:
        # A network trained for rounding is judged in the formats that round.
        if recipe.rounded and not FORMATS[name].rounded:
            continue
        try:
            deployed = deploy(network, name, data.train, recipe.budget)
        except ExportError as error:
            left_out[name] = str(error)
            continue
        scored = plain if name == "float32" else score_predictions(deployed.predict(data.test), data, skip)
        usage = {
            key: list(value) if isinstance(value, tuple) else value
            for key, value in vars(deployed.resource_usage).items()
        }
        over = {
            limit: list(pair) for limit, pair in deployed.resource_usage.over(recipe.budget).items()
        }  # as a ledger says it
        formats[name] = {"scores": _overall(scored), "resource_usage": usage, "over": over}
        shown = scored if recipe.final else plain
    sessions = {
        name: {k: {score: metric(scores["mean"], score) for score in SCORES} for k, scores in horizons.items()}
        for name, horizons in shown.recordings.items()
    }
    counted = footprint(network)
    return {
        "sessions": sessions,
        "scores": mean_scores(sessions),
        "plain": _overall(plain),
        "formats": formats,
        "left_out": left_out,
        "parameters": counted.parameters,
        "macs_tick": counted.macs_tick,
    }


def _overall(scored: ModelScores) -> dict[str, dict[str, float]]:
    return {
        horizon: {score: metric(scores["mean"], score) for score in ("mae", "composite")}
        for horizon, scores in scored.overall.items()
    }


def _weights(network: Predictor) -> Weights:
    return {name: tensor.detach().cpu().clone().contiguous() for name, tensor in network.state_dict().items()}


def _restored(weights: Weights, task: Task, model: ModelSpec) -> Predictor:
    network = Predictor(task, model, blank_scaler(task))
    network.load_state_dict(weights)
    return network.eval()
