"""Command ``edp compare``: compare several evaluated runs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from edp.cli.console import JsonFlag, emit, out, print_table
from edp.storage.paths import full_path

TABLES = 4
"""Errors whose tables the terminal shows; the page has all."""


def compare(
    runs: Annotated[list[Path], typer.Argument(help="Run folders; the others are measured against the first.")],
    output: Annotated[Path, typer.Option("--out", help="The page.")] = Path("compare.html"),
    title: Annotated[str, typer.Option(help="Title of the page.")] = "",
    as_json: JsonFlag = False,
) -> None:
    """Compare evaluated runs on their common test recordings, with paired intervals and one page.

    Example: `edp compare runs/first runs/second`
    """
    from edp.report import build_compare_page, compare_runs
    from edp.report.compare.page import error_table

    comparison = compare_runs(runs)
    page = build_compare_page(comparison, title).write(output)

    def show() -> None:
        out.print(comparison.headline())
        for remark in comparison.remarks:
            out.print(remark)
        for measure in comparison.measures[:TABLES]:
            print_table(error_table(comparison, measure))
        if len(comparison.measures) > TABLES:
            out.print(f"and {len(comparison.measures) - TABLES} more errors on the page")
        out.print(f"page: {full_path(page)}")

    emit(as_json, {"page": str(page), **facts_of(comparison)}, show)


def facts_of(comparison: Any) -> dict[str, object]:
    """Return a comparison as JSON types."""
    rows = []
    for measure in comparison.measures:
        differences = comparison.differences(measure)
        for run in comparison.runs:
            difference = differences.get(run.name)
            rows.append(
                {"run": run.name, "output": measure.output, "what": measure.what, "ahead_s": measure.ahead_s}
                | {"unit": measure.unit, "error": comparison.error(run, measure)}
                | ({} if difference is None else vars(difference))
            )
    return {
        "headline": comparison.headline(),
        "remarks": list(comparison.remarks),
        "recordings": list(comparison.recordings),
        "errors": rows,
    }
