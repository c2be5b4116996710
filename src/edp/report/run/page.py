"""One offline HTML page from a run folder: figures drawn by scripts of its own, no network, safe names."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from markupsafe import Markup

from edp.report.common.chart import Chart
from edp.report.common.page import DRAWING
from edp.report.common.provenance import provenance_rows
from edp.report.common.templates import asset, json_text, stylesheet, template
from edp.report.run import facts as run
from edp.report.run import tables
from edp.report.run.charts import DOTS_AT_MOST, run_charts, signal_chart, signals_of
from edp.report.run.choice import candidates_table, model_tables, promise_line, promise_table, read_choice
from edp.report.run.residuals import correlogram, fit_table
from edp.report.run.sheets import contexts_sheet, machines_sheet, parts_sheet, situation_sheet
from edp.storage import write_bytes
from edp.storage.paths import full_path
from edp.table import Table
from edp.wording import moment, unbroken


def build_report(
    run_folder: str | Path,
    output: str | Path | None = None,
    title: str | None = None,
    limit: str | Path | None = None,
) -> Path:
    """Write the report of a run as one HTML file that opens with no network.

    Args:
        run_folder: Folder that training and evaluation wrote; what is missing in it is named on the page.
        output: Where to write; ``report.html`` in the run folder by default.
        title: Heading of the page; the task's name by default.
        limit: File of the limit of predictability; by default the one beside the run's data, where there is one.

    Returns:
        The file written.

    Raises:
        StorageError: the folder or one of its files cannot be read, or the page cannot be written.
        DataError: predictions and scores do not belong together.
    """
    facts = run.read_facts(run_folder, limit)
    target = Path(output) if output is not None else facts.folder / "report.html"
    write_bytes(target, render(facts, title).encode("utf-8", "replace"))
    return target


def render(facts: run.Facts, title: str | None = None) -> str:
    """The page's text."""
    return template("run.html.jinja").render(**context(facts, title))


def context(facts: run.Facts, title: str | None = None) -> dict[str, Any]:
    """Everything the template shows."""
    network = run.label_of(facts, run.NETWORK) if run.NETWORK in facts.models else ""
    return {
        "title": title or (facts.scores.task.name if facts.scores else "") or full_path(facts.folder).name,
        "network": network,
        "run_name": full_path(facts.folder).name,
        "created": moment(facts.provenance.created if facts.provenance else None),
        "headline": unbroken(run.headline(facts)),
        "verdict": run.verdict_lines(facts),
        "tiles": tables.key_figures(facts),
        "comparisons": tables.comparison_tables(facts),
        "outputs": tables.output_table(facts),
        "intervals": tables.interval_table(facts),
        "spread": run.spread_text(facts),
        "ranked": bool(network) and len(facts.models[run.NETWORK].recordings) > DOTS_AT_MOST,
        "choice": choice_of(facts),
        "unseen": foundation_tables(facts),
        "situations": situations_of(facts),
        "worst": tables.worst_recordings_table(facts),
        "fit": fit_table(facts),
        "signals": signals_of(facts),
        **shown(chart for chart in (signal_chart(facts), *run_charts(facts), correlogram(facts)) if chart is not None),
        "checks": tables.budget_checks(facts),
        "budget": run.budget_name(facts.footprint),
        "parts": tables.parts_table(facts),
        "footprint": tables.footprint_rows(facts),
        "provenance": provenance_rows(facts.provenance),
        "config": facts.config,
        "makers": {name: f"{command} {facts.folder}" for name, command in run.MAKERS.items()},
        "absent": facts.absent,
    }


def situations_of(facts: run.Facts) -> Table | None:
    """Errors by what the axes did, at the headline's horizon; None where the scores do not tell."""
    horizon = run.main_horizon(facts)
    sheet = None if facts.scores is None or horizon is None else situation_sheet(facts.scores, horizon)
    return None if sheet is None else sheet


def choice_of(facts: run.Facts) -> dict[str, Any]:
    """What the preset auto chose, as sentence and tables; empty for any other run."""
    choice = read_choice(facts.folder)
    if choice is None:
        return {}
    return {
        "sentence": unbroken(" ".join(filter(None, (choice.sentence, *(choice.notes or ()), promise_line(choice))))),
        "tables": [entry for entry in (candidates_table(choice), promise_table(facts, choice)) if entry is not None],
        "models": model_tables(facts, choice),
    }


def foundation_tables(facts: run.Facts) -> dict[str, Table]:
    """Machines that were never seen, of a run over many machines; empty for any other."""
    foundation = facts.foundation
    if foundation is None:
        return {}
    unit = facts.unit or "report units"
    sheets = (parts_sheet(foundation), contexts_sheet(foundation, unit), machines_sheet(foundation, unit))
    return {sheet.name: sheet for sheet in sheets}


def shown(charts: Iterable[Chart]) -> dict[str, Any]:
    """What every page needs to show its figures offline: them, their data, the style and the scripts."""
    # Here, since every command that may write a page imports this module, and plotly takes half a second.
    from edp.report.common.interactive import plots

    drawn = plots(charts)
    return {
        "plots": drawn,
        "specs": json_text([plot.spec() for plot in drawn.values()]),
        "style": Markup(stylesheet("page.css")),
        "script": Markup(asset("page.js")),
        "drawing": Markup("\n".join(asset(name) for name in DRAWING)),
    }
