"""Linear recurrences ``h = a h_before + b`` over time, forward and backward, real or complex."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable


def linear_scan(a: Tensor, b: Tensor, start: Tensor) -> Tensor:
    """Return ``h[t] = a[t] h[t - 1] + b[t]`` with ``h[-1] = start``.

    Args:
        a: ``(time, batch, unit)``, or ``(unit,)`` where it is the same at every tick.
        b: ``(time, batch, unit)``.
        start: ``(batch, unit)``.

    Returns:
        h, ``(time, batch, unit)``.
    """
    states: Tensor = _Scan.apply(a, b, start)  # type: ignore[no-untyped-call]
    return states


class _Scan(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, a: Tensor, b: Tensor, start: Tensor) -> Tensor:
        h = _run(a, b, start)
        ctx.save_for_backward(a, h, start)
        return h

    @staticmethod
    # The backward pass works in place and records no graph: a second derivative is refused instead of wrong.
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        a, h, start = ctx.saved_tensors
        constant = a.ndim == 1
        a = a.conj().resolve_conj()  # once: a lazy conjugate is made anew in every operation
        # The gradient runs the same recurrence from the last tick to the first, each with the factor of the next.
        after = a if constant else torch.cat([a[1:], a[:1]])
        total = _run(after, grad, torch.zeros_like(start), backwards=True)
        first = total[0] * (a if constant else a[0])
        before = torch.cat([start.unsqueeze(0), h[:-1]])
        if before.is_complex():
            before = torch.conj_physical_(before)
        by_a = before.mul_(total)
        return by_a.sum(dim=(0, 1)) if constant else by_a, total, first


def _run(a: Tensor, b: Tensor, start: Tensor, backwards: bool = False) -> Tensor:
    """Compute the recurrence with about ``2 sqrt(time)`` operations instead of one per sample.

    Blocks of ``sqrt(time)`` samples run in parallel from zero and store the products of their factors. The final state
    of each block is then added to the next block. The products cannot overflow, since ``|a| < 1``.
    """
    ticks, constant = len(b), a.ndim == 1
    # Blocks of sqrt(ticks) balance the steps inside a block with the joins between blocks.
    size = max(1, math.isqrt(ticks))
    blocks, left = divmod(ticks, size)
    order = -1 if backwards else 1
    # The blocks lie where the run begins, the ticks left over where it ends.
    whole, over = (slice(left, None), slice(left)) if backwards else (slice(ticks - left), slice(ticks - left, None))
    # The copy is the result: all steps below work in place on views of it.
    h = b.clone()
    inside = h[whole].view(blocks, size, *b.shape[1:])
    steps = inside.unbind(1)[::order]
    if constant:
        powers = [a]
        for k in range(1, size):
            steps[k].addcmul_(steps[k - 1], a)
            powers.append(powers[-1] * a)
        products = [torch.stack(powers[::order]).unsqueeze(1)] * blocks
        rest = [a] * left
    else:
        # Factors are multiplied up in place, so the caller's tensor must not be the one that changes.
        shrinking = a[whole].clone().view(blocks, size, *b.shape[1:])
        factors = shrinking.unbind(1)[::order]
        for k in range(1, size):
            steps[k].addcmul_(factors[k], steps[k - 1])
            factors[k].mul_(factors[k - 1])
        products = list(shrinking.unbind(0)[::order])
        rest = list(a[over].unbind(0)[::order])
    end = start
    for block, product in zip(inside.unbind(0)[::order], products, strict=True):
        end = block.addcmul_(product, end)[0 if backwards else -1]
    for row, factor in zip(h[over].unbind(0)[::order], rest, strict=True):
        end = row.addcmul_(factor, end)
    return h
