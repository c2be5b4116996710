"""Stateless layers: reordering, element-wise operations, linear maps and norms.

A value is a flat vector; where a layer has `rows`, it is that many rows of equal length, one after the other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from edp.ir.base import Array, Indices, Layer, LayerRun, Values
from edp.ir.descent import depth_of, find_leaves, summed

LEAST = float(np.finfo(np.float32).tiny)
"""Smallest positive normal number of single precision."""


def split(x: Values, rows: int) -> Values:
    """Split the last dimension into the given number of rows."""
    return x.reshape(*x.shape[:-1], rows, -1)


def flat(x: Values) -> Values:
    """Merge the last two dimensions."""
    return x.reshape(*x.shape[:-2], -1)


class Function(StrEnum):
    """Element-wise functions."""

    RELU = "relu"
    SIGMOID = "sigmoid"
    TANH = "tanh"
    GELU = "gelu"
    SOFTPLUS = "softplus"
    EXP = "exp"
    SQRT = "sqrt"
    SINE = "sine"
    COSINE = "cosine"
    LOG = "log"
    """Natural logarithm. Arguments below the smallest normal number of single precision are replaced by this number."""
    POSITIVE = "positive"
    """Step function: 1 for positive numbers, else 0."""


class BinaryOperation(StrEnum):
    """Operation on two values, the first operand first."""

    ADD = "add"
    SUBTRACT = "subtract"
    MULTIPLY = "multiply"
    DIVIDE = "divide"
    MINIMUM = "minimum"
    MAXIMUM = "maximum"


@dataclass(frozen=True, eq=False, kw_only=True)
class Gather(Layer):
    """Selected elements of the concatenated inputs: selects, joins, repeats and transposes."""

    bit_exact = True

    columns: tuple[int, ...]

    @property
    def width(self) -> int:
        return len(self.columns)

    def over_time(self, run: LayerRun, *inputs: Values) -> Values:
        return np.concatenate(inputs, axis=-1)[..., list(self.columns)]


def runs(columns: Sequence[int], widths: Sequence[int]) -> list[tuple[int, int, int]]:
    """Return runs of neighbouring columns of concatenated inputs: input, first column, number of columns."""
    # A run becomes one copy in C and one split in ONNX; single columns would be a table.
    origin = [(which, column) for which, width in enumerate(widths) for column in range(width)]
    column_runs: list[tuple[int, int, int]] = []
    for column in columns:
        which, at = origin[column]
        if column_runs and column_runs[-1][0] == which and sum(column_runs[-1][1:]) == at:
            column_runs[-1] = (which, column_runs[-1][1], column_runs[-1][2] + 1)
        else:
            column_runs.append((which, at, 1))
    return column_runs


@dataclass(frozen=True, eq=False, kw_only=True)
class Standardise(Layer):
    """``(x - offset) / scale``, in this order: offsets may be large."""

    bit_exact = True

    offset: Array
    scale: Array

    @property
    def width(self) -> int:
        return len(self.offset)

    def over_time(self, run: LayerRun, x: Values) -> Values:
        return np.asarray((x - run.constants["offset"]) / run.constants["scale"])


@dataclass(frozen=True, eq=False, kw_only=True)
class ScaleShift(Layer):
    """``gain x + shift``, each ``(width,)``."""

    bit_exact = True

    gain: Array
    shift: Array

    @property
    def width(self) -> int:
        return len(self.gain)

    def over_time(self, run: LayerRun, x: Values) -> Values:
        return np.asarray(run.constants["gain"] * x + run.constants["shift"])


@dataclass(frozen=True, eq=False, kw_only=True)
class Clip(Layer):
    """Each number, but no less than its own of `low` and no more than its own of `high`, each ``(width,)``."""

    bit_exact = True
    stays_float = True

    low: Array
    high: Array

    @property
    def width(self) -> int:
        return len(self.low)

    def over_time(self, run: LayerRun, x: Values) -> Values:
        below = run.arithmetic.combine(BinaryOperation.MINIMUM, x, run.constants["high"])
        return run.arithmetic.combine(BinaryOperation.MAXIMUM, below, run.constants["low"])


@dataclass(frozen=True, eq=False, kw_only=True)
class Elementwise(Layer):
    """Element-wise operation on two values of `size` elements."""

    bit_exact = True

    operation: BinaryOperation
    size: int

    @property
    def kind(self) -> str:
        return self.operation.capitalize()

    def options(self) -> dict[str, object]:
        # `kind` says which operation it is.
        return {name: value for name, value in super().options().items() if name != "operation"}

    @property
    def width(self) -> int:
        return self.size

    def over_time(self, run: LayerRun, a: Values, b: Values) -> Values:
        return run.arithmetic.combine(self.operation, a, b)


@dataclass(frozen=True, eq=False, kw_only=True)
class Activate(Layer):
    """A function of each number."""

    bit_exact = True

    function: Function
    size: int

    @property
    def width(self) -> int:
        return self.size

    @property
    def tangent_scratch(self) -> int:
        return self.size

    def over_time(self, run: LayerRun, x: Values) -> Values:
        return run.arithmetic.apply(self.function, x)


@dataclass(frozen=True, eq=False, kw_only=True)
class Glu(Layer):
    """First half of each row times the sigmoid of its second half; a row of `size` elements gives ``size / 2``."""

    bit_exact = True

    rows: int
    size: int

    @property
    def width(self) -> int:
        return self.rows * self.size // 2

    def over_time(self, run: LayerRun, x: Values) -> Values:
        halves = x.reshape(*x.shape[:-1], self.rows, 2, -1)
        return flat(halves[..., 0, :] * run.arithmetic.apply(Function.SIGMOID, halves[..., 1, :]))


@dataclass(frozen=True, eq=False, kw_only=True)
class Accumulate(Layer):
    """Cumulative sums over `rows` rows of `size` elements: row i is the sum of rows 0 to i."""

    bit_exact = True
    stays_float = True

    rows: int
    size: int

    @property
    def width(self) -> int:
        return self.rows * self.size

    def over_time(self, run: LayerRun, x: Values) -> Values:
        return flat(np.add.accumulate(split(x, self.rows), axis=-2))


@dataclass(frozen=True, eq=False, kw_only=True)
class Dense(Layer):
    """``W x + b`` on each row; `weight` ``(out, in)``, `bias` ``(out,)``, zeros if the network has no bias."""

    matrices = ("weight",)

    weight: Array
    bias: Array
    rows: int = 1

    @property
    def width(self) -> int:
        return self.rows * len(self.bias)

    @property
    def macs(self) -> int:
        return self.rows * self.weight.size

    def over_time(self, run: LayerRun, x: Values) -> Values:
        return flat(split(x, self.rows) @ run.constants["weight"].T + run.constants["bias"])

    def products(self, x: Values, y: Values) -> dict[str, Values]:
        return {self.name: split(x, self.rows)}


@dataclass(frozen=True, eq=False, kw_only=True)
class GroupedDense(Layer):
    """``W_i x_i + b_i``, row i with its own `weight` ``(rows, out, in)`` and `bias` ``(rows, out)``."""

    matrices = ("weight",)

    weight: Array
    bias: Array

    @property
    def width(self) -> int:
        return self.bias.size

    @property
    def macs(self) -> int:
        return self.weight.size

    def over_time(self, run: LayerRun, x: Values) -> Values:
        rows = split(x, len(self.bias))
        return flat(np.einsum("roi,...ri->...ro", run.constants["weight"], rows) + run.constants["bias"])

    def products(self, x: Values, y: Values) -> dict[str, Values]:
        return {self.name: split(x, len(self.bias))}


@dataclass(frozen=True, eq=False, kw_only=True)
class TreeSums(Layer):
    """Sums of regression trees, each a complete binary tree of depth D (Breiman et al., 1984).

    Output o is the sum of ``leaf[o, t, i - (2^D - 1)]`` over its trees t, the first one first. Node i is reached from
    node 0 by D steps ``i = 2 i + 1 + (x[feature[o, t, i]] > threshold[o, t, i])``, compared in single precision. A node
    that does not split has `NEVER` as its threshold. A sample takes ``outputs trees D`` comparisons for any input, and
    no multiplication.

    Attributes:
        feature: numbers of the input, ``(output, tree, 2^D - 1)``, uint16.
        threshold: ``(output, tree, 2^D - 1)``.
        leaf: ``(output, tree, 2^D)``.
    """

    bit_exact = True

    feature: Indices
    threshold: Array
    leaf: Array

    @property
    def width(self) -> int:
        return len(self.leaf)

    @property
    def depth(self) -> int:
        """Comparisons from the root to a leaf."""
        return depth_of(self.leaf.shape[2])

    def over_time(self, run: LayerRun, x: Values) -> Values:
        return summed(find_leaves(self.feature, run.constants["threshold"], run.constants["leaf"], x))


NEVER = float(np.finfo(np.float32).max)
"""Threshold that no number of single precision exceeds. It is finite, so that every target language can write it."""


@dataclass(frozen=True, eq=False, kw_only=True)
class LayerNorm(Layer):
    """Each row less its mean, over the root of its variance plus `epsilon`, times `gain` plus `shift`."""

    bit_exact = True
    stays_float = True

    gain: Array
    shift: Array
    epsilon: float
    rows: int = 1

    @property
    def width(self) -> int:
        return self.rows * len(self.gain)

    def over_time(self, run: LayerRun, x: Values) -> Values:
        rows = run.arithmetic.normed(split(x, self.rows), self.epsilon)
        return flat(rows * run.constants["gain"] + run.constants["shift"])


@dataclass(frozen=True, eq=False, kw_only=True)
class RowAttention(Layer):
    """Each row of queries attends to all rows of keys and values (the three inputs), one head."""

    bit_exact = True
    stays_float = True

    rows: int
    size: int

    @property
    def width(self) -> int:
        return self.rows * self.size

    @property
    def macs(self) -> int:
        return 2 * self.rows * self.rows * self.size

    @property
    def scratch(self) -> int:
        return self.rows

    def over_time(self, run: LayerRun, *inputs: Values) -> Values:
        q, k, v = (split(x, self.rows) for x in inputs)
        scores = run.arithmetic.total(q[..., :, None, :] * k[..., None, :, :]) / np.sqrt(q.dtype.type(self.size))
        weights = run.arithmetic.softmax(scores)
        return flat(run.arithmetic.total(weights[..., None] * v[..., None, :, :], axis=-2))
