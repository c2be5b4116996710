"""Equations written with torch, recorded as streaming layers: the physics bases are written once, for both."""

from __future__ import annotations

import operator
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from edp.errors import ExportError
from edp.ir import Builder
from edp.ir.layers import Activate, BinaryOperation, Function, ScaleShift, Standardise


class Symbol:
    """Symbolic values of one sample; operations on them are added to a graph.

    It stands where equations expect a tensor ``(batch, time, ...)``, without batch and time. Comparisons give 1 or 0.

    Args:
        build: builder of the layer graph.
        value: name of the value in the graph.
        shape: shape of the values; the last dimension is contiguous.
    """

    def __init__(self, build: Builder, value: str, shape: tuple[int, ...]) -> None:
        self.build, self.value, self.shape = build, value, shape
        self.dtype = torch.float32
        self._factors: tuple[str, np.ndarray] | None = None

    @classmethod
    def __torch_function__(cls, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Handle torch functions and operators with a tensor on the left; called by torch."""
        name = function.__name__.strip("_")
        if name not in FUNCTIONS:
            raise ExportError(f"torch's {name} has no form as layers; write the equation with {', '.join(FUNCTIONS)}")
        return FUNCTIONS[name](*args, **(kwargs or {}))

    def layer(self, kind: type, name: str, *inputs: str, shape: tuple[int, ...], **options: Any) -> Symbol:
        """Add a layer and return its value."""
        return Symbol(self.build, self.build.add(kind, name, *inputs, **options), shape)

    def spread(self, shape: tuple[int, ...]) -> Symbol:
        """Broadcast the elements to a shape."""
        if shape == self.shape:
            return self
        size = int(np.prod(self.shape))
        columns = np.broadcast_to(np.arange(size).reshape(self.shape), shape).ravel().tolist()
        return Symbol(self.build, self.build.pick("repeated", self.value, columns), shape)

    def activate(self, function: Function) -> Symbol:
        """Apply a function to each element."""
        size = int(np.prod(self.shape))
        return self.layer(Activate, str(function), self.value, shape=self.shape, function=function, size=size)

    def affine(self, gain: Any, shift: Any) -> Symbol:
        """Return ``gain x + shift``, each a number or an array of the same shape."""
        gain, shift = (np.broadcast_to(np.asarray(part, np.float32), self.shape).ravel() for part in (gain, shift))
        value = self.value
        if self._factors is not None and (np.abs(gain) == 1).all():
            # A product to which something is added, or whose sign is turned, is one layer; it rounds alike.
            value, gain = self._factors[0], self._factors[1] * gain
        scaled = self.layer(ScaleShift, "scaled", value, shape=self.shape, gain=gain, shift=shift)
        if not shift.any():
            scaled._factors = value, gain
        return scaled

    def __getitem__(self, key: Any) -> Symbol:
        if not (isinstance(key, tuple) and len(key) == 2 and key[0] is Ellipsis):
            raise ExportError("only the last dimension of a value can be chosen from: x[..., columns]")
        # Places are chosen by NumPy on an array of indices, so that its indexing rules hold without being written
        # again.
        places = np.arange(int(np.prod(self.shape))).reshape(self.shape)[..., key[1]]
        picked = self.build.pick("picked", self.value, places.ravel().tolist())
        return Symbol(self.build, picked, places.shape)

    def unbind(self, dim: int) -> list[Symbol]:
        """Return the elements of the last dimension."""
        return [self[..., i] for i in range(self.shape[-1])]

    def unsqueeze(self, dim: int) -> Symbol:
        """Insert a dimension of length 1."""
        at = dim + len(self.shape) + 1
        return Symbol(self.build, self.value, (*self.shape[:at], 1, *self.shape[at:]))

    def expand(self, *shape: int) -> Symbol:
        """Repeat the symbol along dimensions of length 1."""
        return self.spread(shape)

    def to(self, dtype: object) -> Symbol:
        """Return the value unchanged, since there is only one type."""
        return self

    def square(self) -> Symbol:
        """Return each number times itself."""
        return multiply(self, self)

    def abs(self) -> Symbol:
        """Return the absolute value."""
        return maximum(self, -self)

    def __neg__(self) -> Symbol:
        return self.affine(-1.0, 0.0)

    def __add__(self, other: Any) -> Symbol:
        return add(self, other)

    def __radd__(self, other: Any) -> Symbol:
        return add(self, other)

    def __sub__(self, other: Any) -> Symbol:
        return subtract(self, other)

    def __rsub__(self, other: Any) -> Symbol:
        return subtract(other, self)

    def __mul__(self, other: Any) -> Symbol:
        return multiply(self, other)

    def __rmul__(self, other: Any) -> Symbol:
        return multiply(self, other)

    def __truediv__(self, other: Any) -> Symbol:
        return divide(self, other)

    def __rtruediv__(self, other: Any) -> Symbol:
        return divide(other, self)

    # Comparisons become numbers 0 and 1: a graph has no other type.
    def __lt__(self, other: Any) -> Symbol:
        return positive(subtract(other, self))

    def __gt__(self, other: Any) -> Symbol:
        return positive(subtract(self, other))

    def __and__(self, other: Symbol) -> Symbol:
        return multiply(self, other)

    def __or__(self, other: Symbol) -> Symbol:
        return maximum(self, other)


def _array(value: Any) -> np.ndarray:
    """Return the values that are constant when the graph is built."""
    return np.asarray(value.detach().cpu().numpy() if isinstance(value, Tensor) else value, dtype=np.float32)


def _both(operation: BinaryOperation, a: Symbol, b: Symbol) -> Symbol:
    shape = np.broadcast_shapes(a.shape, b.shape)
    a, b = a.spread(shape), b.spread(shape)
    return Symbol(a.build, a.build.combine(operation.value, operation, a.value, b.value), shape)


def _meet(a: Any, b: Any) -> tuple[Symbol, np.ndarray]:
    # Exactly one of the two is a value here; two values are handled by the callers.
    """Return the symbolic operand and the elements of the constant operand, in their common shape."""
    constant, value = (_array(b), a) if isinstance(a, Symbol) else (_array(a), b)
    shape = np.broadcast_shapes(value.shape, constant.shape)
    return value.spread(shape), np.broadcast_to(constant, shape)


def _constant(like: Symbol, numbers: np.ndarray) -> Symbol:
    """Return constants as a symbolic value; non-finite elements of `like` still propagate."""
    # Times zero keeps NaN: an invalid input must not turn into a valid constant.
    return like.affine(0.0, numbers)


def add(a: Any, b: Any) -> Symbol:
    """Add two operands; a constant is allowed."""
    if isinstance(a, Symbol) and isinstance(b, Symbol):
        return _both(BinaryOperation.ADD, a, b)
    value, constant = _meet(a, b)
    return value.affine(1.0, constant)


def subtract(a: Any, b: Any) -> Symbol:
    """Subtract two operands; a constant is allowed."""
    if isinstance(a, Symbol) and isinstance(b, Symbol):
        return _both(BinaryOperation.SUBTRACT, a, b)
    value, constant = _meet(a, b)
    return value.affine(1.0, -constant) if isinstance(a, Symbol) else value.affine(-1.0, constant)


def multiply(a: Any, b: Any) -> Symbol:
    """Multiply two operands; a constant is allowed."""
    if isinstance(a, Symbol) and isinstance(b, Symbol):
        return _both(BinaryOperation.MULTIPLY, a, b)
    value, constant = _meet(a, b)
    return value.affine(constant, 0.0)


def divide(a: Any, b: Any) -> Symbol:
    """Divide two operands; a constant is allowed."""
    if isinstance(a, Symbol) and isinstance(b, Symbol):
        return _both(BinaryOperation.DIVIDE, a, b)
    value, constant = _meet(a, b)
    if isinstance(b, Symbol):
        return _both(BinaryOperation.DIVIDE, _constant(value, constant), value)
    constant, zero = constant.ravel(), np.zeros(constant.size, np.float32)
    return value.layer(Standardise, "divided", value.value, shape=value.shape, offset=zero, scale=constant)


def maximum(a: Any, b: Any) -> Symbol:
    """Return the larger element of each pair; one operand may be constant."""
    return _extreme(BinaryOperation.MAXIMUM, a, b)


def _extreme(operation: BinaryOperation, a: Any, b: Any) -> Symbol:
    if isinstance(a, Symbol) and isinstance(b, Symbol):
        return _both(operation, a, b)
    value, constant = _meet(a, b)
    return _both(operation, value, _constant(value, constant))


def positive(a: Symbol) -> Symbol:
    """Return 1 where a number is above 0, else 0."""
    return a.activate(Function.POSITIVE)


def sign(a: Symbol) -> Symbol:
    """Return 1, 0 or -1."""
    return positive(a) - positive(-a)


def stack(parts: Sequence[Any], dim: int = 0) -> Symbol:
    """Stack single elements along the last dimension; some may be constant."""
    like = next(part for part in parts if isinstance(part, Symbol))
    symbols = [part if isinstance(part, Symbol) else _constant(like, _array(part)) for part in parts]
    return Symbol(like.build, like.build.join("stacked", *(part.value for part in symbols)), (len(symbols),))


FUNCTIONS: dict[str, Callable[..., Any]] = {
    "add": add,
    "sub": subtract,
    "mul": multiply,
    "div": divide,
    "truediv": divide,
    "radd": add,
    "rsub": lambda a, b: subtract(b, a),
    "rmul": multiply,
    "lt": operator.lt,
    "gt": operator.gt,
    "neg": operator.neg,
    "abs": lambda a: a.abs(),
    "square": lambda a: a.square(),
    "sign": sign,
    "sqrt": lambda a: a.activate(Function.SQRT),
    "exp": lambda a: a.activate(Function.EXP),
    "cos": lambda a: a.activate(Function.COSINE),
    "sin": lambda a: a.activate(Function.SINE),
    "clamp": lambda a, min: maximum(a, min),
    "maximum": maximum,
    "minimum": lambda a, b: _extreme(BinaryOperation.MINIMUM, a, b),
    # Known zeros need no layer.
    "zeros_like": lambda a: torch.zeros(a.shape),
    "stack": stack,
}
"""PyTorch functions by name, for recording equations as layers."""
