"""``edp init``: a signal map and settings proposed for logs that nobody described."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from edp.cli.console import JsonFlag, emit, err, listing, out
from edp.cli.progress import show_progress
from edp.errors import ConfigError, count_of
from edp.wording import figure

if TYPE_CHECKING:
    from collections.abc import Sequence

    from edp.logs.proposal.propose import ColumnGuess
    from edp.workflows.proposal import LogsProposal

_SHOWN_ROWS = 60
"""Columns in the table; all of them are in the map and in --json."""
_SHOWN_NAME = 60
"""Characters of a name in the table; a longer one is cut in its middle, since names mostly differ at an end."""
_SIBLINGS = 3
"""So many columns in a row that differ in a number only and are taken for the same stand in one row."""
_NUMBERED = re.compile(r"(.*?)(\d+)(\D*)")


def init(
    logs: Annotated[list[Path], typer.Argument(metavar="LOGS...", help="Logs and folders of logs, of any columns.")],
    folder: Annotated[Path, typer.Option("--out", help="Folder to write map.toml and settings.toml into.")] = Path(),
    yes: Annotated[bool, typer.Option("--yes", help="Write the files without asking.")] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace files that are there already.")] = False,
    as_json: JsonFlag = False,
) -> None:
    """Propose a signal map and settings for a folder of logs.

    Says how sure it is of each column and what to check. A channel that it is unsure of is taken as numbers without a
    unit. Only bounded parts of the logs are read.

    Example: `edp init logs/ --yes`
    """
    from edp.storage.folders import check_kind
    from edp.workflows.proposal import propose, write_proposal

    if not yes and not (sys.stdin.isatty() and sys.stderr.isatty()):
        raise ConfigError("edp init asks before it writes, and there is no terminal to ask on; give --yes")
    check_kind(folder, what="edp init")
    with show_progress("read", as_json) as progress:
        proposal = propose(logs, progress)
    if not as_json:
        show_proposal(proposal)
    if not yes and not typer.confirm(f"Write {' and '.join(proposal.files)} into '{folder}'?", err=True):
        err.print("nothing was written")
        raise typer.Exit(1)
    paths = write_proposal(proposal, folder, overwrite)
    commands, plant = proposal.commands(folder), proposal.plant_command(folder)

    def show() -> None:
        for path in paths:
            out.print(f"wrote {path}")
        out.print("next: " + commands[0])
        for command in commands[1:]:
            out.print("      " + command)
        if plant:
            out.print("or a plant model, which runs on commands alone:")
            out.print("      " + plant)
        else:
            out.print("no plant model is proposed: " + proposal.no_plant())

    plants = {"plant_command": plant or None, "no_plant": proposal.no_plant() or None}
    emit(as_json, _facts(proposal, paths, commands) | plants, show)


def show_proposal(proposal: LogsProposal) -> None:
    """Print the proposed meaning of each column, within 80 columns, and the remarks."""
    look, clock = proposal.proposal.look, proposal.proposal.clock
    rate = "unknown rate" if clock.rate_hz is None else f"{figure(clock.rate_hz)} Hz"
    count = len(proposal.group.paths)
    out.print(f"{count_of(count, 'log')} with these columns; {look.path.name}: {look.rows:,} rows, {rate}")
    # What never moves last: logs of ROS hold more of it than fits.
    columns = sorted(proposal.proposal.columns, key=lambda guess: guess.role == "constant")
    rows = _rows(columns[:_SHOWN_ROWS])
    listing("", ["column", "role", "kind", "unit", "sure", "check"], rows)
    if len(columns) > _SHOWN_ROWS:
        out.print(f"and {len(columns) - _SHOWN_ROWS:,} more columns, which --json lists")
    for note in proposal.notes:
        out.print(f"  note: {note}")
    if proposal.repairs:
        out.print(f"  note: training needs repairs: {', '.join(proposal.repairs)}")
    out.print(f"to predict: {', '.join(proposal.targets)}")
    unsure = sum(guess.sureness == "unsure" for guess in columns if guess.channel)
    if unsure:
        out.print(
            f"unsure of {count_of(unsure, 'channel')}: taken as numbers without a unit (generic) until the map says "
            "more"
        )


def _rows(columns: Sequence[ColumnGuess]) -> list[tuple[str, ...]]:
    """Rows of the table: name, role, kind, unit, sureness, and what to check or why."""
    rows: list[tuple[str, ...]] = []
    siblings: list[str] = []
    for guess in columns:
        row = _row(guess)
        if rows and row[1:] == rows[-1][1:] and _follows(siblings[-1], guess.column):
            siblings.append(guess.column)
        else:
            siblings = [guess.column]
        if len(siblings) == _SIBLINGS:
            del rows[2 - _SIBLINGS :]  # all but the first of them
        if len(siblings) >= _SIBLINGS:
            rows[-1] = (f"{_cut(siblings[0])} to {_cut(siblings[-1])}", *row[1:])
        else:
            rows.append(row)
    return rows


def _follows(name: str, other: str) -> bool:
    """Return whether a name equals another one except for its first number, which is larger by one."""
    one, two = _NUMBERED.fullmatch(name), _NUMBERED.fullmatch(other)
    if one is None or two is None:
        return False
    return (one[1], one[3], int(one[2]) + 1) == (two[1], two[3], int(two[2]))


def _row(guess: ColumnGuess) -> tuple[str, ...]:
    kind = (str(guess.kind.kind).replace("_", " "), guess.kind.unit) if guess.channel else ("-", "-")
    return _cut(guess.column), guess.role, *kind, guess.sureness, guess.check or guess.why


def _cut(name: str) -> str:
    half = (_SHOWN_NAME - len(" ... ")) // 2
    return name if len(name) <= _SHOWN_NAME else f"{name[:half]} ... {name[-half:]}"


def _facts(proposal: LogsProposal, paths: list[Path], commands: list[str]) -> dict[str, object]:
    clock = proposal.proposal.clock
    return {
        "files": [str(path) for path in paths],
        "logs": [str(path) for path in proposal.group.paths],
        "rate_hz": clock.rate_hz,
        "time": clock.column,
        "columns": [
            {
                "column": guess.column,
                "channel": guess.channel or None,
                "role": guess.role,
                "kind": str(guess.kind.kind),
                "unit": guess.kind.unit,
                "sure": guess.sureness,
                "confidence": guess.confidence,
                "why": "; ".join(filter(None, (guess.why, guess.kind.why))),
                "check": guess.check,
            }
            for guess in proposal.proposal.columns
        ],
        "targets": list(proposal.targets),
        "repairs": list(proposal.repairs),
        "notes": list(proposal.notes),
        "next": commands,
    }
