"""An ONNX graph in the making: the only file that imports the `onnx` package, and that knows how opsets differ."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from edp import __version__
from edp.errors import ExportError

OPSETS = {9: 4, 11: 6, 13: 7, 17: 8, 21: 10}
"""IR version by opset: the version at the release of the opset, so that contemporary readers accept the file."""
DEFAULT_OPSET = 13
_NAMES = """
Add Clip Concat Conv Cos Div Erf Exp GRU Gather Gemm Identity LSTM Log Max Min Mul ReduceMean Relu Reshape Sigmoid Sign
Sin Softmax Softplus Split Sqrt Sub Tanh Transpose
"""
OPTIONAL = ("LSTM", "GRU")
"""Operators with optional outputs."""
ALLOWED = frozenset(_NAMES.split())
"""Operators used in exports: stable operators with constant indices and shapes."""


def library() -> ModuleType:
    """Import the `onnx` package.

    Raises:
        ExportError: it is not installed.
    """
    try:
        import onnx
    except ImportError as error:
        raise ExportError(
            "ONNX files need the package onnx, which is not installed; run pip install "
            "'excavator-dynamics-predictor[onnx]'"
        ) from error
    return onnx


class Nodes:
    """Nodes and constants; every method that adds a node returns the name of its value.

    Args:
        opset: a key of `OPSETS`.

    Raises:
        ExportError: the package is missing, or the opset is not one that is written.
    """

    def __init__(self, opset: int = DEFAULT_OPSET) -> None:
        if opset not in OPSETS:
            raise ExportError(f"opset {opset} is not written; choose one of {', '.join(map(str, OPSETS))}")
        self.opset, self._onnx = opset, library()
        self._nodes: list[Any] = []
        self._constants: dict[tuple[str, tuple[int, ...], bytes], str] = {}
        self._tensors: list[Any] = []
        self._taken: set[str] = set()
        self._scope = "graph"

    @contextmanager
    def inside(self, scope: str) -> Iterator[None]:
        """Return the names made within begin with `scope`."""
        before, self._scope = self._scope, scope
        try:
            yield
        finally:
            self._scope = before

    def reserve(self, *names: str) -> None:
        """Keep names of inputs and outputs from being given to anything else."""
        self._taken |= set(names)

    def name(self, what: str) -> str:
        """Return an unused name in this scope."""
        first = f"{self._scope}_{what}"
        free_name = next(
            c for n in range(len(self._taken) + 1) if (c := f"{first}_{n}" if n else first) not in self._taken
        )
        self._taken.add(free_name)
        return free_name

    def constant(self, values: ArrayLike, what: str = "constant") -> str:
        """Add a float32 or int64 constant; equal constants are written once."""
        array = np.asarray(values)
        plain = np.ascontiguousarray(array, dtype=np.int64 if array.dtype == np.int64 else np.float32)
        # Equal by bytes, so that 0.0 and -0.0 stay apart.
        key = (str(plain.dtype), array.shape, plain.tobytes())
        if key not in self._constants:
            self._constants[key] = name = self.name(what)
            self._tensors.append(self._onnx.numpy_helper.from_array(plain.reshape(array.shape), name))
        return self._constants[key]

    def is_zero(self, name: str) -> bool:
        """Return whether a value is a constant of zeros."""
        return any(constant_name == name and not any(data) for (_, _, data), constant_name in self._constants.items())

    def add(self, operator: str, *inputs: str, **attributes: Any) -> str:
        """Add a node with one output."""
        return self.several(operator, inputs, 1, **attributes)[0]

    def several(self, operator: str, inputs: Sequence[str], outputs: int, **attributes: Any) -> list[str]:
        """Add a node with several outputs."""
        if operator not in ALLOWED:
            raise ExportError(f"operator {operator} is not one that importers can be counted on to have")
        output_names = [self.name(operator.lower()) for _ in range(outputs)]
        input_names = list(inputs)
        while not input_names[-1]:  # optional ones at the end that are left out  # trailing only
            input_names.pop()
        self._nodes.append(
            self._onnx.helper.make_node(operator, input_names, output_names, output_names[0], **attributes)
        )
        return output_names

    def split(self, x: str, sizes: Sequence[int], axis: int) -> list[str]:
        """Split a value into neighbouring parts; a single part is the value itself."""
        if len(sizes) == 1:
            return [x]
        # Before opset 13 the sizes were an attribute, since then they are an input.
        if self.opset < 13:
            return self.several("Split", [x], len(sizes), axis=axis, split=list(sizes))
        return self.several("Split", [x, self.constant(np.array(sizes, np.int64), "sizes")], len(sizes), axis=axis)

    def join(self, parts: Sequence[str], axis: int) -> str:
        """Return the values end to end; the value itself where there is one."""
        return parts[0] if len(parts) == 1 else self.add("Concat", *parts, axis=axis)

    def columns(self, x: str, chosen: NDArray[Any]) -> str:
        """Return the chosen columns of a matrix."""
        return self.add("Gather", x, self.constant(chosen.astype(np.int64), "columns"), axis=1)

    def shaped(self, x: str, *shape: int) -> str:
        """Reshape a value; the order of its elements is unchanged."""
        return self.add("Reshape", x, self.constant(np.array(shape, np.int64), "shape"))

    def clip(self, x: str, low: float, high: float) -> str:
        """Return each number, but no less than `low` and no more than `high`."""
        # Before opset 11 the limits were attributes.
        if self.opset < 11:
            return self.add("Clip", x, min=float(low), max=float(high))
        return self.add("Clip", x, self.constant(np.float32(low)), self.constant(np.float32(high)))

    def mean(self, x: str, axis: int) -> str:
        """Return the mean over an axis, which stays with length 1."""
        if self.opset < 18:
            return self.add("ReduceMean", x, axes=[axis], keepdims=1)
        return self.add("ReduceMean", x, self.constant(np.array([axis], np.int64), "axis"), keepdims=1)

    def linear(self, x: str, weight: NDArray[np.float32], bias: NDArray[np.float32] | str) -> str:
        """Return ``x W^T + b``, row by row; `weight` ``(out, in)``, `bias` an array ``(out,)`` or a value."""
        added = bias if isinstance(bias, str) else self.constant(bias, "bias")
        return self.add("Gemm", x, self.constant(weight, "weight"), added, transB=1)

    def product(self, a: str, b: str, added: str | None = None, scale: float = 1.0, turn: bool = False) -> str:
        """Return ``scale a b`` plus a value, both matrices; with `turn`, b is transposed first."""
        third = added or self.constant(np.zeros((1, 1), np.float32), "zero")  # not optional before opset 11
        return self.add("Gemm", a, b, third, alpha=float(scale), transB=int(turn))

    def times(self, x: str, factor: ArrayLike) -> str:
        """Multiply a value by a constant."""
        return self.add("Mul", x, self.constant(factor, "factor"))

    def plus(self, x: str, term: ArrayLike) -> str:
        """Add a constant to a value."""
        return self.add("Add", x, self.constant(term, "term"))

    def less(self, a: str, b: str) -> str:
        """Return ``a - b`` without the subtraction operator, which some importers lack."""
        return self.add("Add", a, self.times(b, np.float32(-1.0)))

    def softmax(self, x: str) -> str:
        """Return the weights that sum to 1 in each row of a matrix."""
        return self.add("Softmax", x, axis=1)

    def model(
        self,
        name: str,
        inputs: Mapping[str, tuple[int, ...]],
        outputs: Mapping[str, tuple[str, tuple[int, ...]]],
        notes: Mapping[str, str],
    ) -> bytes:
        """Return the finished, checked file.

        Args:
            name: name of the graph.
            inputs: shapes by name.
            outputs: value and shape of each output, by name.
            notes: kept in the file as metadata.

        Raises:
            ExportError: the checker of the `onnx` package objects.
        """
        self._name_outputs(set(inputs), {out: value for out, (value, _) in outputs.items()})
        self._drop_unread(outputs)
        helper, proto = self._onnx.helper, self._onnx.TensorProto.FLOAT
        graph = helper.make_graph(
            self._nodes,
            name,
            [helper.make_tensor_value_info(key, proto, shape) for key, shape in inputs.items()],
            [helper.make_tensor_value_info(key, proto, shape) for key, (_, shape) in outputs.items()],
            self._tensors,
        )
        model_proto = helper.make_model(
            graph,
            opset_imports=[helper.make_opsetid("", self.opset)],
            ir_version=OPSETS[self.opset],
            producer_name="excavator-dynamics-predictor",
            producer_version=__version__,
        )
        helper.set_model_props(model_proto, dict(notes))
        try:
            # A full check infers all shapes: an error is found here and not in the importer.
            self._onnx.checker.check_model(model_proto, full_check=True)
        except Exception as error:
            raise ExportError(f"the ONNX checker refuses graph '{name}' at opset {self.opset}: {error}") from error
        # Deterministic order of the maps, so that equal networks give equal bytes.
        return bytes(model_proto.SerializeToString(deterministic=True))

    def _name_outputs(self, inputs: set[str], outputs: Mapping[str, str]) -> None:
        """Let the nodes that make the outputs give them their names."""
        produced = {name for node in self._nodes for name in node.output}
        names: dict[str, str] = {}
        for out, value in outputs.items():
            # An input or another output's value cannot be renamed; `Identity` gives it a second name.
            if value in names or value in inputs or value not in produced:
                self._nodes.append(self._onnx.helper.make_node("Identity", [names.get(value, value)], [out], out))
            else:
                names[value] = out
        for node in self._nodes:
            node.input[:] = [names.get(key, key) for key in node.input]
            node.output[:] = [names.get(key, key) for key in node.output]

    def unread(self, ends: Iterable[str]) -> list[str]:
        """Return the unread outputs of nodes that contribute to `ends` with another output."""
        read_values = set(ends)
        # Backwards: readers come after what they read.
        for node in reversed(self._nodes):
            if read_values & set(node.output):
                read_values |= set(node.input)
        split = [node for node in self._nodes if read_values & set(node.output) and node.op_type not in OPTIONAL]
        return [name for node in split for name in node.output if name not in read_values]

    def _drop_unread(self, outputs: Mapping[str, object]) -> None:
        """Remove nodes and constants that do not contribute to an output."""
        read_values, read_nodes = set(outputs), []
        for node in reversed(self._nodes):
            if read_values & set(node.output):
                read_nodes.append(node)
                read_values |= set(node.input)
                if node.op_type in OPTIONAL:
                    _leave_out(node, read_values)
        # ONNX Runtime up to 1.18 lays unread outputs over values that are still needed (docs/journal).
        self._nodes = read_nodes[::-1]
        self._tensors = [tensor for tensor in self._tensors if tensor.name in read_values]


def _leave_out(node: Any, read_values: set[str]) -> None:
    """Remove the unread outputs of a node."""
    names = [name if name in read_values else "" for name in node.output]
    while not names[-1]:
        names.pop()
    node.output[:] = names
