"""Command ``edp verify``: check that all forms of a network give equal results."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from edp.cli.consent import ask
from edp.cli.console import JsonFlag, emit, err, out, table
from edp.cli.options import MOST_TICKS, MapOption, RepairOption, check_effects, complete_from, source_if_given
from edp.wording import figure, number

if TYPE_CHECKING:
    from edp.workflows.parity import Row


def verify(
    context: typer.Context,
    bundle: Annotated[
        Path, typer.Argument(help="Bundle, or run folder of edp train, edp compress quantise or edp twin.")
    ],
    data: Annotated[
        list[Path],
        typer.Option(
            help="Logs and folders of logs whose first samples, in equal parts, are the reference recording; may be "
            "repeated. Default: random inputs."
        ),
    ] = [],  # noqa: B006
    samples: Annotated[
        int | None,
        typer.Option(
            min=1,
            max=MOST_TICKS,
            help="Samples of the reference recording; default: 400, or for a twin its start-up samples and 60 s.",
        ),
    ] = None,
    forms: Annotated[
        list[str],
        typer.Option(
            "--format",
            autocompletion=complete_from("edp.workflows.parity", "FORMS"),
            help="Exported format to run; may be repeated. Default: all.",
        ),
    ] = [],  # noqa: B006
    interpreters: Annotated[
        list[str],
        typer.Option("--onnxruntime", help="Python program with another ONNX Runtime to run too; may be repeated."),
    ] = [],  # noqa: B006
    strict: Annotated[bool, typer.Option(help="Count forms that cannot be run here as failures.")] = False,
    signal_map: MapOption = None,
    repair: RepairOption = [],  # noqa: B006
    yes: Annotated[
        bool, typer.Option("--yes", help="Run code of a bundle outside of a run folder without confirmation.")
    ] = False,
    as_json: JsonFlag = False,
) -> None:
    """Run one recording through PyTorch and every exported form; compare results and time per sample.

    Each form is exported, compiled and run on this computer: C with cc, Python and MATLAB code with this Python and GNU
    Octave, where they are there. Of a bundle that is not in a run folder it asks first.

    Ends with 1 where a form differs from PyTorch by more than its tolerance.

    Example: `edp verify runs/first`
    """
    from edp.workflows.deployment import load_exported
    from edp.workflows.parity import compare, from_own_run, golden_case, record_case

    check_effects(context, {"interpreters": not forms or any(form.startswith("onnx_") for form in forms)})
    if not (yes or from_own_run(bundle)):
        _ask(bundle)
    loaded = load_exported(bundle)
    source = source_if_given(data, signal_map, repair)
    case = golden_case(loaded, samples) if source is None else record_case(loaded, source, samples)

    def tell(row: Row) -> None:
        if not as_json:
            err.print(f"{row.title}: {row.verdict}", style="dim")

    rows = compare(case, forms, interpreters, tell)
    # A form that needs an absent program is no failure of the network, unless asked.
    bad = {"different", "failed"} | ({"not run"} if strict else set())
    failed = [row.title for row in rows if row.verdict in bad]
    facts = {"ticks": len(case.inputs), "rows": [row.to_json() for row in rows], "failed": failed}
    emit(as_json, facts, lambda: _show(rows, len(case.inputs)))
    if failed:
        err.print(f"not the same: {', '.join(failed)}")
        raise typer.Exit(1)


def _ask(bundle: Path) -> None:
    """Ask on a terminal whether a bundle from elsewhere is to be compiled and run.

    Raises:
        ConfigError: there is no terminal, or the answer is no.
    """
    from edp.workflows.parity import WHAT

    ask(f"'{bundle}' is not the folder of a run of yours. {WHAT}")


def _show(rows: list[Row], ticks: int) -> None:
    shown = [row for row in rows if row.largest is not None]
    cells = [
        (
            row.title,
            row.verdict,
            figure(row.largest, 3),
            figure(row.mean, 2),
            row.tolerance,
            number(row.microseconds, 1),
        )
        for row in shown
    ]
    heads = ["form", "verdict", "largest", "mean", "allowed", "µs a tick"]
    table(f"{ticks} ticks against PyTorch", heads, cells)
    out.print(
        "differences are in what is allowed: a share of a standard deviation of the target and of the largest value;"
    )
    out.print("where all bits must agree, largest is how many numbers differ and mean their share")
    for row in shown:
        if row.note:
            out.print(f"{row.title}: {row.note}")
    for row in rows:
        if row.largest is None:
            out.print(f"{row.title}: {row.verdict}; {row.why}")
