"""Evaluation of complete regression trees for any number of rows."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from edp.ir.base import Indices


def depth_of(leaves: int) -> int:
    """Return the depth of a complete binary tree with the given number of leaves."""
    return leaves.bit_length() - 1


def find_leaves(feature: Indices, threshold: NDArray[Any], leaf: NDArray[Any], x: NDArray[Any]) -> NDArray[Any]:
    """Return the leaf that an input row reaches in each tree of `edp.ir.layers.TreeSums`.

    Args:
        feature: ``(output, tree, node)``.
        threshold: thresholds, same shape. They are compared without conversion, so `x` must have the same number type.
        leaf: ``(output, tree, leaf)``.
        x: ``(..., input)``.

    Returns:
        ``(..., output, tree)``.
    """
    outputs, trees, nodes = feature.shape
    root = nodes * np.arange(outputs * trees).reshape(outputs, trees)
    at = np.zeros((*x.shape[:-1], outputs, trees), dtype=np.int64)
    for _ in range(depth_of(nodes + 1)):
        columns = feature.ravel()[root + at]
        values = np.take_along_axis(x, columns.reshape(*x.shape[:-1], -1).astype(np.int64), -1).reshape(columns.shape)
        at = 2 * at + 1 + (values > threshold.ravel()[root + at])
    first = (nodes + 1) * np.arange(outputs * trees).reshape(outputs, trees)
    return np.asarray(leaf.ravel()[first + at - nodes])


def summed(leaves: NDArray[Any]) -> NDArray[Any]:
    """Return sums over the last axis, added sequentially from zero like a loop in C."""
    # NumPy's own sum adds in pairs, which gives other bits; plus nought makes +0 of a sum of -0.
    return np.asarray(np.add.accumulate(leaves, axis=-1)[..., -1] + leaves.dtype.type(0))
