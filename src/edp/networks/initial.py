"""Initial states of recurrent layers after a reset: zero, a trained constant, or computed from the first samples."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor, nn

from edp.ir import Builder
from edp.ir.memory import PrefixCorrection
from edp.networks.streaming import Cost, Operation, State, Streaming, map_state, parameters_of, state_numbers
from edp.registry import Registry
from edp.settings.bounds import MAX_UNITS, MOST_TICKS, check_bounds, integer


class InitialSpec(Protocol):
    """Options of an initial state."""

    def build(self, recurrent: Streaming, width_in: int) -> Streaming:
        """Build the recurrent layers with this initial state; they read ``(batch, time, width_in)``."""
        ...


INITIAL_STATES: Registry[type[InitialSpec]] = Registry("initial state")


@INITIAL_STATES.register("zero")
@dataclass(frozen=True, kw_only=True)
class ZeroState:
    """The state is zero after a reset, as in the thesis."""

    def build(self, recurrent: Streaming, width_in: int) -> Streaming:
        """Return the recurrent layers unchanged."""
        return recurrent


@INITIAL_STATES.register("constant")
@dataclass(frozen=True, kw_only=True)
class ConstantState:
    """The state after a reset is a learned constant, the same for all streams."""

    def build(self, recurrent: Streaming, width_in: int) -> Streaming:
        """Build the recurrent layers with a trained state at reset."""
        return LearnedConstant(recurrent)


@INITIAL_STATES.register("prefix")
@dataclass(frozen=True, kw_only=True)
class PrefixState:
    """A small network corrects the state once, from the first ticks after a reset.

    Its inputs are the mean and the last value of the recurrent layers' inputs over these samples. Until then
    predictions use the uncorrected state. Its training requires a loss soon after a reset, that is a small ``burn_in``.

    Attributes:
        ticks: length of the prefix.
        hidden: width of the network's hidden layer.

    Raises:
        ConfigError: a value below 1.
    """

    ticks: int = 10
    hidden: int = 16

    def __post_init__(self) -> None:
        check_bounds("initial prefix", self, ticks=integer(1, MOST_TICKS), hidden=integer(1, MAX_UNITS))

    def build(self, recurrent: Streaming, width_in: int) -> Streaming:
        """Build the recurrent layers with a network that corrects their state."""
        return LearnedFromPrefix(recurrent, width_in, self.ticks, self.hidden)


class LearnedConstant(Streaming):
    """Recurrent layers whose state at reset is learned; it starts at zero."""

    def __init__(self, recurrent: Streaming) -> None:
        super().__init__()
        self.recurrent = recurrent
        zeros = recurrent.initial_state(1, torch.zeros(()))
        self.constant = nn.Parameter(torch.zeros(state_numbers(zeros)))

    def initial_state(self, batch: int, like: Tensor) -> State:
        rows = self.constant.to(like).expand(batch, -1)
        return spread_over(self.recurrent.initial_state(batch, like), rows)

    def forward(self, x: Tensor, state: State) -> tuple[Tensor, State]:
        return self.recurrent(x, state)

    def lower(self, build: Builder, x: str) -> str:
        before = len(build.layers)
        y = self.recurrent.lower(build, x)
        build.start_from(build.slots_since(before), self.constant)
        return y

    def costs(self) -> list[Cost]:
        return [*self.recurrent.costs(), Cost("state at reset", self.constant.numel(), width_out=self.constant.numel())]


class LearnedFromPrefix(Streaming):
    """Recurrent layers whose state is corrected once, `ticks` ticks after a reset.

    State: state of the layers; sum of the prefix so far ``(batch, width_in)``; samples since the reset, up to
    `ticks`, ``(batch, 1)``. The correction network runs at every sample, although only one result is used, so that all
    samples take the same time.
    """

    operations = frozenset({Operation.LINEAR, Operation.TANH})

    def __init__(self, recurrent: Streaming, width_in: int, ticks: int, hidden: int) -> None:
        super().__init__()
        self.recurrent, self.width_in, self.ticks = recurrent, width_in, ticks
        numbers = state_numbers(recurrent.initial_state(1, torch.zeros(())))
        self.first, self.second = nn.Linear(2 * width_in, hidden), nn.Linear(hidden, numbers)
        # A small second layer leaves the state near that of the plain network; zeros would stop gradients to the
        # first layer.
        nn.init.normal_(self.second.weight, std=0.01)
        nn.init.zeros_(self.second.bias)

    def initial_state(self, batch: int, like: Tensor) -> State:
        return self.recurrent.initial_state(batch, like), like.new_zeros(batch, self.width_in), like.new_zeros(batch, 1)

    def forward(self, x: Tensor, state: State) -> tuple[Tensor, State]:
        ticks, rows, at = x.shape[1], [], 0
        # A chunk is cut where the prefix of one of its streams ends.
        ends = {int(self.ticks - age) for age in state[2].flatten().tolist()} if ticks > 1 else set()
        for end in [*sorted(end for end in ends if 0 < end < ticks), ticks]:
            y, state = self._piece(x[:, at:end], state)
            rows.append(y)
            at = end
        return torch.cat(rows, dim=1), state

    def _piece(self, x: Tensor, state: State) -> tuple[Tensor, State]:
        """Process a segment in which no prefix ends before the last sample."""
        inner, total, age = state
        y, inner = self.recurrent(x, inner)
        young = age < self.ticks
        # Only ticks of the prefix enter the mean: a later chunk must leave it unchanged.
        total = total + x.sum(dim=1).masked_fill(~young, 0.0)
        age = (age + x.shape[1]).clamp(max=self.ticks)
        seen = torch.cat([total / self.ticks, x[:, -1]], dim=1)
        correction = self.second(torch.tanh(self.first(seen)))
        # The correction is used in the one tick that ends the prefix; all other ticks get zeros and cost the same.
        used = correction.masked_fill(~(young & (age >= self.ticks)), 0.0)
        return y, (map_state(torch.add, inner, spread_over(inner, used)), total, age)

    def lower(self, build: Builder, x: str) -> str:
        before = len(build.layers)
        y = self.recurrent.lower(build, x)
        build.add(
            PrefixCorrection,
            "prefix",
            x,
            first_weight=self.first.weight,
            first_bias=self.first.bias,
            second_weight=self.second.weight,
            second_bias=self.second.bias,
            ticks=self.ticks,
            corrects=tuple((layer, slot.name) for layer, slot in build.slots_since(before)),
        )
        return y

    def costs(self) -> list[Cost]:
        macs = self.first.weight.numel() + self.second.weight.numel()
        parameters = parameters_of(self.first) + parameters_of(self.second)
        width = 2 * self.width_in
        row = Cost(
            "state from the prefix", parameters, per_column=macs, width_in=width, width_out=len(self.second.bias)
        )
        return [*self.recurrent.costs(), row]


def spread_over(state: State, rows: Tensor) -> State:
    """Return the elements of ``(batch, number)`` in the shapes of the tensors of a state, in order."""
    at = 0

    def take(part: Tensor) -> Tensor:
        nonlocal at
        at += part[0].numel()
        return rows[:, at - part[0].numel() : at].reshape(part.shape)

    return map_state(take, state)
