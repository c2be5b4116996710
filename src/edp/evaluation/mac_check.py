"""Multiply-accumulates as they run: networks executed operation by operation and held against their own count."""

from __future__ import annotations

import copy
import math
from collections import Counter, defaultdict
from collections.abc import Iterable
from types import SimpleNamespace
from typing import Any

import torch
from torch import Tensor, nn
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from edp.errors import ConfigError
from edp.networks.physics import PhysicsBase
from edp.networks.predictor import Predictor
from edp.networks.streaming import State, Streaming

# Factors of a product, by the place of the one whose last dimension is summed over.
MATRIX = {"mm": 0, "bmm": 0, "mv": 0, "dot": 0, "addmm": 1, "baddbmm": 1, "addbmm": 1, "addmv": 1}
MOVES = {"cat", "stack", "index", "index_put", "copy", "gather"}
"""Operations on several tensors that only move data."""
ARITHMETIC = {"mul", "div", "sqrt", "pow", "reciprocal", "exp", "sin", "cos"}
"""Operations counted in a physics base, which is arithmetic only. Sums and selections do not count."""


class Trace(TorchDispatchMode):
    """Counts operations and multiply-accumulates under the innermost part that declares its operations.

    Besides matrix products and convolutions it sees products with weights that are written element by element: those
    that a sum or mean takes together, and those of a number with a row of weights that are added to one another.
    Double precision keeps recurrent layers off fused kernels, which cannot be looked into.

    Args:
        network: network whose parts are distinguished; hooks are removed at the end.

    Attributes:
        operations: number of executions of each operation, by part.
        macs: multiply-accumulates by part.
        opaque: operations on weights, or on several values, of which nobody knows what they multiply, by part.
    """

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.operations: dict[str, Counter[str]] = defaultdict(Counter)
        self.macs: Counter[str] = Counter()
        self.opaque: dict[str, set[str]] = defaultdict(set)
        self._inside = [""]
        self._hooks: list[Any] = []
        self._physics = {name for name, part in network.named_modules() if isinstance(part, PhysicsBase)}
        # Storages, not tensors: views share them. Tensors are kept so that no storage is used again.
        self._kept: list[Tensor] = []
        self._weights = {_storage(parameter) for parameter in network.parameters()}
        self._data: set[int] = set()
        self._spread: dict[int, int] = {}
        self._scaled: set[int] = set()
        for name, part in network.named_modules():
            if hasattr(part, "operations"):
                self._hooks.append(part.register_forward_pre_hook(lambda *_, name=name: self._inside.append(name)))
                self._hooks.append(part.register_forward_hook(self._leave))
        self._enter_answer(network)

    def _enter_answer(self, network: nn.Module) -> None:
        """Enter the output layer, whose method `answer` is called instead of the module."""
        output = getattr(network, "output", None)
        if output is None:
            return
        answer = output.answer

        def counted(*args: object) -> object:
            self._inside.append("output")
            result = answer(*args)
            self._inside.pop()
            return result

        output.answer = counted
        self._hooks.append(SimpleNamespace(remove=lambda: delattr(output, "answer")))

    def _leave(self, *_: object) -> None:
        self._inside.pop()

    def __exit__(self, *error: Any) -> None:
        for hook in self._hooks:
            hook.remove()
        super().__exit__(*error)

    def read(self, values: Any) -> None:
        """Mark a tree of tensors as inputs of the network."""
        # Without the mark of data every product would pass for one of weights, computed once.
        self._data |= {_storage(value) for value in _tensors(values)}

    def within(self, name: str) -> int:
        """Return the multiply-accumulates of a part and of the parts inside it."""
        inside = f"{name}." if name else ""
        return sum(macs for part, macs in self.macs.items() if f"{part}.".startswith(inside))

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        result = function(*args, **(kwargs or {}))
        name = function._schema.name.removeprefix("aten::")
        # In-place operations end with an underscore and count as what they compute.
        name = name if name.startswith("_") else name.rstrip("_")
        part = self._inside[-1]
        self.operations[part][name] += 1
        operands = _tensors((args, kwargs))
        results = _tensors(result)
        self._kept += results
        counted = name in MATRIX or name == "convolution"
        if counted:
            self.macs[part] += macs_of(name, args, result)
        elif part in self._physics:
            self.macs[part] += arithmetic_of(name, args, result)
        else:
            self.macs[part] += self._element_wise(name, operands, results)
        if not counted and name not in MOVES and torch.Tag.pointwise not in function.tags and self._hides(operands):
            self.opaque[part].add(name)
        self._follow(operands, results)
        return result

    def _follow(self, operands: list[Tensor], results: list[Tensor]) -> None:
        """Note which results come from data, and which from weights alone."""
        read = {_storage(value) for value in operands}
        into = self._data if read & self._data else self._weights if read & self._weights else None
        if into is not None:
            into |= {_storage(value) for value in results}

    def _hides(self, operands: list[Tensor]) -> bool:
        """Return whether an operation could multiply: data by a matrix of weights, or data by data."""
        data = [value for value in operands if _storage(value) in self._data]
        matrices = [value for value in operands if value.dim() > 1 and self._constant(value)]
        return bool(data) and len(data) + len(matrices) > 1

    def _constant(self, value: Tensor) -> bool:
        """Return whether a tensor comes from weights alone."""
        address = _storage(value)
        return address in self._weights and address not in self._data

    def _element_wise(self, name: str, operands: list[Tensor], results: list[Tensor]) -> int:
        """Return the multiply-accumulates of matrix products that are written as products and sums."""
        places = [_storage(value) for value in operands]
        if name in ("sum", "mean", "cumsum") and places[0] in self._scaled:
            return operands[0].numel()
        if name in ("add", "sub") and len(places) == 2 and set(places) <= set(self._spread):
            first = sum(self._spread[address] for address in places)
            self._spread[_storage(results[0])] = 0  # counted: only what is added to it still counts
            return first
        if name == "mul" and len(places) == 2:
            data = [value for value, address in zip(operands, places, strict=True) if address in self._data]
            if len(data) == 1 and set(places) & self._weights:
                self._scaled.add(_storage(results[0]))
                if results[0].numel() > data[0].numel():
                    self._spread[_storage(results[0])] = results[0].numel()
        return 0


def _storage(value: Tensor) -> int:
    return int(value.untyped_storage()._cdata)


def _tensors(tree: Any) -> list[Tensor]:
    return [leaf for leaf in tree_leaves(tree) if isinstance(leaf, Tensor)]


def macs_of(name: str, args: Any, result: Tensor) -> int:
    """Return the multiply-accumulates of a matrix product or convolution."""
    if name == "convolution":
        return int(result.numel() * math.prod(args[1].shape[1:]))
    terms = args[MATRIX[name]].shape[0 if name == "addbmm" else -1]
    return int(result.numel() * terms) * (args[1].shape[-1] if name == "addbmm" else 1)


def arithmetic_of(name: str, args: Iterable[Any], result: Tensor) -> int:
    """Return the arithmetic operations of a physics base call that depend on inputs.

    What the machine's parameters alone give, tensors of at most one dimension, is computed once.
    """
    of_inputs = any(isinstance(entry, Tensor) and entry.dim() > 1 for entry in args)
    return result.numel() if name in ARITHMETIC and of_inputs else 0


def trace(predictor: Predictor, ticks: int, state: State | None = None) -> tuple[Trace, State]:
    """Record the operations of a call on `ticks` zeros from `state` or from reset; return them and the next state."""
    # Zeros suffice: the operations of a tick do not depend on its numbers.
    like = next(predictor.parameters())
    x = like.new_zeros(1, ticks, predictor.front.inputs)
    state = predictor.initial_state(1, x) if state is None else state
    with torch.no_grad(), Trace(predictor) as seen:
        seen.read((x, state))
        _, state = predictor(x, state)
    return seen, state


def check_counted(predictor: Predictor) -> None:
    """Compare the declared multiply-accumulates of a network's parts with the executed ones.

    Raises:
        ConfigError: a part counts others than it runs, or computes with an operation that hides what it multiplies.
    """
    seen, _ = trace(copy.deepcopy(predictor).cpu().double().eval(), 1)
    for name, operations in seen.opaque.items():
        raise ConfigError(
            f"the part '{name}' of the network computes {', '.join(sorted(operations))}, of which nobody knows the "
            "multiply-accumulates; write it with matrix products, convolutions and element-wise operations"
        )
    wrong = []
    for name, part in predictor.named_modules():
        if isinstance(part, Streaming):
            rows = part.costs()
            counted = sum(row.per_column + row.per_prediction + row.pooling for row in rows)
            if seen.within(name) != counted:
                wrong.append((name, type(part).__name__, counted, seen.within(name)))
    if wrong:
        # The innermost part is the one to correct: those around it sum it up.
        name, kind, counted, ran = max(wrong, key=lambda entry: (entry[0].count("."), len(entry[0])))
        raise ConfigError(
            f"the part '{name}' of the network ({kind}) counts {counted:,} multiply-accumulates a tick, but "
            f"{ran:,} run: correct its method `costs`"
        )
