"""Kind and unit of a column from the stated unit, the name and the range, with a certainty."""

from __future__ import annotations

from dataclasses import dataclass

from edp.logs.proposal.behaviour import Behaviour, Relation
from edp.logs.proposal.columns import LogColumn
from edp.logs.proposal.names import find_unit, is_joint, kind_by_tag, kind_by_word, unit_by_ending
from edp.logs.units import OTHER_UNITS, normalise_unit
from edp.signals import KINDS, TIME_UNITS, UNITS, VOCABULARY, Kind

BOUND = 0.6
"""Confidence below which a channel is mapped as numbers without a unit."""
SURE_NUMBERS = 0.85
"""Confidence of the proposal to use values without a unit."""
_PRESSURES = (Kind.PRESSURE, Kind.PILOT_PRESSURE)
_RATES = {
    Kind.POSITION: Kind.VELOCITY,
    Kind.ANGLE: Kind.ANGULAR_VELOCITY,
    Kind.VELOCITY: Kind.ACCELERATION,
}
"""Kind of the time derivative of each kind."""
_TURNING = {
    Kind.POSITION: Kind.ANGLE,
    Kind.ANGLE: Kind.ANGLE,
    Kind.VELOCITY: Kind.ANGULAR_VELOCITY,
    Kind.ANGULAR_VELOCITY: Kind.ANGULAR_VELOCITY,
}
"""Kind of rotary motion that corresponds to each kind of linear motion."""
_NEAR = 0.1
"""Relative tolerance between the ratio of a change and that of two units."""
_SHORT_UNITS = ("t", "g")
"""Ambiguous unit letters: time or tonnes, grams or gravity."""


@dataclass(frozen=True)
class KindGuess:
    """Kind and unit of a column.

    Attributes:
        kind: physical quantity; generic for a confidence below `BOUND`.
        unit: unit of the numbers in the file; "1" if they are used without conversion.
        confidence: confidence, 0 to 1.
        why: evidence for the guess.
        check: advice for a manual check; empty if nothing is uncertain.
    """

    kind: Kind
    unit: str
    confidence: float
    why: str
    check: str = ""


def add_article(kind: Kind) -> str:
    """Return the kind with its article: ``an angular velocity``."""
    return f"{'an' if kind[0] in 'aeiou' else 'a'} {kind.replace('_', ' ')}"


def _numbers(why: str, check: str, confidence: float = 0.5) -> KindGuess:
    return KindGuess(Kind.GENERIC, "1", confidence, why, check)


def kind_of(column: LogColumn, behaviour: Behaviour, family: int) -> KindGuess:
    """Return the kind and unit of one column.

    Args:
        column: the column.
        behaviour: statistics of the column.
        family: number of instrument tags in the log that begin with the same letters, including this one.
    """
    if column.kind is not None:
        unit = find_unit(column.unit) or KINDS[column.kind].si_unit
        return KindGuess(column.kind, unit, 1.0, "the file states it")
    word = kind_by_word(column.name)
    if column.name in VOCABULARY:
        return _look_up_vocabulary(column, behaviour)
    if column.unit:
        return _guess_by_unit(column.unit, word, behaviour)
    ending = unit_by_ending(column.name)
    if ending is not None:
        return _guess_by_ending(ending, word, behaviour)
    if word in _TURNING and is_joint(column.name):
        return _guess_joint(_TURNING[word], behaviour)
    if word is not None:
        return _guess_by_range(word, behaviour, 0.7, f"its name says {word}")
    tag = kind_by_tag(column.name)
    if tag is not None:
        # One tag alone may be anything; a row of them is an instrument list.
        return _guess_by_range(tag, behaviour, 0.65 if family > 1 else 0.5, "its name is an instrument's tag")
    return _numbers("no name or unit tells", "unit unknown")


def _guess_joint(kind: Kind, behaviour: Behaviour) -> KindGuess:
    """Return the kind of a joint channel: joints turn, with few exceptions, and robots use radians."""
    unit = KINDS[kind].si_unit
    if kind is Kind.ANGLE and unit_by_range(kind, behaviour) is not None:
        return _guess_by_range(kind, behaviour, 0.7, "a joint turns")
    if not is_plausible(kind, unit, behaviour):
        return _numbers("a joint turns", f"{add_article(kind)}? unit unknown")
    return KindGuess(kind, unit, 0.65, "a joint turns", f"{unit}? m if it slides")


def _look_up_vocabulary(column: LogColumn, behaviour: Behaviour) -> KindGuess:
    kind = VOCABULARY[column.name].kind
    unit = find_unit(column.unit) or KINDS[kind].si_unit
    fits = kind in UNITS[unit].kinds and (bool(column.unit) or not _looks_small(kind, behaviour))
    if fits and is_plausible(kind, unit, behaviour):
        return KindGuess(kind, unit, 0.95 if column.unit else 0.85, "a name of Table A.1 or the simulator")
    return _guess_by_range(kind, behaviour, 0.7, "a name of Table A.1, but its numbers are not SI")


def _looks_small(kind: Kind, behaviour: Behaviour) -> bool:
    """Return whether the values are too small for a pressure in pascal."""
    return kind in _PRESSURES and max(abs(behaviour.low), abs(behaviour.high)) < 1e3


def _guess_by_unit(stated: str, word: Kind | None, behaviour: Behaviour) -> KindGuess:
    unit = find_unit(stated)
    if unit is None and normalise_unit(stated) in OTHER_UNITS | TIME_UNITS.keys():
        return _numbers("the file states a unit without a kind", f"in {stated[:12]}, as numbers", SURE_NUMBERS)
    if unit is None:
        return _numbers("the file states a unit", f"unit '{stated[:12]}' is unknown here", BOUND)
    kinds = UNITS[unit].kinds
    kind = word if word in kinds else kinds[0]
    if Kind.GENERIC in kinds:
        return _numbers("the file states no dimension", "", SURE_NUMBERS)
    if word in _TURNING and _TURNING[word] in kinds:
        # A speed in rpm and a position in degrees are those of a shaft.
        kind = word = _TURNING[word]
    if word is not None and word not in kinds:
        return _numbers(f"its name says {word}, its unit {kinds[0]}", f"is '{unit}' right?")
    if unit in _SHORT_UNITS and word is None:
        return _numbers("its unit may be two things", f"is '{unit}' {add_article(kinds[0])}?")
    if not is_plausible(kind, unit, behaviour):
        return _numbers(f"{unit} beyond what {add_article(kind)} reaches", f"is '{unit}' right?")
    return KindGuess(kind, unit, 0.95, "the file states its unit")


def _guess_by_ending(unit: str, word: Kind | None, behaviour: Behaviour) -> KindGuess:
    kinds = UNITS[unit].kinds
    if (word is not None and word not in kinds) or not is_plausible(word or kinds[0], unit, behaviour):
        return _numbers("name, ending and numbers disagree", f"is it in {unit}?")
    return KindGuess(word or kinds[0], unit, 0.85, f"its name ends with {unit}")


def _guess_by_range(kind: Kind, behaviour: Behaviour, confidence: float, why: str) -> KindGuess:
    """Return a kind with a unit derived from the range of the values."""
    unit = unit_by_range(kind, behaviour)
    if unit is None:
        return _numbers(why, f"{add_article(kind)}? unit unknown")
    if confidence < BOUND:
        return _numbers(why, f"{add_article(kind)} in {unit}?", confidence)
    return KindGuess(kind, unit, confidence, f"{why}, its numbers {unit}", f"unit {unit}?")


def is_plausible(kind: Kind, unit: str, behaviour: Behaviour) -> bool:
    """Return whether the range of a column is within the plausibility limits of a kind."""
    low, high = KINDS[kind].plausible
    conversion = UNITS[unit]
    values = [value * conversion.factor + conversion.offset for value in (behaviour.low, behaviour.high)]
    return low <= min(values) and max(values) <= high


def unit_by_range(kind: Kind, behaviour: Behaviour) -> str | None:
    """Return the unit in which a machine has values of this range; None if it is ambiguous."""
    low, largest = behaviour.low, max(abs(behaviour.low), abs(behaviour.high))
    # From (not included) and up to: what lies between the rows is left open.
    ranges: dict[Kind, list[tuple[float, float, str]]] = {
        Kind.PRESSURE: [(2.0, 700.0, "bar"), (1e5, 1e8, "Pa")],
        Kind.PILOT_PRESSURE: [(2.0, 100.0, "bar"), (1e5, 1e7, "Pa")],
        Kind.TEMPERATURE: [(2.0, 150.0, "degC"), (250.0, 450.0, "K")],
        Kind.FLOW: [(0.5, 1000.0, "L/min"), (0.0, 0.02, "m^3/s")],
        Kind.VELOCITY: [(0.02, 3.0, "m/s"), (10.0, 3000.0, "mm/s")],
        Kind.POSITION: [(30.0, 5000.0, "mm")],
        Kind.ANGLE: [(6.4, 720.0, "deg")],
        Kind.ANGULAR_VELOCITY: [(100.0, 20_000.0, "rpm")],
        Kind.RATIO: [(0.0, 1.001, "1"), (5.0, 120.0, "%")],
        Kind.VOLTAGE: [(0.0, 500.0, "V")],
        Kind.CURRENT: [(0.0, 3.0, "A"), (30.0, 3000.0, "mA")],
        Kind.FORCE: [(2000.0, 5e6, "N")],
        Kind.MASS: [(100.0, 1e5, "kg")],
    }
    # A gauge shows a vacuum of one bar at most.
    if kind in _PRESSURES and low < -1.2 and largest < 1e4:
        return None
    return next((unit for least, most, unit in ranges.get(kind, []) if least < largest <= most), None)


def kind_of_change(relation: Relation, other: KindGuess, rate_hz: float | None) -> KindGuess | None:
    """Return the kind and unit of a column that is the change in time of one whose kind and unit are known.

    None for others.

    Args:
        relation: relation of the column to the other column.
        other: kind and unit of the other column.
        rate_hz: rows a second.
    """
    kind = _RATES.get(other.kind)
    if kind is None or rate_hz is None or other.confidence < BOUND or relation.how != "change":
        return None
    ratio = abs(relation.factor) / rate_hz
    for unit, conversion in UNITS.items():
        if kind in conversion.kinds and abs(ratio * conversion.factor / UNITS[other.unit].factor - 1.0) < _NEAR:
            return KindGuess(kind, unit, 0.75, f"the change of {relation.other[:24]} in {unit}")
    return None
