"""What networks compute, seen by tracing: the operations that parts declare and the multiply-accumulates they count."""

from __future__ import annotations

import pytest
import torch

from edp.evaluation.mac_check import Trace, trace
from edp.networks.activations import ACTIVATIONS
from edp.networks.streaming import Operation, Streaming, operations_of

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
            assert seen.within(name) == cost(module.costs()), name
        assert not seen.opaque
    kept = {part: macs for part, macs in seen.macs.items() if not part.startswith(LEFT_OUT)}
    once = sum(macs for part, macs in kept.items() if part.startswith(ONCE))
    wanted = sum(window * row.per_column + row.per_prediction for row in predictor.costs())
    assert window * (sum(kept.values()) - once) + once == wanted
