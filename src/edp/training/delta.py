"""Change of a network by fine-tuning in kilobytes: matrices with few bits, whole or as low-rank products.

The change ``W' - W`` of each matrix is kept whole, in as many bits a number (8 to 4, with a scale a row) as there is
room for. Where 4 are too many it is cut to its largest singular values (Eckart and Young 1936), in 8 bits; which ones
of all matrices are kept is decided by energy a byte. Vectors are in single precision. So any fine-tuning becomes a
delta, whatever method it was done by, and a fleet is one network and a small file a machine.
"""

from __future__ import annotations

import copy
import hashlib
import json
from collections.abc import Mapping
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
from edp.storage import object_with, parse_json, read_bytes
from edp.storage.arrays import ArrayRule, checked_arrays
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
EACH_BYTES = 200
"""Of the name, shape and place of an array in the file, about."""
Eighths = NDArray[np.int8]
Cut = tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]
MAX_BITS, MIN_BITS = 8, 4
"""Of a number of a whole matrix; with fewer than the least, its largest singular values alone say more."""


@dataclass(frozen=True, eq=False)
class Scaled:
    """Matrix of low-bit integers with one scale per row."""

    numbers: Eighths
    scales: NDArray[np.float32]
    bits: int = MAX_BITS

    @staticmethod
    def from_matrix(matrix: NDArray[np.float64], bits: int = MAX_BITS) -> Scaled:
        """Return the nearest scaled matrix."""
        steps = 2 ** (bits - 1) - 1
        scales = (np.abs(matrix).max(axis=1) / steps).astype(np.float32)
        # A row of zeros has a scale of zero; dividing by one leaves its zeros.
        divided = matrix / np.where(scales > 0, scales, 1.0)[:, None]
        return Scaled(np.clip(np.rint(divided), -steps, steps).astype(np.int8), scales, bits)

    def packed(self) -> NDArray[np.uint8]:
        """Return the integers without their unused bits."""
        raised = (self.numbers.astype(np.int16) + 2 ** (self.bits - 1)).astype(np.uint8)
        planes = np.unpackbits(raised.reshape(-1, 1), axis=1)[:, MAX_BITS - self.bits :]
        return np.packbits(planes)

    @staticmethod
    def unpacked(data: NDArray[np.uint8], scales: NDArray[np.float32], columns: int, bits: int) -> Scaled:
        """Create a scaled matrix from the bytes of `packed`."""
        count = len(scales) * columns
        planes = np.unpackbits(data, count=count * bits).reshape(count, bits)
        raised = np.packbits(np.pad(planes, ((0, 0), (MAX_BITS - bits, 0))), axis=1)[:, 0].astype(np.int16)
        return Scaled((raised - 2 ** (bits - 1)).astype(np.int8).reshape(len(scales), columns), scales, bits)

    @property
    def matrix(self) -> NDArray[np.float64]:
        """In double precision."""
        return self.numbers * self.scales.astype(np.float64)[:, None]


@dataclass(frozen=True, eq=False)
class Delta:
    """A change of a network.

    Attributes:
        base: content address of the weights that it is a change of.
        facts: plain values, such as the machine's name, logs and errors.
        vectors: changes by the name of a parameter, float32.
        whole: changes of matrices, with all axes but the first as columns.
        narrow: change of other matrices as two matrices ``(rank, rows)`` and ``(rank, columns)``; the transposed first
            one times the second is the change.
    """

    base: str
    facts: Mapping[str, object]
    vectors: Mapping[str, NDArray[np.float32]]
    whole: Mapping[str, Scaled]
    narrow: Mapping[str, tuple[Scaled, Scaled]]

    @property
    def rank(self) -> int:
        """The largest rank of a matrix that is not whole."""
        return max((len(left.scales) for left, _ in self.narrow.values()), default=0)

    def to_bytes(self) -> bytes:
        """Return the file content: safetensors with a header."""
        arrays: dict[str, NDArray[Any]] = {f"v:{name}": values for name, values in self.vectors.items()}
        parts = [("w", name, part) for name, part in self.whole.items()]
        for name, pair in self.narrow.items():
            parts += [("l", name, pair[0]), ("r", name, pair[1])]
        shapes: dict[str, list[int]] = {}
        for kind, name, part in parts:
            arrays |= {f"{kind}:{name}": part.packed(), f"{kind}s:{name}": part.scales}
            shapes[f"{kind}:{name}"] = [part.numbers.shape[1], part.bits]
        head = {"schema": SCHEMA, "base": self.base, "facts": dict(self.facts), "shapes": shapes, "hash": _hash(arrays)}
        text = json.dumps(head, allow_nan=False, sort_keys=True)
        return bytes(save({**arrays, HEADER: np.frombuffer(text.encode(), np.uint8)}))


def delta_of(
    base: Predictor, tuned: Predictor, facts: Mapping[str, object] | None = None, most_bytes: int = DELTA_BYTES
) -> Delta:
    """Return the change from a network to a fine-tuned one, within a number of bytes.

    Args:
        base: before.
        tuned: after; of the same parts.
        facts: plain values to keep with it.
        most_bytes: maximum size of the file.

    Raises:
        BundleError: networks of other parts, or the vectors alone take more.
    """
    before, after = base.state_dict(), tuned.state_dict()
    if {name: value.shape for name, value in before.items()} != {name: value.shape for name, value in after.items()}:
        raise BundleError("a delta needs two networks of the same parts; give a network and what it was tuned to")
    vectors: dict[str, NDArray[np.float32]] = {}
    matrices: dict[str, NDArray[np.float64]] = {}
    left = most_bytes - HEAD_BYTES - len(json.dumps(dict(facts or {})))
    for name, old in before.items():
        change = (after[name].detach().double() - old.detach().double()).cpu().numpy()
        if not change.any():
            continue
        if change.ndim < 2:
            vectors[name] = change.astype(np.float32)
            left -= 4 * change.size + EACH_BYTES
        else:
            matrices[name] = change.reshape(len(change), -1)
    if left < 0:
        raise BundleError(f"{most_bytes:,} bytes do not hold the changed vectors of this network; allow more")
    for bits in range(MAX_BITS, MIN_BITS - 1, -1):
        needed = sum(-(-matrix.size * bits // 8) + 4 * len(matrix) + 2 * EACH_BYTES for matrix in matrices.values())
        if needed <= left:
            coarse = {name: Scaled.from_matrix(matrix, bits) for name, matrix in matrices.items()}
            return Delta(weights_digest(base), dict(facts or {}), vectors, coarse, {})
    ranks = _ranks(matrices, left)
    whole = {name: Scaled.from_matrix(matrices[name]) for name, rank in ranks.items() if rank is None}
    narrow = {name: _factors(matrices[name], rank) for name, rank in ranks.items() if rank is not None}
    return Delta(weights_digest(base), dict(facts or {}), vectors, whole, narrow)


def _ranks(matrices: Mapping[str, NDArray[np.float64]], left: int) -> dict[str, int | None]:
    """Return the number of singular values per matrix that fit into `left` bytes, by energy per byte; None for all."""
    sizes = {
        name: (matrix.shape[0] + matrix.shape[1] + 8, matrix.size + 4 * len(matrix))
        for name, matrix in matrices.items()
    }
    entries = []
    for name, matrix in matrices.items():
        values = np.linalg.svd(matrix, compute_uv=False)
        entries += [(value**2 / sizes[name][0], name) for value in values if value > 0]
    ranks: dict[str, int | None] = {}
    for _, name in sorted(entries, reverse=True):
        rank, (each, all_of_it) = ranks.get(name, 0), sizes[name]
        if rank is None:
            continue
        spent = rank * each + (4 * EACH_BYTES if rank else 0)
        after = (rank + 1) * each + 4 * EACH_BYTES
        # Names and shapes of both factors come with the first singular value.
        wholly = all_of_it + 2 * EACH_BYTES <= after
        needed = (all_of_it + 2 * EACH_BYTES if wholly else after) - spent
        if needed <= left:
            left -= needed
            ranks[name] = None if wholly else rank + 1
    return ranks


def _factors(matrix: NDArray[np.float64], rank: int) -> tuple[Scaled, Scaled]:
    u, values, v = np.linalg.svd(matrix, full_matrices=False)
    # The root on both sides: both factors are then as exact as each other.
    root = np.sqrt(values[:rank])[:, None]
    return Scaled.from_matrix(root * u[:, :rank].T), Scaled.from_matrix(root * v[:rank])


def apply_delta(base: Predictor, delta: Delta) -> Predictor:
    """Return the network of a machine: a copy of the base with the change added.

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
    changes: dict[str, NDArray[Any]] = {**delta.vectors, **{name: part.matrix for name, part in delta.whole.items()}}
    for name, (left, right) in delta.narrow.items():
        # Before they are multiplied: a file of two long rows must not ask for the memory of their product.
        if name not in state or state[name].numel() != left.numbers.shape[1] * right.numbers.shape[1]:
            raise BundleError(f"the delta changes '{name}', which this network lacks or has in another shape")
        changes[name] = left.matrix.T @ right.matrix
    with torch.no_grad():
        for name, change in changes.items():
            if name not in state or state[name].numel() != change.size:
                raise BundleError(f"the delta changes '{name}', which this network lacks or has in another shape")
            added = torch.from_numpy(change.astype(np.float64)).reshape(state[name].shape)
            state[name].copy_((state[name].double() + added).to(state[name].dtype))
    network.load_state_dict(state)
    return network.eval()


def read_delta(path: str | Path) -> Delta:
    """Read a delta from its file.

    Raises:
        BundleError: no delta, a damaged one, or one of a later version.
    """
    return delta_from_bytes(read_bytes(Path(path), MOST_BYTES, error=BundleError), f"'{path}'")


def delta_from_bytes(data: bytes, where: str) -> Delta:
    """Parse a delta from the bytes of its file; `where` names it in messages."""
    try:
        arrays = load(data)
        text = arrays.pop(HEADER).tobytes().decode()
    except (SafetensorError, KeyError, ValueError) as error:
        raise BundleError(f"{where} is no delta of a network, or is damaged; copy it again") from error
    head = object_with(parse_json(text, where, BundleError), ("schema",), where, BundleError)
    if head["schema"] != SCHEMA:
        raise BundleError(f"{where} is a delta of schema {head['schema']}, {SCHEMA} is read here: update EDP")
    object_with(head, ("base", "facts", "shapes", "hash"), where, BundleError)
    if head["hash"] != _hash(arrays) or not isinstance(head["facts"], dict) or not isinstance(head["shapes"], dict):
        raise BundleError(f"{where} is damaged: its numbers do not have the hash in its header; copy it again")
    matrices = _matrices(arrays, head["shapes"], where)
    whole, lefts, rights = ({name[2:]: m for name, m in matrices.items() if name[:2] == k} for k in ("w:", "l:", "r:"))
    vectors = {name[2:]: values for name, values in arrays.items() if name.startswith("v:")}
    if {name: len(m.scales) for name, m in lefts.items()} != {name: len(m.scales) for name, m in rights.items()}:
        raise BundleError(f"{where} is damaged: it has factors that do not fit together; copy it again")
    narrow = {name: (lefts[name], rights[name]) for name in lefts}
    return Delta(str(head["base"]), head["facts"], vectors, whole, narrow)


def _matrices(arrays: Mapping[str, NDArray[Any]], shapes: Mapping[str, object], where: str) -> dict[str, Scaled]:
    """Return the matrices by name, such as ``w:encoder.weight``, after a check of all arrays."""
    rules = {name: ArrayRule(values.shape, np.float32) for name, values in arrays.items() if name.startswith("v:")}
    for name, shape in shapes.items():
        if not isinstance(shape, list) or len(shape) != 2 or not all(type(one) is int for one in shape):
            raise BundleError(f"{where} is damaged: '{name}' lacks its shape")
        columns, bits = shape
        if not (0 < columns <= MOST_BYTES and MIN_BITS <= bits <= MAX_BITS):
            raise BundleError(f"{where} is damaged: '{name}' has {columns} columns of {bits} bits")
        scales = name.replace(":", "s:", 1)
        rows = len(arrays.get(scales, ()))
        rules[scales] = ArrayRule((rows,), np.float32, is_exact=True)
        rules[name] = ArrayRule((-(-rows * columns * bits // 8),), np.uint8, is_exact=True)
    try:
        checked = checked_arrays(arrays, rules, where)
    except ValueError as error:
        raise BundleError(f"{error}; the delta is damaged: copy it again") from error
    return {
        name: Scaled.unpacked(checked[name], checked[name.replace(":", "s:", 1)], *shape)  # type: ignore[misc]
        for name, shape in shapes.items()
    }


def _hash(arrays: Mapping[str, NDArray[Any]]) -> str:
    state = hashlib.blake2b(digest_size=16)
    for name in sorted(arrays):
        values = arrays[name]
        state.update(f"{name} {values.dtype} {values.shape}\0".encode() + np.ascontiguousarray(values).tobytes())
    return state.hexdigest()
