"""Checkpoints: the whole state of a training after an epoch, as safetensors with a JSON header, never a pickle."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from edp.errors import StorageError
from edp.storage import write_bytes
from edp.training.schedules import ScheduleState

FILE = "checkpoint.safetensors"
REFIT = "refit.safetensors"


@dataclass
class Progress:
    """Where a training stands after a whole number of epochs."""

    epoch: int = 0
    updates: int = 0
    best_score: float = float("inf")
    best_epoch: int = 0
    seconds: float = 0.0
    schedule: ScheduleState = field(default_factory=ScheduleState)
    history: list[dict[str, Any]] = field(default_factory=list)


@dataclass
class Weights:
    """Named tensors of the net itself, its average, and the best so far; and the running errors of its outputs."""

    current: dict[str, Tensor]
    average: dict[str, Tensor]
    best: dict[str, Tensor]
    running: Tensor


def save_checkpoint(
    path: Path, key: str, progress: Progress, weights: Weights, optimizer: torch.optim.Optimizer
) -> None:
    """Write the checkpoint atomically; an earlier one stays until the new one is whole."""
    tensors = {"running": weights.running.detach().cpu().contiguous()}
    for group, named in (("current", weights.current), ("average", weights.average), ("best", weights.best)):
        tensors |= {f"{group}/{name}": tensor.detach().cpu().contiguous() for name, tensor in named.items()}
    state = optimizer.state_dict()
    structure = {"state": _strip(state["state"], "optimizer", tensors), "param_groups": state["param_groups"]}
    header = {"key": key, "progress": asdict(progress), "optimizer": structure}
    data = save(tensors, metadata={"edp": json.dumps(header)})
    write_bytes(path, data)


def load_checkpoint(path: Path, key: str) -> tuple[Progress, Weights, dict[str, Any]] | None:
    """Progress, weights and optimiser state of the run `key`, or None where there is no checkpoint yet.

    Raises:
        StorageError: the file is damaged or belongs to another run.
    """
    if not path.exists():
        return None
    try:
        with safe_open(path, framework="pt") as held:
            header = json.loads(held.metadata()["edp"])
            tensors = {name: held.get_tensor(name) for name in held.keys()}  # noqa: SIM118 (not a mapping)
    except (SafetensorError, KeyError, TypeError, ValueError, OSError) as error:
        raise StorageError(f"checkpoint '{path}' is damaged ({error}); remove it to train from the start") from error
    if header["key"] != key:
        raise StorageError(f"checkpoint '{path}' belongs to another run; choose another folder with --out")
    plain = header["progress"]
    progress = Progress(**{**plain, "schedule": ScheduleState(**plain["schedule"])})
    groups: dict[str, dict[str, Tensor]] = {"current": {}, "average": {}, "best": {}}
    for name, tensor in tensors.items():
        group, _, rest = name.partition("/")
        if group in groups:
            groups[group][rest] = tensor
    state = _restore(header["optimizer"]["state"], tensors)
    optimizer = {
        "state": {int(index): value for index, value in state.items()},
        "param_groups": header["optimizer"]["param_groups"],
    }
    return progress, Weights(**groups, running=tensors["running"]), optimizer


def _strip(value: Any, path: str, tensors: dict[str, Tensor]) -> Any:
    """Plain JSON of a tree; its tensors go to `tensors` and leave a reference."""
    if isinstance(value, Tensor):
        tensors[path] = value.detach().cpu().contiguous()
        # The order in memory decides how a matrix product rounds; without it a resumed run drifts by a last bit.
        return {"tensor": path, "stride": torch.empty_like(value, memory_format=torch.preserve_format).stride()}
    if isinstance(value, dict):
        return {str(key): _strip(item, f"{path}/{key}", tensors) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_strip(item, f"{path}/{i}", tensors) for i, item in enumerate(value)]
    return value


def _restore(value: Any, tensors: dict[str, Tensor]) -> Any:
    if isinstance(value, dict):
        if set(value) == {"tensor", "stride"}:
            held = tensors[value["tensor"]]
            return torch.empty_strided(held.shape, value["stride"], dtype=held.dtype).copy_(held)
        return {key: _restore(item, tensors) for key, item in value.items()}
    if isinstance(value, list):
        return [_restore(item, tensors) for item in value]
    return value
