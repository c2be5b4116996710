"""Cell of a twin with feedback ports and its weight gradients: a GRU that outputs changes."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from edp.data.twin_channels import TwinChannels
from edp.networks.twin.scales import Array, TwinScales
from edp.networks.twin.steps import run_backward, run_forward


class CellWeights(nn.Module):
    """Weights of a cell with commands, `read` more inputs and `answers` outputs, initially zero."""

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
        """Set random weights with PyTorch's uniform bound; output weights are multiplied by `answers`."""
        generator, bound = torch.Generator().manual_seed(seed), 1.0 / math.sqrt(self.units)
        with torch.no_grad():
            for name, weight in self.named_parameters():
                if name == "pull":  # it starts where it is
                    continue
                weight.uniform_(-bound, bound, generator=generator)
                if name.startswith("out"):
                    weight.mul_(answers)

    @property
    def looped(self) -> tuple[nn.Parameter, ...]:
        """Parameters that the compiled loop reads: all except the command weights and the bias of the gates."""
        return self.feedback_weight, self.h_weight, self.inner_bias, self.out_weight, self.out_bias


class TwinNetwork(CellWeights):
    """Cell over scaled values, time first.

    Args:
        commands: number of commands.
        answers: number of outputs.
        units: width of the memory.
        pulled: outputs that a static map pulls, all but the strokes; 0 without a map.
    """

    def __init__(self, commands: int, answers: int, units: int, pulled: int = 0) -> None:
        super().__init__(commands, answers, answers, units)
        # Start with full pull, so that an untrained network reproduces the static map.
        self.pull = nn.Parameter(torch.ones(pulled)) if pulled else None

    def forward(
        self,
        commands: Tensor,
        measured: Tensor,
        port: Tensor,
        start: tuple[Tensor, Tensor],
        bounds: Bounds,
        mapped: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Return outputs ``(time, batch, output)`` and the final h ``(batch, units)``.

        Args:
            commands: ``(time, batch, command)``.
            measured: ``(time, batch, output)``, any finite number where `port` is 0.
            port: 1 if a port reads the measured value, 0 if it reads the last output.
            start: last output ``(batch, output)`` and h ``(batch, units)``.
            bounds: bounds of the outputs.
            mapped: outputs of the static map ``(time, batch, output)``, zero for strokes; None without a map.
        """
        projected = nn.functional.linear(commands, self.command_weight, self.bias)
        mapped = torch.zeros(0, 0, 0) if mapped is None else mapped
        weights = (*self.looped, self.pulls(bounds))
        result = _Steps.apply(projected, measured, port, *start, *weights, mapped, bounds)  # type: ignore[no-untyped-call]
        return result[0], result[1]

    def pulls(self, bounds: Bounds) -> Tensor:
        """Return the fraction by which each output is pulled to the map per sample, 0 for strokes.

        Empty without a map.
        """
        if self.pull is None:
            return torch.zeros(0)
        strokes = torch.zeros(len(bounds.trapezoid))
        share, velocities = self.pull.clamp(0.0, 1.0), bounds.velocities
        return torch.cat([share[:velocities], strokes, share[velocities:]])


@dataclass(frozen=True, eq=False)
class Bounds:
    """Bounds of scaled outputs: change per unit of output, low, high ``(output,)``, trapezoid ``(stroke,)``.

    Velocities.
    """

    change: Array
    low: Array
    high: Array
    trapezoid: Array
    velocities: int

    @staticmethod
    def from_scales(channels: TwinChannels, scales: TwinScales) -> Bounds:
        """Return the bounds of a twin in its scaled units."""
        offset, width = scales.answer_offset, scales.answer_width
        low, high = (np.ascontiguousarray((end - offset) / width) for end in (scales.low, scales.high))
        change = np.ascontiguousarray(scales.change_width / width)
        return Bounds(change, low, high, scales.trapezoid(channels), len(channels.velocities))

    @property
    def arrays(self) -> tuple[Array, Array, Array, Array]:
        """Return the arrays for the compiled loop."""
        return self.change, self.low, self.high, self.trapezoid


def buffers(ticks: int, batch: int, answers: int, units: int) -> tuple[Array, ...]:
    """Allocate the arrays of `run_forward`: outputs, feedback, mask of inactive bounds, gates, inner sums, and h."""
    shapes = [(ticks, answers)] * 3 + [(ticks, 3 * units), (ticks, units), (ticks + 1, units)]
    return tuple(np.empty((time, batch, width), np.float32) for time, width in shapes)


class _Steps(torch.autograd.Function):
    """`run_forward` with `run_backward` as its adjoint."""

    @staticmethod
    def forward(
        ctx: Any, projected: Tensor, measured: Tensor, port: Tensor, answer: Tensor, h: Tensor, *rest: Any
    ) -> tuple[Tensor, Tensor]:
        bounds: Bounds = rest[7]
        ticks, batch, width = measured.shape
        saved = buffers(ticks, batch, width, h.shape[1])
        inputs, weights = (
            tuple(np.ascontiguousarray(tensor.detach().numpy()) for tensor in tensors)
            for tensors in ((projected, measured, port, rest[6]), rest[:6])
        )
        start = (np.ascontiguousarray(answer.detach().numpy()), np.ascontiguousarray(h.detach().numpy()))
        run_forward(inputs, weights, bounds.arrays, bounds.velocities, start, saved)
        ctx.saved, ctx.inputs, ctx.weights, ctx.bounds = saved, inputs, weights, bounds
        return torch.from_numpy(saved[0]), torch.from_numpy(saved[5][-1])

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_answers: Tensor, grad_h: Tensor) -> tuple[Tensor | None, ...]:
        _, fed, _, gates, inner, hs = ctx.saved
        by_gates, by_inner, by_out = np.empty_like(gates), np.empty_like(inner), np.empty_like(fed)
        by_answer, by_h = np.zeros_like(fed[0]), np.array(grad_h.numpy(), order="C")
        grads = (by_gates, by_inner, by_out, by_answer, by_h)
        incoming = np.ascontiguousarray(grad_answers.numpy())
        (_, _, port, mapped), bounds = ctx.inputs, ctx.bounds
        run_backward(incoming, port, ctx.weights, bounds.arrays, bounds.velocities, ctx.saved, grads)
        pull = ctx.weights[5]
        by_pull = ((mapped - fed) * (by_out / bounds.change)).sum((0, 1)) if len(pull) else np.zeros(0, np.float32)
        by_weights = weight_gradients(fed, hs, by_gates, by_inner, by_out)
        return (
            torch.from_numpy(by_gates),
            None,
            None,
            torch.from_numpy(by_answer),
            torch.from_numpy(by_h),
            *by_weights,
            torch.from_numpy(by_pull),
            None,
            None,
        )


def weight_gradients(read: Array, hs: Array, by_gates: Array, by_inner: Array, by_out: Array) -> tuple[Tensor, ...]:
    """Return the gradients of `CellWeights.looped` from cell inputs, h and the adjoint's gradients; time first."""
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
