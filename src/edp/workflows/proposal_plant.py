"""Whether proposed columns can train a plant model, which runs on commands alone, and what a user must name for it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from edp.data.derived_velocities import RATE_OF
from edp.data.roles import COMMANDS
from edp.data.twin_channels import INTEGRAL
from edp.logs.proposal.propose import MapProposal
from edp.signals import Kind

_LISTED = 3
"""Names in a sentence at most."""


@dataclass(frozen=True)
class PlantProposal:
    """What of the logs a plant model would read and answer with.

    Attributes:
        parts: channels to name to `edp twin`, by part; a part that it finds by itself is not among them.
        why_not: a sentence: why the logs cannot train one, and what to record or to name; empty where they can.
    """

    parts: dict[str, tuple[str, ...]] = field(default_factory=dict)
    why_not: str = ""


def propose_plant(proposal: MapProposal, targets: Sequence[str], inputs: Sequence[str]) -> PlantProposal:
    """What a plant model of these columns needs.

    Args:
        proposal: the columns.
        targets: channels to predict.
        inputs: channels that command, where no kind tells it.
    """
    kinds = {guess.channel: guess.kind.kind for guess in proposal.columns if guess.channel}
    commands = [guess.channel for guess in proposal.of_role("command")]
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
            why_not=f"it answers with positions or speeds, and {_shown(targets)} are none: record one, or give what "
            "shall answer the kind generic in the map and name it, edp twin --set 'channels.velocities=[...]'"
        )
    return _of_positions(proposal, kinds, commands, assignments)


def _of_positions(
    proposal: MapProposal, kinds: dict[str, Kind], commands: Sequence[str], assignments: dict[str, tuple[str, ...]]
) -> PlantProposal:
    """Of logs without a measured velocity: `edp twin` takes the changes of the positions."""
    asked = [name for name, kind in kinds.items() if kind in INTEGRAL]
    if asked:  # one that is no answer, or the answers to predict would be velocities
        return PlantProposal(
            why_not=f"it would take {_shown(asked)}, which no measurement follows, for an answer: record the speed "
            "itself, or give this column the kind generic in the map"
        )
    if not assignments["commands"] and not any(kinds[name] in COMMANDS for name in commands):
        assignments = {"commands": tuple(commands)}
    measured = tuple(guess.channel for guess in proposal.of_role("measured") if guess.kind.kind in RATE_OF)
    others = [
        name for name, kind in kinds.items() if kind in RATE_OF and name not in (*measured, *assignments["commands"])
    ]
    return PlantProposal(assignments | ({"strokes": measured} if others else {}))


def _shown(names: Sequence[str]) -> str:
    more = f" and {len(names) - _LISTED} more" if len(names) > _LISTED else ""
    return ", ".join(names[:_LISTED]) + more
