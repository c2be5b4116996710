"""Training in parts: each part continues the previous part with the same bits as an uninterrupted training.

One of a single epoch is parted at an update, one of several between two epochs.
"""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import torch
from torch import Tensor

from edp.data.prepared import Prepared
from edp.errors import ConfigError
from edp.networks.predictor import ModelSpec
from edp.storage.reading import Table
from edp.training.checkpoint import TrainingPosition, optimizer_state, pack, unpack
from edp.training.fit import Loop
from edp.training.outcome import Fitted
from edp.training.schedules import ScheduleState
from edp.training.spec import TrainingSpec, thread_count


def fit_part(
    data: Prepared,
    model: ModelSpec,
    spec: TrainingSpec,
    until: int | None = None,
    start: bytes | None = None,
    windowed: bool = False,
) -> tuple[Fitted, bytes | None]:
    """Train from the beginning, or from where a part ended, until an update or to the end.

    Args:
        data: prepared series.
        model: the network.
        spec: settings of the training, without a refit.
        until: the last update of this part where there is one epoch, else its last epoch; None for the end.
        start: state at the end of an earlier part of this training; None for the beginning.
        windowed: whether what validates is predicted from reset over each window, and not as a stream.

    Returns:
        What a training that ends there gives (the averaged weights of one epoch, unless the start was better; of
        several, those of the best epoch so far), and what the next part goes on from; None at the end.

    Raises:
        ConfigError: a refit, or an `until` that is not before the end or not after the start.
        DataError: a recording is shorter than the burn-in.
        Diverged: the loss is not finite any more.
    """
    if spec.refit != "none":
        raise ConfigError(f"a training with refit = '{spec.refit}' cannot be done in parts; refit = 'none' must hold")
    # The number of threads changes the order of sums, and with it the last bits of a result.
    torch.set_num_threads(thread_count(spec))
    loop = Loop(data, model, spec, None, windowed=windowed)
    if spec.epochs > 1:
        return _epochs(loop, until, start)
    if start is not None:
        _restore(loop, unpack(start))
    if until is None:
        return loop.fit(lambda event: None), None
    if not loop.within.updates < until < loop.updates:
        raise ConfigError(
            f"a part from update {loop.within.updates} to {until} of {loop.updates}; it must end after its start and "
            "before the end of the training"
        )
    loop.advance(until, lambda event: None)
    state = pack(_state(loop))
    return loop.pause(), state


def _epochs(loop: Loop, until: int | None, start: bytes | None) -> tuple[Fitted, bytes | None]:
    """Run a part of several epochs; after an early stop later parts are empty."""
    if start is not None:
        _restore_epochs(loop, unpack(start))
    if until is None:
        loop.go_on(lambda event: None)
        return loop.finish(), None
    if not loop.progress.epoch < until < loop.epochs:
        raise ConfigError(
            f"a part from epoch {loop.progress.epoch} to {until} of {loop.epochs}; it must end after its start and "
            "before the end of the training"
        )
    loop.epochs = until  # of the loop only: schedules and averages count with the epochs of the spec
    loop.go_on(lambda event: None)
    state = pack(_state_of_epochs(loop))
    return loop.finish(), state


def _state_of_epochs(loop: Loop) -> dict[str, object]:
    """Return the state for later epochs, which seed their own random values.

    Without times, equal parts give equal bytes.
    """
    # Times differ from run to run; without them equal trainings leave equal bytes.
    progress = asdict(loop.progress) | {"seconds": 0.0}
    progress["history"] = [row | {"seconds": 0.0} for row in progress["history"]]
    return {
        "progress": progress,
        "current": dict(loop.net.named_parameters()),
        "average": loop.average,
        "best": loop.best,
        "optimizer": loop.optimizer.state_dict(),
        "running": loop.objective.running,
    }


def _restore_epochs(loop: Loop, state: Table) -> None:
    progress = state["progress"]
    loop.progress = TrainingPosition(**{**progress, "schedule": ScheduleState(**progress["schedule"])})
    with torch.no_grad():
        for name, parameter in loop.net.named_parameters():
            parameter.copy_(state["current"][name])
            loop.average[name].copy_(state["average"][name])
            loop.best[name].copy_(state["best"][name])
        loop.objective.running.copy_(state["running"])
    loop.optimizer.load_state_dict(optimizer_state(state["optimizer"]))


def _state(loop: Loop) -> dict[str, object]:
    """Return the state that determines the remainder of a training, in addition to its settings.

    Without times, equal parts give equal bytes.
    """
    cuda = loop.device.type == "cuda"
    return {
        "updates": loop.progress.updates,
        "epoch_updates": loop.within.updates,
        "total": loop.within.total,
        "stream": loop.within.stream,
        "current": dict(loop.net.named_parameters()),
        "average": loop.average,
        "optimizer": loop.optimizer.state_dict(),
        "running": loop.objective.running,
        # Dropout is drawn along the epoch, so the generator's state is part of the place inside it.
        "chance": torch.get_rng_state(),
        "chance on the device": torch.cuda.get_rng_state(loop.device) if cuda else None,
    }


def _restore(loop: Loop, state: Table) -> None:
    loop.progress.updates = state["updates"]
    loop.within.updates, loop.within.total = state["epoch_updates"], state["total"]
    loop.within.stream = _move_tree(state["stream"], loop.device)
    with torch.no_grad():
        for name, parameter in loop.net.named_parameters():
            parameter.copy_(state["current"][name])
            loop.average[name].copy_(state["average"][name])
        loop.objective.running.copy_(state["running"])
    loop.optimizer.load_state_dict(optimizer_state(state["optimizer"]))
    torch.set_rng_state(state["chance"])
    if loop.device.type == "cuda" and state["chance on the device"] is not None:
        torch.cuda.set_rng_state(state["chance on the device"], loop.device)


def _move_tree(tree: Any, device: torch.device) -> Any:
    if isinstance(tree, Tensor):
        return tree.to(device)
    if isinstance(tree, dict):
        return {name: _move_tree(part, device) for name, part in tree.items()}
    if isinstance(tree, list | tuple):
        return type(tree)(_move_tree(part, device) for part in tree)
    return tree
