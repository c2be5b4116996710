"""Methods of transfer: the protocol, the registry, and a class per method."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from edp.data.prepared import Prepared
from edp.data.series import Series
from edp.errors import ConfigError
from edp.evaluation.baselines import RidgeArx
from edp.evaluation.judge import baseline_predictions
from edp.networks.blocks.machine_code import CODE
from edp.networks.decomposition import decompose
from edp.networks.matrices import matrices_of
from edp.networks.predictor import Predictor
from edp.networks.running import stream_predictions
from edp.registry import Registry
from edp.settings.earlier_keys import present_keys
from edp.settings.tree import value_at
from edp.training.averages import NoAverage
from edp.training.bundle import weights_digest
from edp.training.optimizers import AdamW, Discriminative, Sgd
from edp.training.pretraining.spec import MetaSpec
from edp.training.schedules import Constant
from edp.training.transfer.both_domains import BothDomains, BothSpec
from edp.training.transfer.strategies import LowRank
from edp.training.warm_start import WarmStart
from edp.workflows.transfer.case import TransferCase, repeat_chunks

CODE_RATE = 0.05
"""Learning rate of a machine's code, whose values are of the order of one: a hundred times the rate of weights."""
STEP_RATE = 0.5
"""Learning rate of `FewSteps` for a source that was not meta-learned."""
SCRATCH_TIMES = 2
"""Epochs of `Scratch` over the epochs of a fine-tuning: random weights need more updates."""
Predictions = list[NDArray[np.float32]]


@dataclass(frozen=True, eq=False)
class Made:
    """Result of a method.

    Attributes:
        predict: predictions ``(time, horizon, target)``, SI units, on ``data.test`` of the target, or of the source,
            whose inputs are the same.
        learned: number of parameters trained on the target.
        network: the network; None where it is none.
    """

    predict: Callable[[Prepared], Predictions]
    learned: int
    network: Predictor | None = None


def result_of_network(network: Predictor, names: Sequence[str] | None = None) -> Made:
    """Return the result of a method that trained the parameters with these names; None for all parameters."""
    learned = sum(value.numel() for name, value in network.named_parameters() if names is None or name in names)
    return Made(lambda data: stream_predictions(network, data.test), learned, network)


class Method(Protocol):
    """A way from a source to a predictor of the target."""

    label: ClassVar[str]
    """Name in tables and pictures."""
    trains: ClassVar[bool] = True
    """Whether it leaves a run, which can be evaluated, reported and exported."""
    needs_source: ClassVar[bool] = False
    """Whether it needs the recordings of the source."""
    needs_code: ClassVar[bool] = False
    """Whether the source's network must read the code of a machine."""

    def make(self, case: TransferCase) -> Made:
        """Carry out the method, or continue a stopped one."""
        ...


METHODS: Registry[type[Method]] = Registry("method")


def code_names(network: Predictor) -> list[str]:
    """Return the names of the parameters that are a machine's code; empty if the network reads no code."""
    return [name for name, _ in network.named_parameters() if name.rpartition(".")[2] == CODE]


@METHODS.register("code")
class MachineCodeAlone(Method):
    """Search of the target machine's code with the weights of the fleet."""

    label = "Code alone"
    needs_code = True

    def make(self, case: TransferCase) -> Made:
        """Train the code."""
        source = case.source.predictor
        names = code_names(source)
        frozen = [name for name, _ in source.named_parameters() if name not in names]
        training = case.tuning(AdamW(learning_rate=CODE_RATE, weight_decay=0.0))
        network = case.train("code", training, lambda: WarmStart(source, frozen), centred=False)
        return result_of_network(network, names)


@METHODS.register("direct")
class Direct(Method):
    """Network of the source with its own scaling, without fine-tuning (4.4.1)."""

    label = "Direct transfer"
    trains = False

    def make(self, case: TransferCase) -> Made:
        """Return the network of the source unchanged."""
        return result_of_network(case.source.predictor, ())


@METHODS.register("few_steps")
class FewSteps(Method):
    """Steps of gradient descent at the rate of the source's meta-learning, each an epoch that may be the best one."""

    label = "A few steps"

    def make(self, case: TransferCase) -> Made:
        """Take the steps; what did not adapt in the meta-learning does not here."""
        spec, source = case.spec, case.source
        more = source.bundle.provenance.more
        meta = present_keys(MetaSpec, value_at(more, "strategy.meta") or {})
        rate = spec.inner_learning_rate or float(meta.get("inner_learning_rate", STEP_RATE))
        frozen = decompose(source.predictor).encoding if meta.get("head_only") else ()
        training = replace(
            case.tuning(Sgd(learning_rate=rate), spec.inner_steps),
            # Plain descent at a constant rate without an average: what meta-learning trained for.
            terms=case.experiment.training.terms,
            schedule=Constant(),
            average=NoAverage(),
            # One update over all logs makes each step an epoch, which validation can choose.
            updates=1,
        )
        network = case.train("few_steps", training, lambda: WarmStart(source.predictor, frozen), centred=False)
        names = [name for name, _ in network.named_parameters() if name not in frozen]
        return result_of_network(network, names)


@METHODS.register("full")
class Full(Method):
    """All parameters from the first update on, at one rate."""

    label = "Fine-tuned, one rate"

    def make(self, case: TransferCase) -> Made:
        """Train everything."""
        network = case.train("full", case.tuning(), lambda: WarmStart(case.source.predictor))
        return result_of_network(network)


@METHODS.register("linear_probe")
class LinearProbe(Method):
    """A new linear read-out of the source's features; all below it is held."""

    label = "Linear probe"

    def make(self, case: TransferCase) -> Made:
        """Train the last layer."""
        parts = decompose(case.source.predictor)
        frozen = {*parts.encoding, *parts.head} - {*parts.last}
        network = case.train("linear_probe", case.tuning(), lambda: WarmStart(case.source.predictor, frozen))
        return result_of_network(network, parts.last)


@METHODS.register("low_rank")
class Adapters(Method):
    """Every weight matrix plus a learned product of two narrow ones, added to it at the end."""

    label = "Low-rank adapters"

    def make(self, case: TransferCase) -> Made:
        """Train the changes."""
        rank = case.spec.rank
        network = case.train(
            "low_rank", case.tuning(), lambda: LowRank(case.source.predictor, rank), {"rank": rank}, centred=False
        )
        learned = sum(change_size(m.values.shape, m.axes, rank) for m in matrices_of(network))
        return replace(result_of_network(network), learned=learned)


def change_size(shape: tuple[int, ...], axes: tuple[int, ...], rank: int) -> int:
    """Return the parameters of a change of a weight of this shape whose outputs lie along `axes`."""
    rows = columns = 1
    for axis, size in enumerate(shape):
        rows, columns = (rows * size, columns) if axis in axes else (rows, columns * size)
    # A rank beyond the smaller side brings no further change.
    return min(rank, rows, columns) * (rows + columns)


@METHODS.register("rehearsal")
class Rehearsal(Method):
    """Everything learns from the target's logs and the source's recordings together."""

    label = "Rehearsal"
    needs_source = True

    def make(self, case: TransferCase) -> Made:
        """Train on both domains."""
        return train_both(case, "rehearsal", BothSpec(weight=case.spec.source_weight))


@METHODS.register("rehearsal_distilled")
class DistilledRehearsal(Method):
    """Rehearsal with a fraction of the source domain, distilled from the source network."""

    label = "Rehearsal, distilled"
    needs_source = True

    def make(self, case: TransferCase) -> Made:
        """Train on both domains."""
        spec = BothSpec(weight=case.spec.source_weight, soft=case.spec.distillation_fraction)
        return train_both(case, "rehearsal_distilled", spec)


@METHODS.register("adversarial")
class Adversarial(Method):
    """Rehearsal with a classifier of domains on the backbone's features, whose gradient is reversed (5.5.1)."""

    label = "Rehearsal, adversarial"
    needs_source = True

    def make(self, case: TransferCase) -> Made:
        """Train on both domains."""
        spec = BothSpec(weight=case.spec.source_weight, reversal=case.spec.adversarial_weight)
        return train_both(case, "adversarial", spec)


def train_both(case: TransferCase, name: str, spec: BothSpec) -> Made:
    """Train on both domains; the best epoch is chosen on as many validation ticks of the one as of the other.

    Raises:
        ConfigError: the recordings of the source are not at hand.
    """
    source = case.source
    if source.data is None:
        raise ConfigError(f"method '{name}' needs the recordings of the source: {source.absent}")
    source_series = source.data.train
    # Four start-ups at least: a shorter piece would judge its beginning alone.
    least = 4 * (
        max(source.predictor.spec.window, case.experiment.training.chunks.burn_in) + case.data.task.max_horizon
    )
    judged = share(source.data.validation, sum(part.samples for part in case.data.validation), least)
    network = case.train(
        name,
        case.tuning(),
        lambda: BothDomains(source.predictor, source_series, spec),
        asdict(spec),
        judged=judged,
        centred=False,
    )
    return result_of_network(network)


def share(series: Sequence[Series], ticks: int, least: int) -> list[Series]:
    """Return the starts of as many series as `ticks` ticks allow, each at least `least` ticks, spread over all."""
    # As many ticks of the source as of the target: the larger domain must not choose the epoch alone.
    count = max(1, min(len(series), ticks // least))
    size = max(least, ticks // count)
    chosen = [series[i * len(series) // count] for i in range(count)]
    return [replace(one, inputs=one.inputs[:size], targets=one.targets[:size]) for one in chosen]


@METHODS.register("ridge_arx")
class Ridge(Method):
    """A linear map from the last samples of all inputs, fitted on the target's training part."""

    label = "Ridge ARX on the target"
    trains = False

    def make(self, case: TransferCase) -> Made:
        """Fit it; penalty and history are chosen on the validation part."""
        predict, baseline = baseline_predictions(RidgeArx, case.data, case.experiment.evaluation)
        return Made(predict, int(baseline.weights.size + baseline.intercept.size))


@METHODS.register("scratch")
class Scratch(Method):
    """The source's network and way of training, new weights, scaling fitted on the target."""

    label = "From scratch"

    def make(self, case: TransferCase) -> Made:
        """Train as ``edp train`` would, with the early stopping of the fine-tuning."""
        training, spec = case.experiment.training, case.spec
        chunks = repeat_chunks(training.chunks)
        training = replace(
            training,
            chunks=chunks,
            epochs=SCRATCH_TIMES * spec.single_phase_epochs,
            patience=spec.patience,
            refit="none",
        )
        network = case.train("scratch", training, None)
        return result_of_network(network)


@METHODS.register("two_phase")
class TwoPhase(Method):
    """Phase 1 trains the head alone, phase 2 everything, the backbone at a much smaller rate (Table 3.1)."""

    label = "Fine-tuned, two phases"

    def make(self, case: TransferCase) -> Made:
        """Return both phases; the first is a run of its own within the run of the second."""
        spec, parts = case.spec, decompose(case.source.predictor)
        # 0.999 is AdamW's usual value; the library's default of 0.99 is for short runs.
        heads = AdamW(learning_rate=spec.head_learning_rate, weight_decay=spec.weight_decay, beta2=0.999)
        warmed = case.train(
            "two_phase, head",
            case.tuning(heads, spec.head_epochs),
            lambda: WarmStart(case.source.predictor, parts.encoding),
            phase="head",
        )
        # Depth counts from the head: layers near the input change least.
        above = list(reversed(parts.backbone))
        rates = tuple((part, spec.backbone_learning_rate * spec.depth_decay**depth) for depth, part in enumerate(above))
        optimizer = Discriminative(rates=rates, learning_rate=spec.head_learning_rate, weight_decay=spec.weight_decay)
        start = {"start": weights_digest(warmed)}
        network = case.train("two_phase", case.tuning(optimizer, spec.epochs), lambda: WarmStart(warmed), start)
        return result_of_network(network)
