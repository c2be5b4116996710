"""Optional repairs; each repair is recorded in the meta data of the recording."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edp.errors import ConfigError, DataError
from edp.logs.timebase import Clock, Rows, Stamps, judge
from edp.recording import Recording
from edp.wording import typed

Mask = NDArray[np.bool_]

_CHOICES = {
    "nan": ("refuse", "hold", "keep"),
    "gaps": ("refuse", "hold", "cut", "keep"),
    "duplicates": ("refuse", "last"),
    "falling": ("refuse", "sort", "cut"),
}


@dataclass(frozen=True)
class Repair:
    """Repairs allowed while reading; the default allows no repair.

    Attributes:
        nan: missing or infinite values: ``hold`` the last good value, or ``keep`` them as NaN.
        gaps: gaps in time: ``hold`` the last sample, ``cut`` to the longest segment without one, or ``keep`` NaN.
        duplicates: equal time stamps: keep the ``last`` row of each.
        falling: time stamps that go back: ``sort`` rows by time, or ``cut`` to the longest segment without one, for a
            clock that begins again.
    """

    nan: str = "refuse"
    gaps: str = "refuse"
    duplicates: str = "refuse"
    falling: str = "refuse"

    def __post_init__(self) -> None:
        for name, allowed in _CHOICES.items():
            value = getattr(self, name)
            if value not in allowed:
                raise ConfigError(f"repair: {name} = '{value}' is not one of {', '.join(allowed)}")


def repair_stamps(stamps: Stamps, repair: Repair, where: str) -> tuple[Clock, Rows | None, list[dict[str, object]]]:
    """Evaluate stamps and repair falling and duplicate ones where allowed.

    Returns:
        the clock, the rows kept in their new order (None: all, as they are), and the repairs made.

    Raises:
        DataError: a defect that `repair` does not allow to repair.
    """
    clock = judge(stamps, where)
    repairs: list[dict[str, object]] = []
    order: Rows | None = None
    if len(clock.falling):
        if repair.falling == "refuse":
            raise DataError(
                f"{where}: time goes back in {len(clock.falling)} row(s), first in row {clock.falling[0]} "
                f'(t = {typed(stamps[clock.falling[0]])} s); repair the file or set repair falling = "sort" '
                '(--repair falling=sort), or "cut" where the clock begins anew there (--repair falling=cut)'
            )
        fact = {"repair": f"falling = {repair.falling}", "count": len(clock.falling), "row": int(clock.falling[0])}
        repairs.append(fact)
        # Stable: rows of equal stamps keep their order, so that `last` means the last in the file.
        order = np.argsort(stamps, kind="stable") if repair.falling == "sort" else _longest_rise(clock)
        stamps = stamps[order]
        clock = judge(stamps, where)
    if len(clock.duplicates):
        if repair.duplicates == "refuse":
            raise DataError(
                f"{where}: {len(clock.duplicates)} duplicate time stamp(s), first in row {clock.duplicates[0]} "
                f'(t = {typed(stamps[clock.duplicates[0]])} s); repair the file or set repair duplicates = "last" '
                "(--repair duplicates=last)"
            )
        repairs.append({"repair": "duplicates = last", "count": len(clock.duplicates), "row": int(clock.duplicates[0])})
        last = np.append(np.diff(stamps) > 0, True)
        order = np.flatnonzero(last) if order is None else order[last]
        clock = judge(stamps[last], where)
    return clock, order, repairs


def _longest_rise(clock: Clock) -> Rows:
    """Return the rows of the longest segment in which time does not go back, shape ``(rows,)``."""
    edges = np.concatenate(([0], clock.falling, [len(clock.stamps)]))
    best = int(np.argmax(np.diff(edges)))
    return np.arange(edges[best], edges[best + 1])


def repair_gaps(missing: Mask, rate_hz: float, repair: Repair, where: str) -> tuple[slice, list[dict[str, object]]]:
    """Return the rows to keep and the repairs made, given the samples in gaps, shape ``(time,)``.

    Raises:
        DataError: there are gaps and `repair` does not allow them.
    """
    starts, stops = runs(missing)
    if not len(starts):
        return slice(None), []
    longest = float((stops - starts).max() / rate_hz)
    if repair.gaps == "refuse":
        raise DataError(
            f"{where}: {len(starts)} gap(s) in time, first at row {starts[0]} (t = "
            f"{typed(starts[0] / rate_hz)} s), longest "
            f'{typed(longest)} s; set repair gaps = "hold" (--repair gaps=hold), "cut" (keep the longest stretch) '
            'or "keep" (NaN)'
        )
    fact = {"repair": f"gaps = {repair.gaps}", "count": len(starts), "row": int(starts[0]), "longest_s": longest}
    if repair.gaps != "cut":
        return slice(None), [fact]
    good_starts, good_stops = runs(~missing)
    best = int(np.argmax(good_stops - good_starts))
    return slice(int(good_starts[best]), int(good_stops[best])), [fact]


def repairs_of(meta: Mapping[str, object]) -> list[object]:
    """Return the repairs that the data of a recording state."""
    repairs = meta.get("repairs")
    return list(repairs) if isinstance(repairs, list | tuple) else []


def repair_values(
    values: NDArray[np.float32],
    missing: Mask,
    names: Sequence[str],
    rate_hz: float,
    repair: Repair,
    where: str,
    first_row: int = 0,
) -> list[dict[str, object]]:
    """Check for NaN and infinity outside gaps, shape ``(time, channel)``, and hold them in place where allowed.

    `first_row` is the row of the recording that `values` begin with.

    Raises:
        DataError: there are some and `repair` does not allow them, or a channel starts with one.
    """
    repairs: list[dict[str, object]] = []
    finite = np.isfinite(values)
    if finite.all():
        return repairs
    sound = np.asarray(finite.all(axis=0))
    for column, name in enumerate(names):
        if sound[column]:
            continue
        bad = ~np.isfinite(values[:, column])
        # Gaps that are to stay NaN are no missing values.
        repairable = bad & ~missing if repair.gaps in ("keep", "refuse") else bad
        rows = np.flatnonzero(repairable)
        if not len(rows) or repair.nan == "keep":
            continue
        first = first_row + int(rows[0])
        if repair.nan == "refuse":
            raise DataError(
                f"{where}: channel '{name}' has {len(rows)} missing or infinite value(s), first in row {first} "
                f'(t = {typed(first / rate_hz)} s); repair the file or set repair nan = "hold" (--repair nan=hold)'
            )
        # Nothing is taken from later samples, which a machine would not have had.
        if bad[0]:
            raise DataError(
                f"{where}: channel '{name}' starts with a missing value, nothing earlier can be held; "
                f"start the rows at {first_row + int(np.argmin(bad))} or later"
            )
        # Each row's latest good row, without a loop.
        source = np.maximum.accumulate(np.where(bad, 0, np.arange(len(bad))))
        values[repairable, column] = values[source[repairable], column]
        repairs.append({"repair": "nan = hold", "channel": name, "count": len(rows), "row": first})
    return repairs


def runs(mask: Mask) -> tuple[Rows, Rows]:
    """Return starts and stops (exclusive) of the runs of True in a mask, shape ``(time,)``."""
    edges = np.diff(np.concatenate(([False], mask, [False])).astype(np.int8))
    return np.flatnonzero(edges == 1), np.flatnonzero(edges == -1)


def split_at_gaps(recording: Recording, min_samples: int = 2) -> list[Recording]:
    """Return the segments between gaps (rows with NaN in every channel), each as a recording.

    Read with ``Repair(gaps="keep")`` to have the gaps as NaN. Stretches shorter than `min_samples` are left out.
    """
    gap: Mask = np.asarray(np.isnan(recording.values).all(axis=1))
    parts = [(a, b) for a, b in zip(*runs(~gap)) if b - a >= min_samples]
    if len(parts) == 1 and parts[0] == (0, recording.samples):
        return [recording]
    return [recording.rows(int(a), int(b), f"{recording.name}.{i}") for i, (a, b) in enumerate(parts)]
