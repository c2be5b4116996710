"""Output of the monitor as levels, messages and values of a diagnostic status. Needs Python only.

Nothing here knows ROS: `node.py` puts it into messages.
"""

from __future__ import annotations

import ctypes
import math
from dataclasses import dataclass
from pathlib import Path

from .core import HERE, Core, Tick

OK, WARN, ERROR, STALE = 0, 1, 2, 3
"""Levels of a DiagnosticStatus."""
HOLD_S = 60.0
"""Time in s for which an alarm is reported. A persistent fault raises another alarm."""
SHOWN = 5
"""Maximum number of summaries listed per alarm."""


class MonitorCore(Core):
    """Monitor of one machine with its state; its results are named by `about["outputs"]`."""

    def __init__(self, folder: Path = HERE) -> None:
        super().__init__(folder)
        self._evidence = self._c[f"{self.about['name']}_evidence"]
        self.summaries = [f"{name}.{what}" for name in self.about["residuals"] for what in self.about["summaries"]]
        self._deviations = (ctypes.c_double * len(self.summaries))()

    @property
    def outputs(self) -> dict[str, float]:
        """Return the outputs of the last sample by name."""
        return dict(zip(self.about["outputs"], self.result()[0][0]))

    def evidence(self) -> list[tuple[str, float]]:
        """Return the summaries that deviated most before the last alarm, with their mean deviation in usual widths."""
        self._evidence(self._state, self._deviations)
        ranked = sorted(zip(self.summaries, self._deviations), key=lambda entry: -abs(entry[1]))
        return [(name, value) for name, value in ranked[:SHOWN] if value != 0.0]


@dataclass
class MonitorReport:
    """Diagnostic report of a monitor.

    Attributes:
        core: the monitor.
        raised: stamp of the last alarm, s; NaN before any.
        alarms: alarms so far.
    """

    core: MonitorCore
    raised: float = math.nan
    alarms: int = 0

    def take(self, tick: Tick, stamp: float) -> bool:
        """Look at a tick at `stamp` s; whether it raised an alarm."""
        if not tick.predicted:
            return False
        alarms = int(self.core.outputs["alarms"])
        new = alarms > self.alarms
        self.alarms = alarms
        self.raised = stamp if new else self.raised
        return new

    def report(self, tick: Tick | None, stamp: float, fresh: bool) -> tuple[int, str, dict[str, str]]:
        """Return the level, message and values of a diagnostic status.

        Args:
            tick: the last one.
            stamp: time stamp, s.
            fresh: whether it came since the last report.
        """
        values = {name: f"{value:.6g}" for name, value in self.core.outputs.items()}
        values |= {name: str(count) for name, count in self.core.counts.items()}
        values |= {"monitor_hash": self.core.about["monitor_hash"]}
        if not fresh or tick is None:
            return STALE, "no joints in the last second", values
        if 0.0 <= stamp - self.raised <= HOLD_S:
            evidence = self.core.evidence()
            values |= {f"evidence.{name}": f"{value:+.3g}" for name, value in evidence}
            most = f": '{evidence[0][0]}' deviates most, by {evidence[0][1]:+.2g} usual widths" if evidence else ""
            since = self.core.outputs["since_s"] + stamp - self.raised
            return ERROR, f"not healthy for {since:.0f} s{most}", values
        if not tick.valid:
            return WARN, tick.why or "not judged", values
        return OK, "healthy", values
