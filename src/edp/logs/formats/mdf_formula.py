"""Parser for formulas of MDF 4 (algebraic conversions). Text of a file is never evaluated as code.

Grammar, after ASAM MCD-2 MC: numbers, the raw value ``X`` (also ``X1``), ``+ - * /``, power (``^``, also ``**``),
signs, parentheses and the functions of `FUNCTIONS`, upper and lower case alike. Powers bind tighter than signs, and a
power of a power needs parentheses, since tools do not agree on its order. All arithmetic is float64: a result that is
too large is infinite at once. `log` is the natural logarithm, as in the tools that evaluate these formulas as C does;
`log10` the decimal one.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Values = NDArray[np.float64]

LONGEST = 4096
"""Maximum number of characters of a formula. Calibration tools write a few dozen."""
DEEPEST = 32
"""Maximum nesting depth of parentheses, functions and signs, which bounds the stack of the parser."""
MAX_TOKENS = 512
"""Maximum number of tokens of a formula. Each token takes at most one pass over the values."""
_TOKEN = re.compile(
    r"\s*(?:(?P<number>(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][-+]?[0-9]+)?)|(?P<name>[A-Za-z_][A-Za-z_0-9]*)"
    # Two stars before one: a power would otherwise be read as two products.
    r"|(?P<sign>\*\*|[-+*/^(),]))"
)
FUNCTIONS: Mapping[str, Callable[..., Any]] = {
    "abs": np.abs,
    "sqrt": np.sqrt,
    "exp": np.exp,
    "ln": np.log,
    "log": np.log,
    "log10": np.log10,
    "sin": np.sin,
    "cos": np.cos,
    "tan": np.tan,
    "asin": np.arcsin,
    "acos": np.arccos,
    "atan": np.arctan,
    "arcsin": np.arcsin,
    "arccos": np.arccos,
    "arctan": np.arctan,
    "sinh": np.sinh,
    "cosh": np.cosh,
    "tanh": np.tanh,
    "pow": np.power,
}
"""Functions of one argument, except `pow`."""
_TWO = frozenset({"pow"})


class FormulaError(ValueError):
    """Text that does not follow the formula grammar."""


@dataclass(frozen=True)
class Formula:
    """A formula in reverse Polish order, each step a number, ``X`` or an operation.

    Attributes:
        steps: steps in the order of evaluation.
    """

    steps: tuple[float | str, ...]

    @staticmethod
    def parse(text: str) -> Formula:
        """Read a formula.

        Raises:
            FormulaError: the text is not of the grammar, or longer or deeper than formulas may be.
        """
        if len(text) > LONGEST:
            raise FormulaError(f"it has {len(text)} characters, at most {LONGEST} are read")
        return Formula(tuple(_Parser(_tokens(text)).parse()))

    def __call__(self, raw: NDArray[Any]) -> Values:
        """Return the physical values of raw ones, float64 of the same shape.

        NaN and infinite where the formula has no value.
        """
        x = np.asarray(raw, dtype=np.float64)
        stack: list[Any] = []
        with np.errstate(all="ignore"):
            for step in self.steps:
                if isinstance(step, float):
                    # float64, not float: Python raises an error at overflow and at division by zero.
                    stack.append(np.float64(step))
                elif step == "x":
                    stack.append(x)
                elif step in _TWO_SIDED:
                    right, left = stack.pop(), stack.pop()
                    stack.append(_TWO_SIDED[step](left, right))
                else:
                    stack.append(_ONE_SIDED[step](stack.pop()))
        # A formula without X gives one number for all rows; copied, since a broadcast array cannot be written to.
        return np.array(np.broadcast_to(stack.pop(), x.shape), dtype=np.float64)


_TWO_SIDED: Mapping[str, Callable[[Any, Any], Any]] = {
    "+": np.add,
    "-": np.subtract,
    "*": np.multiply,
    "/": np.divide,
    "^": np.power,
    "pow": np.power,
}
_ONE_SIDED: Mapping[str, Callable[[Any], Any]] = {
    "negative": np.negative,
    **{name: function for name, function in FUNCTIONS.items() if name not in _TWO},
}


def _tokens(text: str) -> list[tuple[str, str]]:
    """Return the kind (number, name, sign) and text of each token."""
    tokens: list[tuple[str, str]] = []
    at = 0
    text = text.rstrip()
    while at < len(text):
        match = _TOKEN.match(text, at)
        if match is None or match.lastgroup is None:
            raise FormulaError(f"character {at + 1} begins neither a number, a name nor one of + - * / ^ ( )")
        tokens.append((match.lastgroup, match[match.lastgroup].lower()))
        if len(tokens) > MAX_TOKENS:
            raise FormulaError(f"it has more than {MAX_TOKENS} numbers, names and signs")
        at = match.end()
    if not tokens:
        raise FormulaError("it is empty")
    return tokens


class _Parser:
    """Recursive descent, a method a level of binding."""

    def __init__(self, tokens: list[tuple[str, str]]) -> None:
        self.tokens = tokens
        self.at = 0
        self.depth = 0
        self.steps: list[float | str] = []

    def parse(self) -> list[float | str]:
        self.sum()
        if self.at < len(self.tokens):
            raise FormulaError(f"'{self.tokens[self.at][1]}' follows a complete formula")
        return self.steps

    def next_is(self, *signs: str) -> str | None:
        """Consume and return the next token if it is among the given signs."""
        if self.at < len(self.tokens):
            kind, text = self.tokens[self.at]
            if kind == "sign" and text in signs:
                self.at += 1
                return text
        return None

    def sum(self) -> None:
        self.product()
        while sign := self.next_is("+", "-"):
            self.product()
            self.steps.append(sign)

    def product(self) -> None:
        self.signed()
        while sign := self.next_is("*", "/"):
            self.signed()
            self.steps.append(sign)

    def signed(self) -> None:
        """Parse a power with an optional sign; ``-X^2`` is ``-(X^2)``."""
        if sign := self.next_is("+", "-"):
            self.deeper()
            self.signed()
            self.depth -= 1
            if sign == "-":
                self.steps.append("negative")
            return
        self.atom()
        if self.next_is("^", "**"):
            self.exponent()
            self.steps.append("^")
            if self.next_is("^", "**"):
                raise FormulaError("it has a power of a power without parentheses")

    def exponent(self) -> None:
        if sign := self.next_is("+", "-"):
            self.deeper()
            self.exponent()
            self.depth -= 1
            if sign == "-":
                self.steps.append("negative")
            return
        self.atom()

    def atom(self) -> None:
        if self.at >= len(self.tokens):
            raise FormulaError("it ends where a number, X or a function must follow")
        kind, text = self.tokens[self.at]
        self.at += 1
        if kind == "number":
            self.steps.append(float(text))
        elif kind == "name" and text in ("x", "x1"):
            self.steps.append("x")
        elif kind == "name":
            self.function(text)
        elif text == "(":
            self.deeper()
            self.sum()
            self.close()
        else:
            raise FormulaError(f"'{text}' stands where a number, X or a function must stand")

    def function(self, name: str) -> None:
        if name not in FUNCTIONS:
            raise FormulaError(f"it names '{name[:40]}'; known are X and {', '.join(FUNCTIONS)}")
        if not self.next_is("("):
            raise FormulaError(f"'{name}' needs its argument in parentheses")
        self.deeper()
        self.sum()
        if name in _TWO:
            if not self.next_is(","):
                raise FormulaError(f"'{name}' needs two arguments")
            self.sum()
        self.close()
        self.steps.append(name)

    def close(self) -> None:
        if not self.next_is(")"):
            raise FormulaError("a parenthesis is not closed")
        self.depth -= 1

    def deeper(self) -> None:
        self.depth += 1
        if self.depth > DEEPEST:
            raise FormulaError(f"it is nested more than {DEEPEST} deep")
