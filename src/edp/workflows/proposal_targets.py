"""What of proposed columns is predicted."""

from __future__ import annotations

from collections.abc import Sequence

from edp.errors import DataError
from edp.logs.proposal.names import is_error_name
from edp.logs.proposal.propose import ColumnGuess, MapProposal
from edp.signals import Kind

MOST_TARGETS = 4
"""Outputs at most: each is a model of its own in the time that a first run takes."""
_TARGETS = (
    (Kind.VELOCITY,),
    (Kind.ANGULAR_VELOCITY,),
    (Kind.POSITION,),
    (Kind.ANGLE,),
    (Kind.FORCE,),
    (Kind.PRESSURE,),
    (Kind.FLOW,),
    (Kind.TEMPERATURE,),
)
"""What is predicted: the first of these kinds that is measured, or else all that is measured."""


def choose_targets(proposal: MapProposal) -> tuple[tuple[str, ...], list[str]]:
    """What to predict, and what to say of it.

    Raises:
        DataError: nothing moves.
    """
    measured = proposal.of_role("measured")
    notes = []
    if not measured:
        measured = proposal.of_role("command", "reference")
        if not measured:
            texts = len(proposal.look.texts)
            unread = f", and {texts} that hold text" if texts else ""
            raise DataError(
                f"'{proposal.look.path}': no column moves (constants, counters and labels only{unread}); there is "
                "nothing to predict: record while the machine works, and give each column a name of its own"
            )
        notes.append("no column looks measured: check task.targets")
    # A deviation follows from two other columns; where nothing else moves it is what there is.
    measured = tuple(guess for guess in measured if not is_error_name(guess.column)) or measured
    # A change of another column is a velocity, whatever its unit.
    changes = [guess for guess in measured if guess.relation is not None and guess.relation.how == "change"]
    # Where one of a row of axes shows it, its brothers are velocities, too.
    families = {_stem(guess.column) for guess in changes} | _beside_changes(changes, proposal)
    changes = [guess for guess in measured if guess in changes or {guess.column, _stem(guess.column)} & families]
    by_kind = [[g for g in measured if g.kind.kind in kinds] for kinds in _TARGETS]
    chosen = next((guesses for guesses in [by_kind[0], by_kind[1], changes, *by_kind[2:]] if guesses), list(measured))
    if len(chosen) > MOST_TARGETS:
        notes.append(f"{len(chosen)} columns could be predicted; the first {MOST_TARGETS} are (task.targets)")
    return tuple(guess.channel for guess in chosen[:MOST_TARGETS]), notes


def _stem(name: str) -> str:
    """A name without the number of an axis; of names that end with none the name itself."""
    return name.rstrip("0123456789") or name


def _beside_changes(changes: Sequence[ColumnGuess], proposal: MapProposal) -> set[str]:
    """Columns named as a change is, where one is named as what changes: v_boom beside s_boom, as v_arm of s_arm."""
    columns = [guess.column for guess in proposal.columns]
    named = set[str]()
    for change in changes:
        other = "" if change.relation is None else change.relation.other
        ahead, of = _without_shared_end(change.column, other)
        if ahead and of and len(ahead) < len(change.column):
            named |= {name for name in columns if name.startswith(ahead) and of + name[len(ahead) :] in columns}
    return named


def _without_shared_end(one: str, other: str) -> tuple[str, str]:
    """Two names without the letters that end both."""
    shared = 0
    while shared < min(len(one), len(other)) and one[-1 - shared] == other[-1 - shared]:
        shared += 1
    return one[: len(one) - shared], other[: len(other) - shared]
