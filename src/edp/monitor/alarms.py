"""Alarms: time, onset, strength, and the detector that raised them; a diagnosis names causes."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Literal, Protocol, TypeVar

from edp.monitor.diagnosis.causes import NONE_OF_THESE, Cause
from edp.storage.reading import Table

Severity = Literal["note", "warning", "stop"]


@dataclass(frozen=True)
class MonitorAlarm:
    """One alarm of a monitor.

    Attributes:
        recording: recording of the alarm; empty for a stream.
        raised_s: end of the block at which the statistic passed its limit, s from the start.
        since_s: estimate of the onset: end of the last block at which the statistic was at a healthy level.
        detector: name of the detector that raised it.
        statistic: over the scale of its watch.
        limit: exceeded limit.
        evidence: names of summaries with their mean conditioned deviation since `since_s`, in healthy standard
            deviations, the largest first.
        causes: possible causes, the most probable first; empty without a diagnosis.
        sentence: all of this for a reader.
        severity: grade of the alarm.
    """

    recording: str
    raised_s: float
    since_s: float
    detector: str
    statistic: float
    limit: float
    evidence: tuple[tuple[str, float], ...]
    causes: tuple[Cause, ...] = ()
    sentence: str = ""
    severity: Severity = "warning"

    def to_json(self) -> Table:
        """Return the plain JSON values, keys as the fields."""
        plain = asdict(self)
        plain["evidence"] = [[name, value] for name, value in self.evidence]
        return plain


class Raised(Protocol):
    """Interface common to alarms and their data on a page."""

    @property
    def recording(self) -> str: ...
    @property
    def raised_s(self) -> float: ...
    @property
    def evidence(self) -> tuple[tuple[str, float], ...]: ...
    @property
    def causes(self) -> tuple[Cause, ...]: ...


AnyAlarm = TypeVar("AnyAlarm", bound=Raised)


def episodes(alarms: Iterable[AnyAlarm]) -> list[list[AnyAlarm]]:
    """Group equal alarms of one recording. Detectors are reset at an alarm, so that a lasting fault raises several.

    Alarms say the same where their most probable causes sit in one component; without such a cause, where the same
    residual deviates most.

    Args:
        alarms: alarms in any order.

    Returns:
        Lists in order of time, by their first alarms.
    """
    together: dict[tuple[str, str, str], list[AnyAlarm]] = {}
    for alarm in sorted(alarms, key=lambda one: (one.recording, one.raised_s)):
        cause = alarm.causes[0] if alarm.causes else None
        named = cause is not None and cause.kind != NONE_OF_THESE
        component = cause.component if cause is not None and named else ""
        # A summary's name is that of its residual and, behind the last point, what is taken of it.
        residual = "" if named or not alarm.evidence else alarm.evidence[0][0].rpartition(".")[0]
        together.setdefault((alarm.recording, component, residual), []).append(alarm)
    return list(together.values())
