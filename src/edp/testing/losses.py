"""The contract of a main loss: gradients, the order of streams, ticks that do not count, its least value."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from edp.data.features import FeatureSet
from edp.data.scaling import Scaler
from edp.data.task import TargetMode, Task
from edp.networks.backbones import LstmSpec
from edp.networks.heads import MlpHead
from edp.networks.losses import LOSSES, TERMS, AdaptiveWeights
from edp.networks.outputs import OUTPUTS
from edp.networks.predictor import ModelSpec, Predictor, build_model
from edp.networks.streaming import indifferent_parameters
from edp.testing.expectations import ContractError, expect, expect_near
from edp.testing.networks import check_spec
from edp.training.objective import Objective
from edp.training.spec import TrainingSpec

TASK = Task(FeatureSet("f", ("a", "b", "u")), ("a", "b"), (1, 4), TargetMode.DELTA, 100.0)
Batch = tuple[Tensor, Tensor, Tensor]


def loss_network(output: str, dtype: torch.dtype = torch.float64, task: Task = TASK) -> Predictor:
    """Return a small network with a registered output, for `task`."""
    shape = (len(task.horizons), len(task.targets))
    rng = np.random.default_rng(3)
    scaler = Scaler(np.zeros(3), rng.uniform(0.5, 2, 3), np.zeros(shape), rng.uniform(0.5, 2, shape))
    spec = ModelSpec(backbone=LstmSpec(units=5), head=MlpHead(hidden=6), output=OUTPUTS[output](), window=6)
    return build_model(task, spec, scaler, seed=1).to(dtype)


def loss_batch(streams: int = 4, ticks: int = 12, seed: int = 0) -> Batch:
    """Return inputs ``(batch, time, input)``, targets ``(batch, time, horizon, target)`` and the valid mask."""
    rng = np.random.default_rng(seed)
    valid = rng.random((streams, ticks)) > 0.2
    # Ticks of a burn-in count for no stream; the others are drawn.
    valid[:, :3] = False
    return (
        torch.from_numpy(rng.normal(size=(streams, ticks, 3))),
        torch.from_numpy(rng.normal(size=(streams, ticks, 2, 2))),
        torch.from_numpy(valid),
    )


def objective_of(loss: str, **options: Any) -> TrainingSpec:
    """Return training settings with every term, weight and decay in addition to the loss."""
    return TrainingSpec(
        loss=LOSSES[loss](),
        terms=tuple(TERMS[name]() for name in TERMS),
        weight_power=1.0,
        horizon_decay=0.8,
        adaptive=AdaptiveWeights(blend=0.5),
        **options,
    )


def objective_value(network: Predictor, spec: TrainingSpec, batch: Batch) -> Tensor:
    """Return the objective of a batch, a scalar."""
    x, future, valid = batch
    answer, features, _ = network.run(x, network.initial_state(len(x), x))
    return Objective(spec, network.code).evaluate(answer, future, features, valid)


def check_objective(loss: str, output: str) -> None:
    """Check that the objective is finite and its gradient reaches every parameter."""
    network = loss_network(output)
    value = objective_value(network, objective_of(loss), loss_batch())
    expect(bool(torch.isfinite(value)), f"the objective is {value.item()}")
    value.backward()
    for name, parameter in network.named_parameters():
        gradient = parameter.grad
        if gradient is None or not torch.isfinite(gradient).all():
            raise ContractError(f"the gradient of '{name}' is not finite, or there is none")
        if name not in indifferent_parameters(network):
            # 1e-9 tells a path from rounding.
            expect(float(gradient.abs().sum()) > 1e-9, f"the objective does not reach '{name}'")


def check_order_of_streams(loss: str, output: str) -> None:
    """Check that the order of the streams in a batch does not matter."""
    network, batch = loss_network(output), loss_batch()
    x, future, valid = (part[[2, 0, 3, 1]] for part in batch)
    with torch.no_grad():
        turned = objective_value(network, objective_of(loss), (x, future, valid))
        first = objective_value(network, objective_of(loss), batch)
    expect_near(turned, first, "the order of the streams changes the objective", rtol=1e-12, atol=1e-12)


def check_masked_ticks(loss: str, output: str) -> None:
    """Check that masked samples have no effect."""
    network = loss_network(output)
    x, future, valid = loss_batch()
    # A value far from all others: a masked tick that leaks shows at once.
    changed = torch.where(valid[..., None, None], future, 100.0)
    with torch.no_grad():
        first = objective_value(network, objective_of(loss), (x, future, valid))
        second = objective_value(network, objective_of(loss), (x, changed, valid))
    expect_near(second, first, "ticks that do not count change the objective", rtol=1e-12, atol=1e-12)


def check_least_value(loss: str, output: str) -> None:
    """Check that a perfect prediction has the least loss and a worse one has more; for a point the least is zero."""
    network, spec = loss_network(output), LOSSES[loss]()
    x, _, _ = loss_batch()
    with torch.no_grad():
        answer, _, _ = network.run(x, network.initial_state(len(x), x))
        # A stated spread stays as it is; only the prediction moves.
        perfect = spec.evaluate(answer, answer.center)
        expect(perfect.shape == answer.center.shape, f"the loss has shape {tuple(perfect.shape)}; one a prediction")
        before = perfect
        # From hundredths to beyond the thresholds of robust losses.
        for away in (0.01, 0.1, 1.0, 3.0):
            for sign in (-1.0, 1.0):
                worse = spec.evaluate(answer, answer.center + sign * away)
                expect(bool((worse >= perfect).all()), f"an error of {sign * away:g} has less loss than none")
            expect(
                float(worse.mean()) > float(before.mean()), f"an error of {away:g} has no more loss than a smaller one"
            )
            before = worse
    if output == "point":
        expect(float(perfect.abs().max()) == 0, "a perfect point prediction has a loss above 0")


def check_loss(loss: type[Any]) -> None:
    """Check the contract of a main loss with every output that it trains.

    Args:
        loss: a class entered with ``@LOSSES.register("name")``.

    Raises:
        ConfigError: it is not registered.
        ContractError: a contract is broken; the message says which and how.
    """
    name = LOSSES.name_of(loss)
    check_spec(LOSSES, name)
    expect(bool(loss.outputs), f"loss '{name}' trains no output; name some in `outputs`")
    for output in loss.outputs:
        expect(output in OUTPUTS, f"loss '{name}' trains the output '{output}', which is not registered")
        for check in (check_objective, check_order_of_streams, check_masked_ticks, check_least_value):
            try:
                check(name, output)
            except ContractError as error:
                raise ContractError(f"loss '{name}', output '{output}': {error}") from error
