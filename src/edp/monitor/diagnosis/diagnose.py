"""An alarm with its causes, in words: from the rows since its onset and the dictionary of its monitor."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from datetime import datetime

import numpy as np
from numpy.typing import NDArray

from edp.monitor.alarms import MonitorAlarm
from edp.monitor.diagnosis.matching import causes_of, match
from edp.monitor.diagnosis.sentences import alarm_sentence
from edp.monitor.diagnosis.severity import severity
from edp.monitor.diagnosis.signatures import Dictionary

Array = NDArray[np.float64]
AFTER_S = 60.0
"""Time after an alarm whose rows name its cause where a log has them: a change at once is alarmed within a block."""
MOST_ROWS = 180
"""Blocks that name a cause: of a longer stretch the last ones, and no onset."""


def diagnosed(
    alarm: MonitorAlarm, dictionary: Dictionary, rows: Array, fresh: bool = True, start: datetime | None = None
) -> MonitorAlarm:
    """The alarm with causes, sentence and severity.

    Args:
        alarm: as the chain raised it.
        dictionary: of the monitor.
        rows: conditioned rows since the onset, shape (blocks, summaries).
        fresh: whether they begin at an onset.
        start: of the recording, as a time of day.
    """
    late = len(rows) > MOST_ROWS
    found = match(dictionary, rows[-MOST_ROWS:], fresh and not late)
    causes = causes_of(dictionary, found)
    sentence = alarm_sentence(causes, alarm.since_s, start)
    return replace(alarm, causes=causes, sentence=sentence, severity=severity(causes))


def onset_of(since: int, alarms: Sequence[tuple[int, int]]) -> tuple[int, bool]:
    """Block after which a fault began, and whether it is known.

    A fault that stays alarms again after each reset: its onset is that of the first alarm of the row.

    Args:
        since: block after which the deviation of this alarm began.
        alarms: (since, raised) of the alarms before, in order.
    """
    for earlier_since, raised in reversed(alarms):
        if since != raised:
            break
        since = earlier_since
    return since, True
