"""Statistics of numeric columns: time, counters, constants, steps, and dependencies between columns."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from edp.logs.formats.base import Column
from edp.logs.proposal.columns import LogColumn

RELATED = 24
"""Maximum number of columns compared in pairs, because the work grows with the square."""
_ALIKE = 0.97
"""Minimum correlation for a change, a copy or a reference of another column. Common motion in a repeated cycle reaches
0.9.
"""
_ROUNDED_ALIKE = 0.999
"""Minimum correlation of copies that were rounded separately."""
_MANY_COUNTS = 50
"""Minimum range of a rounded copy, in units of its last digit."""
_LAGS = 25
"""Maximum lead of a reference in samples."""
_HOLDS = 0.9
"""Fraction of equal neighbours above which a column counts as piecewise constant."""
_FEW = 12
"""Maximum number of distinct values of a label."""
_SLOW = 2e-3
"""Maximum number of changes per row of a label, because operators switch rarely."""
_REMARKS_FILL, _REMARKS_SPAN = 0.1, 0.2
"""Maximum fraction of filled rows, and of rows between the first and the last filled row, of a list next to a table."""
_SPANS = (1, 4, 16)
"""Numbers of rows over which changes are compared with a velocity. Noise dominates short spans, motion long spans."""


_MIN_STEPS, _MAX_LOST = 50, 5
"""Steps from which a clock that loses rows is told, and the longest of its steps over the usual one."""


@dataclass(frozen=True)
class Behaviour:
    """Statistics of one numeric column.

    Attributes:
        filled: fraction of rows that contain a number.
        low: smallest value.
        high: largest value.
        constant: whether all values are equal.
        whole: integers only.
        levels: distinct values.
        holds: fraction of rows that repeat the previous row.
        rises: no row is below the one before.
        climbs: every row is above the one before.
        step: median of the steps that are not zero, 0 where there are none.
        even: nearly all steps have one size.
        steady: nearly all steps are between half and twice their median, as those of a clock that waits for others.
        spanned: fraction of rows between the first and the last row with a number.
        restarts: rows at which an even rise begins again.
        coarse: many levels, but hardly a step of more than one: a slow signal that its sensor rounds.
        falls: rows below the one before.
        lossy: steps are one size or a few times it, as those of a clock whose logger loses rows.
    """

    filled: float
    low: float
    high: float
    constant: bool
    whole: bool
    levels: int
    holds: float
    rises: bool
    climbs: bool
    step: float
    even: bool
    restarts: int
    coarse: bool = False
    steady: bool = False
    spanned: float = 1.0
    falls: int = 0
    lossy: bool = False

    @property
    def counts(self) -> bool:
        """Whether the column is a counter: integers that rise by one."""
        return self.whole and self.rises and not self.constant and abs(self.step - 1.0) < 1e-9

    @property
    def beside(self) -> bool:
        """Whether only a few consecutive rows are filled, as in a list of results written next to the table."""
        return 0 < self.filled < _REMARKS_FILL and self.spanned < _REMARKS_SPAN

    @property
    def switches(self) -> bool:
        """A few whole values, changed seldom."""
        return self.whole and self.levels <= _FEW and self.changes <= _SLOW and not self.constant

    @property
    def changes(self) -> float:
        """Share of rows that differ from the row before."""
        return 1.0 - self.holds

    @property
    def steps(self) -> bool:
        """Moves in steps of its own and holds its value between them."""
        return self.holds >= _HOLDS and not self.constant and not self.coarse


def behaviour_of(column: LogColumn) -> Behaviour:
    """Look at one column."""
    values = column.values
    finite = values[np.isfinite(values)]
    if not len(finite):
        return Behaviour(0.0, np.nan, np.nan, True, False, 0, 1.0, False, False, 0.0, False, 0)
    steps = np.concatenate([np.diff(piece) for piece in column.pieces])
    steps = steps[np.isfinite(steps)]
    moving = steps[steps != 0]
    step = float(np.median(moving)) if len(moving) else 0.0
    first = column.pieces[0]
    rounded = (first[-1] - first[0]) / (len(first) - 1) if len(first) > 1 else np.nan
    # The mean step knows more than a printed one, unless rows are lost.
    if step > 0 and abs(rounded - step) < 0.1 * step:
        step = float(rounded)
    paced = (moving >= 0.5 * step) & (moving <= 2.0 * step)
    near = np.abs(moving - step) <= 0.1 * abs(step)
    falls = int(np.count_nonzero(steps < 0))
    constant = bool(finite.min() == finite.max())
    sizes, levels = np.abs(moving), len(np.unique(finite))
    least = float(np.median(sizes)) if len(sizes) else 0.0
    return Behaviour(
        filled=len(finite) / len(values),
        low=float(finite.min()),
        high=float(finite.max()),
        constant=constant,
        whole=bool(np.all(finite == np.rint(finite))),
        levels=levels,
        holds=float(np.mean(steps == 0)) if len(steps) else 1.0,
        rises=falls == 0,
        climbs=bool(len(steps)) and bool(np.all(steps > 0)),
        step=step,
        even=bool(len(moving)) and float(near.mean()) > 0.9,
        restarts=falls if step > 0 and falls and float(near.mean()) > 0.9 else 0,
        coarse=levels > 4 and len(sizes) > 0 and float(np.mean(sizes <= 1.1 * least)) > 0.9,
        steady=step > 0 and float(paced.mean()) > 0.95,
        spanned=float(np.ptp(np.flatnonzero(np.isfinite(values))) + 1) / len(values),
        falls=falls,
        lossy=_loses_rows(moving),
    )


def _loses_rows(moving: Column) -> bool:
    """Return whether most steps have one size and nearly all others are a few times it."""
    if len(moving) < _MIN_STEPS:
        return False
    step = float(np.median(moving))
    if step <= 0:
        return False
    times = moving / step
    whole = np.rint(times)
    fitting = (np.abs(times - whole) <= 0.1) & (whole >= 1) & (whole <= _MAX_LOST)
    return bool(np.mean(fitting) > 0.98 and np.mean(fitting & (whole == 1)) > 0.6)


@dataclass(frozen=True)
class Relation:
    """Dependency of a column on another one.

    Attributes:
        how: ``change`` (its change in time), ``copy`` or ``reference`` (what the other one follows).
        other: name of the other column.
        factor: for a change, the column divided by the change per row of the other column.
        strength: correlation.
    """

    how: str
    other: str
    factor: float
    strength: float


def relations_of(columns: list[LogColumn]) -> dict[str, Relation]:
    """Return the strongest dependency of each column that has one, by name, among the first `RELATED` columns."""
    chosen = columns[:RELATED]
    found_relations: dict[str, Relation] = {}
    for column in chosen:
        candidates = [relation for other in chosen if other is not column and (relation := _relation(column, other))]
        # Copies first: a copy of a velocity is a change of the position, too.
        order = sorted(candidates, key=lambda relation: (relation.how != "copy", -relation.strength))
        if order:
            found_relations[column.name] = order[0]
    return {name: relation for name, relation in found_relations.items() if not _is_turned_round(name, found_relations)}


def _is_turned_round(name: str, relations: Mapping[str, Relation]) -> bool:
    """Return whether a column passes for the change of its own change.

    In a steady swing each is the change of the other.
    """
    relation = relations[name]
    back = relations.get(relation.other)
    mutual = back is not None and relation.how == back.how == "change" and back.other == name
    return mutual and back is not None and relation.strength < back.strength


def _relation(column: LogColumn, other: LogColumn) -> Relation | None:
    own, theirs = column.pieces[0], other.pieces[0]
    good = np.isfinite(own) & np.isfinite(theirs)
    if good.sum() < 50 or len(own) != len(theirs):
        return None
    own, theirs = own[good], theirs[good]
    if _scatter(own) == 0 or _scatter(theirs) == 0:
        return None
    level = _correlation(own, theirs)
    if abs(level) > 1 - 1e-9 or (abs(level) > _ROUNDED_ALIKE and _differ_by_rounding(own, theirs)):
        return Relation("copy", other.name, float(np.std(own) / np.std(theirs)), abs(level))
    change = _change(own, theirs)
    if change is not None and change[1] > max(_ALIKE, abs(level)):
        return Relation("change", other.name, *change)
    return Relation("reference", other.name, 1.0, level) if _leads(own, theirs, level) else None


def repeats(column: LogColumn, other: LogColumn) -> bool:
    """Return whether a column can be a copy of a column in other units."""
    own, theirs = column.pieces[0], other.pieces[0]
    if len(own) != len(theirs):
        return False
    good = np.isfinite(own) & np.isfinite(theirs)
    own, theirs = own[good], theirs[good]
    if _scatter(own) == 0 or _scatter(theirs) == 0:
        # Both stand still, or one moves by less than the other can show.
        return min(_scatter(own), _scatter(theirs)) == 0 and max(_levels(own), _levels(theirs)) <= 2
    return abs(_correlation(own, theirs)) > 1 - 1e-9 or _is_rounded_copy(own, theirs)


def _levels(values: Column) -> int:
    return len(np.unique(values))


def _scatter(values: Column) -> float:
    return float(np.std(values)) if len(values) else 0.0


def _correlation(a: Column, b: Column) -> float:
    if len(a) < 3 or _scatter(a) == 0 or _scatter(b) == 0:
        return 0.0
    return float(np.corrcoef(a, b)[0, 1])


def _differ_by_rounding(own: Column, theirs: Column) -> bool:
    """Return whether a column equals a scaled copy of another one up to the last printed digits."""
    # Encoders side by side agree to a count, too: only columns of many counts tell.
    many = min(np.ptp(own) / _last_digit(own), np.ptp(theirs) / _last_digit(theirs)) > _MANY_COUNTS
    return bool(many) and _is_rounded_copy(own, theirs)


def _is_rounded_copy(own: Column, theirs: Column) -> bool:
    slope, offset = np.polyfit(theirs, own, 1)
    printed = _last_digit(own) + abs(slope) * _last_digit(theirs)
    return bool(np.abs(own - slope * theirs - offset).max() <= printed)


def _last_digit(values: Column) -> float:
    """Return the smallest difference between distinct values."""
    steps = np.diff(np.unique(values))
    # Binary rounding makes differences far below the last printed digit.
    steps = steps[steps > 1e-9 * max(float(np.abs(values).max()), 1e-300)]
    return float(steps.min()) if len(steps) else np.inf


def _change(own: Column, theirs: Column) -> tuple[float, float] | None:
    """Factor and correlation of a column with the change of another, over the span that shows it best."""
    best: tuple[float, float] | None = None
    sums = np.concatenate(([0.0], np.cumsum(own)))
    for span in _SPANS:
        if len(own) < 20 * span:
            continue
        moved = theirs[span:] - theirs[:-span]
        # The mean over the span, its ends shared: whether a logger differentiates forwards or backwards is open.
        mean = 0.5 * ((sums[span:-1] - sums[: -span - 1]) + (sums[span + 1 :] - sums[1:-span])) / span
        strength = abs(_correlation(mean, moved))
        if best is None or strength > best[1]:
            slope = float(mean @ moved / (moved @ moved)) * span if np.any(moved) else 0.0
            best = (slope, strength)
    return best


def _leads(own: Column, theirs: Column, level: float) -> bool:
    """Return whether a column is what another one is to follow: the same level, in steps or earlier.

    Sensors side by side have one level, too; neither leads.
    """
    spread = _scatter(theirs)
    if level < _ALIKE or not 0.9 < _scatter(own) / spread < 1.1 or abs(float(np.mean(own - theirs))) > 0.15 * spread:
        return False
    still = float(np.mean(np.diff(own) == 0)), float(np.mean(np.diff(theirs) == 0))
    if still[0] >= _HOLDS or still[1] >= _HOLDS:
        return still[0] > still[1]
    span = 8
    if len(own) < 10 * (span + _LAGS):
        return False
    a, b = own[span:] - own[:-span], theirs[span:] - theirs[:-span]
    middle = slice(_LAGS, len(a) - _LAGS)
    scores = [_correlation(a[middle], np.roll(b, -lag)[middle]) for lag in range(-_LAGS, _LAGS + 1)]
    best = int(np.argmax(scores)) - _LAGS
    return best > 0 and scores[best + _LAGS] - scores[_LAGS] > 1e-5


def is_steered_by(command: LogColumn, reference: LogColumn, measured: LogColumn) -> bool:
    """Return whether a column is a controller output: gain, damping and offset of reference and measurement."""
    own, target, actual = (column.pieces[0] for column in (command, reference, measured))
    if not len(own) == len(target) == len(actual) or len(own) < 100:
        return False
    rate = np.gradient(actual)
    good = np.isfinite(own) & np.isfinite(target) & np.isfinite(rate)
    if good.sum() < 100 or _scatter(own[good]) == 0:
        return False
    ones, reference_rate = np.ones(int(good.sum())), np.gradient(target)[good]
    answer = _compute_unexplained(own[good], np.column_stack([(target - actual)[good], rate[good], ones]))
    # What the motion says by itself, or that which is asked for, is a velocity and no answer.
    velocity = _compute_unexplained(own[good], np.column_stack([rate[good], reference_rate, ones]))
    return answer < 0.1 and velocity > max(0.02, 2.0 * answer)


def _compute_unexplained(own: Column, parts: Column) -> float:
    """Share of the variance of a column that a linear combination of others, shape ``(rows, parts)``, leaves."""
    fitted, *_ = np.linalg.lstsq(parts, own, rcond=None)
    return float(np.var(own - parts @ fitted) / np.var(own))
