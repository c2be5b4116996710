"""Time stamps: are rows uniform, and if not, how are they brought to a uniform grid without looking ahead.

The rule, in order:

1. Rows are taken as uniform, at the mean rate, where the stamps lie within 5 % of a step (rms) and never half a
   step off a straight line, or within half a unit of their last printed digit of it (stamps rounded by a logger),
   or, where many repeat, within half of the step between those that differ.
2. Otherwise, or where another rate is wanted, a uniform grid starts at the first stamp and each tick takes the
   latest sample whose stamp is not later than the tick (zero-order hold, causal: no future sample is ever used).
3. A jump of more than 5 median steps and more than 50 ms is a gap: its last sample is held for one step, later
   ticks are missing (NaN) unless a repair is asked for.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edp.errors import DataError
from edp.wording import typed

Stamps = NDArray[np.float64]
Rows = NDArray[np.intp]

UNIFORM_RMS = 0.05
"""Maximum RMS distance of the time stamps from a line, in steps."""
UNIFORM_MAX = 0.5
"""Maximum single distance from the line, in steps. Beyond half a step a row belongs to another sample."""
GAP_STEPS = 5.0
"""Minimum length of a gap in median steps; a gap must also exceed `GAP_SECONDS`."""
GAP_SECONDS = 0.05
"""Minimum length of a gap in s, because fast loggers normally skip some steps."""
LATEST_SECONDS = 1e11
"""Maximum time stamp in s, about 3,000 years. Larger stamps have another unit."""
SHORTEST_STEP_S = 1e-9
"""Minimum step in s, because clocks count nanoseconds."""
_SAME_TICK = 1e-6
"""Fraction of a sample interval by which rounding may delay a stamp."""
_EVEN = 1e-4
"""Fraction of a step below which distances from a line count as rounding."""
_REPEATED = 0.3
"""Fraction of rows with repeated stamps above which the clock is coarser than the rows."""
_MAX_REPEATS = 1000
"""Maximum number of rows with one time stamp."""
_MIN_ROLLOVERS = 5
"""Minimum drift in samples between a rounded rate and the grid that excludes lost rows."""


@dataclass(frozen=True, eq=False)
class Clock:
    """Time stamps of one time column and their analysis.

    Attributes:
        stamps: time of each row in seconds, shape ``(time,)``; the fitted line where rows are uniform.
        uniform: rows are uniform by rule 1.
        rate_hz: mean rate where uniform, else one over the median step.
        step_s: median step.
        jitter: rms distance from a straight line, in steps.
        gaps: rows after which a gap follows.
        duplicates: rows whose stamp equals the one before.
        falling: rows whose stamp is earlier than the one before.
    """

    stamps: Stamps
    uniform: bool
    rate_hz: float
    step_s: float
    jitter: float
    gaps: Rows
    duplicates: Rows
    falling: Rows


def uniform_clock(samples: int, rate_hz: float) -> Clock:
    """Return the clock of rows that are uniform by a stated rate or sample time."""
    none = np.empty(0, dtype=np.intp)
    return Clock(np.arange(samples) / rate_hz, True, rate_hz, 1.0 / rate_hz, 0.0, none, none, none)


def judge(stamps: Stamps, where: str) -> Clock:
    """Evaluate time stamps in seconds, shape ``(time,)``.

    Raises:
        DataError: fewer than two stamps, a stamp that is no number, or all stamps equal.
    """
    if len(stamps) < 2:
        raise DataError(f"{where}: {len(stamps)} time stamp(s); a recording needs at least 2")
    broken = np.flatnonzero(~np.isfinite(stamps))
    if len(broken):
        raise DataError(
            f"{where}: {len(broken)} time stamp(s) are missing or not finite, first in row {broken[0]}; "
            "repair the file, or set 'sample_time_s' in the signal map if rows are uniform"
        )
    largest = float(np.abs(stamps).max())
    if largest > LATEST_SECONDS:
        raise DataError(
            f"{where}: the time stamp of row {int(np.abs(stamps).argmax())} lies {typed(largest)} s from zero; where "
            "the "
            'file counts in another unit, set time_unit = "ms", "us" or "ns" in the signal map, else repair the stamp'
        )
    none = np.empty(0, dtype=np.intp)
    if (even := _even(stamps)) is not None:
        step, jitter = even
        rate = nice_rate(step, len(stamps), jitter)
        line = stamps[0] + np.arange(len(stamps)) / rate
        return Clock(line, True, rate, 1.0 / rate, jitter, none, none, none)
    steps = np.diff(stamps)
    rising = steps[steps > 0]
    if not len(rising):
        raise DataError(f"{where}: no time stamp is later than the first; is this the time column?")
    median = float(np.median(rising))
    if median < SHORTEST_STEP_S:
        raise DataError(f"{where}: time steps of {typed(median)} s; is this the time column, and in which unit?")
    start, step = _line(stamps)
    off = stamps - (start + step * np.arange(len(stamps))) if step > 0 else np.full(len(stamps), np.inf)
    jitter = float(np.sqrt(np.mean(off**2)) / step) if step > 0 else float("inf")
    near = jitter <= UNIFORM_RMS and float(np.abs(off).max()) <= UNIFORM_MAX * step
    rounded_line = None if near or step <= 0 else _fit_rounded_line(stamps, median) or _fit_repeated_line(stamps, steps)
    if rounded_line is not None:
        near, (start, step) = True, rounded_line
    if near:
        rate = nice_rate(step, len(stamps), jitter)
        line = start + np.arange(len(stamps)) / rate
        return Clock(line, True, rate, 1.0 / rate, jitter, none, none, none)
    gaps = np.flatnonzero(steps > max(GAP_STEPS * median, GAP_SECONDS))
    return Clock(
        stamps,
        False,
        nice_rate(median, 100, jitter),
        median,
        jitter,
        gaps,
        np.flatnonzero(steps == 0) + 1,
        np.flatnonzero(steps < 0) + 1,
    )


def _even(stamps: Stamps) -> tuple[float, float] | None:
    """Return step and rms deviation in steps for evenly spaced stamps up to rounding; None for other stamps.

    What most logs have, computed without the medians that the general rule takes.
    """
    step = float(stamps[-1] - stamps[0]) / (len(stamps) - 1)
    if step < SHORTEST_STEP_S:
        return None
    off = np.arange(len(stamps)) * step
    off += stamps[0]
    off -= stamps
    if max(float(off.max()), -float(off.min())) > _EVEN * step:
        return None
    return step, float(np.sqrt(off @ off / len(off)) / step)


def _line(stamps: Stamps) -> tuple[float, float]:
    """Start and step of a straight line through the stamps, robust against a few bad ones."""
    # Steps across half of the log: a few bad stamps move the median hardly at all.
    half = len(stamps) // 2
    step = float(np.median((stamps[half:] - stamps[: len(stamps) - half]) / half))
    return float(np.median(stamps - step * np.arange(len(stamps)))), step


def _fit_rounded_line(stamps: Stamps, median: float) -> tuple[float, float] | None:
    """Start and step of the line of which the stamps are the rounded values; None where rounding is not all there is.

    Every stamp must lie within half a unit of its last printed digit of the line (and 5 % of a step). Stamps that
    are all whole multiples of the median step could as well be a log with rows missing; they count as rounded only
    where the line leaves them behind so often that lost rows would have broken it.
    """
    multiples = (stamps - stamps[0]) / median
    on_grid = bool(np.all(np.abs(multiples - np.rint(multiples)) < 0.01))
    if on_grid and abs(multiples[-1] - (len(stamps) - 1)) < _MIN_ROLLOVERS:
        return None
    rows = np.arange(len(stamps)) - 0.5 * (len(stamps) - 1)
    mean = float(stamps.mean())
    step = float(rows @ (stamps - mean) / (rows @ rows))
    if step <= 0:
        return None
    off = np.abs(stamps - mean - step * rows)
    decades = np.floor(np.log10(np.maximum(np.abs(stamps), 1e-9))).astype(int)
    for decade in np.unique(decades):
        part = decades == decade
        digit = _find_last_digit(stamps[part], floor=0.02 * step)
        if float(off[part].max()) > 0.51 * digit + UNIFORM_RMS * step:
            return None
    return mean + step * float(rows[0]), step


def _fit_repeated_line(stamps: Stamps, steps: Stamps) -> tuple[float, float] | None:
    """Start and step of the line that stamps of a coarse clock follow, which repeat for some rows; None for others.

    Exports that keep some digits of a number do that, whatever the last digit is worth. A row that was lost within a
    step of the clock cannot be told from one that was not.
    """
    largest = float(steps.max())
    rising = steps[steps > 0]
    if float(steps.min()) < 0 or len(rising) > (1.0 - _REPEATED) * len(steps):
        return None
    # One long step is a gap; many of one length are the clock's own.
    if float(np.mean(rising > 0.7 * largest)) < 0.2 or len(steps) > _MAX_REPEATS * len(rising):
        return None
    rows = np.arange(len(stamps)) - 0.5 * (len(stamps) - 1)
    mean = float(stamps.mean())
    step = float(rows @ (stamps - mean) / (rows @ rows))
    off = np.abs(stamps - mean - step * rows)
    # A step that holds one row or two is a row late or early, not a stamp of many rows.
    if largest < 1.5 * step or float(off.max()) > 0.6 * largest:
        return None
    return mean + step * float(rows[0]), step


def _find_last_digit(stamps: Stamps, floor: float) -> float:
    """Return the largest power of ten that divides all stamps; powers below `floor` are not tried."""
    for power in range(10):
        if 10.0**-power < floor:
            break
        scaled = stamps * 10.0**power
        if np.all(np.abs(scaled - np.rint(scaled)) < 1e-5):
            return 10.0**-power
    return 0.0


def nice_rate(step_s: float, samples: int, jitter: float) -> float:
    """Return 1 / step, rounded to a simple number if this shifts the last row by no more than the jitter of stamps.

    The shift is at most a quarter step, and the rate changes by at most 0.1 %.
    """
    # Stamps without jitter tell the rate to a millionth of a step; above a quarter step rows would change places.
    allowed = float(np.clip(jitter, 1e-6, 0.25))
    rate = 1.0 / step_s
    candidates = [round(rate, digits) for digits in range(4)]
    candidates += [1.0 / step for digits in range(7) if (step := round(step_s, digits))]
    for candidate in candidates:
        off = abs(candidate - rate) / rate
        if candidate > 0 and off <= 1e-3 and off * samples <= allowed:
            return float(candidate)
    return rate


@dataclass(frozen=True)
class Grid:
    """Uniform ticks: `start_s` + k / `rate_hz`, k = 0 .. `count` - 1."""

    start_s: float
    rate_hz: float
    count: int

    @property
    def ticks(self) -> Stamps:
        """Time of each tick in seconds, shape ``(time,)``."""
        return self.start_s + np.arange(self.count) / self.rate_hz


def common_grid(clocks: Sequence[Clock], rate_hz: float | None, where: str) -> Grid:
    """Return the grid on which every clock has a sample: from the latest start to the earliest end.

    Without a wanted rate the fastest clock's rate is taken.

    Raises:
        DataError: the columns' times do not overlap.
    """
    rate = rate_hz or max(clock.rate_hz for clock in clocks)
    start = max(float(clock.stamps[0]) for clock in clocks)
    stop = min(float(clock.stamps[-1]) for clock in clocks)
    if stop < start:
        raise DataError(
            f"{where}: times of columns do not overlap (latest start {typed(start)} s, earliest end {typed(stop)} s)"
        )
    # The last stamp is a tick of its own where it misses the grid by rounding only.
    ticks = (stop - start) * rate
    return Grid(start, rate, int(np.floor(ticks + max(_SAME_TICK, 1e-9 * ticks))) + 1)


def hold_rows(clock: Clock, grid: Grid) -> tuple[Rows | None, NDArray[np.bool_]]:
    """Return the row used at each sample, and the samples in gaps.

    A tick takes the latest row whose stamp is not later than the tick (within a millionth of a tick).

    Returns:
        rows, shape ``(time,)``, None where every tick takes its own row; and the gap mask, shape ``(time,)``.
    """
    missing = np.zeros(grid.count, dtype=np.bool_)
    same_rate = abs(clock.rate_hz - grid.rate_hz) <= 1e-9 * grid.rate_hz
    if clock.uniform and same_rate and grid.count == len(clock.stamps) and clock.stamps[0] == grid.start_s:
        return None, missing
    ticks = grid.ticks
    # Stamps since 1970 resolve 0.24 us in float64, more than a millionth of a tick at 100 Hz.
    slack = max(_SAME_TICK / grid.rate_hz, 4 * float(np.spacing(np.abs(clock.stamps).max())))
    rows = np.maximum(np.searchsorted(clock.stamps, ticks + slack, side="right") - 1, 0)
    if len(clock.gaps):
        before_gap = np.zeros(len(clock.stamps), dtype=np.bool_)
        before_gap[clock.gaps] = True
        held_for = max(clock.step_s, 1.0 / grid.rate_hz)
        missing = before_gap[rows] & (ticks - clock.stamps[rows] > held_for + slack)
    return rows, missing
