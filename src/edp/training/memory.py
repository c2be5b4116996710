"""How much memory a training takes, computed from its settings before it is taken."""

from __future__ import annotations

import math

import torch

from edp.data.prepared import Prepared
from edp.networks.predictor import Predictor
from edp.networks.streaming import state_numbers
from edp.storage.memory import check_setting
from edp.training.spec import TrainingSpec
from edp.training.validation import MAX_VALIDATED

FLOAT, DOUBLE = 4, 8
COPIES = 6
"""Of the weights: themselves, gradients, average, best ones, and what a checkpoint holds while it is written."""
STATES = 4
"""Of the state of each stream: before and after an update, at reset, and with the ticks behind it."""
TEMPORARY = 2.0
"""Of what the backward pass needs, with gradients on the way; five measured peaks lay at 0.35 to 0.93 of the sum."""
PROBED = (64, 128)
"""Ticks of the two passes that tell what a tick takes; banded sums go by blocks of 64."""
LANE_BYTES = 4_096
"""Of Python's own lists and arrays for each lane."""


def check_training_memory(net: Predictor, data: Prepared, spec: TrainingSpec, passes: int = 1) -> None:
    """Raise an error if the machine has too little memory for a training.

    Args:
        net: the network, freshly built.
        data: training data.
        spec: settings of the training.
        passes: through the network that one update goes back through; more than one where it adapts on the way.

    Raises:
        ConfigError: names the settings, what they would take and what is free.
    """
    chunks, task = spec.chunks, net.task
    what = (
        f"training: training.chunks.batch = {chunks.batch:,} with chunks of {chunks.length:,} ticks, "
        f"{len(task.inputs):,} channels, {len(task.horizons):,} horizon(s) of {len(task.targets):,} target(s) and "
        f"{sum(parameter.numel() for parameter in net.parameters()):,} parameters"
    )
    advice = "make training.chunks.batch or training.chunks.length smaller, or the network"
    constant_bytes = _weights(net, spec) + _batch(net, spec) + _validation(net, data)
    check_setting(constant_bytes, what, advice)  # before the network is tried, which takes the state of a stream
    check_setting(constant_bytes + passes * _backward(net, spec), what, advice)


def _weights(net: Predictor, spec: TrainingSpec) -> float:
    return FLOAT * sum(COPIES * math.prod(p.shape) + 2 * spec.optimizer.remembers(p.shape) for p in net.parameters())


def _batch(net: Predictor, spec: TrainingSpec) -> float:
    # The meta device tells shapes without memory.
    """Return the memory of inputs, future targets and state of all streams of an update."""
    chunks, task = spec.chunks, net.task
    like = torch.zeros((), device="meta")
    state = state_numbers(net.initial_state(1, like))
    ends = len(task.horizons) * len(task.targets)
    # Rows of a batch are cut, put together, and read as tensors; the next batch is cut meanwhile.
    tick = 3 * (len(task.inputs) + ends + 2)
    return chunks.batch * (FLOAT * (chunks.length * tick + STATES * state) + LANE_BYTES)


def _validation(net: Predictor, data: Prepared) -> float:
    """Return the memory of the network outputs for the validation samples, in double precision."""
    ticks = min(sum(part.samples for part in data.validation), MAX_VALIDATED)
    return 3 * DOUBLE * ticks * len(net.task.horizons) * len(net.task.targets) * (1 + net.spec.output.values)


def _backward(net: Predictor, spec: TrainingSpec) -> float:
    """Return the memory that the backward pass needs, estimated from two short passes of one stream."""
    chunks = spec.chunks
    first, second = (_measure_saved(net, ticks) for ticks in PROBED)
    # The difference of two passes removes what does not grow with the ticks.
    tick = max(0.0, (second - first) / (PROBED[1] - PROBED[0]))
    start = max(0.0, first - tick * PROBED[0])
    # The loss takes differences of predictions and targets, some of them kept for the way back.
    loss = 10 * FLOAT * len(net.task.horizons) * len(net.task.targets) * net.spec.output.values
    return TEMPORARY * chunks.batch * (start + (tick + loss) * chunks.length)


def _measure_saved(net: Predictor, ticks: int) -> int:
    """Return the bytes of tensors that a forward pass of one stream keeps for the way back."""
    like = next(net.parameters())
    counted_storages = {parameter.untyped_storage().data_ptr() for parameter in net.parameters()}
    total = 0

    def pack(tensor: torch.Tensor) -> torch.Tensor:
        nonlocal total
        storage = tensor.untyped_storage()
        # Views share a storage, and weights are kept anyway: each storage counts once, weights not at all.
        if storage.data_ptr() not in counted_storages:
            counted_storages.add(storage.data_ptr())
            total += storage.nbytes()
        return tensor

    x = torch.zeros(1, ticks, len(net.task.inputs), dtype=like.dtype, device=like.device)
    was_training = net.training
    net.train()
    try:
        # The trial must not move the random numbers of the training.
        with torch.random.fork_rng(devices=[]), torch.autograd.graph.saved_tensors_hooks(pack, lambda tensor: tensor):
            net.forward_features(x, net.initial_state(1, x))
    finally:
        net.train(was_training)
    return total
