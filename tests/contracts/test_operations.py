"""What networks compute, seen by tracing: the operations that parts declare and the multiply-accumulates they count."""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from types import SimpleNamespace

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from edp.models.activations import ACTIVATIONS
from edp.streaming import Operation, Streaming, operations_of

# Which declarations allow an operation of PyTorch; double precision keeps recurrent layers off the fused kernels.
PRODUCTS = {Operation.LINEAR, Operation.MATMUL, Operation.LSTM, Operation.GRU}
ALLOWED = {
    "mm": PRODUCTS,
    "addmm": PRODUCTS,
    "bmm": PRODUCTS,
    "baddbmm": PRODUCTS,
    "convolution": {Operation.CONV1D},
    "linalg_vector_norm": {Operation.CONV1D},  # the weight norm, folded when exported
    "sigmoid": {Operation.SIGMOID, Operation.LSTM, Operation.GRU},
    "tanh": {Operation.TANH, Operation.LSTM, Operation.GRU},
    "relu": {Operation.RELU},
    "gelu": {Operation.GELU},
    "glu": {Operation.GLU},
    "softplus": {Operation.SOFTPLUS},
    "_softmax": {Operation.SOFTMAX},
    "native_layer_norm": {Operation.LAYER_NORM},
    "sqrt": {Operation.SQRT},
    "exp": {Operation.EXP},
    "expm1": {Operation.EXP},
    "sin": {Operation.SINE},
    "cos": {Operation.SINE},
}
# Moving numbers, making masks, and element-wise arithmetic: understood, not declared.
FREE = {
    *("_reshape_alias", "_to_copy", "_unsafe_view", "alias", "cat", "clone", "constant_pad_nd", "copy", "detach"),
    *(
        "expand",
        "index",
        "lift_fresh",
        "permute",
        "select",
        "slice",
        "split",
        "split_with_sizes",
        "squeeze",
        "stack",
        "t",
        "transpose",
    ),
    *("unbind", "unsafe_chunk", "unsafe_split", "unsqueeze", "view", "view_as_complex", "view_as_real", "unfold"),
    *(
        "arange",
        "empty",
        "empty_like",
        "full",
        "new_empty",
        "new_full",
        "new_zeros",
        "ones_like",
        "zeros",
        "zeros_like",
    ),
    *("bitwise_and", "bitwise_not", "bitwise_or", "eq", "ge", "gt", "lt", "masked_fill", "remainder", "where"),
    *(
        "abs",
        "add",
        "addcmul",
        "clamp",
        "cumsum",
        "div",
        "flip",
        "maximum",
        "minimum",
        "mul",
        "neg",
        "pow",
        "reciprocal",
        "rsub",
    ),
    *("addcmul", "lerp", "sign", "sub", "sum"),
}


class Trace(TorchDispatchMode):
    """Counts operations and multiply-accumulates under the innermost module that declares its operations."""

    def __init__(self, network: torch.nn.Module) -> None:
        super().__init__()
        self.inside = [""]
        self.operations: dict[str, Counter[str]] = defaultdict(Counter)
        self.macs: Counter[str] = Counter()
        self.hooks = []
        for name, module in network.named_modules():
            if hasattr(module, "operations"):
                self.hooks.append(module.register_forward_pre_hook(lambda *_, name=name: self.inside.append(name)))
                self.hooks.append(module.register_forward_hook(self._leave))
        self._enter_answer(network, "output")

    def _enter_answer(self, network: torch.nn.Module, name: str) -> None:
        """An output is asked for its answer, not called as a module."""
        output = getattr(network, name, None)
        if output is None:
            return
        answer = output.answer

        def traced(*args: object) -> object:
            self.inside.append(name)
            result = answer(*args)
            self.inside.pop()
            return result

        output.answer = traced
        self.hooks.append(SimpleNamespace(remove=lambda: delattr(output, "answer")))

    def _leave(self, *_: object) -> None:
        self.inside.pop()

    def __exit__(self, *error: object) -> None:
        for hook in self.hooks:
            hook.remove()
        super().__exit__(*error)

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        result = function(*args, **(kwargs or {}))
        name = function._schema.name.removeprefix("aten::")
        self.operations[self.inside[-1]][name if name.startswith("_") else name.rstrip("_")] += 1
        self.macs[self.inside[-1]] += macs_of(name, args, result)
        if self.inside[-1] == "physics":
            self.macs["physics"] += arithmetic_of(name, args, result)
        return result


def macs_of(name, args, result):
    if name in ("mm", "bmm"):
        return result.numel() * args[0].shape[-1]
    if name in ("addmm", "baddbmm"):
        return result.numel() * args[1].shape[-1]
    if name == "convolution":
        return result.numel() * math.prod(args[1].shape[1:])
    return 0


def arithmetic_of(name, args, result):
    """A physics base is arithmetic only: what makes numbers from inputs counts, sums and choices apart.

    What the machine's numbers alone give, tensors of at most one dimension, is computed once.
    """
    counted = name in ("mul", "div", "sqrt", "pow", "reciprocal", "exp", "sin", "cos")
    of_inputs = any(isinstance(entry, torch.Tensor) and entry.dim() > 1 for entry in args)
    return result.numel() if counted and of_inputs else 0


def trace(predictor, ticks, state=None):
    """A traced call on `ticks` ticks from `state`, and the next state."""
    x = torch.zeros(1, ticks, predictor.front.inputs, dtype=torch.float64)
    state = predictor.initial_state(1, x) if state is None else state
    with torch.no_grad(), Trace(predictor) as seen:
        _, state = predictor(x, state)
    return seen, state


def complaints(network, seen):
    """Where the traced operations and the declared ones differ."""
    modules, found = dict(network.named_modules()), []
    for name, module in modules.items():
        declared = getattr(module, "operations", frozenset())
        used = set(seen.operations.get(name, ())) - FREE
        found += [f"{name}: {operation} has no word in Operation" for operation in used - set(ALLOWED)]
        used &= set(ALLOWED)
        found += [f"{name}: {operation} is not declared" for operation in used if not ALLOWED[operation] & declared]
        found += [f"{name}: {word} is not used" for word in declared if not any(word in ALLOWED[o] for o in used)]
    return found


def test_parts_declare_exactly_the_operations_they_use(structure, predictor_of):
    predictor = predictor_of(structure)
    seen, _ = trace(predictor, 12)
    assert complaints(predictor, seen) == []
    words = operations_of(predictor)
    used = {operation for counts in seen.operations.values() for operation in counts} & set(ALLOWED)
    assert all(ALLOWED[operation] & words for operation in used)


def test_a_false_declaration_is_found():
    class False_(torch.nn.Module):
        operations = frozenset({Operation.GELU})

        def forward(self, x):
            return torch.erfinv(torch.tanh(x)) + 1

    module = False_()
    with torch.no_grad(), Trace(module) as seen:
        module(torch.zeros(2))
    assert complaints(module, seen) == [
        ": erfinv has no word in Operation",
        ": tanh is not declared",
        ": gelu is not used",
    ]


@pytest.mark.parametrize("name", list(ACTIVATIONS))
def test_activations_declare_exactly_the_operations_they_use(name):
    module = ACTIVATIONS[name]().build(2).double()
    with torch.no_grad(), Trace(module) as seen:
        module(torch.zeros(3, 2, dtype=torch.float64))
    assert complaints(module, seen) == []


def cost(rows):
    return sum(row.per_column + row.per_prediction + row.pooling for row in rows)


# Parts whose work counts once per prediction; pooling is left out of windowed counts, as in the thesis's tables.
ONCE = ("backbone.extras", "gate", "heads", "bypass", "physics")
LEFT_OUT = "backbone.pooling"


def test_the_counted_work_is_what_runs(structure, predictor_of):
    """Part by part for a tick: the first after a reset, the next, and one when every ring is full; and for a window."""
    predictor = predictor_of(structure)
    streams = {name: module for name, module in predictor.named_modules() if isinstance(module, Streaming)}
    window, state = predictor.spec.window, None
    for ticks in (1, 1, window, 1):
        seen, state = trace(predictor, ticks, state)
        if ticks > 1:  # bands of several ticks overlap: more runs than a stream needs
            continue
        for name, module in streams.items():
            inside = sum(macs for part, macs in seen.macs.items() if f"{part}.".startswith(f"{name}." if name else ""))
            assert inside == cost(module.costs()), name
    kept = {part: macs for part, macs in seen.macs.items() if not part.startswith(LEFT_OUT)}
    once = sum(macs for part, macs in kept.items() if part.startswith(ONCE))
    wanted = sum(window * row.per_column + row.per_prediction for row in predictor.costs())
    assert window * (sum(kept.values()) - once) + once == wanted
