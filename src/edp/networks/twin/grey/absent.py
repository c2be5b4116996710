"""Placeholder arguments of `edp.networks.twin.grey.run.run_lanes` for runs without cell, trace or sums."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from edp.networks.twin.grey.correction import Cell, Trace

NO_SUMS = (np.zeros((0, 0)), np.zeros(0), np.zeros(0))


def _singles(*dimensions: int) -> tuple[NDArray[np.float32], ...]:
    return tuple(np.zeros((0,) * count, np.float32) for count in dimensions)


NO_CELL: Cell = (*_singles(3, 2, 2, 2, 1, 2, 1), *NO_SUMS[1:], np.zeros(0), np.zeros(0, np.int64))  # type: ignore[assignment]
NO_TRACE: Trace = _singles(3, 3, 3, 3, 3, 4, 2)  # type: ignore[assignment]
