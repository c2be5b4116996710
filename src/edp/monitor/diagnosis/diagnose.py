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
"""Time after an alarm whose blocks are used to find the cause, s. An abrupt change raises an alarm within one block."""
MAX_ROWS = 180
"""Maximum number of blocks for a diagnosis. A longer segment is reduced to its last blocks, without an onset."""


def diagnosed(alarm: MonitorAlarm, dictionary: Dictionary, rows: Array, start: datetime | None = None) -> MonitorAlarm:
    """Return the alarm with causes, sentence and severity.

    Args:
        alarm: alarm of the chain.
        dictionary: dictionary of the monitor.
        rows: conditioned rows since the onset, shape (blocks, summaries).
        start: time of day at the start of the recording.
    """
    matched = match(dictionary, rows[-MAX_ROWS:], fresh=len(rows) <= MAX_ROWS)
    causes = causes_of(dictionary, matched)
    sentence = alarm_sentence(causes, alarm.since_s, start)
    return replace(alarm, causes=causes, sentence=sentence, severity=severity(causes))


def onset_of(since: int, earlier: Sequence[tuple[int, int]]) -> int:
    """Block after which a fault began: one that stays alarms again after each reset, and its first alarm knows.

    Args:
        since: block after which the deviation of this alarm began.
        earlier: blocks since which and at which the alarms before were raised, in order.
    """
    for began, raised in reversed(earlier):
        if since != raised:
            break
        since = began
    return since
