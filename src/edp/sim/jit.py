"""Compiling the simulator's inner loops, with an on-disk cache where one can be kept."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import numba

Function = TypeVar("Function", bound=Callable[..., Any])

# No "nnan"/"ninf": a diverging state must stay visible as NaN.
FASTMATH = {"nsz", "arcp", "contract", "afn", "reassoc"}


def compiled(function: Function) -> Function:
    """Compile with Numba; cache the machine code on disk, or do without where no folder is writable."""
    try:
        fast: Any = numba.njit(cache=True, fastmath=FASTMATH, error_model="numpy")(function)
    except RuntimeError:  # Numba found neither a writable source folder nor a writable user cache
        fast = numba.njit(fastmath=FASTMATH, error_model="numpy")(function)
    return fast  # type: ignore[no-any-return]
