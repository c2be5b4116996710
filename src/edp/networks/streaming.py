"""The streaming contract: a causal module with explicit state, run in chunks of any length with the same result."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from edp.errors import ExportError
from edp.ir.builder import Builder

State = Any
"""State of a module: tree (tuple, dict) of tensors whose first dimension is the batch; ``()`` for a module without
memory."""


@dataclass(frozen=True)
class Cost:
    """Analytical cost of one part.

    Attributes:
        part: name of the layer.
        parameters: trainable numbers as stored (weight-norm gains and STanh amplitudes included).
        foldable: operations that an inference build merges into neighbouring layers (gains, output amplitudes).
        per_column: multiply-accumulates for each new time step of the input.
        per_prediction: multiply-accumulates once per prediction.
        pooling: multiply-accumulates of window pooling, once per prediction; the thesis's windowed figures
            (Tables 4.8, 4.9) leave them out, the streaming figure counts them.
        width_in: features read per time step.
        width_out: features written per time step.
        per_time_step: False where the part runs on the last time step only (heads).
        tree_steps: comparisons of regression trees of a prediction, and one step for the leaf of each tree.
    """

    part: str
    parameters: int
    foldable: int = 0
    per_column: int = 0
    per_prediction: int = 0
    pooling: int = 0
    width_in: int = 0
    width_out: int = 0
    per_time_step: bool = True
    tree_steps: int = 0


class Operation(StrEnum):
    """Primitive operations of networks, which an export target must support.

    Moving numbers (concatenation, slices, ring buffers) and element-wise arithmetic (sums, products, quotients,
    choice by a mask) are understood and not listed.
    """

    LINEAR = "linear"
    MATMUL = "matmul"
    CONV1D = "conv1d"
    LSTM = "lstm"
    GRU = "gru"
    SIGMOID = "sigmoid"
    TANH = "tanh"
    RELU = "relu"
    GELU = "gelu"
    GLU = "glu"
    SOFTPLUS = "softplus"
    SOFTMAX = "softmax"
    LAYER_NORM = "layer_norm"
    SQRT = "sqrt"
    EXP = "exp"
    SINE = "sine"


class Streaming(nn.Module, ABC):
    """Causal map from samples to features with explicit state.

    For any split of a sequence into chunks, running the chunks in order and handing the state on gives the same
    output as one call (chunk invariance); output t never depends on inputs after t (causality).

    Attributes:
        operations: operations of the part itself, without those of the parts inside it.
        matrices: weights of multiply-accumulates among its own parameters: name, and axes of its outputs. Those of
            PyTorch's layers inside it are known.
        fixed: names of its parameters that no training changes (``requires_grad`` is False).
        indifferent: names of its parameters on which its output does not depend.
    """

    operations: frozenset[Operation] = frozenset()
    fixed: tuple[str, ...] = ()
    indifferent: tuple[str, ...] = ()
    matrices: ClassVar[tuple[tuple[str, tuple[int, ...]], ...]] = ()

    @abstractmethod
    def initial_state(self, batch: int, like: Tensor) -> State:
        """State at reset for `batch` streams, with the device and dtype of `like`."""

    @abstractmethod
    def forward(self, x: Tensor, state: State) -> tuple[Tensor, State]:
        """Map ``(batch, time, width_in)`` and a state to ``(batch, time, ...)`` and the next state."""

    @abstractmethod
    def costs(self) -> list[Cost]:
        """Return analytic costs, a row for each part."""

    def lower(self, build: Builder, x: str) -> str:
        """Add the layers that compute this part tick by tick to a graph, as in evaluation.

        Args:
            build: builder of the layer graph.
            x: name of the value that the part reads.

        Returns:
            The name of the value that it gives.

        Raises:
            ExportError: it has no such form.
        """
        raise ExportError(
            f"the part '{type(self).__name__}' of the network has no form as a list of streaming layers; train "
            "without it, or write its method `lower`"
        )

    def __call__(self, x: Tensor, state: State) -> tuple[Tensor, State]:
        """Run the module (typed shadow of ``nn.Module.__call__``)."""
        result: tuple[Tensor, State] = super().__call__(x, state)
        return result


def list_fixed_parameters(model: nn.Module) -> set[str]:
    """Return the full names of the parameters that parts of a model declare as `Streaming.fixed`."""
    return _list_declared(model, "fixed")


def indifferent_parameters(model: nn.Module) -> set[str]:
    """Return the full names of the parameters that parts of a model declare as `Streaming.indifferent`."""
    return _list_declared(model, "indifferent")


def _list_declared(model: nn.Module, attribute: str) -> set[str]:
    parts = model.named_modules()
    names = ((prefix, name) for prefix, part in parts for name in getattr(part, attribute, ()))
    return {f"{prefix}.{name}" if prefix else name for prefix, name in names}


class Chain(Streaming):
    """Parts in series, each on ``(batch, time, width)``."""

    def __init__(self, parts: Sequence[Streaming]) -> None:
        super().__init__()
        self.parts = nn.ModuleList(parts)

    def _streams(self) -> list[Streaming]:
        return [part for part in self.parts if isinstance(part, Streaming)]

    def initial_state(self, batch: int, like: Tensor) -> State:
        return tuple(part.initial_state(batch, like) for part in self._streams())

    def forward(self, x: Tensor, state: State) -> tuple[Tensor, State]:
        new = []
        for part, old in zip(self._streams(), state, strict=True):
            x, part_state = part(x, old)
            new.append(part_state)
        return x, tuple(new)

    def lower(self, build: Builder, x: str) -> str:
        for part in self._streams():
            x = part.lower(build, x)
        return x

    def costs(self) -> list[Cost]:
        return [cost for part in self._streams() for cost in part.costs()]


def operations_of(module: nn.Module) -> frozenset[Operation]:
    """Return every primitive operation that a network declares, the parts inside it included."""
    return frozenset().union(*(getattr(part, "operations", ()) for part in module.modules()))


def parameters_of(module: nn.Module) -> int:
    """Return the number of trainable parameters of a module."""
    return sum(parameter.numel() for parameter in module.parameters())


def map_state(change: Callable[..., Tensor], state: State, *others: State) -> State:
    """Apply `change` to corresponding tensors of one or several equal trees."""
    if isinstance(state, Tensor):
        return change(state, *others)
    if isinstance(state, dict):
        return {key: map_state(change, value, *(o[key] for o in others)) for key, value in state.items()}
    return tuple(map_state(change, value, *(o[i] for o in others)) for i, value in enumerate(state))


def detach_state(state: State) -> State:
    """Return the state detached from the autograd graph."""
    return map_state(lambda tensor: tensor.detach(), state)


def reset_where(reset: Tensor, initial: State, state: State) -> State:
    """Return the initial state for streams where `reset` (batch,) is true, the given state elsewhere."""

    def choose(fresh: Tensor, old: Tensor) -> Tensor:
        mask = reset.reshape(-1, *([1] * (old.ndim - 1)))
        return torch.where(mask, fresh, old)

    return map_state(choose, initial, state)


def state_numbers(state: State) -> int:
    """Return the number of elements of a state."""
    if isinstance(state, Tensor):
        return state.numel()
    values = state.values() if isinstance(state, dict) else state
    return sum(state_numbers(value) for value in values)
