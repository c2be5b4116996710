"""A signal map for logs that nobody described, column by column with how sure it is."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np

from edp.logs.proposal.behaviour import Behaviour, Relation, behaviour_of, is_steered_by, relations_of, repeats
from edp.logs.proposal.clocks import ClockGuess, clock_of
from edp.logs.proposal.columns import LogColumn, LogLook
from edp.logs.proposal.kinds import BOUND, KindGuess, add_article, kind_of, kind_of_change
from edp.logs.proposal.names import (
    ends_as_stamp,
    is_counter_name,
    is_error_name,
    is_sample_time_name,
    is_stamp_name,
    kind_by_word,
    role_by_word,
    tag_family,
    words_of,
)
from edp.signals import TABLE_A1, VOCABULARY, ChannelMap, Kind, SignalMap
from edp.wording import percent, typed

SURE = 0.85
"""Confidence above which a proposal needs no check."""
MAPPED_ROLES = ("reference", "command", "measured", "label")
"""Roles of columns that become channels. Time, counters, constants and texts do not."""
_COMMANDS = (Kind.PILOT_PRESSURE, Kind.CURRENT, Kind.VOLTAGE, Kind.RATIO)
_MEASURED = tuple(kind for kind in Kind if kind not in (*_COMMANDS, Kind.GENERIC))
"""Kinds that show what a machine does, however they move; names and what follows them tell their references."""
_FOLLOWED = (Kind.PRESSURE, Kind.TEMPERATURE, Kind.FLOW)
"""Kinds that count as references only because of their name."""
_NUMBERS = re.compile(r"\d+")
_MIN_SWITCHES = 3
"""Minimum expected number of label changes in a log before a command without changes counts as a command."""
_PLAIN_NAME = re.compile(r"\w[\w .\-/()%]{0,63}")
_MAX_CHANNELS = 200
_MAX_FALLS = 5
"""Maximum number of logger restarts within a log, at which time stamps fall."""
_SWITCHED_HZ = {"command": 0.01, "": 0.05, "label": 1.0}
"""Changes a second below which a column of a few whole values is a label, by what its name says: a working machine
opens valves more often than every 100 s."""


@dataclass(frozen=True)
class ColumnGuess:
    """Proposed meaning of a column.

    Attributes:
        column: name of the column in the file.
        channel: name of the channel; empty where it becomes none.
        role: ``time``, ``counter``, ``constant``, ``text``, ``remark``, or one of `MAPPED_ROLES`.
        kind: kind and unit.
        confidence: joint confidence of role and kind, 0 to 1.
        why: evidence for the role.
        check: advice for a manual check.
        relation: dependency on another column.
    """

    column: str
    channel: str
    role: str
    kind: KindGuess
    confidence: float
    why: str
    check: str = ""
    relation: Relation | None = None

    @property
    def sureness(self) -> str:
        """Certainty in one word; ``unsure`` is below `BOUND`."""
        return "sure" if self.confidence >= SURE else "likely" if self.confidence >= BOUND else "unsure"


@dataclass(frozen=True)
class MapProposal:
    """Proposed signal map with its evidence."""

    look: LogLook
    clock: ClockGuess
    columns: tuple[ColumnGuess, ...]
    signal_map: SignalMap

    def select_role(self, *roles: str) -> tuple[ColumnGuess, ...]:
        """Return the channels with the given roles, in order."""
        return tuple(guess for guess in self.columns if guess.channel and guess.role in roles)


def propose_map(look: LogLook, common: Collection[str] | None = None, beside: Sequence[LogLook] = ()) -> MapProposal:
    """Propose what every column of a log is.

    Args:
        look: the columns.
        common: columns that all logs of a group have; None for all of this log. Others become no channels.
        beside: further logs of the group: a column that repeats another one does so in each, and one that rests does.
    """
    behaviours = {column.name: behaviour_of(column) for column in look.columns}
    clock = clock_of(look, behaviours)
    families = Counter(tag_family(column.name) for column in look.columns)
    moving = [c for c in look.columns if _is_free(c, behaviours[c.name], clock)]
    relations = relations_of(moving)
    behaviours = _where_they_move(behaviours, beside)
    ranges = _ranges_of_all(behaviours, beside)
    kinds = {c.name: kind_of(c, ranges[c.name], families[tag_family(c.name)]) for c in look.columns}
    kinds = _unify_kinds(look.columns, kinds)
    for name, relation in relations.items():
        change = kind_of_change(relation, kinds[relation.other], clock.rate_hz)
        if change is not None and kinds[name].confidence < BOUND:
            kinds[name] = change
    steered = _find_controlled(moving, relations)
    # What follows a reference is measured, also where a coarse sensor makes it move in steps.
    following = {
        r.other: Relation("follows", name, 1.0, r.strength) for name, r in relations.items() if r.how == "reference"
    }
    relations = following | relations
    guesses = [
        _column_guess(column, behaviours[column.name], kinds[column.name], clock, relations.get(column.name), steered)
        for column in look.columns
    ]
    if common is not None:
        guesses = [g if g.column in common else replace(g, channel="", check="not in all logs") for g in guesses]
    guesses = _name_channels(_drop_copies(guesses, beside))
    texts = [
        ColumnGuess(name, "", "time", _NO_KIND, clock.confidence, "dates", clock.check)
        if name == clock.column
        else ColumnGuess(name, "", "text", _NO_KIND, 0.9, "holds text")
        for name in look.texts
    ]
    columns = (*guesses, *texts)
    return MapProposal(look, clock, columns, _signal_map(look, clock, columns))


_NO_KIND = KindGuess(Kind.GENERIC, "1", 1.0, "")
_EMPTY = "empty"
"""Reason for a constant column: all rows are empty."""


def _where_they_move(behaviours: dict[str, Behaviour], beside: Sequence[LogLook]) -> dict[str, Behaviour]:
    """Replace the statistics of a column that is constant in the first log by statistics from another log of the group.

    A machine is often tested one axis a log.
    """
    moving = dict(behaviours)
    for column in (column for look in beside for column in look.columns):
        first = moving.get(column.name)
        if first is not None and (first.constant or first.steps):
            other = behaviour_of(column)
            more = not other.constant if first.constant else not (other.constant or other.steps)
            moving[column.name] = other if more else first
    return moving


def _ranges_of_all(behaviours: dict[str, Behaviour], beside: Sequence[LogLook]) -> dict[str, Behaviour]:
    """Widen the range of each column to all logs of a group, since a unit cannot be derived from a constant column."""
    ranges = dict(behaviours)
    for column in (column for look in beside for column in look.columns):
        numbers = column.values[np.isfinite(column.values)]
        behaviour = ranges.get(column.name)
        if behaviour is not None and len(numbers):
            low, high = np.fmin(behaviour.low, numbers.min()), np.fmax(behaviour.high, numbers.max())
            ranges[column.name] = replace(behaviour, low=float(low), high=float(high))
    return ranges


def _unify_kinds(columns: Sequence[LogColumn], kinds: dict[str, KindGuess]) -> dict[str, KindGuess]:
    """Return the kinds; a column of a series of axes with an ambiguous unit takes the kind of the others."""
    rows: dict[str, list[LogColumn]] = {}
    for column in columns:
        rows.setdefault(_NUMBERS.sub("", column.name), []).append(column)
    filled = dict(kinds)
    for row in rows.values():
        word = kind_by_word(row[0].name)
        guessed = {(kinds[c.name].kind, kinds[c.name].unit): kinds[c.name] for c in row if kinds[c.name].kind is word}
        if word is None or len(guessed) != 1:
            continue
        guess = next(iter(guessed.values()))
        for column in row:
            if kinds[column.name].confidence < BOUND and not column.unit and column.kind is None:
                filled[column.name] = replace(guess, confidence=BOUND, why="as the others of its row")
    return filled


def _is_free(column: LogColumn, behaviour: Behaviour, clock: ClockGuess) -> bool:
    """Return whether a column may be related to others: no time, no constant, no counter, no label."""
    idle = behaviour.constant or behaviour.counts or behaviour.switches or (behaviour.restarts and behaviour.whole)
    return column.name != clock.column and column.name not in clock.beside and not idle


def _find_controlled(columns: Sequence[LogColumn], relations: dict[str, Relation]) -> dict[str, str]:
    """Return the columns that are controller outputs, each with its reference."""
    by_name = {column.name: column for column in columns}
    pairs = [(name, relation.other) for name, relation in relations.items() if relation.how == "reference"]
    return {
        column.name: target
        for target, actual in pairs
        for column in columns
        if column.name not in (target, actual) and is_steered_by(column, by_name[target], by_name[actual])
    }


def _column_guess(
    column: LogColumn,
    behaviour: Behaviour,
    kind: KindGuess,
    clock: ClockGuess,
    relation: Relation | None,
    steered: dict[str, str],
) -> ColumnGuess:
    name = column.name
    if name == clock.column or name in clock.beside:
        return ColumnGuess(name, "", "time", _NO_KIND, clock.confidence, "time of the rows", clock.check)
    aside = _aside(name, behaviour, kind, clock.rate_hz, column.samples)
    if aside is not None:
        return aside
    role, sure, why = _role(column, behaviour, kind, relation, steered)
    check = kind.check
    if sure < BOUND and not check:
        check = f"is it a {role}?"
    return ColumnGuess(name, name, role, kind, min(sure, kind.confidence), why, check, relation)


def _aside(name: str, behaviour: Behaviour, kind: KindGuess, rate_hz: float | None, rows: int) -> ColumnGuess | None:
    """Return the guess for a column without motion (constant, counter, label); None for other columns."""
    if behaviour.beside and not is_known(name):
        return ColumnGuess(
            name, "", "remark", _NO_KIND, 0.85, f"filled in {percent(behaviour.filled)} of the rows", "not taken"
        )
    if behaviour.constant:
        value = _EMPTY if not behaviour.filled else f"always {typed(behaviour.high)}"
        return ColumnGuess(name, "", "constant", _NO_KIND, 0.95, value, "" if is_known(name) else "not taken")
    # A logger that was restarted has stamps that fall now and then.
    rising = behaviour.rises or behaviour.falls <= _MAX_FALLS
    if is_stamp_name(name) or (ends_as_stamp(name) and rising):
        return ColumnGuess(name, "", "time", _NO_KIND, 0.9, "the stamp of a message", "not taken")
    if is_sample_time_name(name) and behaviour.low >= 0:
        return ColumnGuess(name, "", "time", _NO_KIND, 0.8, "the time between rows", "not taken")
    if behaviour.counts and behaviour.levels > 2:
        sure = 0.9 if is_counter_name(name) else 0.65
        return ColumnGuess(name, "", "counter", _NO_KIND, sure, "rises by one", "" if sure >= SURE else "a counter?")
    if behaviour.restarts and behaviour.even and behaviour.whole:
        return ColumnGuess(name, "", "counter", _NO_KIND, 0.7, "counts and begins anew", "a counter?")
    word = role_by_word(name)
    if word == "label" and behaviour.levels == 2 and (behaviour.low, behaviour.high) == (0.0, 1.0):
        return ColumnGuess(name, name, "label", kind, max(kind.confidence, BOUND), "a flag by its name", "a feature?")
    seldom = behaviour.changes * (rate_hz or 1.0) < _SWITCHED_HZ.get(word, 0.0)
    # In a log of a minute a valve that is tested opens once.
    brief = word == "command" and rows < _MIN_SWITCHES * (rate_hz or 1.0) / _SWITCHED_HZ[word]
    if behaviour.switches and seldom and not brief:
        sure = min(0.85 if word == "label" else 0.7, max(kind.confidence, BOUND))
        check = kind.check if kind.kind is not Kind.GENERIC and kind.check else "a feature?"
        return ColumnGuess(name, name, "label", kind, sure, f"{behaviour.levels} values, seldom changed", check)
    return None


def is_known(name: str) -> bool:
    """Return whether a name is of the vocabulary.

    Whose constants may be wanted (conflux lines that a machine lacks).
    """
    return name in VOCABULARY


def _role(
    column: LogColumn, behaviour: Behaviour, kind: KindGuess, relation: Relation | None, steered: dict[str, str]
) -> tuple[str, float, str]:
    """Return the role of a column that moves, how sure, and why."""
    name, word = column.name, role_by_word(column.name)
    if name in TABLE_A1:
        return ("command" if kind.kind in _COMMANDS else "measured"), 0.95, "a name of Table A.1"
    # Chambers of cylinders at rest hold one level without following each other.
    if relation is not None and relation.how == "reference" and (kind.kind not in _FOLLOWED or word == "reference"):
        return "reference", 0.85 if word == "reference" else 0.75, f"{relation.other[:24]} follows it"
    if is_error_name(name):
        return "measured", 0.7, "a deviation by its name"
    if relation is not None and relation.how == "follows":
        return "measured", 0.85 if word == "measured" else 0.75, f"follows {relation.other[:24]}"
    if name in steered:
        return "command", 0.8, f"a controller's answer to {steered[name][:24]}"
    if word in ("reference", "command", "measured"):
        # A single letter is a habit, not a word.
        by_letter = all(len(part) == 1 or part.isdigit() for part in words_of(name)[:1])
        # y1 of a joystick is no output: what holds its value between steps of its own was moved by hand.
        if not (by_letter and word == "measured" and behaviour.steps):
            return word, 0.7 if by_letter else 0.85, "its name"
    if column.unit == "us":
        return "command", 0.75, "the width of a pulse"
    if kind.kind in _COMMANDS and kind.confidence >= BOUND:
        return "command", 0.65, add_article(kind.kind)
    if kind.kind in _MEASURED and kind.confidence >= BOUND:
        return "measured", 0.85, add_article(kind.kind)
    if behaviour.steps:
        return "command", 0.65, "moves in steps"
    if relation is not None and relation.how == "change":
        return "measured", 0.7, f"the change of {relation.other[:24]}"
    return "measured", 0.65, "moves by itself"


def _drop_copies(guesses: Sequence[ColumnGuess], beside: Sequence[LogLook]) -> list[ColumnGuess]:
    """Remove channels that repeat an earlier column in another unit, since they would be predicted twice."""
    columns = [{column.name: column for column in look.columns} for look in beside]
    channels: set[str] = set()
    single = []
    for guess in guesses:
        name, relation = guess.column, guess.relation
        copied = relation is not None and relation.how == "copy" and relation.other in channels and not is_known(name)
        if copied and relation is not None and all(_is_repeated(log, name, relation.other) for log in columns):
            guess = replace(guess, channel="", why=f"repeats {relation.other[:40]}", check="a copy; not taken")
        elif guess.channel:
            channels.add(guess.column)
        single.append(guess)
    return single


def _is_repeated(columns: dict[str, LogColumn], name: str, other: str) -> bool:
    return name in columns and other in columns and repeats(columns[name], columns[other])


def _name_channels(guesses: Sequence[ColumnGuess]) -> list[ColumnGuess]:
    """Return the channels under names that every export takes and a person can type; too many ones are left out."""
    named, used, count = [], set[str](), 0
    for i, guess in enumerate(guesses):
        channel = guess.channel
        count += bool(channel)
        if channel and (count > _MAX_CHANNELS or not channel.isprintable()):
            guess = replace(guess, channel="", check=f"left out: beyond {_MAX_CHANNELS} channels, or an odd name")
        elif channel:
            plain = channel if _PLAIN_NAME.fullmatch(channel) else channel.strip("/ .:")[:64].replace(":", ".")
            channel = plain if _PLAIN_NAME.fullmatch(plain) and plain not in used else f"channel_{i + 1}"
            used.add(channel)
            guess = replace(guess, channel=channel)
        named.append(guess)
    return named


def _signal_map(look: LogLook, clock: ClockGuess, columns: Sequence[ColumnGuess]) -> SignalMap:
    channels = tuple(
        ChannelMap(
            guess.channel,
            guess.column,
            guess.kind.unit,
            guess.kind.kind,
        )
        for guess in columns
        if guess.channel
    )
    return SignalMap(
        channels,
        time=clock.column,
        time_unit=clock.unit,
        sample_time_s=clock.sample_time_s,
        rate_hz=clock.wanted_hz,
        header=not look.headerless,
        columns=tuple(sorted((*look.names, *look.texts), key=_place)) if look.headerless else (),
    )


def _place(name: str) -> int:
    """Return the position of a column that is named by its position only."""
    return int(name.rpartition("_")[2])


def plain_map(look: LogLook) -> SignalMap:
    """Return a map of all numeric columns for inspection: proposed kinds, otherwise dimensionless values."""
    proposal = propose_map(look)
    # A column without any number is a delimiter too many, not a sensor.
    unmapped = [g for g in proposal.columns if not g.channel and g.role in ("constant", "counter") and g.why != _EMPTY]
    mapped = proposal.signal_map.channels
    used = {entry.name for entry in mapped}
    more = [
        ChannelMap(g.column, g.column, "1", Kind.GENERIC) for g in unmapped if g.column not in used | set(VOCABULARY)
    ]
    # A fast log is inspected as it is.
    return replace(proposal.signal_map, channels=(*mapped, *more)[:_MAX_CHANNELS], rate_hz=None)
