"""How alarms are judged: found or not, how late in motion, false alarms an hour. Nothing is adjusted by points."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edp.monitor.calibration import hours_between
from edp.sim.faults import FAULTS, parse_fault

LARGE = (0, 1)
"""Ranks of the two largest sizes."""


@dataclass(frozen=True)
class Case:
    """One faulty session.

    Attributes:
        kind: of the fault.
        rank: of its size in the ladder of the kind, 0 for the largest.
        size: in the first unit of the kind; None for kinds that are there or not.
        found: whether an alarm came after the onset.
        delay_s: seconds of motion from the onset to that alarm; NaN where none came.
        false_alarms: alarms before the onset.
        healthy_s: seconds before the onset.
    """

    kind: str
    rank: int
    size: float | None
    found: bool
    delay_s: float
    false_alarms: int
    healthy_s: float


def judged(fault: str, moving: NDArray[np.int64], raised_s: Sequence[float], rate_hz: float = 100.0) -> Case:
    """Judge the alarms of a faulty session.

    An alarm before the onset is a false one: it neither counts as found nor keeps a later one from it.

    Args:
        fault: its text.
        moving: ticks of each second in which the machine moved.
        raised_s: when alarms were raised.
        rate_hz: ticks a second.
    """
    spec = parse_fault(fault)
    sizes = FAULTS[spec.kind].ladder
    rank = 0 if spec.size is None else len(sizes) - 1 - sizes.index(spec.size)
    after = [when for when in raised_s if when > spec.onset_s]
    delay = motion_between(moving, spec.onset_s, min(after), rate_hz) if after else math.nan
    return Case(spec.kind, rank, spec.size, bool(after), delay, len(raised_s) - len(after), spec.onset_s)


def motion_between(moving: NDArray[np.int64], start_s: float, end_s: float, rate_hz: float = 100.0) -> float:
    """Seconds of motion between two moments; a second is taken to be moved in evenly."""
    passed = np.concatenate(([0.0], np.cumsum(moving) / rate_hz))
    begin, end = np.interp([start_s, end_s], np.arange(len(passed)), passed)
    return float(end - begin)


def share_found(cases: Sequence[Case], ranks: Sequence[int] | None = None) -> float:
    """Share of the cases (of these ranks) that were found; NaN of none."""
    chosen = [case.found for case in cases if ranks is None or case.rank in ranks]
    return float(np.mean(chosen)) if chosen else math.nan


def median_delay(cases: Sequence[Case], ranks: Sequence[int] | None = None) -> float:
    """Median over what was found, s of motion; NaN where nothing was."""
    delays = [case.delay_s for case in cases if case.found and (ranks is None or case.rank in ranks)]
    return float(np.median(delays)) if delays else math.nan


def false_alarm_rate(count: int, hours: float) -> dict[str, float]:
    """Hours to a false alarm with the exact interval of its mean, and the number in 8 h."""
    low, high = hours_between(count, hours)
    return {"alarms": count, "hours": hours, "low_hours": low, "high_hours": high, "in_8_h": 8.0 * count / hours}


def curves(cases: Sequence[Case]) -> dict[str, dict[str, Any]]:
    """Of each kind: share found by size, and the size found in half of the cases."""
    kinds: dict[str, dict[str, Any]] = {}
    for kind in dict.fromkeys(case.kind for case in cases):
        mine = [case for case in cases if case.kind == kind]
        sizes = sorted({case.size for case in mine if case.size is not None})
        shares = {size: share_found([case for case in mine if case.size == size]) for size in sizes}
        kinds[kind] = {
            "unit": FAULTS[kind].unit,
            "found": {f"{size:g}": share for size, share in shares.items()} or {"there": share_found(mine)},
            "half": size_found_in_half(shares),
            "delay_s": median_delay(mine),
        }
    return kinds


def size_found_in_half(shares: Mapping[float, float]) -> float:
    """Where the share found reaches a half, between sizes on a logarithmic scale; 0 where the smallest is found.

    Shares are first made not to fall with the size, as a larger fault is not harder to see; infinite where the largest
    size is found in fewer.
    """
    sizes = sorted(shares)
    if not sizes:
        return math.nan
    rising = np.maximum.accumulate([shares[size] for size in sizes])
    if rising[0] >= 0.5:
        return 0.0
    if rising[-1] < 0.5:
        return math.inf
    above = int(np.argmax(rising >= 0.5))
    low, high = rising[above - 1], rising[above]
    part = (0.5 - low) / (high - low)
    return float(math.exp(math.log(sizes[above - 1]) * (1 - part) + math.log(sizes[above]) * part))


def area_under_curve(healthy: NDArray[np.float64], faulty: NDArray[np.float64]) -> float:
    """Chance that a faulty score is above a healthy one, ties counted half."""
    above = (faulty[:, None] > healthy[None, :]).mean()
    return float(above + 0.5 * (faulty[:, None] == healthy[None, :]).mean())


def summary(cases: Sequence[Case]) -> dict[str, Any]:
    """Figures of one detector on the faulty sessions."""
    return {
        "found": share_found(cases),
        "found_large": share_found(cases, LARGE),
        "delay_s": median_delay(cases),
        "delay_largest_s": median_delay(cases, (0,)),
        "before_onset": sum(case.false_alarms for case in cases),
        "before_onset_hours": sum(case.healthy_s for case in cases) / 3600.0,
    }
