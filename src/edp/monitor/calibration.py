"""Alarm limits of detectors for a given false alarm rate, from healthy sessions not used for fitting."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import special

from edp.errors import ConfigError, DataError, count_of
from edp.monitor.detectors.base import DetectorSpec, alarms, statistics
from edp.settings.bounds import above, shown
from edp.wording import figure

Array = NDArray[np.float64]
CONFIDENCE = 0.95
LANES = 48
"""Number of limits tried per pass over the sessions. Three passes resolve a limit to 1e-5 of the range."""
PASSES = 3
MIN_PART = 1e-6
"""Minimum contribution of a summary to an alarm. Smaller contributions are rounding errors of the division."""
MAX_HOURS = above(0.0, 1e6)


@dataclass(frozen=True)
class AlarmLimit:
    """Alarm limit and its false alarms.

    Attributes:
        limit: limit of a statistic.
        alarms: number of alarms on the healthy sessions. The expected number on new sessions is at most one higher.
        hours: total length of the healthy sessions, h.
        promised_hours: operating hours to one false alarm that were asked for.
        low_hours: shortest and `high_hours` longest mean time between false alarms that go with the count, exact for
            independent alarms (Garwood 1936), at `CONFIDENCE`; `high_hours` is infinite where there was none.
    """

    limit: float
    alarms: int
    hours: float
    promised_hours: float
    low_hours: float
    high_hours: float

    def sentence(self) -> str:
        """Return the rates as a sentence for a report."""
        high = "any time" if math.isinf(self.high_hours) else f"{figure(self.high_hours, 3)} h"
        return (
            f"{count_of(self.alarms, 'false alarm')} in {figure(self.hours, 3)} h of healthy sessions: one in "
            f"{figure(self.low_hours, 3)} h to "
            f"{high} ({figure(100 * CONFIDENCE)} %), asked for one in {figure(self.promised_hours, 3)} h"
        )


def hours_between(count: int, hours: float) -> tuple[float, float]:
    """Return the interval of the mean time between alarms, h, from their number (Garwood, Biometrika 28, 1936)."""
    tail = (1.0 - CONFIDENCE) / 2.0
    # Quantiles of chi-squared over two are those of the gamma distribution.
    least = float(special.gammaincinv(count, tail)) if count else 0.0
    most = float(special.gammaincinv(count + 1, 1.0 - tail))
    return hours / most, hours / least if count else math.inf


def calibrated(spec: DetectorSpec, sessions: Sequence[Array], rows_per_s: float, promised_hours: float) -> AlarmLimit:
    """Return the lowest limit with at most one false alarm in `promised_hours` on new sessions of this kind.

    The lowest limit with k alarms here has k + 1 in as many new hours on average, as the largest of n values is passed
    by one new value of n + 1. Where the hours allow k + 1 and a part of one more, the limit lies as far on the way from
    the lowest one with k alarms to that with k + 1: in the tail the rate is a convex function of the limit, so that it
    is no higher there than as far on the way from one rate to the other.

    Sessions are whole: each begins with a reset detector, and the detector is reset at each alarm. What holds on them
    holds elsewhere only for machines, work and weather of their kind.

    Args:
        spec: the detector.
        sessions: white residuals of healthy sessions, shape (time, channels) each.
        rows_per_s: rate of the rows.
        promised_hours: operating hours to one false alarm.

    Raises:
        ConfigError: a number is out of its bounds, or there are too few hours for the expected error; says for which
            there are enough.
        DataError: there are no sessions, or they have other numbers of residuals.
    """
    for name, value in (("rows_per_s", rows_per_s), ("promised_hours", promised_hours)):
        if not MAX_HOURS.holds(value):
            raise ConfigError(f"calibration: {name} = {shown(value)}; {MAX_HOURS.rule(name)} must hold")
    widths = {np.asarray(session).shape[1:] for session in sessions}
    if len(widths) != 1 or len(next(iter(widths))) != 1:
        raise DataError(f"calibration: {len(sessions)} sessions of widths {sorted(widths)}; give all of one width")
    hours = sum(len(session) for session in sessions) / rows_per_s / 3600.0
    # 1e-9 allows for the rounding of the division.
    allowed = math.floor(hours / promised_hours + 1e-9) - 1
    part = max(hours / promised_hours - 1.0 - allowed, 0.0)
    if allowed < 0:
        raise ConfigError(
            f"calibration: {figure(hours, 3)} h of healthy sessions are too few for one false alarm in "
            f"{figure(promised_hours, 3)} "
            f"h; they support one in {figure(hours, 3)} h: ask for that, or bring {figure(promised_hours - hours, 3)} "
            "h more"
        )
    whole = [session for session in sessions if len(session)]
    peaks = [_range(spec, session) for session in whole]
    limit = _lowest(spec, whole, peaks, allowed)
    if part > MIN_PART:
        limit -= part * (limit - _lowest(spec, whole, peaks, allowed + 1))
    # A session whose largest statistic does not pass a limit has no alarm at it.
    loud = [session for session, (_, most) in zip(whole, peaks, strict=True) if most > limit]
    count = int(_counts(spec, loud, np.array([limit]))[0])
    return AlarmLimit(limit, count, hours, promised_hours, *hours_between(count, hours))


def _lowest(
    spec: DetectorSpec, sessions: Sequence[Array], ranges: Sequence[tuple[float, float]], allowed: int
) -> float:
    """Return the lowest limit with at most `allowed` alarms; `ranges` are the ranges of the sessions' statistics."""
    most = sorted((high for _, high in ranges), reverse=True)
    # Below the largest statistics of one session more than may alarm, each of these does.
    low, high = most[allowed] if len(most) > allowed else min(low for low, _ in ranges), most[0]
    loud = [session for session, (_, peak) in zip(sessions, ranges, strict=True) if peak > low]
    limit = low
    for _ in range(PASSES if allowed and loud else 0):
        limits = np.linspace(low, high, LANES)
        counts = _counts(spec, loud, limits)
        # The last limit with too many: resets make counts fall with the limit on the whole, not at each step.
        bad = np.flatnonzero(counts > allowed)
        first = int(bad[-1]) + 1 if len(bad) else 0
        limit = float(limits[first])
        if first == 0:
            break
        low, high = float(limits[first - 1]), limit
    return limit


def _range(spec: DetectorSpec, session: Array) -> tuple[float, float]:
    """Return the least and largest statistic of a session."""
    values = statistics(spec.build(session.shape[1]), session[:, None, :])
    return float(values.min()), float(values.max())


def _counts(spec: DetectorSpec, sessions: Sequence[Array], limits: Array) -> NDArray[np.int64]:
    """Count the false alarms of all sessions at each limit."""
    counts = np.zeros(len(limits), dtype=np.int64)
    for session in sessions:
        detector = spec.build(session.shape[1], len(limits))
        same = np.broadcast_to(
            np.asarray(session, dtype=float)[:, None, :], (len(session), len(limits), session.shape[1])
        )
        counts += np.bincount([alarm.lane for alarm in alarms(detector, same, limits)], minlength=len(limits))
    return counts
