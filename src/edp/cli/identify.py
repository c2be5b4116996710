"""``edp calibrate``: from logs to a machine file of the simulator."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from edp.cli.console import JsonFlag, emit, out, table
from edp.cli.options import LogsArgument, MapOption, RepairOption, source_of
from edp.cli.progress import show_progress
from edp.cli.twin import score_table
from edp.cli.verdicts import end_with, show_verdict, verdict_facts
from edp.settings.results import plain_value
from edp.wording import figure

if TYPE_CHECKING:
    from edp.workflows.identify import Identified


def identify(
    data: LogsArgument,
    file: Annotated[Path, typer.Option("--out", help="Machine file (.toml) to write; numbers beside it as .json.")],
    machine: Annotated[
        str, typer.Option(help="M22, C14, or a machine file: pins, lengths and bores, and a guess of the rest.")
    ] = "M22",
    run: Annotated[
        Path | None, typer.Option(help="Run folder of a grey box of these logs, in place of a new fit.")
    ] = None,
    config: Annotated[Path | None, typer.Option(help="Settings of the grey box and its fit (TOML).")] = None,
    changes: Annotated[list[str], typer.Option("--set", help="One setting, for example twin.fit.starts=1.")] = [],  # noqa: B006
    signal_map: MapOption = None,
    repair: RepairOption = [],  # noqa: B006
    as_json: JsonFlag = False,
) -> None:
    """Calibrate the simulator: fit a machine file to logs of boom, arm and bucket.

    Valve curves, dead bands, leakage, friction, volumes, pumps, time constants, inertia and gravity are fitted to the
    logs; pins, lengths and bores are those of --machine, and so is what the logs do not tell, which is said number by
    number. Both machines are then driven by the commands of held-out recordings.

    Example: `edp calibrate logs --out mine.toml --machine measured.toml`
    """
    from edp.config.twin import load_twin_experiment
    from edp.evaluation.guard import machine_verdict
    from edp.workflows.identify import identify as run_identify

    experiment = None
    if config is not None or changes:
        # A file says which kind it is of.
        experiment = load_twin_experiment(config, changes if config else ["twin.kind=greybox", *changes])
    with show_progress("identify", as_json) as progress:
        result = run_identify(source_of(data, signal_map, repair), file, machine, experiment, run, progress)
    numbers = [row.to_dict() for row in result.rows]
    verdict = machine_verdict(result.scores)
    facts = {
        "machine": str(file), "numbers": numbers, "models": plain_value(result.scores), "notes": result.notes,
        **verdict_facts(verdict),
    }  # fmt: skip

    def show() -> None:
        show_verdict(verdict)
        number_table(result)
        score_table(result.scores)
        for note in result.notes:
            out.print(f"note: {note}")
        out.print(f"machine in {file}, numbers and scores in {file.with_suffix('.json')}")
        out.print(f"next: edp simulate data/mine --machine {file}")

    emit(as_json, facts, show)
    end_with(verdict)


def number_table(result: Identified) -> None:
    """Print one row per parameter: guess, identified value and interval, or that the logs do not identify it."""
    rows = []
    for row in result.rows:
        interval = row.interval("kept: not told by the logs")
        rows.append([row.label, row.unit, figure(row.base), figure(row.value), interval])
    told_count = sum(row.is_told for row in result.rows)
    rough = sum(row.excited for row in result.rows) - told_count
    table(
        f"{told_count} of {len(rows)} numbers are told by the logs, {rough} roughly",
        ["", "unit", "guess", "identified", "about 95 %"],
        rows,
    )
