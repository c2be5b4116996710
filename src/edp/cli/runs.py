"""``edp runs``: what trainings, twins and searches lie on disk."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from edp.cli.console import JsonFlag, emit, listing, out

if TYPE_CHECKING:
    from edp.storage.run_listing import ListedRun


def runs(
    folder: Annotated[Path, typer.Argument(help="Folder to look below.")] = Path(),
    max_runs: Annotated[int, typer.Option(min=1, max=10_000, help="Runs to show, the latest first.")] = 40,
    as_json: JsonFlag = False,
) -> None:
    """List the runs below a folder: kind, data, error on test logs, when, finished or not.

    Example: `edp runs runs/`
    """
    from edp.storage.run_listing import list_runs

    listed, whole = list_runs(folder)

    def show() -> None:
        rows = [
            (str(_below(run.folder, folder)), run.kind, run.state, run.when[:16].replace("T", " "), run.score or "-")
            for run in listed[:max_runs]
        ]
        if not rows:
            out.print(f"no runs below '{folder}'; edp train writes one")
            return
        listing("", ["run", "kind", "state", "when", "error on test logs"], rows)
        # One log may have been given by a relative and by an absolute path.
        sources: dict[str, list[ListedRun]] = {}
        for run in listed[:max_runs]:
            if run.data:
                sources.setdefault(os.path.abspath(run.data), []).append(run)
        for own in sources.values():
            names = [str(_below(run.folder, folder)) for run in own]
            out.print(f"  data {own[0].data}: {', '.join(names[:4])}{', ...' if len(names) > 4 else ''}")
        if len(listed) > max_runs:
            out.print(f"and {len(listed) - max_runs} older ones (--max-runs)")
        if not whole:
            out.print("there are more folders than were looked into; give one nearer to the runs")

    facts = [
        {
            "folder": str(run.folder),
            "kind": run.kind,
            "state": run.state,
            "when": run.when,
            "data": run.data,
            "score": run.score,
        }
        for run in listed
    ]
    emit(as_json, {"runs": facts, "complete": whole}, show)


def _below(path: Path, top: Path) -> Path:
    return path.relative_to(top) if path != top else path
