"""A recurrent network with feedback ports: it reads commands and the state of the machine, and answers its change."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from edp.data.series import Series
from edp.data.twin_channels import TwinChannels
from edp.ir import Builder
from edp.ir.layers import BinaryOperation, Dense
from edp.ir.memory import Gru
from edp.networks.twin.base import PREFIX, TWINS, Twin, TwinState, solved_columns
from edp.networks.twin.scales import Array, TwinScales
from edp.networks.twin.steps import run_backward, run_forward
from edp.settings.bounds import MOST_UNITS, check_bounds, integer

PIECE = 256
"""Ticks that a run without gradients keeps at once: the loop writes what only a backward run would read."""


@TWINS.register("recurrent")
@dataclass(frozen=True, kw_only=True)
class Recurrent:
    """A GRU with feedback ports, trained on its own free runs (`edp.training.free_run`).

    Attributes:
        units: width of its memory.
        prefix_ticks: measured ticks before a free run, in which its memory forms.

    Raises:
        ConfigError: a value out of range.
    """

    units: int = 96
    prefix_ticks: int = 30

    def __post_init__(self) -> None:
        check_bounds("recurrent twin", self, units=integer(1, MOST_UNITS), prefix_ticks=PREFIX)

    def start(self, channels: TwinChannels, scales: TwinScales, train: Sequence[Series], seed: int) -> RecurrentTwin:
        """An untrained one; its weights follow from the seed."""
        network = TwinNetwork(len(channels.commands), len(channels.answers), self.units)
        # Answers that start at no change at all make the first free runs stand still.
        network.draw(seed, 0.1)
        return RecurrentTwin(channels, scales, self.prefix_ticks, network)

    def shapes(self, channels: TwinChannels) -> dict[str, tuple[int, ...]]:
        """Those of the network."""
        with torch.device("meta"):  # a header says how wide it is: no memory before that is checked
            network = TwinNetwork(len(channels.commands), len(channels.answers), self.units)
        return {name: tuple(weight.shape) for name, weight in network.named_parameters()}

    def build(self, channels: TwinChannels, scales: TwinScales, arrays: Mapping[str, Array]) -> RecurrentTwin:
        """The twin with these weights."""
        network = TwinNetwork(len(channels.commands), len(channels.answers), self.units)
        network.load_state_dict({name: torch.from_numpy(np.array(arrays[name])) for name in self.shapes(channels)})
        return RecurrentTwin(channels, scales, self.prefix_ticks, network)


class CellWeights(nn.Module):
    """Weights of a cell that reads commands and `read` further numbers, and answers `answers` of them; zero."""

    def __init__(self, commands: int, read: int, answers: int, units: int) -> None:
        super().__init__()
        self.units = units
        self.command_weight = nn.Parameter(torch.zeros(3 * units, commands))
        self.bias = nn.Parameter(torch.zeros(3 * units))
        # Inputs first: the compiled loop multiplies rows of a batch with them.
        self.feedback_weight = nn.Parameter(torch.zeros(read, 3 * units))
        self.h_weight = nn.Parameter(torch.zeros(units, 3 * units))
        self.inner_bias = nn.Parameter(torch.zeros(units))
        self.out_weight = nn.Parameter(torch.zeros(units, answers))
        self.out_bias = nn.Parameter(torch.zeros(answers))

    def draw(self, seed: int, answers: float) -> None:
        """Draw weights with PyTorch's uniform bound, those of the answers times `answers`."""
        generator, bound = torch.Generator().manual_seed(seed), 1.0 / math.sqrt(self.units)
        with torch.no_grad():
            for name, weight in self.named_parameters():
                weight.uniform_(-bound, bound, generator=generator)
                if name.startswith("out"):
                    weight.mul_(answers)

    @property
    def looped(self) -> tuple[nn.Parameter, ...]:
        """What the compiled loop reads: all but the commands' part and the bias of the gates."""
        return self.feedback_weight, self.h_weight, self.inner_bias, self.out_weight, self.out_bias


class TwinNetwork(CellWeights):
    """The cell over scaled numbers, time first."""

    def __init__(self, commands: int, answers: int, units: int) -> None:
        super().__init__(commands, answers, answers, units)

    def forward(
        self, commands: Tensor, measured: Tensor, port: Tensor, start: tuple[Tensor, Tensor], bounds: Bounds
    ) -> tuple[Tensor, Tensor]:
        """Answers ``(time, batch, answer)`` and the h after them ``(batch, units)``.

        Args:
            commands: ``(time, batch, command)``.
            measured: ``(time, batch, answer)``, any finite number where `port` is 0.
            port: 1 where a port reads what was measured, 0 where it reads the last answer.
            start: last answer ``(batch, answer)`` and h ``(batch, units)``.
            bounds: of the answers.
        """
        projected = nn.functional.linear(commands, self.command_weight, self.bias)
        result = _Steps.apply(projected, measured, port, *start, *self.looped, bounds)  # type: ignore[no-untyped-call]
        return result[0], result[1]


@dataclass(frozen=True, eq=False)
class Bounds:
    """Of scaled answers: change by unit of output, low, high ``(answer,)``, trapezoid ``(stroke,)``; velocities."""

    change: Array
    low: Array
    high: Array
    trapezoid: Array
    velocities: int

    @staticmethod
    def of(channels: TwinChannels, scales: TwinScales) -> Bounds:
        """The bounds of a twin in its own numbers."""
        offset, width = scales.answer_offset, scales.answer_width
        low, high = (np.ascontiguousarray((end - offset) / width) for end in (scales.low, scales.high))
        change = np.ascontiguousarray(scales.change_width / width)
        return Bounds(change, low, high, scales.trapezoid(channels), len(channels.velocities))

    @property
    def arrays(self) -> tuple[Array, Array, Array, Array]:
        """As the compiled loop reads them."""
        return self.change, self.low, self.high, self.trapezoid


def _buffers(ticks: int, batch: int, answers: int, units: int) -> tuple[Array, ...]:
    """What `run_forward` writes: answers, fed values, where no bound acts, gates, inner sums, and h."""
    shapes = [(ticks, answers)] * 3 + [(ticks, 3 * units), (ticks, units), (ticks + 1, units)]
    return tuple(np.empty((time, batch, width), np.float32) for time, width in shapes)


class _Steps(torch.autograd.Function):
    """`run_forward` with `run_backward` as its adjoint."""

    @staticmethod
    def forward(
        ctx: Any, projected: Tensor, measured: Tensor, port: Tensor, answer: Tensor, h: Tensor, *rest: Any
    ) -> tuple[Tensor, Tensor]:
        weights = tuple(weight.detach().numpy() for weight in rest[:5])
        bounds: Bounds = rest[5]
        ticks, batch, width = measured.shape
        saved = _buffers(ticks, batch, width, h.shape[1])
        into, values, ports, last, memory = (
            np.ascontiguousarray(tensor.detach().numpy()) for tensor in (projected, measured, port, answer, h)
        )
        run_forward(into, values, ports, weights, bounds.arrays, bounds.velocities, (last, memory), saved)
        ctx.saved, ctx.port, ctx.weights, ctx.bounds = saved, ports, weights, bounds
        return torch.from_numpy(saved[0]), torch.from_numpy(saved[5][-1])

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_answers: Tensor, grad_h: Tensor) -> tuple[Tensor | None, ...]:
        _, fed, _, gates, inner, hs = ctx.saved
        by_gates, by_inner, by_out = np.empty_like(gates), np.empty_like(inner), np.empty_like(fed)
        by_answer, by_h = np.zeros_like(fed[0]), np.array(grad_h.numpy(), order="C")
        grads = (by_gates, by_inner, by_out, by_answer, by_h)
        incoming = np.ascontiguousarray(grad_answers.numpy())
        run_backward(incoming, ctx.port, ctx.weights, ctx.bounds.arrays, ctx.bounds.velocities, ctx.saved, grads)
        by_weights = weight_gradients(fed, hs, by_gates, by_inner, by_out)
        return (
            torch.from_numpy(by_gates),
            None,
            None,
            torch.from_numpy(by_answer),
            torch.from_numpy(by_h),
            *by_weights,
            None,
        )


def weight_gradients(read: Array, hs: Array, by_gates: Array, by_inner: Array, by_out: Array) -> tuple[Tensor, ...]:
    """Gradients of `CellWeights.looped`, from what a cell read, its h, and the adjoint's gradients; tick first."""
    units = by_inner.shape[2]

    # Gradients of the weights need all ticks at once: one large product replaces one small product a tick.
    def rows(values: Array) -> Tensor:
        return torch.from_numpy(values).flatten(0, 1)

    gate_rows, inner_rows, out_rows, before = rows(by_gates), rows(by_inner), rows(by_out), rows(hs[:-1])
    return (
        rows(read).t() @ gate_rows,
        torch.cat([before.t() @ gate_rows[:, : 2 * units], before.t() @ inner_rows], dim=1),
        inner_rows.sum(0),
        rows(hs[1:]).t() @ out_rows,
        out_rows.sum(0),
    )


class RecurrentTwin(Twin):
    """The network in SI units, without gradients. State: ``answer`` scaled, and ``h`` ``(batch, units)``."""

    def __init__(self, channels: TwinChannels, scales: TwinScales, prefix_ticks: int, network: TwinNetwork) -> None:
        super().__init__(channels, scales, prefix_ticks)
        self.network, self.bounds = network, Bounds.of(channels, scales)

    def initial_state(self, command: Array, measured: Array) -> TwinState:
        return {"answer": self.scaled(measured), "h": np.zeros((len(measured), self.network.units), np.float32)}

    def free_run(self, commands: Tensor, measured: Tensor, port: Tensor) -> Tensor:
        """Scaled answers ``(time, batch, answer)`` with gradients by the weights, from measured starts.

        Args:
            commands: scaled ``(time, batch, command)``.
            measured: scaled ``(time, batch, answer)``, any finite number where `port` is 0.
            port: 1 where a port reads what was measured; all of the first tick.
        """
        start = (measured[0], torch.zeros(measured.shape[1], self.network.units))
        answers, _ = self.network(commands, measured, port, start, self.bounds)
        return torch.as_tensor(answers)

    def _run(self, commands: Array, measured: Array, state: TwinState) -> tuple[Array, TwinState]:
        network, batch = self.network, len(commands)
        arrays = tuple(weight.detach().numpy() for weight in network.looped)
        command_weight, bias = network.command_weight.detach().numpy(), network.bias.detach().numpy()
        pieces, answer, h = [], state["answer"], state["h"]
        for at in range(0, commands.shape[1], PIECE):
            read = np.ascontiguousarray(self.scaled(measured[:, at : at + PIECE]).swapaxes(0, 1))
            port = np.isfinite(read).astype(np.float32)
            saved = _buffers(len(read), batch, read.shape[2], network.units)
            command_rows = self.scaled_commands(commands[:, at : at + PIECE]).swapaxes(0, 1)
            # A product a tick, so that a chunk and its single ticks round alike.
            projected = np.stack([row @ command_weight.T for row in command_rows]) + bias
            bounds = self.bounds
            run_forward(
                projected, np.nan_to_num(read), port, arrays, bounds.arrays, bounds.velocities, (answer, h), saved
            )
            pieces.append(saved[0].swapaxes(0, 1))
            answer, h = saved[0][-1].copy(), saved[5][-1].copy()
        answers = np.concatenate(pieces, axis=1) * self.scales.answer_width + self.scales.answer_offset
        return np.asarray(answers, dtype=np.float32), {"answer": answer, "h": h}

    def lower(self, build: Builder, commands: str, fed: str) -> str:
        network, solved = self.network, solved_columns(self.channels)
        arrays = {name: weight.detach().numpy() for name, weight in network.named_parameters()}
        # The commands' part has the gates' biases; the inner bias is that of n alone.
        inner = np.concatenate([np.zeros(2 * network.units, np.float32), arrays["inner_bias"]])
        h = build.add(
            Gru,
            "memory",
            build.join("read", commands, fed),
            weight_x=np.concatenate([arrays["command_weight"], arrays["feedback_weight"].T], axis=1),
            weight_h=arrays["h_weight"].T,
            bias_x=arrays["bias"],
            bias_h=inner,
        )
        unit = self.bounds.change[solved]
        weight, bias = unit[:, None] * arrays["out_weight"].T[solved], unit * arrays["out_bias"][solved]
        change = build.add(Dense, "change", h, weight=weight, bias=bias)
        return build.combine("proposed", BinaryOperation.ADD, build.pick("before", fed, solved), change)

    def arrays(self) -> dict[str, Array]:
        weights = {name: weight.detach().numpy().copy() for name, weight in self.network.named_parameters()}
        return self.scales.arrays() | weights
