"""Contract of declared operations: a part declares exactly the primitive operations that it uses."""

from __future__ import annotations

from torch import nn

from edp.evaluation.mac_check import Trace, trace
from edp.networks.predictor import Predictor
from edp.networks.streaming import Operation, operations_of
from edp.testing.expectations import expect

TICKS = 12
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
"""Declarations that permit an operation of PyTorch. In double precision, recurrent layers do not use the fused
kernels."""
FREE = {
    *("_reshape_alias", "_to_copy", "_unsafe_view", "alias", "cat", "clone", "constant_pad_nd", "copy", "detach"),
    *(
        "expand",
        "gather",
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
"""Moving numbers, making masks, and element-wise arithmetic: understood, not declared."""


def declaration_errors(network: nn.Module, seen: Trace) -> list[str]:
    """Return the differences between traced and declared operations."""
    errors = []
    for name, module in network.named_modules():
        declared: frozenset[Operation] = getattr(module, "operations", frozenset())
        used = set(seen.operations.get(name, ())) - FREE
        errors += [f"{name}: {operation} has no word in Operation" for operation in used - set(ALLOWED)]
        used &= set(ALLOWED)
        errors += [f"{name}: {operation} is not declared" for operation in used if not ALLOWED[operation] & declared]
        errors += [f"{name}: {word} is not used" for word in declared if not any(word in ALLOWED[o] for o in used)]
    return errors


def check_operations(predictor: Predictor) -> None:
    """Check that every part declares exactly its operations in `operations`, so that an export target can refuse it.

    Args:
        predictor: predictor in double precision, in evaluation mode.

    Raises:
        ContractError: an operation that is not declared, is declared and not used, or has no word.
    """
    # Operations of twelve ticks are those of any number.
    seen, _ = trace(predictor, TICKS)
    errors = declaration_errors(predictor, seen)
    expect(not errors, f"declared operations differ from those that run: {'; '.join(errors)}")
    words = operations_of(predictor)
    used = {operation for counts in seen.operations.values() for operation in counts} & set(ALLOWED)
    lacking = sorted(operation for operation in used if not ALLOWED[operation] & words)
    expect(not lacking, f"the network as a whole does not declare {', '.join(lacking)}")
