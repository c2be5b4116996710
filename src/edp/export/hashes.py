"""Content addresses of a network and of its scaling, as every exported form names them."""

from __future__ import annotations

import hashlib
from typing import Any

from numpy.typing import NDArray

from edp.ir import Graph
from edp.networks.predictor import Predictor


def model_hash(graph: Graph) -> str:
    """Return content address of layers, options and constants."""
    state = hashlib.blake2b(digest_size=16)
    for layer in graph.layers:
        # Arrays are hashed by their bytes, everything else by its text: `repr` of an array is cut off.
        state.update(repr((layer.kind, layer.options())).encode())
        for name, values in layer.tensors().items():
            state.update(repr((name, values.shape)).encode() + little_endian(values))
    for key, values in graph.initial.items():
        state.update(repr(key).encode() + little_endian(values))
    return state.hexdigest()


def scale_hash(predictor: Predictor) -> str:
    """Return the content address of the scaling between SI units and network values."""
    state = hashlib.blake2b(digest_size=16)
    for part in (predictor.front.offset, predictor.front.width, predictor.code.offset, predictor.code.width):
        # Little-endian on every machine, so that hashes compare.
        state.update(part.detach().cpu().float().numpy().astype("<f4").tobytes())
    return state.hexdigest()


def little_endian(values: NDArray[Any]) -> bytes:
    """Return the bytes of the values in the byte order of hashes and checksums."""
    return values.astype(values.dtype.newbyteorder("<")).tobytes()
