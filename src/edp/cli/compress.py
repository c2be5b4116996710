"""``edp compress search``: the best network that a controller can run."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from edp.cli.console import JsonFlag, emit, out, print_table
from edp.cli.options import DataOption, MapOption, RepairOption, SettingsOption, source_if_given
from edp.cli.progress import show_progress

if TYPE_CHECKING:
    from edp.evaluation.compression import CompressionResult
    from edp.workflows.compression import CompressedRow


def compress(
    bundle: Annotated[Path, typer.Argument(help="Run folder of the teacher, or its bundle.")],
    folder: Annotated[Path, typer.Option("--out", help="Folder of the search; an unfinished search continues.")],
    data: DataOption = [],  # noqa: B006
    budget: Annotated[
        Path | None, typer.Option("--budget", help="Limits of the controller (TOML); by default those of the thesis.")
    ] = None,
    reopen_test_set: Annotated[
        bool,
        typer.Option(
            "--reopen-test-set", help="Open the sealed test set again for another choice; the opening is recorded."
        ),
    ] = False,
    config: SettingsOption = None,
    changes: Annotated[
        list[str], typer.Option("--set", help="One setting, for example compress.units=[24] or training.epochs=10.")
    ] = [],  # noqa: B006
    signal_map: MapOption = None,
    repair: RepairOption = [],  # noqa: B006
    as_json: JsonFlag = False,
) -> None:
    """Search width, pruning, number formats and quantisation-aware training for the best network within a budget.

    Choices rest on the validation part; the test part is opened once, for the chosen network and the teacher. Stop
    it at any moment (Ctrl-C): the same command continues.

    Example: `edp compress search runs/first --budget examples/budgets/small_controller.toml --out runs/small`
    """
    from edp.config.commands import TRAINING_TABLES, command_settings
    from edp.evaluation.controller import load_budget
    from edp.report import write_compression_page
    from edp.workflows.compression import (
        CompressionSearchRequest,
        CompressionSearchSpec,
        search,
    )

    own = [] if budget is None else [{"compress": {"budget": asdict(load_budget(budget))}}]
    spec, others = command_settings("compress", CompressionSearchSpec, config, [*changes, *own], TRAINING_TABLES)
    request = CompressionSearchRequest(spec=spec, again=reopen_test_set, changes=others)
    source = source_if_given(data, signal_map, repair)
    with show_progress("compress", as_json) as progress:
        compression = search(bundle, request, folder, source, progress)
    page = write_compression_page(folder)

    def show() -> None:
        _tables(compression)
        if compression.best is not None:
            _show_next(compression.best, folder)
        out.print(f"report: {page}")

    emit(as_json, compression.to_table() | {"report": str(page)}, show)


def _show_next(best: CompressedRow, folder: Path) -> None:
    # An integer network leaves its run in float; quantising it is the next step.
    whole = best.number_format == "w8a16"
    then = f"edp compress quantise {best.run} --out {folder / 'w8a16'}" if whole else f"edp evaluate {best.run}"
    out.print(f"next: {then}, or edp compress estimate {best.run}")


def _tables(facts: CompressionResult) -> None:
    from edp.report.compression import facts as words

    for horizon in facts.horizons:
        table = words.front_table(facts, horizon)
        rows = tuple((f"{'* ' if i in table.marked else '  '}{row[0]}", *row[1:]) for i, row in enumerate(table.rows))
        print_table(replace(table, caption=f"{table.caption}; * on the front", rows=rows))
        out.print()
    out.print(words.headline(facts))
    for line in words.verdict(facts):
        out.print(line)
