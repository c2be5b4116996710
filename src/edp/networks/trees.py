"""Complete regression trees as a part of a network: fitted elsewhere, evaluated in constant time."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from edp.ir import Builder
from edp.ir import layers as ir
from edp.ir.builder import indices
from edp.networks.streaming import Cost, State, Streaming

MAX_TREES = 2000
"""Maximum number of trees per predicted value. Boosting with a learning rate of 0.05 stops far below this number."""
MAX_DEPTH = 8
"""Maximum depth of a tree. A tree of this depth has 256 leaves and 768 parameters, 2.5 KB of flash."""
BLOCK = 2**20
"""Maximum number of tree nodes evaluated at a time, over all rows: 16 MB in single precision."""


class Trees(Streaming):
    """Sums of complete regression trees, ``(batch, time, width)`` to ``(batch, time, outputs)``; no memory.

    The equations are in `edp.ir.layers.TreeSums`. The tables are not trainable parameters, and no gradient passes
    through them, since a sum of trees is constant between thresholds. Near a threshold, double precision can select
    another branch than single precision, which exported code uses.

    Args:
        width: number of input columns.
        outputs: number of sums.
        trees: number of trees per sum.
        depth: comparisons from the root to a leaf.

    Attributes:
        feature: ``(output, tree, 2^depth - 1)``, int64.
        threshold: thresholds, same shape; initially no node splits.
        leaf: ``(output, tree, 2^depth)``, at first zeros.
    """

    feature: Tensor
    threshold: Tensor
    leaf: Tensor

    def __init__(self, width: int, outputs: int, trees: int, depth: int) -> None:
        super().__init__()
        self.width, self.outputs, self.trees, self.depth = width, outputs, trees, depth
        self.register_buffer("feature", torch.zeros(outputs, trees, 2**depth - 1, dtype=torch.int64))
        self.register_buffer("threshold", torch.full((outputs, trees, 2**depth - 1), ir.NEVER))
        self.register_buffer("leaf", torch.zeros(outputs, trees, 2**depth))
        # A table from a file could name a column that is not there: it must not get as far as a prediction.
        self.register_load_state_dict_post_hook(_check_loaded)  # type: ignore[no-untyped-call]

    def set_tables(self, feature: Any, threshold: Any, leaf: Any) -> None:
        """Take over fitted tables; see `edp.training.tree_tables`.

        Args:
            feature: column indices from 0 to ``width - 1``, ``(output, tree, 2^depth - 1)``.
            threshold: finite thresholds in single precision, same shape; `edp.ir.layers.NEVER` if a node does not
                split.
            leaf: finite in single precision, ``(output, tree, 2^depth)``.

        Raises:
            ValueError: another shape, a column that is not there, or a number that is not finite.
        """
        tables = {
            name: torch.as_tensor(np.asarray(values))
            for name, values in (("feature", feature), ("threshold", threshold), ("leaf", leaf))
        }
        if tables["feature"].is_floating_point():
            raise ValueError("trees: the features are real numbers; columns are integers")
        tables = {name: values.to(getattr(self, name)) for name, values in tables.items()}
        _check(self, tables)
        for name, values in tables.items():
            getattr(self, name).copy_(values)

    def initial_state(self, batch: int, like: Tensor) -> State:
        return ()

    def forward(self, x: Tensor, state: State) -> tuple[Tensor, State]:
        rows = x.reshape(-1, self.width)
        # Each row by itself: the size of a block changes no number of a row.
        most = max(1, BLOCK // (self.outputs * self.trees))
        sums = [self._sums(part) for part in rows.split(most)]
        return torch.cat(sums).view(*x.shape[:-1], self.outputs), state

    def _sums(self, rows: Tensor) -> Tensor:
        """Return ``(row, output)``."""
        nodes, count = 2**self.depth - 1, self.outputs * self.trees
        tree = torch.arange(count, device=rows.device)
        feature, threshold, leaf = (table.flatten() for table in (self.feature, self.threshold, self.leaf))
        at = torch.zeros(len(rows), count, dtype=torch.int64, device=rows.device)
        for _ in range(self.depth):
            node = tree * nodes + at
            at = 2 * at + 1 + (rows.gather(1, feature[node]) > threshold[node])
        return leaf[tree * (nodes + 1) + at - nodes].view(len(rows), self.outputs, self.trees).sum(dim=2)

    def lower(self, build: Builder, x: str) -> str:
        tables = {"feature": indices(self.feature), "threshold": self.threshold, "leaf": self.leaf}
        return build.add(ir.TreeSums, "sums", x, **tables)

    def costs(self) -> list[Cost]:
        """Return the costs: comparisons only, without multiply-accumulates and trained parameters."""
        return [
            Cost(
                f"{self.trees} trees of depth {self.depth} for each of {self.outputs} outputs",
                0,
                width_in=self.width,
                width_out=self.outputs,
                per_time_step=False,
                tree_steps=self.outputs * self.trees * (self.depth + 1),
            )
        ]


def _check_loaded(module: Any, incompatible_keys: object) -> None:
    _check(module, {name: getattr(module, name) for name in ("feature", "threshold", "leaf")})


def _check(trees: Trees, tables: dict[str, Tensor]) -> None:
    """Raise an error for tables that do not match these trees.

    Raises:
        ValueError: says which and why.
    """
    for name, values in tables.items():
        shape = tuple(getattr(trees, name).shape)
        if tuple(values.shape) != shape:
            raise ValueError(f"trees: the table '{name}' is {tuple(values.shape)}; {shape} must hold")
        if not torch.isfinite(values).all():
            raise ValueError(f"trees: the table '{name}' holds a number that is not finite")
    feature = tables["feature"]
    outside = feature[(feature < 0) | (feature >= trees.width)]
    if len(outside):
        raise ValueError(f"trees: a node reads column {int(outside[0])}; 0 to {trees.width - 1} must hold")
