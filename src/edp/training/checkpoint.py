"""Checkpoints: the whole state of a training, as safetensors with a JSON header, never a pickle."""

from __future__ import annotations

import hashlib
import json
import re
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor

from edp.errors import StorageError
from edp.networks.streaming import State
from edp.storage import parse_json, read_bytes, write_bytes
from edp.storage.paths import is_entry_at
from edp.storage.reading import Table
from edp.training.schedules import ScheduleState

CHECKPOINT_BYTES = 16 * 2**30
"""Most that a checkpoint has: three times the weights, and the optimiser's two, of a network of 800 million numbers."""
BLANK = "0" * 32
"""In the place of the checksum while it is computed, so that it covers the whole file."""
CHECKSUM = re.compile(rb'"blake2b":"([0-9a-f]{32})"')
FILE = "checkpoint.safetensors"
REFIT = "refit.safetensors"


@dataclass
class TrainingPosition:
    """Training position after an integer number of epochs."""

    epoch: int = 0
    updates: int = 0
    best_score: float = float("inf")
    best_epoch: int = 0
    seconds: float = 0.0
    schedule: ScheduleState = field(default_factory=ScheduleState)
    history: list[Table] = field(default_factory=list)


@dataclass
class Within:
    """Training position inside an epoch.

    Attributes:
        updates: updates of the epoch so far.
        total: sum of their losses.
        stream: state of the net that the next chunk goes on from.
    """

    updates: int = 0
    total: float = 0.0
    stream: State | None = None

    @property
    def loss(self) -> float:
        """Mean loss until now."""
        return self.total / max(1, self.updates)


@dataclass
class Weights:
    """Named tensors of the network, its average and the best until now; and the running errors of its outputs."""

    current: dict[str, Tensor]
    average: dict[str, Tensor]
    best: dict[str, Tensor]
    running: Tensor


def save_checkpoint(
    path: Path, key: str, progress: TrainingPosition, weights: Weights, optimizer: torch.optim.Optimizer
) -> None:
    """Write the checkpoint atomically; an earlier one stays until the new one is whole."""
    tensors = {"running": weights.running.detach().cpu().contiguous()}
    for group, named in (("current", weights.current), ("average", weights.average), ("best", weights.best)):
        tensors |= {f"{group}/{name}": tensor.detach().cpu().contiguous() for name, tensor in named.items()}
    # Structure goes to JSON and tensors to safetensors: neither executes code when it is read.
    state = optimizer.state_dict()
    structure = _strip(state, "optimizer", tensors)
    header = {"key": key, "progress": asdict(progress), "optimizer": structure}
    write_bytes(path, _insert_digest(save(tensors, metadata={"edp": json.dumps(header), "blake2b": BLANK})))


def load_checkpoint(path: Path, key: str) -> tuple[TrainingPosition, Weights, dict[str, object]] | None:
    """Return progress, weights and optimiser state of the run `key`; None without a checkpoint.

    Raises:
        StorageError: the file is damaged, in a single bit, too, or belongs to another run.
    """
    if not is_entry_at(path):
        return None
    data = read_bytes(path, CHECKPOINT_BYTES, f"checkpoint '{path}'")
    try:
        _check_digest(data)
        header, tensors = _header(data), load(data)
        if header["key"] != key:
            raise StorageError(f"checkpoint '{path}' belongs to another run; choose another folder with --out")
        return _parse_checkpoint(header, tensors)
    except (SafetensorError, LookupError, AttributeError, TypeError, ValueError, RuntimeError) as error:
        # safetensors, JSON and missing keys each raise their own type; all of them mean damage.
        raise damaged(path, error) from error


def damaged(path: Path, error: Exception) -> StorageError:
    """Return the error for a damaged checkpoint, which stays on disk."""
    return StorageError(f"checkpoint '{path}' is damaged ({error}); remove it to train from the start")


def _parse_checkpoint(header: Table, tensors: dict[str, Tensor]) -> tuple[TrainingPosition, Weights, dict[str, object]]:
    plain = header["progress"]
    progress = TrainingPosition(**{**plain, "schedule": ScheduleState(**plain["schedule"])})
    groups: dict[str, dict[str, Tensor]] = {"current": {}, "average": {}, "best": {}}
    for name, tensor in tensors.items():
        group, _, rest = name.partition("/")
        if group in groups:
            groups[group][rest] = tensor
    optimizer = optimizer_state(_restore(header["optimizer"], tensors))
    return progress, Weights(**groups, running=tensors["running"]), optimizer


def optimizer_state(plain: Table) -> Table:
    """Return an optimiser state for loading, from its form with text keys."""
    return {**plain, "state": {int(index): value for index, value in plain["state"].items()}}


def pack(tree: Any) -> bytes:
    """Serialise a tree of tables, lists, tuples, tensors and plain values as safetensors; keys become text."""
    tensors: dict[str, Tensor] = {}
    plain = _strip(tree, "", tensors)
    # Parts of one tensor may share their memory, which the format refuses.
    copies = {name: tensor.clone() for name, tensor in tensors.items()}
    return save(copies, metadata={"edp": json.dumps(plain)})


def unpack(data: bytes) -> Any:
    """Restore the tree given to `pack`, bit for bit."""
    return _restore(_header(data), load(data))


def _header(data: bytes) -> Any:
    # safetensors begin with the length of their header, 8 bytes, little-endian.
    size = int.from_bytes(data[:8], "little")
    outer = parse_json(data[8 : 8 + size].decode(), "its header", ValueError)
    return parse_json(outer["__metadata__"]["edp"], "its header", ValueError, finite=False)


def _place_of_digest(data: bytes) -> int:
    end = 8 + int.from_bytes(data[:8], "little")
    # The search ends with the header: weights could hold the same bytes by chance.
    spot = CHECKSUM.search(data, 8, min(end, len(data)))
    if spot is None:
        raise ValueError("it has no checksum: cut off, or written by an earlier version of EDP")
    return spot.start(1)


def _digest(data: bytes, position: int) -> bytes:
    # The checksum's own place counts as zeros, so that it can stand inside of what it covers.
    state = hashlib.blake2b(data[:position], digest_size=16)
    state.update(BLANK.encode())
    state.update(memoryview(data)[position + len(BLANK) :])
    return state.hexdigest().encode()


def _insert_digest(data: bytes) -> bytes:
    position = _place_of_digest(data)
    return data[:position] + _digest(data, position) + data[position + len(BLANK) :]


def _check_digest(data: bytes) -> None:
    position = _place_of_digest(data)
    if data[position : position + len(BLANK)] != _digest(data, position):
        raise ValueError("its checksum does not fit: cut off or changed")


def _strip(value: Any, path: str, tensors: dict[str, Tensor]) -> Any:
    """Return the plain JSON of a tree; its tensors go to `tensors` and leave a reference."""
    if isinstance(value, Tensor):
        tensors[path] = value.detach().cpu().contiguous()
        # The order in memory decides how a matrix product rounds; without it a resumed run drifts by a last bit.
        return {"tensor": path, "stride": torch.empty_like(value, memory_format=torch.preserve_format).stride()}
    if isinstance(value, dict):
        return {str(key): _strip(item, f"{path}/{key}", tensors) for key, item in value.items()}
    if isinstance(value, list | tuple):
        parts = [_strip(item, f"{path}/{i}", tensors) for i, item in enumerate(value)]
        return {"tuple": parts} if isinstance(value, tuple) else parts
    return value


def _restore(value: Any, tensors: dict[str, Tensor]) -> Any:
    if isinstance(value, dict):
        if set(value) == {"tensor", "stride"}:
            stored = tensors[value["tensor"]]
            if (
                sum((n - 1) * step for n, step in zip(stored.shape, value["stride"], strict=True)) + 1
                > stored.numel()
                # A forged stride could reach beyond the storage.
                > 0
            ):
                raise ValueError(f"'{value['tensor']}' asks for more memory than it has numbers")
            return torch.empty_strided(stored.shape, value["stride"], dtype=stored.dtype).copy_(stored)
        if set(value) == {"tuple"}:
            return tuple(_restore(item, tensors) for item in value["tuple"])
        return {key: _restore(item, tensors) for key, item in value.items()}
    if isinstance(value, list):
        return [_restore(item, tensors) for item in value]
    return value
