"""What an alarm says: when, since when, by how much, and by whom it was raised; causes are named by a diagnosis."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

SEVERITIES = ("note", "warning", "stop")


@dataclass(frozen=True)
class MonitorAlarm:
    """One alarm of a monitor.

    Attributes:
        recording: that it was raised in; empty in a stream.
        raised_s: end of the block at which the statistic passed its limit, s from the start.
        since_s: estimate of the onset: end of the last block at which the statistic was at a healthy level.
        detector: name of the detector that raised it.
        statistic: over the scale of its watch.
        limit: that it passed.
        evidence: names of summaries with their mean conditioned deviation since `since_s`, in healthy standard
            deviations, the largest first.
        causes: dataclasses of a diagnosis, the most probable first; empty without one.
        sentence: all of this for a reader.
        severity: one of `SEVERITIES`.
    """

    recording: str
    raised_s: float
    since_s: float
    detector: str
    statistic: float
    limit: float
    evidence: tuple[tuple[str, float], ...]
    causes: tuple[Any, ...] = ()
    sentence: str = ""
    severity: str = "warning"

    def to_json(self) -> dict[str, Any]:
        """Plain JSON values, keys as the fields."""
        plain = asdict(self)
        plain["evidence"] = [[name, value] for name, value in self.evidence]
        return plain
