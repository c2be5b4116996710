"""``edp report``: the page of a run."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from edp.cli.console import JsonFlag, emit, out
from edp.storage.paths import full_path


def report(
    run: Annotated[Path, typer.Argument(help="Run folder of edp train or edp twin.")],
    output: Annotated[Path | None, typer.Option("--out", help="The page; default: report.html in the run.")] = None,
    title: Annotated[str | None, typer.Option(help="Title of the page.")] = None,
    limit: Annotated[
        Path | None, typer.Option(help="Limit of predictability (limit.json); default: beside the run's data.")
    ] = None,
    as_json: JsonFlag = False,
) -> None:
    """Write one offline page: predictions, errors, baselines, footprint, settings; of a twin its free runs.

    Example: `edp report runs/first`
    """
    from edp.errors import ConfigError
    from edp.report import build_report, build_twin_report, headline, holds_free_runs, read_facts
    from edp.report.run.facts import main_horizon
    from edp.report.run.outputs import judged_line
    from edp.report.run.predictability import limit_line

    if holds_free_runs(run):
        if limit is not None:
            raise ConfigError(f"--limit: '{run}' holds a twin, which looks no fixed time ahead; leave it out")
        page = build_twin_report(run, output, title)
        emit(as_json, {"report": str(page)}, lambda: out.print(f"report: {full_path(page)}"))
        return
    page = build_report(run, output, title, limit)
    facts = read_facts(run, limit)
    line, least = headline(facts), limit_line(facts, main_horizon(facts))
    judged = judged_line(facts.scores, facts.provenance) if facts.scores else ""

    def show() -> None:
        out.print(line)
        if judged:
            out.print(judged)
        if least:
            out.print(least)
        out.print(f"report: {full_path(page)}")

    emit(as_json, {"report": str(page), "headline": line, "tests": judged, "limit": least}, show)
