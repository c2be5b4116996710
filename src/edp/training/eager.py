"""Optimisers of PyTorch without its compiler, whose import takes a second at the start of each training.

The first step of an optimiser, and the first call of each method that the compiler must not trace, imports the compiler
with SymPy, 820 modules in all, only to tell it so. EDP compiles no training step. The classes here take the same steps,
to the bit, and keep everything else that they inherit, hooks included.
"""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable
from typing import Any

import torch

MARKED = ("add_param_group", "state_dict", "load_state_dict", "zero_grad")
"""Methods of `torch.optim.Optimizer` that are not to be compiled."""
_MARK = "__dynamo_disable"
"""Where `torch._compile` keeps what it calls instead of such a method."""
# PyTorch keeps what it wraps; a version that wraps nothing is taken as it is.
_adam_step: Callable[..., Any] = inspect.unwrap(torch.optim.Adam.step)
_sgd_step: Callable[..., Any] = inspect.unwrap(torch.optim.SGD.step)


class EagerAdamW(torch.optim.AdamW):
    """AdamW whose step imports no compiler."""

    @torch.no_grad()  # what the wrapper does besides, where the step is not itself differentiated
    def step(self, closure: Any = None) -> Any:
        """Return one step; see `torch.optim.AdamW.step`."""
        return _adam_step(self, closure)


class EagerSgd(torch.optim.SGD):
    """Gradient descent whose step imports no compiler."""

    @torch.no_grad()
    def step(self, closure: Any = None) -> Any:
        """Return one step; see `torch.optim.SGD.step`."""
        return _sgd_step(self, closure)


def _unmark() -> None:
    # Whoever loaded the compiler may want the marks.
    if "torch._dynamo" in sys.modules:
        return
    for name in MARKED:
        plain = getattr(getattr(torch.optim.Optimizer, name), "__wrapped__", None)
        if plain is not None and not hasattr(plain, _MARK):
            setattr(plain, _MARK, plain)


_unmark()
