"""The columns of a recording, one after the other, each side by side in memory."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from edp.logs.quality.measures import Values
from edp.recording import Recording

PIECE_BYTES = 32 * 2**20
"""Size of the columns copied at once. Rows are contiguous, so that one column alone touches as much memory as 16."""


def columns(recording: Recording) -> Iterator[Values]:
    """Return each column of the values, float32, shape ``(time,)``; some are copied at once, and at least one."""
    values = recording.values
    each = max(1, PIECE_BYTES // max(1, 4 * len(values)))
    for first in range(0, values.shape[1], each):
        yield from np.ascontiguousarray(values[:, first : first + each].T)
