"""Recordings without the targets: their inputs as a series."""

from __future__ import annotations

import numpy as np

from edp.data.series import Series
from edp.data.task import Task
from edp.errors import DataError
from edp.recording import Recording
from edp.wording import typed


def unlabelled(task: Task, recording: Recording) -> Series:
    """Return the inputs of a recording for a training strategy; target channels are not required.

    Raises:
        DataError: another rate, a missing input, or one that is not finite.
    """
    if abs(recording.rate_hz - task.rate_hz) > 1e-3 * task.rate_hz:
        raise DataError(
            f"recording '{recording.name}' has {typed(recording.rate_hz)} Hz, the task {typed(task.rate_hz)} Hz; "
            "the rates must "
            "be equal: set rate_hz in the signal map"
        )
    inputs = np.ascontiguousarray(recording.select(task.inputs))
    bad = ~np.isfinite(inputs)
    if bad.any():
        row, column = (int(i) for i in np.argwhere(bad)[0])
        raise DataError(
            f"recording '{recording.name}' ({recording.source}): channel '{task.inputs[column]}' has "
            f"{int(bad[:, column].sum())} missing or infinite value(s), the first at row {row}; repair the log or ask "
            'for a repair (nan = "hold")'
        )
    # Fill the targets with zeros, since a series needs columns for all targets.
    return Series(recording.name, inputs, np.zeros((len(inputs), len(task.targets)), dtype=np.float32))
