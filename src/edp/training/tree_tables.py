"""Fitted boosted trees as complete trees of one depth: the tables of `edp.networks.trees.Trees`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from edp.ir.layers import NEVER

if TYPE_CHECKING:
    from sklearn.ensemble import HistGradientBoostingRegressor

_Number = TypeVar("_Number", bound=np.generic)
Tables = tuple[NDArray[np.int64], NDArray[np.float32], NDArray[np.float32]]
"""Features and thresholds ``(tree, 2^depth - 1)``, leaves ``(tree, 2^depth)``."""


def complete_tables(model: HistGradientBoostingRegressor, depth: int) -> Tables:
    """Return the trees of a fitted model, each extended to a common depth.

    Sums of the trees are the model's predictions for inputs in single precision, up to the rounding of the leaves:
    every comparison turns out as in the model. What the model predicts without trees is part of the first tree's
    leaves.

    Args:
        model: fitted on numbers, without categories.
        depth: depth of the complete trees, at least that of the model.

    Raises:
        ValueError: a tree is deeper, splits by categories, or holds a number beyond single precision.
    """
    # Private names of scikit-learn: it has no public way to the nodes of these trees.
    grown = [one_output[0].nodes for one_output in model._predictors]
    feature = np.zeros((len(grown), 2**depth - 1), dtype=np.int64)
    threshold = np.full(feature.shape, NEVER, dtype=np.float32)
    leaf = np.zeros((len(grown), 2**depth))
    for tree, nodes in enumerate(grown):
        _fill(nodes, depth, feature[tree], threshold[tree], leaf[tree])
    leaf[0] += float(np.ravel(model._baseline_prediction)[0])
    if not np.abs(leaf).max() <= NEVER:
        raise ValueError("a leaf of the trees is beyond single precision; scale the targets")
    return feature, threshold, leaf.astype(np.float32)


def stack_tables(tables: Sequence[Tables], trees: int) -> Tables:
    """Return the tables of several outputs, ``(output, tree, ...)``; missing trees give zero.

    Args:
        tables: tables of each output, with equal depth.
        trees: number of trees of each output, at least the largest number of any output.

    Raises:
        ValueError: one of them has more.
    """
    most = max(len(feature) for feature, _, _ in tables)
    if most > trees:
        raise ValueError(f"an output has {most} trees; at most {trees} must hold")
    feature, threshold, leaf = zip(*tables, strict=True)
    return _stack_rows(feature, trees, 0), _stack_rows(threshold, trees, NEVER), _stack_rows(leaf, trees, 0.0)


def _stack_rows(rows: Sequence[NDArray[_Number]], trees: int, fill: float) -> NDArray[_Number]:
    """Return the rows of each output ``(output, tree, ...)``, with rows of `fill` where it has fewer."""
    full = np.full((len(rows), trees, rows[0].shape[1]), fill, dtype=rows[0].dtype)
    for target, own in zip(full, rows, strict=True):
        target[: len(own)] = own
    return full


def round_down_to_single(threshold: float) -> np.float32:
    """Return the single-precision number t with ``x > t`` exactly where ``x > threshold``, for all single-precision x.

    Raises:
        ValueError: there is none that is finite.
    """
    if threshold >= NEVER:
        return np.float32(NEVER)
    if not threshold >= -NEVER:
        raise ValueError(f"a threshold of the trees is {threshold}, which single precision does not hold")
    nearest = np.float32(threshold)
    # Rounded up, numbers between the two thresholds would go to the other side.
    return nearest if float(nearest) <= threshold else np.nextafter(nearest, np.float32(-np.inf))


def _fill(nodes: Any, depth: int, feature: Any, threshold: Any, leaf: Any) -> None:
    """Put one tree into its rows of the tables."""
    waiting = [(0, 0, 0)]  # node of the model, place in the complete tree, level
    while waiting:
        number, at, level = waiting.pop()
        node = nodes[number]
        if node["is_leaf"]:
            # The leaf fills all places below it, so that no comparison on the way matters.
            wide = 2 ** (depth - level)
            first = (at + 1) * wide - 2**depth
            leaf[first : first + wide] = node["value"]
            continue
        if level == depth:
            raise ValueError(f"a tree is deeper than {depth}; grow trees with max_depth = {depth}, or take more")
        if node["is_categorical"]:
            raise ValueError("a tree splits by categories; fit trees on numbers alone")
        feature[at], threshold[at] = node["feature_idx"], round_down_to_single(float(node["num_threshold"]))
        waiting += [(int(node["left"]), 2 * at + 1, level + 1), (int(node["right"]), 2 * at + 2, level + 1)]
