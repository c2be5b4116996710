"""Random rows for a self-test, equal in Python and C, so that the folder need not contain them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from edp.export.c.text import array, reference_array
from edp.export.escape import Code
from edp.export.monitor.parts import MonitorParts
from edp.monitor.chain import MonitorChain

JUDGED_BLOCKS = 80
"""Number of evaluated blocks of the self-test, after the settling blocks. In the second half residuals are shifted."""
MOST_TICKS = 200_000
"""Maximum number of samples of the self-test. With longer blocks it has fewer blocks."""
SHIFT = 2.0
"""Shift of the residuals in the self-test, in units of their scale."""
MISSING = 32
"""Inverse fraction of missing values in the self-test, in a quarter of the samples."""
SEED = 1
Rows = NDArray[np.float32]


def golden_blocks(chain: MonitorChain) -> int:
    """Return the number of blocks of the self-test."""
    return min(chain.settle + JUDGED_BLOCKS, max(2, MOST_TICKS // chain.summaries.block))


def drawn_rows(chain: MonitorChain) -> tuple[Rows, Rows]:
    """Return random inputs ``(tick, input)`` and residuals ``(tick, residual)`` in their usual range, NaN if missing.

    A tick draws its inputs, then its residuals, each as ``centre + spread (2 u - 1)`` in single precision.
    """
    block, inputs, residuals = chain.summaries.block, len(chain.summaries.centre), chain.summaries.residuals
    ticks = golden_blocks(chain) * block
    width = inputs + residuals
    draws = _lcg(ticks * (width + 1), SEED).reshape(ticks, width + 1)
    u = (draws[:, 1:] >> np.uint32(8)).astype(np.float32) * np.float32(2.0**-24)
    centre, spread, scale = usual_widths(chain)
    middle = np.concatenate([centre, np.zeros(residuals, np.float32)])
    values = middle + np.concatenate([spread, scale]) * (np.float32(2.0) * u - np.float32(1.0))
    late = np.arange(ticks) >= (golden_blocks(chain) - JUDGED_BLOCKS // 2) * block
    values[late] += np.concatenate([np.zeros(inputs, np.float32), scale * np.float32(SHIFT)])
    holes = (draws[:, :1] >> np.uint32(30) == 0) & (draws[:, 1:] % np.uint32(MISSING) == 0)
    values[holes] = np.nan
    return values[:, :inputs], values[:, inputs:]


def usual_widths(chain: MonitorChain) -> tuple[Rows, Rows, Rows]:
    """Return the middle and width of each input, and width of each residual, in single precision."""
    summaries = chain.summaries
    centre, spread, scale = summaries.centre, 1.0 / summaries.spread, 1.0 / summaries.scale
    return centre.astype(np.float32), spread.astype(np.float32), scale.astype(np.float32)


def _lcg(count: int, seed: int) -> NDArray[np.uint32]:
    """Return pseudo-random integers modulo 2^32 by the linear congruential generator of Numerical Recipes."""
    out = np.empty(count, np.uint32)
    x = seed
    for i in range(count):
        x = (1_664_525 * x + 1_013_904_223) & 0xFFFFFFFF
        out[i] = x
    return out


def golden_header(name: str, parts: MonitorParts) -> Code:
    """Return the reference values of a self-test as a header."""
    chain, rows = parts.golden_chain, parts.golden_residuals
    widths = dict(zip(("centre", "spread", "scale"), usual_widths(parts.chain), strict=True))
    lines = [
        f"/* What {name} gives in Python: statistics of drawn rows, and residuals of a stretch. */",
        reference_array("double", "golden_statistics", chain.statistics, missing=True),
        array("int32_t", "golden_alarms", map(str, chain.alarms)),
        array("int32_t", "golden_since", map(str, chain.since)),
        reference_array("double", "golden_evidence", chain.evidence, missing=True),
        *(reference_array("float", f"golden_{what}", values, missing=True) for what, values in widths.items()),
        f"#define GOLDEN_TICKS {len(rows.inputs)}u",
        reference_array("float", "golden_inputs", rows.inputs, missing=True),
        reference_array("float", "golden_residuals", rows.residuals, missing=True),
        reference_array("float", "golden_tolerance", rows.tolerance, missing=True),
    ]
    return Code("\n".join(lines) + "\n")
