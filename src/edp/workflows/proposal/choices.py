"""Targets of a model for proposed columns, division of its logs, and whether a plant model is possible."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from edp.data.derived_velocities import RATE_OF
from edp.data.even_split import blocks_where_time_is_uneven, rests_where_it_tests
from edp.data.roles import COMMANDS
from edp.data.splits import ByName, ByTime
from edp.data.twin_channels import INTEGRAL
from edp.errors import DataError, count_of
from edp.logs.proposal.columns import LogLook
from edp.logs.proposal.groups import LogGroup
from edp.logs.proposal.names import is_error_name
from edp.logs.proposal.propose import ColumnGuess, MapProposal
from edp.recording import Recording
from edp.signals import Channel, Kind
from edp.workflows.proposal.files import horizons_for

MAX_TARGETS = 4
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
"""Kinds of proposed targets: the first of these that is measured, or otherwise all measured channels."""
_MIN_RECORDINGS = 5
"""Recordings from which whole ones test; of fewer a single one would decide the score."""
_MOVES = 0.1
"""Minimum deviation of a moving column in a log, as a fraction of its largest deviation in any log."""
_IN_MOST, _MIN_TESTED = 0.7, 1.5
"""Fraction of the logs in which a machine moves all axes, and mean number of test logs in which a column should
move."""
_LISTED = 3
"""Names in a sentence at most."""


def choose_targets(proposal: MapProposal) -> tuple[tuple[str, ...], list[str]]:
    """Choose the targets, with notes.

    Raises:
        DataError: nothing moves.
    """
    measured = proposal.select_role("measured")
    notes = []
    if not measured:
        measured = proposal.select_role("command", "reference")
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
    families = {_stem(guess.column) for guess in changes} | _find_related_columns(changes, proposal)
    changes = [guess for guess in measured if guess in changes or {guess.column, _stem(guess.column)} & families]
    by_kind = [[g for g in measured if g.kind.kind in kinds] for kinds in _TARGETS]
    chosen = next((guesses for guesses in [by_kind[0], by_kind[1], changes, *by_kind[2:]] if guesses), list(measured))
    if len(chosen) > MAX_TARGETS:
        notes.append(f"{len(chosen)} columns could be predicted; the first {MAX_TARGETS} are (task.targets)")
    return tuple(guess.channel for guess in chosen[:MAX_TARGETS]), notes


def _stem(name: str) -> str:
    """Return a name without the number of an axis; other names are returned unchanged."""
    return name.rstrip("0123456789") or name


def _find_related_columns(changes: Sequence[ColumnGuess], proposal: MapProposal) -> set[str]:
    """Return columns named like known changes: v_boom for s_boom, if v_arm is the change of s_arm."""
    columns = [guess.column for guess in proposal.columns]
    named = set[str]()
    for change in changes:
        other = "" if change.relation is None else change.relation.other
        ahead, of = _drop_common_suffix(change.column, other)
        if ahead and of and len(ahead) < len(change.column):
            named |= {name for name in columns if name.startswith(ahead) and of + name[len(ahead) :] in columns}
    return named


def _drop_common_suffix(one: str, other: str) -> tuple[str, str]:
    """Return two names without the letters that end both."""
    shared = 0
    while shared < min(len(one), len(other)) and one[-1 - shared] == other[-1 - shared]:
        shared += 1
    return one[: len(one) - shared], other[: len(other) - shared]


def choose_split(group: LogGroup, proposal: MapProposal, targets: Sequence[str]) -> tuple[dict[str, object], list[str]]:
    """Choose the split: whole logs if there are many, else time, blocks if ends differ; with the reason."""
    idle = _rests_in_most(group, proposal, targets) if len(group.paths) >= _MIN_RECORDINGS else ""
    if len(group.paths) >= _MIN_RECORDINGS and not idle:
        return {"kind": "names"}, []
    because = [idle] if idle else []
    rate = proposal.clock.wanted_hz or proposal.clock.rate_hz
    names = list(dict.fromkeys(guess.column for guess in proposal.columns if guess.channel in targets))
    if rate and names and (idle or len(group.looks) == len(group.paths)):
        step = max(1, round((proposal.clock.rate_hz or rate) / rate))
        logs = [_targets_of(look, names, step, rate) for look in group.looks]
        uneven = blocks_where_time_is_uneven(logs, names, horizons_for(rate), ByTime())
        if uneven is not None:
            blocks, why = uneven  # of a long log a part was looked at
            longer = min(look.rows / step for look in group.looks) / min(log.samples for log in logs)
            split = {"kind": "blocks", "block_s": round(blocks.block_s * max(1.0, longer), 2), "every": blocks.every}
            return split, [*because, f"{why}: blocks of time test in turn"]
        if rests_where_it_tests(logs, names, horizons_for(rate), ByTime()):
            return {"kind": "time"}, [
                *because,
                "the machine moves in so small a part of this that the end, which would test, is mostly rest, and so "
                "are blocks of it: a test there says little; record more motion, or give a part that moves",
            ]
    return {"kind": "time"}, because


def _rests_in_most(group: LogGroup, proposal: MapProposal, targets: Sequence[str]) -> str:
    """State why whole logs would not test an output or a command that moves in few logs; empty if they would."""
    tests = max(1, round(ByName.test_fraction * len(group.paths)))
    for guess in proposal.columns:
        if guess.channel not in targets and not (guess.channel and guess.role == "command"):
            continue
        sizes = np.array([_size(look, guess.column) for look in group.looks])
        moving = sizes > _MOVES * sizes.max()
        if moving.mean() < _IN_MOST and tests * moving.mean() < _MIN_TESTED:
            return (
                f"{guess.column[:40]} moves in {np.count_nonzero(moving)} of {count_of(len(sizes), 'log')}: the end "
                "of each log "
                "tests, since a whole one shows little of the others (split)"
            )
    return ""


def _size(look: LogLook, name: str) -> float:
    """Return how much a column of a log moves: its standard deviation."""
    values = next(column.values for column in look.columns if column.name == name)
    values = values[np.isfinite(values)]
    return float(np.std(values)) if len(values) else 0.0


def _targets_of(look: LogLook, names: Sequence[str], step: int, rate: float) -> Recording:
    """Return target columns of a looked-at log; missing values separate its segments."""
    columns = {column.name: column for column in look.columns}
    apart = np.full(1, np.nan)
    values = [np.concatenate([x for piece in columns[name].pieces for x in (piece[::step], apart)]) for name in names]
    channels = tuple(Channel(name, Kind.GENERIC) for name in names)
    return Recording(look.path.name, channels, np.stack(values, axis=1).astype(np.float32), rate)


@dataclass(frozen=True)
class PlantProposal:
    """Inputs and outputs of a plant model for these logs.

    Attributes:
        parts: channels to name to `edp twin`, by part; a part that it finds by itself is not among them.
        why_not: a sentence: why the logs cannot train one, and what to record or to name; empty where they can.
    """

    parts: dict[str, tuple[str, ...]] = field(default_factory=dict)
    why_not: str = ""


def propose_plant(proposal: MapProposal, targets: Sequence[str], inputs: Sequence[str]) -> PlantProposal:
    """Propose a plant model for these columns.

    Args:
        proposal: the columns.
        targets: channels to predict.
        inputs: channels that command, where no kind tells it.
    """
    kinds = {guess.channel: guess.kind.kind for guess in proposal.columns if guess.channel}
    commands = [guess.channel for guess in proposal.select_role("command")]
    if not commands:
        return PlantProposal(
            why_not="no column looks like a command: record what moves the machine (valve current, pilot pressure, "
            "lever), or name such a column, edp twin --set 'channels.commands=[...]'"
        )
    if set(commands) & set(targets):
        return PlantProposal(why_not="no column but the command moves: record what answers it, a position or a speed")
    # Of two experiments side by side the names of the columns are others, and their kinds unknown.
    answers = {kinds.get(name, Kind.GENERIC) for name in targets}
    assignments = {"commands": tuple(inputs)}
    if answers <= {*INTEGRAL, Kind.GENERIC}:
        return PlantProposal(assignments | ({"velocities": tuple(targets)} if Kind.GENERIC in answers else {}))
    if not answers <= {*RATE_OF}:
        return PlantProposal(
            why_not=f"it answers with positions or speeds, and {_list_names(targets)} are none: record one, or give "
            "what shall answer the kind generic in the map and name it, edp twin --set 'channels.velocities=[...]'"
        )
    return _propose_from_positions(proposal, kinds, commands, assignments)


def _propose_from_positions(
    proposal: MapProposal, kinds: dict[str, Kind], commands: Sequence[str], assignments: dict[str, tuple[str, ...]]
) -> PlantProposal:
    """Propose a plant model without measured velocities: `edp twin` differentiates the positions."""
    asked = [name for name, kind in kinds.items() if kind in INTEGRAL]
    if asked:  # one that is no answer, or the answers to predict would be velocities
        return PlantProposal(
            why_not=f"it would take {_list_names(asked)}, which no measurement follows, for an answer: record the "
            "speed itself, or give this column the kind generic in the map"
        )
    if not assignments["commands"] and not any(kinds[name] in COMMANDS for name in commands):
        assignments = {"commands": tuple(commands)}
    measured = tuple(guess.channel for guess in proposal.select_role("measured") if guess.kind.kind in RATE_OF)
    others = [
        name for name, kind in kinds.items() if kind in RATE_OF and name not in (*measured, *assignments["commands"])
    ]
    return PlantProposal(assignments | ({"strokes": measured} if others else {}))


def _list_names(names: Sequence[str]) -> str:
    more = f" and {len(names) - _LISTED} more" if len(names) > _LISTED else ""
    return ", ".join(names[:_LISTED]) + more
