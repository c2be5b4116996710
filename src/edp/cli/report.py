"""``edp report``: the page of a run."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from edp.cli.console import JsonFlag, emit, out
from edp.cli.options import check_effects
from edp.storage.paths import full_path


def report(
    context: typer.Context,
    run: Annotated[Path, typer.Argument(help="Run folder of edp train or edp twin.")],
    output: Annotated[Path | None, typer.Option("--out", help="The page; default: report.html in the run.")] = None,
    title: Annotated[str | None, typer.Option(help="Title of the page.")] = None,
    limit: Annotated[
        Path | None, typer.Option(help="Limit of predictability (limit.json); default: beside the run's data.")
    ] = None,
    budget: Annotated[
        Path | None, typer.Option("--budget", help="Controller (TOML) against which the run's network is held.")
    ] = None,
    as_json: JsonFlag = False,
) -> None:
    """Write an offline report page of a run: predictions, errors, baselines, footprint and settings.

    Example: `edp report runs/first`
    """
    from edp.report import build_report, build_twin_report, headline, holds_free_runs, read_facts
    from edp.report.run.facts import limit_line, main_horizon
    from edp.report.run.outputs import describe_evaluation

    is_twin = holds_free_runs(run)
    check_effects(context, {"limit": not is_twin, "budget": not is_twin})
    if is_twin:
        page = build_twin_report(run, output, title)
        emit(as_json, {"report": str(page)}, lambda: out.print(f"report: {full_path(page)}"))
        return
    if budget is not None:
        from edp.evaluation.controller import load_budget
        from edp.workflows.deployment import state_budget

        state_budget(run, load_budget(budget))
    page = build_report(run, output, title, limit)
    facts = read_facts(run, limit)
    line, least = headline(facts), limit_line(facts, main_horizon(facts))
    judged = describe_evaluation(facts.scores, facts.provenance) if facts.scores else ""

    def show() -> None:
        out.print(line)
        if judged:
            out.print(judged)
        if least:
            out.print(least)
        out.print(f"report: {full_path(page)}")

    emit(as_json, {"report": str(page), "headline": line, "tests": judged, "limit": least}, show)
