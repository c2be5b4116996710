"""Random rows for a self-test, equal in Python and C, so that the folder need not contain them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from edp.export.monitor.parts import ChainPart

JUDGED_BLOCKS = 80
"""Blocks of the self-test behind those that are not judged; in the second half residuals are shifted."""
MOST_TICKS = 200_000
"""Of the self-test; longer blocks are fewer."""
SHIFT = 2.0
"""Scales by which they are shifted."""
MISSING = 32
"""One number in so many is missing, at a quarter of the ticks."""
SEED = 1
Rows = NDArray[np.float32]


def golden_blocks(chain: ChainPart) -> int:
    """Blocks of the self-test."""
    return min(chain.settle + JUDGED_BLOCKS, max(2, MOST_TICKS // chain.block))


def drawn_rows(chain: ChainPart) -> tuple[Rows, Rows]:
    """Return random inputs ``(tick, input)`` and residuals ``(tick, residual)`` in their usual range, NaN if missing.

    A tick draws its inputs, then its residuals, each as ``centre + spread (2 u - 1)`` in single precision.
    """
    ticks, inputs, residuals = golden_blocks(chain) * chain.block, len(chain.centre), len(chain.scale)
    width = inputs + residuals
    draws = _lcg(ticks * (width + 1), SEED).reshape(ticks, width + 1)
    u = (draws[:, 1:] >> np.uint32(8)).astype(np.float32) * np.float32(2.0**-24)
    centre, spread, scale = usual_widths(chain)
    middle = np.concatenate([centre, np.zeros(residuals, np.float32)])
    values = middle + np.concatenate([spread, scale]) * (np.float32(2.0) * u - np.float32(1.0))
    late = np.arange(ticks) >= (golden_blocks(chain) - JUDGED_BLOCKS // 2) * chain.block
    values[late] += np.concatenate([np.zeros(inputs, np.float32), scale * np.float32(SHIFT)])
    holes = (draws[:, :1] >> np.uint32(30) == 0) & (draws[:, 1:] % np.uint32(MISSING) == 0)
    values[holes] = np.nan
    return values[:, :inputs], values[:, inputs:]


def usual_widths(chain: ChainPart) -> tuple[Rows, Rows, Rows]:
    """Middle and width of each input, and width of each residual, in single precision."""
    return (
        chain.centre.astype(np.float32),
        (1.0 / chain.spread).astype(np.float32),
        (1.0 / chain.scale).astype(np.float32),
    )


def _lcg(count: int, seed: int) -> NDArray[np.uint32]:
    """Numbers of the linear congruential generator of Numerical Recipes, modulo 2^32."""
    out = np.empty(count, np.uint32)
    x = seed
    for i in range(count):
        x = (1_664_525 * x + 1_013_904_223) & 0xFFFFFFFF
        out[i] = x
    return out
