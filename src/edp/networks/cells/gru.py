"""The GRU layer, forward and backward by hand: autograd's bookkeeping costs PyTorch's own a multiple on the CPU."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from edp.ir import Builder
from edp.ir.memory import Gru as GruLayer
from edp.networks.cells.base import CELLS
from edp.networks.streaming import Cost, Operation, State, Streaming, parameters_of


@CELLS.register("gru")
@dataclass(frozen=True, kw_only=True)
class GruCell:
    """GRU (eq. 3.12 to 3.15) as PyTorch has it.

    The reset gate acts after the linear map, ``n = tanh(W x + b + r (U h + b'))``, where eq. 3.14 has ``U (r h)``,
    and there are two bias vectors; PyTorch's z is one minus that of the thesis. Parameters are those of ``nn.GRU``.
    """

    family: ClassVar[str] = "gru"
    zoneout: ClassVar[bool] = False

    def build(self, width_in: int, units: int, zoneout: float) -> Streaming:
        """Return one layer."""
        return StreamingGru(width_in, units)


class StreamingGru(Streaming):
    """GRU layer; the state is h ``(batch, units)``, zero at reset."""

    operations = frozenset({Operation.GRU})
    matrices = (("weight_ih", (0,)), ("weight_hh", (0,)))

    def __init__(self, width_in: int, units: int) -> None:
        super().__init__()
        self.width_in, self.units = width_in, units
        # The uniform bound 1/sqrt(units) is PyTorch's, so that results compare with its own layer.
        bound = 1.0 / math.sqrt(units)
        self.weight_ih = nn.Parameter(torch.empty(3 * units, width_in).uniform_(-bound, bound))
        self.weight_hh = nn.Parameter(torch.empty(3 * units, units).uniform_(-bound, bound))
        self.bias_ih = nn.Parameter(torch.empty(3 * units).uniform_(-bound, bound))
        self.bias_hh = nn.Parameter(torch.empty(3 * units).uniform_(-bound, bound))

    def initial_state(self, batch: int, like: Tensor) -> State:
        return like.new_zeros(batch, self.units)

    def forward(self, x: Tensor, state: State) -> tuple[Tensor, State]:
        projected = nn.functional.linear(x.transpose(0, 1), self.weight_ih, self.bias_ih)
        y: Tensor = _Steps.apply(projected, self.weight_hh, self.bias_hh, state)  # type: ignore[no-untyped-call]
        return y.transpose(0, 1), y[-1]

    def lower(self, build: Builder, x: str) -> str:
        weights = {"weight_x": self.weight_ih, "weight_h": self.weight_hh}
        return build.add(GruLayer, "gru", x, **weights, bias_x=self.bias_ih, bias_h=self.bias_hh)

    def costs(self) -> list[Cost]:
        width, units = self.width_in, self.units
        macs = 3 * units * (width + units)
        return [Cost(f"GRU {width}->{units}", parameters_of(self), per_column=macs, width_in=width, width_out=units)]


class _Steps(torch.autograd.Function):
    """h at every tick from ``(time, batch, 3 units)`` projections, gates in the order r, z, n."""

    @staticmethod
    def forward(ctx: Any, projected: Tensor, recurrent: Tensor, bias: Tensor, h: Tensor) -> Tensor:
        ticks, batch, units = projected.shape[0], h.shape[0], h.shape[1]
        hs = projected.new_empty(ticks + 1, batch, units)
        hs[0] = h
        gates, inner = torch.empty_like(projected), torch.empty_like(projected)
        # A contiguous transpose: the product of each tick reads it row by row.
        down = recurrent.t().contiguous()
        into_soft, into_new = (part.unbind(0) for part in projected.split([2 * units, units], dim=2))
        up_soft, up_new = (part.unbind(0) for part in inner.split([2 * units, units], dim=2))
        soft, new = (part.unbind(0) for part in gates.split([2 * units, units], dim=2))
        reset, keep = (part.unbind(0) for part in gates[..., : 2 * units].chunk(2, dim=2))
        hidden, up = hs.unbind(0), inner.unbind(0)
        for t in range(ticks):
            # Views are unbound once before the loop; indexing inside it would cost more than the small products.
            torch.addmm(bias, hidden[t], down, out=up[t])
            torch.add(into_soft[t], up_soft[t], out=soft[t]).sigmoid_()
            torch.addcmul(into_new[t], reset[t], up_new[t], out=new[t]).tanh_()
            torch.lerp(new[t], hidden[t], keep[t], out=hidden[t + 1])
        ctx.save_for_backward(recurrent, hs, gates, inner)
        return hs[1:]

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_h: Tensor) -> tuple[Tensor | None, ...]:
        recurrent, hs, gates, inner = ctx.saved_tensors
        ticks, batch, units = grad_h.shape
        reset, keep, new = gates.chunk(3, dim=2)
        # Derivatives of h by the pre-activations, for all ticks; those of n by way of U h differ by the reset gate.
        by_new = (1 - keep) * (1 - new.square())
        by_reset = by_new * inner[..., 2 * units :] * reset * (1 - reset)
        by_keep = (hs[:-1] - new) * keep * (1 - keep)
        factors = torch.stack([by_reset, by_keep, by_new * reset], dim=2)
        grads, totals = torch.empty_like(factors), torch.empty_like(hs[1:])
        flat = grads.view(ticks, batch, 3 * units).unbind(0)
        # Unbound views again, one list for each operand of the loop.
        grad_of, total_of, keep_of, grads_of, factors_of = (
            values.unbind(0) for values in (grad_h, totals, keep, grads, factors)
        )
        dh = torch.zeros_like(hs[0])
        for t in range(ticks - 1, -1, -1):
            total = torch.add(dh, grad_of[t], out=total_of[t])
            torch.mul(factors_of[t], total.unsqueeze(1), out=grads_of[t])
            dh = torch.addmm(total * keep_of[t], flat[t], recurrent)
        # Gradients of the weights need all ticks at once: one large product replaces one small product a tick.
        rows = grads.view(ticks * batch, 3 * units)
        by_recurrent, by_bias = rows.t() @ hs[:-1].flatten(0, 1), rows.sum(dim=0)
        # The gradient by the input of n lacks the reset gate, which acts on U h only.
        grads = grads.clone()
        torch.mul(by_new, totals, out=grads[:, :, 2])
        return grads.flatten(2), by_recurrent, by_bias, dh
