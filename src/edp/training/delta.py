"""What a fine-tuning changed in a network, in kilobytes: matrices as products of two narrow ones, the rest as it is.

A change ``W' - W`` of a matrix is cut to its largest singular values (Eckart and Young 1936); which ones of all
matrices are kept is decided by energy a byte, until the bytes are used up. Vectors are kept whole. So any fine-tuning
becomes a delta, whatever method it was done by, and a fleet is one network and a small file a machine.
"""

from __future__ import annotations

import copy
import hashlib
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load, save

from edp.errors import BundleError
from edp.networks.predictor import Predictor
from edp.storage import object_with, parse_json, read_bytes, write_bytes
from edp.training.bundle import weights_digest

SCHEMA = 1
SUFFIX = ".delta"
DELTA_BYTES = 64 * 2**10
"""Of a delta, unless told otherwise."""
MOST_BYTES = 64 * 2**20
"""Of the file of a delta; one of a network of ten million parameters, whole."""
HEADER = "header"
HEAD_BYTES = 4096
"""Kept free for the header and for names, shapes and places of the arrays."""
EACH_BYTES = 160
"""Of the name, shape and place of an array in the file, about."""
Half = NDArray[np.float16]


@dataclass(frozen=True, eq=False)
class Delta:
    """A change of a network.

    Attributes:
        base: content address of the weights that it is a change of.
        facts: plain values, such as the machine's name, logs and errors.
        whole: changes by the name of a parameter, float32.
        narrow: by the name of a parameter, ``(rows, rank)`` and ``(rank, columns)`` whose product is its change, with
            all axes but the first as columns.
    """

    base: str
    facts: Mapping[str, Any]
    whole: Mapping[str, NDArray[np.float32]]
    narrow: Mapping[str, tuple[Half, Half]]

    @property
    def rank(self) -> int:
        """The largest rank of a matrix."""
        return max((left.shape[1] for left, _ in self.narrow.values()), default=0)

    def to_bytes(self) -> bytes:
        """The file: safetensors with a header."""
        arrays: dict[str, NDArray[Any]] = {f"w:{name}": values for name, values in self.whole.items()}
        for name, (left, right) in self.narrow.items():
            arrays |= {f"l:{name}": np.ascontiguousarray(left), f"r:{name}": np.ascontiguousarray(right)}
        head = {"schema": SCHEMA, "base": self.base, "facts": dict(self.facts), "hash": _hash(arrays)}
        text = json.dumps(head, allow_nan=False, sort_keys=True)
        return bytes(save({**arrays, HEADER: np.frombuffer(text.encode(), np.uint8)}))


def delta_of(
    base: Predictor, tuned: Predictor, facts: Mapping[str, Any] | None = None, most_bytes: int = DELTA_BYTES
) -> Delta:
    """The change from a network to a fine-tuned one, within a number of bytes.

    Args:
        base: before.
        tuned: after; of the same parts.
        facts: plain values to keep with it.
        most_bytes: of the file.

    Raises:
        BundleError: networks of other parts, or the vectors alone take more.
    """
    before, after = base.state_dict(), tuned.state_dict()
    if {name: value.shape for name, value in before.items()} != {name: value.shape for name, value in after.items()}:
        raise BundleError("a delta needs two networks of the same parts; give a network and what it was tuned to")
    whole: dict[str, NDArray[np.float32]] = {}
    cut: dict[str, tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]] = {}
    left = most_bytes - HEAD_BYTES - len(json.dumps(dict(facts or {})))
    for name, old in before.items():
        change = (after[name].detach().double() - old.detach().double()).cpu().numpy()
        if not change.any():
            continue
        if change.ndim < 2:
            whole[name] = change.astype(np.float32)
            left -= 4 * change.size + EACH_BYTES
        else:
            cut[name] = np.linalg.svd(change.reshape(len(change), -1), full_matrices=False)
    if left < 0:
        raise BundleError(f"{most_bytes:,} bytes do not hold the changed vectors of this network; allow more")
    return Delta(weights_digest(base), dict(facts or {}), whole, dict(_narrow(cut, left)))


def _narrow(
    cut: Mapping[str, tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]], left: int
) -> Iterator[tuple[str, tuple[Half, Half]]]:
    """The singular values with the most energy a byte that fit into `left` bytes, as products of narrow matrices."""
    entries = []
    for name, (u, values, v) in cut.items():
        size = 2 * (len(u) + v.shape[1])
        entries += [(value**2 / size, size, name) for value in values if value > 0]
    ranks: dict[str, int] = {}
    for _, size, name in sorted(entries, reverse=True):
        # The names and shapes of both factors come with the first of a matrix.
        needed = size + (0 if name in ranks else 2 * EACH_BYTES)
        if needed > left:
            continue
        left -= needed
        ranks[name] = ranks.get(name, 0) + 1
    for name, rank in ranks.items():
        u, values, v = cut[name]
        # The root on both sides keeps each well within the range of half precision.
        root = np.sqrt(values[:rank])
        yield name, ((u[:, :rank] * root).astype(np.float16), (root[:, None] * v[:rank]).astype(np.float16))


def with_delta(base: Predictor, delta: Delta) -> Predictor:
    """The network of a machine: a copy of the base with the change added.

    Raises:
        BundleError: the delta is one of another network.
    """
    if weights_digest(base) != delta.base:
        raise BundleError(
            f"the delta is a change of the network {delta.base}, and this one is {weights_digest(base)}; give the "
            "network that the fleet was fine-tuned from"
        )
    network = copy.deepcopy(base)
    state = network.state_dict()
    changes: dict[str, NDArray[Any]] = dict(delta.whole)
    for name, (left, right) in delta.narrow.items():
        changes[name] = left.astype(np.float64) @ right.astype(np.float64)
    with torch.no_grad():
        for name, change in changes.items():
            if name not in state or state[name].numel() != change.size:
                raise BundleError(f"the delta changes '{name}', which this network lacks or has in another shape")
            added = torch.from_numpy(change.astype(np.float64)).reshape(state[name].shape)
            state[name].copy_((state[name].double() + added).to(state[name].dtype))
    network.load_state_dict(state)
    return network.eval()


def write_delta(path: str | Path, delta: Delta) -> None:
    """Write a delta, whole or not at all.

    Raises:
        StorageError: the file cannot be written.
    """
    write_bytes(Path(path), delta.to_bytes())


def read_delta(path: str | Path) -> Delta:
    """A delta from its file.

    Raises:
        BundleError: no delta, a damaged one, or one of a later version.
    """
    return delta_from_bytes(read_bytes(Path(path), MOST_BYTES, error=BundleError), f"'{path}'")


def delta_from_bytes(data: bytes, where: str) -> Delta:
    """A delta from the bytes of its file; `where` names it in messages."""
    try:
        arrays = load(data)
        text = arrays.pop(HEADER).tobytes().decode()
    except (SafetensorError, KeyError, ValueError) as error:
        raise BundleError(f"{where} is no delta of a network, or is damaged; copy it again") from error
    head = object_with(parse_json(text, where, BundleError), ("schema",), where, BundleError)
    if head["schema"] != SCHEMA:
        raise BundleError(f"{where} is a delta of schema {head['schema']}, {SCHEMA} is read here: update EDP")
    object_with(head, ("base", "facts", "hash"), where, BundleError)
    if head["hash"] != _hash(arrays) or not isinstance(head["facts"], dict):
        raise BundleError(f"{where} is damaged: its numbers do not have the hash in its header; copy it again")
    whole = {name[2:]: values for name, values in arrays.items() if name.startswith("w:")}
    lefts = {name[2:]: values for name, values in arrays.items() if name.startswith("l:")}
    rights = {name[2:]: values for name, values in arrays.items() if name.startswith("r:")}
    fitting = lefts.keys() == rights.keys() and all(
        left.ndim == rights[name].ndim == 2 and left.shape[1] == len(rights[name]) for name, left in lefts.items()
    )
    if not fitting or not all(np.isfinite(values).all() for values in arrays.values()):
        raise BundleError(f"{where} is damaged: factors that do not fit together, or numbers that are not finite")
    return Delta(str(head["base"]), head["facts"], whole, {name: (lefts[name], rights[name]) for name in lefts})


def _hash(arrays: Mapping[str, NDArray[Any]]) -> str:
    state = hashlib.blake2b(digest_size=16)
    for name in sorted(arrays):
        values = arrays[name]
        state.update(f"{name} {values.dtype} {values.shape}\0".encode() + np.ascontiguousarray(values).tobytes())
    return state.hexdigest()
