"""The network as plain MATLAB code: a statement or two a layer, the functions that it calls, and the weights."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib import resources
from typing import Any

import numpy as np

from edp.errors import ExportError
from edp.export.escape import Code, matlab_comment, matlab_names
from edp.ir import Array, Graph, Layer, layers, memory
from edp.ir.base import INPUT
from edp.ir.layers import BinaryOperation, Function, runs
from edp.storage.reading import Table

# 47 characters, a part behind them and a number stay within MATLAB's 63.
LONGEST_LAYER = 47
"""Maximum number of characters of the layer's part of a name. Suffixes of constants and slots follow."""
MAX_PIECES = 8
"""Maximum number of contiguous column ranges that are written as ranges. For more ranges a constant is used."""
FUNCTIONS = {
    Function.RELU: "max({x}, 0)",
    Function.SIGMOID: "sigmoid({x})",
    Function.TANH: "tanh({x})",
    Function.GELU: "gelu({x})",
    Function.SOFTPLUS: "softplus({x})",
    Function.EXP: "exp({x})",
    Function.SQRT: "sqrt({x})",
    Function.SINE: "sin({x})",
    Function.COSINE: "cos({x})",
    Function.LOG: "log(max({x}, realmin('single')))",
    Function.POSITIVE: "positive({x})",
}
"""MATLAB expressions of the element-wise functions."""


@dataclass(frozen=True, eq=False)
class Native:
    """Writes the layers of a graph as MATLAB code.

    Attributes:
        graph: the layers.
    """

    graph: Graph

    @cached_property
    def _fields(self) -> dict[tuple[str, str], str]:
        """Names of values (no part), constants and slots, by layer and part."""
        keys = [(layer.name, "") for layer in self.graph.layers]
        keys += [(layer.name, part) for layer in self.graph.layers for part in self.laid(layer)]
        keys += [(name, slot.name) for name, slot in self.graph.slots()]
        short = (
            # The end of a layer's name tells more than its beginning, which all layers of a part share.
            "_".join(filter(None, (name.replace(".", "_")[-LONGEST_LAYER:], part))).lstrip("_")
            for name, part in keys
        )
        return dict(zip(keys, matlab_names(list(short)), strict=True))

    def laid(self, layer: Layer) -> Table:
        """Return the constants of a layer in the order in which MATLAB reads them."""
        tensors = {
            part: values.reshape(-1, 1) if values.ndim == 1 else values for part, values in layer.tensors().items()
        }
        if isinstance(layer, memory.Convolution):
            tensors["weight"] = layer.weight.reshape(len(layer.weight), -1)
        elif isinstance(layer, layers.GroupedDense):
            tensors |= {"weight": layer.weight.transpose(1, 2, 0), "bias": layer.bias.T}
        elif isinstance(layer, layers.TreeSums):
            # A column a tree; columns of the input count from 1, as numbers that index.
            tensors = {part: values.reshape(-1, values.shape[2]).T for part, values in tensors.items()}
            tensors["feature"] = tensors["feature"] + 1.0
        elif isinstance(layer, memory.Rotation):
            tensors["factor"] = layer.factor.T
        elif isinstance(layer, layers.Gather) and len(self.runs(layer)) > MAX_PIECES:
            # MATLAB counts from 1.
            tensors["columns"] = np.array([[column + 1] for column in layer.columns], dtype=float)
        return tensors

    def runs(self, layer: layers.Gather) -> list[tuple[int, int, int]]:
        """Return runs of neighbouring columns: input, first column, number of columns."""
        return runs(layer.columns, [self.graph.width_of(name) for name in layer.inputs])

    def value(self, name: str) -> str:
        """Return the variable of a value."""
        return "in" if name == INPUT else f"v.{self._fields[name, '']}"

    def constant(self, layer: Layer, part: str) -> str:
        """Return the constant of a layer."""
        return f"w.{self._fields[layer.name, part]}"

    def slot(self, layer: str, part: str) -> str:
        """Return the state of a layer."""
        return f"s.{self._fields[layer, part]}"

    def weights(self) -> dict[str, object]:
        """Return all constants by field."""
        tensors = {
            (layer.name, part): values for layer in self.graph.layers for part, values in self.laid(layer).items()
        }
        return {self._fields[key]: values for key, values in tensors.items()}

    def start(self) -> dict[str, Array]:
        """Return the initial states by field: columns; rings have one column per sample, the oldest first."""
        return {
            self._fields[name, slot.name]: _column(self.graph.start(name, slot)) for name, slot in self.graph.slots()
        }

    def code(self) -> Code:
        """Return the statements of a time step: from ``in`` and states ``s`` to values ``v`` and the next states.

        Raises:
            ExportError: a layer has no form in MATLAB.
        """
        lines: list[str] = []
        for layer in self.graph.layers:
            write = WRITERS.get(type(layer))
            if write is None:
                raise ExportError(
                    f"layer '{layer.name}' is a {type(layer).__name__}, which has no form in MATLAB; these have: "
                    f"{', '.join(sorted(kind.__name__ for kind in WRITERS))}"
                )
            lines.append(f"% {matlab_comment(layer.name)}: {layer.kind}, {layer.width or 'no'} numbers")
            lines += write(self, layer, [self.value(name) for name in layer.inputs])
        return Code("\n".join(lines))

    def results(self) -> Code:
        """Return the statement that lists the results."""
        listed = (f"out.{meaning} = {self.value(value)}" for meaning, value in self.graph.results.items())
        return Code("; ".join(listed) + ";")


def functions_for(code: str) -> Code:
    """Return the functions that code calls, and the functions called by them."""
    text = resources.files("edp.export.simulink").joinpath("templates/layers.m.in").read_text()
    bodies = {}
    # Functions are cut out of one tested file, so that generated code and tests share them.
    for part in re.split(r"^(?=function )", text, flags=re.MULTILINE):
        signature = re.match(r"function (?:.*?= )?(\w+)\(", part)
        if signature:
            bodies[signature[1]] = part.strip() + "\n"
    needed: set[str] = set()
    search = [code]
    # Functions call functions: the search goes on until nothing new is needed.
    while search:
        for name in set(re.findall(r"\b(\w+)\(", search.pop())) & set(bodies) - needed:
            needed.add(name)
            search.append(bodies[name])
    return Code("\n".join(part for name, part in bodies.items() if name in needed).rstrip())


Write = Callable[[Native, Any, Sequence[str]], list[str]]


def _column(values: Array) -> Array:
    """Return the vectors as columns; rows of a matrix as columns."""
    return np.ascontiguousarray(values.reshape(-1, 1) if values.ndim == 1 else values.T)


def _simple(pattern: str) -> Write:
    """Return a writer for a statement with inputs ``{0}``, ``{1}``, and constants, slots and layer fields by name."""

    def write(native: Native, layer: Any, x: Sequence[str]) -> list[str]:
        names = {part: native.constant(layer, part) for part in native.laid(layer)}
        names |= {f"s_{slot.name}": native.slot(layer.name, slot.name) for slot in layer.slots}
        # Text of a layer is left out: only numbers and generated names may become code.
        plain = {key: _plain(value) for key, value in vars(layer).items() if isinstance(value, int | float)}
        return [pattern.format(*x, y=native.value(layer.name), **(plain | names))]

    return write


def _plain(value: float) -> str:
    """Return a layer option as a literal; text never becomes code."""
    if isinstance(value, bool):
        return str(value).lower()
    return f"{np.float32(value):.9g}" if isinstance(value, float) else str(value)


def _gather(native: Native, layer: layers.Gather, x: Sequence[str]) -> list[str]:
    column_runs = native.runs(layer)
    if len(column_runs) > MAX_PIECES:
        joined = x[0] if len(x) == 1 else f"[{'; '.join(x)}]"
        lines = [f"given = {joined};"]
        return [*lines, f"{native.value(layer.name)} = given({native.constant(layer, 'columns')});"]
    parts = []
    for value, first, length in column_runs:
        # A whole value needs no index.
        whole = (first, length) == (0, native.graph.width_of(layer.inputs[value]))
        ends = str(first + 1) if length == 1 else f"{first + 1}:{first + length}"
        parts.append(x[value] if whole else f"{x[value]}({ends})")
    joined = parts[0] if len(parts) == 1 else f"[{'; '.join(parts)}]"
    return [f"{native.value(layer.name)} = {joined};"]


def _activate(native: Native, layer: layers.Activate, x: Sequence[str]) -> list[str]:
    return [f"{native.value(layer.name)} = {FUNCTIONS[layer.function].format(x=x[0])};"]


def _convolution(native: Native, layer: memory.Convolution, x: Sequence[str]) -> list[str]:
    if not layer.slots:
        return _simple("{y} = {weight} * {0} + {bias};")(native, layer, x)
    return _simple("[{y}, {s_ring}] = convolution({0}, {weight}, {bias}, {dilation}, {s_ring});")(native, layer, x)


def _trees(native: Native, layer: layers.TreeSums, x: Sequence[str]) -> list[str]:
    pattern = f"{{y}} = trees({{0}}, {{feature}}, {{threshold}}, {{leaf}}, {layer.depth}, {layer.width});"
    return _simple(pattern)(native, layer, x)


def _prefix(native: Native, layer: memory.PrefixCorrection, x: Sequence[str]) -> list[str]:
    parts = ("first_weight", "first_bias", "second_weight", "second_bias")
    named = ", ".join(f"'{part}', {native.constant(layer, part)}" for part in parts)
    total, age = (native.slot(layer.name, part) for part in ("total", "age"))
    lines = [
        f"correction = struct({named});",
        f"[change, {total}, {age}] = prefix({x[0]}, correction, {layer.ticks}, {total}, {age});",
    ]
    sizes, at = {(name, slot.name): slot.size for name, slot in native.graph.slots()}, 0
    for owner in layer.corrects:
        state, size = native.slot(*owner), sizes[owner]
        # MATLAB stores columns first; `reshape` with the state's own size keeps the order of the start.
        lines.append(f"{state} = {state} + reshape(change({at + 1}:{at + size}), size({state}));")
        at += size
    return lines


def _layer_norm_lstm(native: Native, layer: memory.LayerNormLstm, x: Sequence[str]) -> list[str]:
    parts = {"x": "gain_x", "h": "gain_h", "c": "gain_c", "shift": "shift_c"}
    named = ", ".join(f"'{key}', {native.constant(layer, part)}" for key, part in parts.items())
    weights = "{weight_x}, {weight_h}, {bias}, norms"
    call = f"[{{s_h}}, {{s_c}}] = layer_norm_lstm({{0}}, {weights}, {{share}}, {{epsilon}}, {{s_h}}, {{s_c}});"
    return [f"norms = struct({named});", *_simple(call)(native, layer, x), *_simple("{y} = {s_h};")(native, layer, x)]


def _feed(native: Native, layer: memory.Feed, x: Sequence[str]) -> list[str]:
    return [f"{native.slot(layer.into, 'last')} = {x[0]};"]


OPERATIONS = {
    BinaryOperation.ADD: "{y} = {0} + {1};",
    BinaryOperation.SUBTRACT: "{y} = {0} - {1};",
    BinaryOperation.MULTIPLY: "{y} = {0} .* {1};",
    BinaryOperation.DIVIDE: "{y} = {0} ./ {1};",
    BinaryOperation.MINIMUM: "{y} = min({0}, {1});",
    BinaryOperation.MAXIMUM: "{y} = max({0}, {1});",
}

WRITERS: dict[type[Layer], Write] = {
    layers.Gather: _gather,
    layers.Standardise: _simple("{y} = ({0} - {offset}) ./ {scale};"),
    layers.ScaleShift: _simple("{y} = {gain} .* {0} + {shift};"),
    layers.Clip: _simple("{y} = max(min({0}, {high}), {low});"),
    layers.Elementwise: lambda native, layer, x: _simple(OPERATIONS[layer.operation])(native, layer, x),
    layers.Activate: _activate,
    layers.Glu: _simple("{y} = glu({0}, {rows});"),
    layers.Accumulate: _simple("{y} = accumulate({0}, {rows});"),
    layers.Dense: _simple("{y} = dense({0}, {weight}, {bias}, {rows});"),
    layers.GroupedDense: _simple("{y} = grouped_dense({0}, {weight}, {bias});"),
    layers.TreeSums: _trees,
    layers.LayerNorm: _simple("{y} = layer_norm({0}, {gain}, {shift}, {epsilon}, {rows});"),
    layers.RowAttention: _simple("{y} = row_attention({0}, {1}, {2}, {rows});"),
    memory.Difference: _simple(
        "[{y}, {s_before}, {s_age}] = difference({0}, {factor}, {from_zero}, {s_before}, {s_age});"
    ),
    memory.Starting: _simple("[{y}, {s_age}] = starting({0}, {mean}, {ticks}, {s_age});"),
    memory.Convolution: _convolution,
    memory.Lstm: _simple(
        "[{s_h}, {s_c}] = lstm({0}, {weight_x}, {weight_h}, {bias}, {share}, {s_h}, {s_c}); {y} = {s_h};"
    ),
    memory.LayerNormLstm: _layer_norm_lstm,
    memory.Gru: _simple("{s_h} = gru({0}, {weight_x}, {weight_h}, {bias_x}, {bias_h}, {s_h}); {y} = {s_h};"),
    memory.MinGru: _simple("{s_h} = min_gru({0}, {s_h}); {y} = {s_h};"),
    memory.Rotation: _simple("[{y}, {s_h}] = rotation({0}, {factor}, {s_h});"),
    memory.TrailingMean: _simple("[{y}, {s_ring}, {s_age}] = trailing_mean({0}, {window}, {s_ring}, {s_age});"),
    memory.AttentionPool: _simple(
        "[{y}, {s_ring}, {s_scores}] = attention_pool({0}, {score}, {bias}, {s_ring}, {s_scores});"
    ),
    memory.WindowAttention: _simple(
        "[{y}, {s_keys}, {s_values}, {s_age}] = "
        "window_attention({0}, {1}, {2}, [{heads}, {window}], {s_keys}, {s_values}, {s_age});"
    ),
    memory.Feedback: _simple("{y} = {s_last};"),
    memory.Feed: _feed,
    memory.PrefixCorrection: _prefix,
}
"""Writer functions by layer class."""
