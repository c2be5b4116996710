"""A training of one epoch in parts: each goes on from what the one before left, to the same bits as without a stop."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from edp.data.prepared import Prepared
from edp.errors import ConfigError
from edp.models.predictor import ModelSpec
from edp.training.checkpoint import optimizer_state, pack, unpack
from edp.training.fit import Loop, thread_count
from edp.training.outcome import Fitted
from edp.training.spec import TrainingSpec


def fit_part(
    data: Prepared, model: ModelSpec, spec: TrainingSpec, until: int | None = None, start: bytes | None = None
) -> tuple[Fitted, bytes | None]:
    """Train from the beginning, or from where a part ended, until an update or to the end.

    Args:
        data: prepared series.
        model: the network.
        spec: how to train; of one epoch, without a refit.
        until: the last update of this part; None for the end.
        start: what an earlier part of the same training left; None for the beginning.

    Returns:
        What a training that ends there gives (its averaged weights, unless the start was better), and what the next
        part goes on from; None at the end.

    Raises:
        ConfigError: several epochs or a refit, or an `until` that is not before the end or not after the start.
        DataError: a recording is shorter than the burn-in.
        Diverged: the loss is not finite any more.
    """
    if spec.epochs != 1 or spec.refit != "none":
        raise ConfigError(
            f"a training of {spec.epochs} epochs with refit = '{spec.refit}' cannot be done in parts; epochs = 1 and "
            "refit = 'none' must hold"
        )
    torch.set_num_threads(thread_count(spec))
    loop = Loop(data, model, spec, None)
    if start is not None:
        _restore(loop, unpack(start))
    if until is None:
        return loop.fit(lambda event: None), None
    if not loop.within.given < until < loop.updates:
        raise ConfigError(
            f"a part from update {loop.within.given} to {until} of {loop.updates}; it must end after its start and "
            "before the end of the training"
        )
    loop.advance(until, lambda event: None)
    state = pack(_state(loop))
    return loop.pause(), state


def _state(loop: Loop) -> dict[str, Any]:
    """All that the rest of a training depends on and its settings do not say. No times: equal parts, equal bytes."""
    cuda = loop.device.type == "cuda"
    return {
        "updates": loop.progress.updates,
        "given": loop.within.given,
        "total": loop.within.total,
        "stream": loop.within.stream,
        "current": dict(loop.net.named_parameters()),
        "average": loop.average,
        "optimizer": loop.optimizer.state_dict(),
        "running": loop.objective.running,
        "chance": torch.get_rng_state(),
        "chance on the device": torch.cuda.get_rng_state(loop.device) if cuda else None,
    }


def _restore(loop: Loop, held: dict[str, Any]) -> None:
    loop.progress.updates = held["updates"]
    loop.within.given, loop.within.total = held["given"], held["total"]
    loop.within.stream = _moved(held["stream"], loop.device)
    with torch.no_grad():
        for name, parameter in loop.net.named_parameters():
            parameter.copy_(held["current"][name])
            loop.average[name].copy_(held["average"][name])
        loop.objective.running.copy_(held["running"])
    loop.optimizer.load_state_dict(optimizer_state(held["optimizer"]))
    torch.set_rng_state(held["chance"])
    if loop.device.type == "cuda" and held["chance on the device"] is not None:
        torch.cuda.set_rng_state(held["chance on the device"], loop.device)


def _moved(tree: Any, device: torch.device) -> Any:
    if isinstance(tree, Tensor):
        return tree.to(device)
    if isinstance(tree, dict):
        return {name: _moved(part, device) for name, part in tree.items()}
    if isinstance(tree, list | tuple):
        return type(tree)(_moved(part, device) for part in tree)
    return tree
