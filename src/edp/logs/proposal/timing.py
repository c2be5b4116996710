"""Requirements of the time stamps of a group of logs before training: one rate, and repairs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from edp.errors import DataError
from edp.logs.proposal.clocks import ClockGuess
from edp.logs.proposal.columns import LogLook
from edp.logs.timebase import Clock, judge
from edp.signals import TIME_UNITS
from edp.wording import typed

_ONE_RATE = 1.0005
"""Maximum ratio of rates that count as equal. The reader allows a deviation of a thousandth."""
_LONG_S, _LONG_STEPS = 1.0, 20.0
"""Gap length in s and in steps above which a session is divided, because holding values would falsify the motion."""
_MAX_KEPT = 0.8
"""Minimum fraction of the rows on one side of a break, above which the rest is cut off."""


@dataclass(frozen=True)
class Timing:
    """Timing of a group of logs.

    Attributes:
        rate_hz: the rate to bring all of them to; None where they have one.
        repairs: required repairs of each examined log, in the notation of ``--repair``.
    """

    rate_hz: float | None
    repairs: dict[Path, tuple[str, ...]]

    @property
    def shared(self) -> tuple[str, ...]:
        """Repairs common to all logs, one per defect; ``hold`` if gaps of some logs are cut."""
        by_defect: dict[str, str] = {}
        for repair in sorted({one for repairs in self.repairs.values() for one in repairs}):
            by_defect[repair.partition("=")[0]] = repair  # "gaps=hold" comes after "gaps=cut"
        return tuple(by_defect[defect] for defect in sorted(by_defect, key=lambda defect: (defect != "nan", defect)))

    @property
    def apart(self) -> dict[Path, tuple[str, ...]]:
        """Logs that need their own repairs, because other logs need another repair for the same defect."""
        return {path: repairs for path, repairs in self.repairs.items() if not set(repairs) <= set(self.shared)}

    @property
    def notes(self) -> tuple[str, ...]:
        """Remarks on rates and breaks for the user."""
        rate = (
            ()
            if self.rate_hz is None
            else (f"the logs differ in rate: all are brought to {typed(self.rate_hz)} Hz (rate_hz)",)
        )
        cut = (
            f"{path.name[:40]}: a long break in time; its longest stretch is used ({', '.join(repairs)})"
            for path, repairs in self.apart.items()
            if "gaps=cut" in repairs
        )
        anew = [path.name[:40] for path, repairs in self.repairs.items() if "falling=cut" in repairs]
        restarted = [f"the clock begins anew in {', '.join(anew[:3])}: the longest part is used"] if anew else []
        return (*rate, *cut, *restarted)


def timing_of(looks: Sequence[LogLook], clock: ClockGuess, mapped: Sequence[str]) -> Timing:
    """Return the rates and repairs of logs with one map.

    Args:
        looks: the logs.
        clock: time of their rows.
        mapped: columns that become channels.
    """
    repairs, rates = {}, []
    for look in looks:
        clocks = _clocks(look, clock)
        columns = [column for column in look.columns if column.name in mapped]
        own = [column.clock for column in columns if column.clock is not None]
        # Reading takes the fastest of several clocks.
        rates += [clocks[0].rate_hz] if clocks else [max(one.rate_hz for one in own)] if own else []
        missing = ["nan=hold"] if any(not np.isfinite(column.values).all() for column in columns) else []
        needed = (*missing, *sorted({repair for one in (*clocks, *own) for repair in _repairs(one)}))
        if needed:
            repairs[look.path] = needed
    apart = len(rates) > 1 and clock.wanted_hz is None and max(rates) > _ONE_RATE * min(rates)
    return Timing(_plain(float(np.median(rates))) if apart else None, repairs)


def repair_table(repairs: Sequence[str]) -> dict[str, str]:
    """Return the repairs as a data-set file has them."""
    return {defect: how for defect, _, how in (repair.partition("=") for repair in repairs)}


def _plain(rate_hz: float) -> float:
    """Return a rate rounded to two digits."""
    return float(f"{rate_hz:.2g}")


def _clocks(look: LogLook, clock: ClockGuess) -> list[Clock]:
    """Return the clock of each segment of a log; empty without a numeric time column."""
    time = next((column for column in look.columns if column.name == clock.column), None)
    clocks = []
    for piece in () if time is None else time.pieces:
        try:
            clocks.append(judge(piece * TIME_UNITS[clock.unit], clock.column or ""))
        except DataError:  # which inspection and training name in their words
            continue
    return clocks


def _repairs(clock: Clock) -> set[str]:
    if clock.uniform:
        return set()
    repairs = {f"falling={_choose_falling_repair(clock)}"} if len(clock.falling) else set()
    repairs |= {"duplicates=last"} if len(clock.duplicates) else set()
    return repairs | ({f"gaps={_choose_gap_repair(clock)}"} if len(clock.gaps) else set())


def _choose_falling_repair(clock: Clock) -> str:
    """Return ``cut`` if a clock restarts, since sorting would mix two sessions; otherwise ``sort``."""
    back = np.diff(clock.stamps)[clock.falling - 1]
    return "cut" if back.min() < -max(_LONG_S, _LONG_STEPS * clock.step_s) else "sort"


def _choose_gap_repair(clock: Clock) -> str:
    """Return ``cut`` where a long break leaves nearly all rows on one side, else ``hold``."""
    breaks = clock.gaps[np.diff(clock.stamps)[clock.gaps] > max(_LONG_S, _LONG_STEPS * clock.step_s)]
    if not len(breaks):
        return "hold"
    # Cutting keeps the longest stretch between any gaps, long or short.
    edges = np.concatenate(([0], clock.gaps + 1, [len(clock.stamps)]))
    return "cut" if np.diff(edges).max() >= _MAX_KEPT * len(clock.stamps) else "hold"
