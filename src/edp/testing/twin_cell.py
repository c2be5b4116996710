"""Plain implementation of the cell of a recurrent twin, sample by sample: reference for the compiled loop."""

from __future__ import annotations

import torch
from torch import Tensor

from edp.networks.twin.recurrent_cell import Bounds, TwinNetwork


def plain_steps(
    network: TwinNetwork,
    commands: Tensor,
    measured: Tensor,
    port: Tensor,
    start: tuple[Tensor, Tensor],
    bounds: Bounds,
    mapped: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Compute `TwinNetwork.forward` with the same arguments; autograd stores a graph of every sample."""
    change, low, high, trapezoid = (torch.from_numpy(values) for values in bounds.arrays)
    n, units, strokes = bounds.velocities, network.units, len(bounds.trapezoid)
    answer, h = start
    answers = []
    for t in range(len(commands)):
        fed = torch.where(port[t] > 0, measured[t], answer)
        into = commands[t] @ network.command_weight.T + network.bias + fed @ network.feedback_weight
        up = h @ network.h_weight
        soft = torch.sigmoid(into[:, : 2 * units] + up[:, : 2 * units])
        reset, keep = soft.chunk(2, dim=1)
        new = torch.tanh(into[:, 2 * units :] + reset * (up[:, 2 * units :] + network.inner_bias))
        h = new + keep * (h - new)
        value = fed + change * (h @ network.out_weight + network.out_bias)
        if mapped is not None:
            value = value + network.pulls(bounds) * (mapped[t] - fed)
        velocity = value[:, :n].clamp(low[:n], high[:n])
        rest = value[:, n + strokes :].clamp(low[n + strokes :], high[n + strokes :])
        parts = [velocity, rest]
        if strokes:
            s = slice(n, 2 * n)
            stroke = fed[:, s] + trapezoid * (fed[:, :n] + velocity)
            into_stop = ((stroke > high[s]) & (velocity > 0)) | ((stroke < low[s]) & (velocity < 0))
            parts = [velocity.masked_fill(into_stop, 0.0), stroke.clamp(low[s], high[s]), rest]
        answer = torch.cat(parts, dim=1)
        answers.append(answer)
    return torch.stack(answers), h
