"""Monitor of a closed loop: suspected channels lose trust, and controllers fall back."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from edp.control.guard import TRUSTED, GuardVerdict
from edp.control.plant import STROKES, PlantInterface
from edp.errors import ConfigError
from edp.monitor.alarms import MonitorAlarm
from edp.monitor.monitor import Monitor, MonitorStream
from edp.monitor.monitor_file import load_monitor
from edp.sim.faults.shown import list_falsified
from edp.wording import typed

Array = NDArray[np.float64]
HOLD_S = 60.0
"""Time after an alarm for which it holds: detectors begin again at an alarm, and a fault that stays raises another."""
SURE = 0.5
"""Probability of a cause from which on a diagnosis is acted upon."""
EXPLAINED = 0.5
"""Score of a channel from which on it is taken for a fault of its sensor alone."""
ALIKE = 0.99
"""Fraction of the highest score above which a channel is suspected as well."""


class MonitorGuard:
    """The guard of `edp.control.guard` that a monitor is.

    An alarm whose diagnosis names a sensor takes that channel away, and the controller goes on: that port of its twin
    runs free. Without strokes a twin drifts within seconds, so that a sensor of a stroke brings the levers to neutral.
    Without such a diagnosis the channels that explain the evidence best are taken away, strokes excepted; where they
    explain little of it, as where the machine is another one, or are strokes alone, the controller falls back.

    Args:
        monitor: running monitor.
        hold_s: time for which an alarm holds.
    """

    def __init__(self, monitor: Monitor, hold_s: float = HOLD_S) -> None:
        self.monitor, self.hold_s = monitor, hold_s
        self._stream = MonitorStream(monitor)
        self._columns: list[int] = []
        self._verdict, self._left = TRUSTED, 0
        self._names: frozenset[str] = frozenset()

    def __repr__(self) -> str:
        return f"MonitorGuard({self.monitor.provenance}, {self.monitor.limit}, hold_s={self.hold_s})"

    def reset(self, plant: PlantInterface) -> None:
        """See `edp.control.guard.LoopGuard`.

        Raises:
            ConfigError: another rate, or none of the monitor's channels.
        """
        names = {channel.name: i for i, channel in enumerate(plant.channels)}
        if abs(plant.rate_hz - self.monitor.rate_hz) > 1e-3 * self.monitor.rate_hz:
            raise ConfigError(
                f"{plant.source} has {typed(plant.rate_hz)} Hz, the monitor {typed(self.monitor.rate_hz)} Hz; run "
                "the loop at "
                "the rate of the monitor's recordings"
            )
        if not names.keys() & {*self.monitor.inputs}:
            raise ConfigError(
                f"{plant.source} measures none of the monitor's channels, such as {self.monitor.inputs[0]}"
            )
        self._columns = [names.get(name, -1) for name in self.monitor.inputs]
        self._names = frozenset(names)
        self._stream.reset()
        self._verdict, self._left = TRUSTED, 0

    def step(self, observation: Array) -> GuardVerdict:
        """See `edp.control.guard.LoopGuard`."""
        padded = np.append(np.asarray(observation, float), np.nan)
        verdict = self._stream.step(padded[self._columns])
        if verdict.alarm is not None:
            self._verdict = self.verdict_of(verdict.alarm)
            self._left = round(self.hold_s * self.monitor.rate_hz)
        elif self._left == 0:
            self._verdict = TRUSTED
        self._left = max(0, self._left - 1)
        return self._verdict

    def verdict_of(self, alarm: MonitorAlarm) -> GuardVerdict:
        """Return the consequence of an alarm for a loop."""
        cause = alarm.causes[0] if alarm.causes else None
        sure = cause is not None and cause.probability >= SURE
        if cause is not None and sure and cause.at_fault == "sensor":
            falsified = frozenset(list_falsified(cause.kind, cause.site)) & self._names
            if falsified:
                reason = f"sensor fault, {cause.kind}, probability {cause.probability:.2f}"
                return GuardVerdict(falsified, bool(falsified & {*STROKES}), reason)
        if cause is not None and sure and cause.at_fault == "machine":
            # Sensors tell the truth, and the model is of another machine.
            return GuardVerdict(frozenset(), True, f"fault of the machine, {cause.kind}")
        names, share = suspected(alarm, list_evaluated_channels(self.monitor))
        suspects = (frozenset(names) & self._names) - {*STROKES}
        return GuardVerdict(suspects, not suspects or share < EXPLAINED, f"alarm of the monitor, {alarm.detector}")


def list_evaluated_channels(monitor: Monitor) -> dict[str, tuple[str, ...]]:
    """Return the evaluated channels of each residual by its name."""
    return {
        name: judged for source in monitor.sources for name, judged in zip(source.names, source.judged, strict=True)
    }


def suspected(alarm: MonitorAlarm, judged: Mapping[str, tuple[str, ...]]) -> tuple[tuple[str, ...], float]:
    """Return the channels whose residuals deviate most, and their score from 0 to 1.

    A channel scores by the share of all deviation that lies in residuals that evaluate it, times how much of these
    residuals deviates: one that explains all, and has no residual that stays quiet, scores highest.

    Args:
        alarm: with its evidence.
        judged: see `list_evaluated_channels`.
    """
    squares: dict[str, float] = {}
    for summary, deviation in alarm.evidence:
        residual = summary.rpartition(".")[0]
        squares[residual] = squares.get(residual, 0.0) + deviation * deviation
    total, largest = sum(squares.values()), max(squares.values(), default=0.0)
    if total <= 0.0:
        return (), 0.0
    scores: dict[str, float] = {}
    for channel in {name for residual in squares for name in judged.get(residual, ())}:
        own = [squares.get(residual, 0.0) for residual, channels in judged.items() if channel in channels]
        scores[channel] = sum(own) / total * (sum(own) / len(own) / largest)
    best = max(scores.values(), default=0.0)
    return tuple(sorted(channel for channel, score in scores.items() if score >= ALIKE * best)), best


def monitor_guard(folder: str | Path) -> MonitorGuard:
    """Return the guard from the monitor of a folder.

    Raises:
        BundleError: not a monitor, or damaged.
    """
    return MonitorGuard(load_monitor(folder))
