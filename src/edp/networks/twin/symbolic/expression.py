"""Scalar expressions and their derivatives.

Equal expressions are one object, so that common subexpressions are computed once. Derivatives come from reverse-mode
automatic differentiation (Griewank and Walther, Evaluating Derivatives, 2008).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

FUNCTIONS = ("sqrt", "exp", "tanh", "sin", "cos")


@dataclass(eq=False, slots=True)
class Expression:
    """One operation on other expressions.

    Attributes:
        graph: graph that owns the expression.
        index: position in the order of creation; the arguments of an expression have smaller indices.
        operation: ``constant``, ``input``, ``+``, ``-``, ``*``, ``/``, ``less`` (four arguments: c if a < b, else d),
            or a name in `FUNCTIONS`.
        arguments: arguments of the operation.
        value: value of a constant.
    """

    graph: ExpressionGraph
    index: int
    operation: str
    arguments: tuple[Expression, ...] = ()
    value: float = 0.0

    def __add__(self, other: Any) -> Expression:
        return self.graph.add(self, self.graph.wrap(other))

    def __radd__(self, other: Any) -> Expression:
        return self.graph.add(self.graph.wrap(other), self)

    def __sub__(self, other: Any) -> Expression:
        return self.graph.subtract(self, self.graph.wrap(other))

    def __rsub__(self, other: Any) -> Expression:
        return self.graph.subtract(self.graph.wrap(other), self)

    def __mul__(self, other: Any) -> Expression:
        return self.graph.multiply(self, self.graph.wrap(other))

    def __rmul__(self, other: Any) -> Expression:
        return self.graph.multiply(self.graph.wrap(other), self)

    def __truediv__(self, other: Any) -> Expression:
        return self.graph.divide(self, self.graph.wrap(other))

    def __rtruediv__(self, other: Any) -> Expression:
        return self.graph.divide(self.graph.wrap(other), self)

    def __neg__(self) -> Expression:
        return self.graph.subtract(self.graph.wrap(0.0), self)


@dataclass(eq=False)
class ExpressionGraph:
    """Expressions of one set of equations.

    Attributes:
        nodes: all expressions; arguments come before the expressions that use them.
    """

    nodes: list[Expression] = field(default_factory=list)
    _known: dict[tuple[object, ...], Expression] = field(default_factory=dict)
    _slopes: dict[int, tuple[Expression, Expression]] = field(default_factory=dict)

    def _node(self, operation: str, *arguments: Expression, value: float = 0.0, key: object = None) -> Expression:
        identity = (operation, *(argument.index for argument in arguments), value, key)
        if identity not in self._known:
            node = Expression(self, len(self.nodes), operation, arguments, value)
            self.nodes.append(node)
            self._known[identity] = node
        return self._known[identity]

    def wrap(self, value: Expression | float) -> Expression:
        """Return `value` itself if it is an expression, else a constant expression."""
        return value if isinstance(value, Expression) else self._node("constant", value=float(value))

    def inputs(self, name: str, count: int) -> list[Expression]:
        """Return `count` input expressions."""
        return [self._node("input", key=(name, index)) for index in range(count)]

    def link(self, values: Sequence[Expression], argument: Expression) -> None:
        """Declare inputs as a function of `argument` and the successive derivatives of this function.

        The caller computes the inputs, for example by interpolation; `gradient` then applies the chain rule.
        """
        for value, slope in pairwise(values):
            self._slopes[value.index] = (argument, slope)

    def add(self, a: Expression, b: Expression) -> Expression:
        """Return a + b."""
        if a.operation == b.operation == "constant":
            return self.wrap(a.value + b.value)
        if _is(a, 0.0) or _is(b, 0.0):
            return b if _is(a, 0.0) else a
        return self._node("+", a, b)

    def subtract(self, a: Expression, b: Expression) -> Expression:
        """Return a - b."""
        if a.operation == b.operation == "constant":
            return self.wrap(a.value - b.value)
        return a if _is(b, 0.0) else self._node("-", a, b)

    def multiply(self, a: Expression, b: Expression) -> Expression:
        """Return a * b."""
        if a.operation == b.operation == "constant":
            return self.wrap(a.value * b.value)
        if _is(a, 0.0) or _is(b, 0.0):
            return self.wrap(0.0)
        if _is(a, 1.0) or _is(b, 1.0):
            return b if _is(a, 1.0) else a
        return self._node("*", a, b)

    def divide(self, a: Expression, b: Expression) -> Expression:
        """Return a / b."""
        if a.operation == b.operation == "constant":
            return self.wrap(a.value / b.value)
        if b.operation == "constant":
            return self.multiply(a, self.wrap(1.0 / b.value))
        # Quotients by one value share its reciprocal, and so do their derivatives.
        return self.multiply(a, self._node("/", self.wrap(1.0), b))

    def less(self, a: Any, b: Any, then: Any, otherwise: Any) -> Expression:
        """Return `then` if a < b, else `otherwise`; NaN compares as false."""
        chosen = self.wrap(then), self.wrap(otherwise)
        return chosen[0] if chosen[0] is chosen[1] else self._node("less", self.wrap(a), self.wrap(b), *chosen)

    def least(self, a: Any, b: Any) -> Expression:
        """Return the smaller of two expressions."""
        return self.less(a, b, a, b)

    def largest(self, a: Any, b: Any) -> Expression:
        """Return the larger of two expressions."""
        return self.less(a, b, b, a)

    def absolute(self, a: Any) -> Expression:
        """Return |a|."""
        return self.less(a, 0.0, -a, a)

    def function(self, name: str, a: Any) -> Expression:
        """Apply a function of `FUNCTIONS` to an expression."""
        argument = self.wrap(a)
        if argument.operation == "constant":
            return self.wrap(getattr(math, name)(argument.value))
        return self._node(name, argument)

    def gradient(self, result: Expression) -> dict[int, Expression]:
        """Return the derivatives of an expression by its subexpressions, by their index; zeros are omitted."""
        adjoint: dict[int, Expression] = {result.index: self.wrap(1.0)}
        for node in self._below([result]):
            weight = adjoint.get(node.index)
            if weight is None:
                continue
            for argument, along in self._shares(node, weight):
                if not _is(along, 0.0):
                    before = adjoint.get(argument.index)
                    adjoint[argument.index] = along if before is None else before + along
        return adjoint

    def jacobian(
        self, results: Sequence[Expression], variables: Sequence[Expression]
    ) -> dict[tuple[int, int], Expression]:
        """Return the derivatives that are not identically zero, by the positions of result and variable."""
        entries = {}
        for row, result in enumerate(results):
            slopes = self.gradient(result)
            for column, variable in enumerate(variables):
                if variable.index in slopes:
                    entries[row, column] = slopes[variable.index]
        return entries

    def needed(self, results: Iterable[Expression]) -> list[Expression]:
        """Return the subexpressions of `results`; arguments come before the expressions that use them."""
        return self._below(results)[::-1]

    def _below(self, results: Iterable[Expression]) -> list[Expression]:
        seen = {node.index for node in results}
        waiting = list(seen)
        while waiting:
            for argument in self._dependencies(self.nodes[waiting.pop()]):
                if argument.index not in seen:
                    seen.add(argument.index)
                    waiting.append(argument.index)
        return [self.nodes[index] for index in sorted(seen, reverse=True)]

    def _dependencies(self, node: Expression) -> tuple[Expression, ...]:
        linked = self._slopes.get(node.index)
        return node.arguments if linked is None else (linked[0],)

    def _shares(self, node: Expression, weight: Expression) -> list[tuple[Expression, Expression]]:
        """Return the arguments of a node, each with `weight` times the derivative of the node by that argument."""
        if node.index in self._slopes:
            argument, slope = self._slopes[node.index]
            return [(argument, weight * slope)]
        if node.operation in ("constant", "input"):
            return []
        if node.operation == "less":
            a, b, then, otherwise = node.arguments
            return [(then, self.less(a, b, weight, 0.0)), (otherwise, self.less(a, b, 0.0, weight))]
        if node.operation in ("+", "-"):
            a, b = node.arguments
            return [(a, weight), (b, weight if node.operation == "+" else -weight)]
        if node.operation == "*":
            a, b = node.arguments
            return [(a, weight * b), (b, weight * a)]
        if node.operation == "/":
            return [(node.arguments[1], -(weight * (node * node)))]
        (a,) = node.arguments
        return [(a, weight * self._slope_of_function(node, a))]

    def _slope_of_function(self, node: Expression, a: Expression) -> Expression:
        if node.operation == "sqrt":
            return 0.5 / node
        if node.operation == "exp":
            return node
        if node.operation == "tanh":
            return 1.0 - node * node
        return self.function("cos", a) if node.operation == "sin" else -self.function("sin", a)


def _is(node: Expression, value: float) -> bool:
    return node.operation == "constant" and node.value == value
