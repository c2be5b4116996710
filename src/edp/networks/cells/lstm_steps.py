"""The LSTM's recurrence with optional layer norm and zoneout, forward and backward by hand.

Autograd over a loop of small operations spends its time on bookkeeping. Here what does not depend on the previous
tick (input projections, derivatives of the gates, gradients of the weights) is done for all ticks at once, and only
the recurrence itself is a loop, without a graph. Views of all ticks are made at once, since making one costs as much
as a small operation.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

EPSILON = 1e-5  # in the variance of layer norm

Shares = tuple[Tensor, Tensor] | float
"""Fractions of the new h and c that an LSTM with zoneout takes: arrays of 0 and 1, each ``(time, batch, units)``, or
one number."""

Norm = tuple[Tensor, Tensor, Tensor]
"""Layer normalisation of an LSTM: gain of the normalised ``U h``, gain and shift of the normalised c."""


def output_first(weight: Tensor) -> Tensor:
    """Return the rows of PyTorch's gate order i, f, g, o in the order o, i, f, g.

    So one call squashes the three sigmoid gates, and one product gives the gradients of the three that make c.
    """
    i, f, g, o = weight.chunk(4, dim=0)
    return torch.cat([o, i, f, g])


def lstm_steps(
    projected: Tensor, recurrent: Tensor, norm: Norm | None, state: tuple[Tensor, Tensor], share: Shares
) -> tuple[Tensor, tuple[Tensor, Tensor]]:
    """Run ``c~ = f c + i g``, ``h~ = o tanh(c~)`` over time, gates in the order o, i, f, g.

    Args:
        projected: input part of the pre-activations, including all biases, ``(time, batch, 4 units)``.
        recurrent: ``(4 units, units)``.
        norm: layer normalisation, optional: ``U h`` is normalised and multiplied by ``(4 units,)``; ``tanh`` acts on c
            after normalisation, multiplication and addition of ``(units,)`` each.
        state: h and c, each ``(batch, units)``.
        share: fraction of the new state, ``h = h_before + share (h~ - h_before)``, and equally for c; 1 without
            zoneout.

    Returns:
        h at every tick, ``(time, batch, units)``, and (h, c) after the last.
    """
    h, c = _Steps.apply(projected, recurrent, torch.stack(state), share, *(norm or ()))  # type: ignore[no-untyped-call]
    return h, (h[-1], c)


class _Steps(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, projected: Tensor, recurrent: Tensor, state: Tensor, share: Shares, *norm: Tensor
    ) -> tuple[Tensor, Tensor]:
        gain, c_gain, c_shift = norm or (None, None, None)
        ticks, batch, units = len(projected), state.shape[1], state.shape[2]
        hs, cs = (projected.new_empty(ticks + 1, batch, units) for _ in range(2))
        hs[0], cs[0] = state
        keep = _each(share, ticks)
        # Without zoneout the new c is the kept c: the buffer is shared and a copy a tick is saved.
        fresh_cs = cs[1:] if keep is None else projected.new_empty(ticks, batch, units)
        gates, squashed = torch.empty_like(projected), projected.new_empty(ticks, batch, units)
        down = recurrent.t().contiguous()
        h, c, fresh, tanh = (values.unbind(0) for values in (hs, cs, fresh_cs, squashed))
        into, out, soft = projected.unbind(0), gates.unbind(0), gates[..., : 3 * units].unbind(0)
        o, i, f, g = (gate.unbind(0) for gate in gates.chunk(4, dim=2))
        norms = _Norms(gain, c_gain, c_shift)
        for t in range(ticks):
            if gain is None:
                torch.addmm(into[t], h[t], down, out=out[t])
            else:
                torch.add(into[t], norms.sums(h[t] @ down), out=out[t])
            soft[t].sigmoid_()
            g[t].tanh_()
            torch.mul(f[t], c[t], out=fresh[t]).addcmul_(i[t], g[t])
            torch.tanh(fresh[t] if gain is None else norms.cell(fresh[t]), out=tanh[t])
            torch.mul(o[t], tanh[t], out=h[t + 1])
            if keep is not None:
                torch.lerp(h[t], h[t + 1], keep[0][t], out=h[t + 1])
                torch.lerp(c[t], fresh[t], keep[1][t], out=c[t + 1])
        ctx.save_for_backward(recurrent, gain, c_gain, hs, cs, fresh_cs, gates, squashed, *norms.held())
        ctx.share = share
        return hs[1:], cs[-1].clone()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_h: Tensor, grad_c: Tensor) -> tuple[Tensor | None, ...]:
        recurrent, gain, c_gain, hs, cs, fresh_cs, gates, squashed, *norm_tensors = ctx.saved_tensors
        ticks, batch, units = squashed.shape
        by_c, by_o, through, f, grad = (
            values.unbind(0) for values in (*_derivatives(gates, squashed, cs), gates.chunk(4, dim=2)[2], grad_h)
        )
        grads = torch.empty_like(gates)
        whole, to_o = grads.unbind(0), grads[..., :units].unbind(0)
        to_c = grads.view(ticks, batch, 4, units)[:, :, 1:].unbind(0)
        norms = None if gain is None else _NormsBackward(gain, c_gain, norm_tensors, fresh_cs)
        keep = _each(ctx.share, ticks)
        dh, dc = grad[-1], grad_c
        for t in range(ticks - 1, -1, -1):
            fresh_h, fresh_c = (dh, dc) if keep is None else (dh * keep[0][t], dc * keep[1][t])
            if norms is None:
                total = torch.addcmul(fresh_c, fresh_h, through[t])
            else:
                total = fresh_c + norms.cell(fresh_h * through[t], t)
            # The gradient is written into the slices of one buffer, so that the weights' gradient is one product at
            # the end.
            torch.mul(by_c[t], total.unsqueeze(1), out=to_c[t])
            torch.mul(by_o[t], fresh_h, out=to_o[t])
            row = whole[t] if norms is None else norms.sums(whole[t], t)
            # What reaches h before this tick past the gates: by zoneout, and from the output there.
            past = [] if keep is None else [dh - fresh_h]
            past += [grad[t - 1]] if t else []
            base = past[0] + past[1] if len(past) == 2 else past[0] if past else None
            dc = total * f[t] if keep is None else torch.addcmul(dc - fresh_c, total, f[t])
            dh = row @ recurrent if base is None else torch.addmm(base, row, recurrent)
        rows = grads if norms is None else norms.rows()
        by_norm = () if norms is None else norms.gradients(grads)
        by_recurrent = rows.flatten(0, 1).t() @ hs[:-1].flatten(0, 1)
        return grads, by_recurrent, torch.stack([dh, dc]), None, *by_norm


def _each(share: Shares, ticks: int) -> tuple[Sequence[Tensor | float], Sequence[Tensor | float]] | None:
    """Return the update fractions of h and c for each sample; None for a full update."""
    if isinstance(share, tuple):
        return share[0].unbind(0), share[1].unbind(0)
    return None if share == 1.0 else ([share] * ticks, [share] * ticks)


def _derivatives(gates: Tensor, squashed: Tensor, cs: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return derivatives of c~ by i, f, g pre-activations ``(time, batch, 3, units)``, of h~ by o's and tanh's."""
    o, i, f, g = gates.chunk(4, dim=2)
    # Derivatives of all ticks at once; only the product with the incoming gradient remains in the loop.
    by_c = torch.stack([g * i * (1 - i), cs[:-1] * f * (1 - f), i * (1 - g.square())], dim=2)
    return by_c, squashed * o * (1 - o), o * (1 - squashed.square())


class _Norms:
    """The two layer norms of the recurrence, tick by tick, and what their backward needs."""

    def __init__(self, gain: Tensor | None, c_gain: Tensor | None, c_shift: Tensor | None) -> None:
        self.gain, self.c_gain, self.c_shift = gain, c_gain, c_shift
        self.of_sums: list[tuple[Tensor, Tensor, Tensor]] = []
        self.of_cell: list[tuple[Tensor, Tensor]] = []

    def sums(self, sums: Tensor) -> Tensor:
        y, mean, scale = torch.native_layer_norm(sums, [sums.shape[1]], self.gain, None, EPSILON)
        self.of_sums.append((sums, mean, scale))
        # Mean and scale are kept from the forward pass; computing them again would double the cost of the norm.
        return y

    def cell(self, c: Tensor) -> Tensor:
        y, mean, scale = torch.native_layer_norm(c, [c.shape[1]], self.c_gain, self.c_shift, EPSILON)
        self.of_cell.append((mean, scale))
        return y

    def held(self) -> list[Tensor]:
        """Return sums, means and scales of the sums, then means and scales of c, each over all samples."""
        columns = [*zip(*self.of_sums, strict=True), *zip(*self.of_cell, strict=True)]
        return [torch.stack(column) for column in columns]


class _NormsBackward:
    """Gradients through the two layer norms, from the last tick to the first."""

    def __init__(self, gain: Tensor, c_gain: Tensor, norm_tensors: Sequence[Tensor], cs: Tensor) -> None:
        sums, mean, scale, c_mean, c_scale = norm_tensors
        self.gain, self.c_gain = gain, c_gain
        self.normed, self.c_normed = (sums - mean) * scale, (cs - c_mean) * c_scale
        self.of_sums = [values.unbind(0) for values in (sums, mean, scale)]
        self.of_cell = [values.unbind(0) for values in (cs, c_mean, c_scale)]
        self.made: list[Tensor] = []
        self.c_grads: list[Tensor] = []

    def sums(self, grad: Tensor, t: int) -> Tensor:
        self.made.append(_norm_backward(grad, self.of_sums, t, self.gain))
        return self.made[-1]

    def cell(self, grad: Tensor, t: int) -> Tensor:
        self.c_grads.append(grad)
        return _norm_backward(grad, self.of_cell, t, self.c_gain)

    def rows(self) -> Tensor:
        """Return the gradients by ``U h`` at every tick."""
        # The loop runs from the last tick to the first, so the list is turned round.
        return torch.stack(self.made[::-1])

    def gradients(self, grads: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the gradients by the gain of the sums, and by gain and shift of c."""
        c_grads = torch.stack(self.c_grads[::-1])
        by_gain = (grads * self.normed).sum(dim=(0, 1))
        return by_gain, (c_grads * self.c_normed).sum(dim=(0, 1)), c_grads.sum(dim=(0, 1))


def _norm_backward(grad: Tensor, seen: Sequence[Sequence[Tensor]], t: int, gain: Tensor) -> Tensor:
    """Return the gradient by the input of a layer norm at tick t; `seen` are inputs, means and scales of all ticks."""
    x, mean, scale = (values[t] for values in seen)
    gradients: tuple[Tensor, ...] = torch.ops.aten.native_layer_norm_backward(
        grad, x, [x.shape[1]], mean, scale, gain, None, [True, False, False]
    )
    return gradients[0]
