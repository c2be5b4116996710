"""Whether a data set is one for the preset auto."""

from __future__ import annotations

from edp.data.prepared import Prepared
from edp.storage.memory import check_setting
from edp.wording import typed

COPIES = 8
"""Of what is predicted at each tick, in double precision: the truth, and what each candidate said of it."""


def check_size(data: Prepared) -> None:
    """Refuse data of which not all ticks can be judged in memory: every candidate is compared on every tick.

    Raises:
        ConfigError: says what it would take, what is free, and what to do.
    """
    ticks = sum(part.samples for part in (*data.train, *data.validation))
    outputs = len(data.task.horizons) * len(data.task.targets)
    check_setting(
        8 * COPIES * ticks * outputs,
        f"the preset auto, which compares its candidates on all {typed(ticks / data.task.rate_hz / 3600)} h of "
        "training",
        "train with --preset standard, which reads a store piece by piece, or give a data-set file of some logs",
    )
