"""Memory order of weight matrices in the C code."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from edp.ir import Layer
from edp.ir.layers import GroupedDense

# Sixteen rows: measured on a Cortex-M4F, 165,833 instead of 193,784 instructions a tick (docs/journal).
PANEL = 16
"""Number of rows that a matrix product computes in parallel: `EDP_PANEL` of the runtime."""


def laid(layer: Layer, name: str, values: NDArray[Any]) -> NDArray[Any]:
    """Return the elements of a constant in the order of the C code.

    Matrices lie in panels of `PANEL` rows, in each of them column by column, so that a processor with vectors reads
    neighbours; the rows that are left over lie one after the other.
    """
    if name not in layer.matrices:
        return values.ravel()
    if isinstance(layer, GroupedDense):
        return np.concatenate([_panels(matrix) for matrix in values])
    return _panels(values.reshape(len(values), -1))


def _panels(matrix: NDArray[Any]) -> NDArray[Any]:
    rows, columns = matrix.shape
    # Rows beyond the last whole panel are few and stay row by row.
    whole = rows - rows % PANEL
    packed = matrix[:whole].reshape(-1, PANEL, columns).transpose(0, 2, 1)
    return np.concatenate([packed.ravel(), matrix[whole:].ravel()])
