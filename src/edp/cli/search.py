"""``edp search``: the phased model search, its state, its page and its export."""

from __future__ import annotations

import json
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperGroup

from edp.cli.console import JsonFlag, Steps, duration, emit, out, progress, table
from edp.cli.options import LogsArgument, MapOption, RepairOption, check_effects, source_of
from edp.errors import count_of
from edp.storage.reading import Table
from edp.wording import number

if TYPE_CHECKING:
    from rich.progress import Progress

    from edp.workflows.search.context import Decision
    from edp.workflows.search.runner import SearchResult
    from edp.workflows.search.study_log import StudyLog

StudyArgument = Annotated[Path, typer.Argument(help="Folder of a study, as in edp search --study.")]
DEFAULT = "run"


class _RunByDefault(TyperGroup):
    """`edp search DATA ...` is `edp search run DATA ...`."""

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Return the named command, or `run`."""
        if args and args[0] not in self.commands:
            args = [DEFAULT, *args]
        return super().resolve_command(ctx, args)

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Options before the data belong to `run`."""
        if args and args[0].startswith("-") and args[0] not in ("--help", "-h"):
            # Options may stand before the data, as in every other command.
            args = [DEFAULT, *args]
        return super().parse_args(ctx, args)


app = typer.Typer(
    cls=_RunByDefault,
    no_args_is_help=True,
    rich_markup_mode="markdown",
    help="Search for the network: phases, tests and a report. `edp search DATA --study DIR` is `edp search run ...`.",
)


@app.command(DEFAULT)
def run(
    context: typer.Context,
    data: LogsArgument,
    study: Annotated[Path, typer.Option("--study", help="Folder of the study; an unfinished study continues.")],
    preset: Annotated[str, typer.Option(help="Extent of the search: quick, standard or thesis.")] = "quick",
    config: Annotated[
        Path | None, typer.Option(help="Settings (TOML) that override the preset, with [search].")
    ] = None,
    changes: Annotated[
        list[str],
        typer.Option("--set", help="One setting, such as search.trials=30, search.mode=thesis or model.window=40."),
    ] = [],  # noqa: B006
    phase: Annotated[str | None, typer.Option(help="Last phase to run; default: all.")] = None,
    budget: Annotated[
        Path | None,
        typer.Option(
            help="Limits of the controller (TOML) for phase 6, to which a study is bound from its first phase on; by "
            "default those of the thesis."
        ),
    ] = None,
    workers: Annotated[int, typer.Option(help="Parallel trainings; 0: one for each core.")] = 0,
    cluster: Annotated[str, typer.Option(help="Address of a Ray cluster for the trainings, or auto.")] = "",
    open_cluster: Annotated[
        bool,
        typer.Option(
            "--open-cluster", help="Accept a cluster without a token, on which anyone who can reach it can run code."
        ),
    ] = False,
    threads: Annotated[int, typer.Option(help="CPU threads per training (results depend on it).")] = 1,
    seconds: Annotated[float | None, typer.Option(help="Time limit of a training, in seconds.")] = None,
    memory: Annotated[float | None, typer.Option(help="Memory limit of a training, in MB.")] = None,
    signal_map: MapOption = None,
    repair: RepairOption = [],  # noqa: B006
    as_json: JsonFlag = False,
) -> None:
    """Search for the network: from which features and backbone to which modules, each step tested.

    Each log is a session; too few logs are divided into sessions.

    Stop it at any moment (Ctrl-C, or a power failure): the same command continues, and repeats no training.

    Example: `edp search logs/ --study studies/first --preset quick`

    Example: `edp search logs/ --study studies/first --phase screening --set search.features='["FG2", "own.toml"]'`
    """
    from edp.workflows.search.plan import load_plan
    from edp.workflows.search.runner import Resources, SearchCallbacks, run_search

    # JSON quotes the path as TOML wants it.
    changes = [*changes, f"search.compression.budget={json.dumps(str(budget))}"] if budget is not None else changes
    plan = load_plan(config, preset, changes)
    check_effects(context, {"budget": plan.spec.compression.on})
    resources = Resources(
        workers=workers,
        threads=threads,
        seconds=seconds,
        memory_mb=memory,
        cluster=cluster,
        open_cluster=open_cluster,
    )
    source = source_of(data, signal_map, repair)
    with progress(as_json) as shown:
        display = SearchDisplay(shown, Steps(as_json), as_json)
        callbacks = SearchCallbacks(
            on_note=display.on_note,
            on_phase=display.on_phase,
            on_progress=display.on_progress,
            on_decision=display.on_decision,
        )
        result = run_search(source, plan, study, resources, phase, callbacks)
        # Pictures take long; an unfinished study is drawn when it is asked for.
        page = _write_report(study, None, pictures=result.state == "finished")
    emit(as_json, _facts(result) | {"report": str(page)}, lambda: _show(result, page))


@app.command("status")
def status(study: StudyArgument, as_json: JsonFlag = False) -> None:
    """Show the progress of a study: phases, trainings done, running and left, decisions. Nothing is changed.

    Example: `edp search status studies/first`
    """
    from edp.storage.study_file import reading_parts
    from edp.workflows.search.study_log import look_at

    progress = look_at(study)
    with reading_parts(study):
        emit(as_json, progress, lambda: _show_status(progress))


@app.command("report")
def report(
    study: StudyArgument,
    output: Annotated[
        Path | None, typer.Option("--out", help="Folder of page, tables and pictures; default: DIR.")
    ] = None,
    pictures: Annotated[bool, typer.Option(help="Write the pictures as SVG and PNG too.")] = True,
    as_json: JsonFlag = False,
) -> None:
    """Write the report of a study, finished or under way: page, tables (CSV, Markdown), pictures.

    Example: `edp search report studies/first --out report`
    """
    page = _write_report(study, output, pictures)
    emit(as_json, {"report": str(page)}, lambda: out.print(f"report: {page}"))


@app.command("export")
def export(
    study: StudyArgument,
    output: Annotated[Path | None, typer.Option("--out", help="The journal; default: optuna.journal in DIR.")] = None,
    as_json: JsonFlag = False,
) -> None:
    """Export the trials of phases 1, 4 and 5 as a journal for optuna-dashboard. The study is unchanged.

    Example: `edp search export studies/first && optuna-dashboard studies/first/optuna.journal`
    """
    from edp.workflows.search.export import export_study

    file, names = export_study(study, output)
    facts = {"journal": str(file), "studies": names}
    emit(as_json, facts, lambda: _show_journal(file, names))


def _show_journal(file: Path, names: Sequence[str]) -> None:
    out.print(f"{len(names)} studies in {file}")
    out.print(f"next: optuna-dashboard {file}")


class SearchDisplay:
    """Shows phases, trainings and the time left; decisions as sentences."""

    def __init__(self, shown: Progress, steps: Steps, quiet: bool) -> None:
        self.shown, self.steps, self.quiet = shown, steps, quiet
        self.bar = shown.add_task("search", total=1.0, note="reading recordings")
        self.title = ""

    def on_note(self, text: str) -> None:
        """Print a sentence."""
        if not self.quiet:
            out.print(text)

    def on_phase(self, name: str, study_log: StudyLog) -> None:
        """Print the beginning of a phase."""
        from edp.workflows.search.phases import PHASES

        self.title = f"phase {list(PHASES).index(name) + 1} of {len(PHASES)}, {PHASES[name].title}"
        self.on_progress(study_log)

    def on_progress(self, study_log: StudyLog) -> None:
        """Show how far it is."""
        counts, left = study_log.counts(), study_log.seconds_left()
        # No more than are asked for: workers may be idle at the end of a batch.
        running = min(study_log.workers, counts["asked"] - counts["done"])
        remaining, done = max(0, counts["total"] - counts["done"]), count_of(counts["done"], "training")
        note = f"{self.title}: {done}, {running} running, {remaining} left"
        self.shown.update(self.bar, completed=counts["done"] / max(1, counts["total"]), note=note)
        self.steps.say(f"search: {note}" + ("" if not left else f", at most {duration(max(1.0, left))}"))

    def on_decision(self, decision: Decision) -> None:
        """Print a decision and its reason."""
        from edp.workflows.search.phases import PHASES

        if not self.quiet:
            out.print(PHASES[decision.phase].title, style="bold")
            for sentence in decision.sentences:
                out.print(f"  {sentence}")


def _write_report(study: Path, output: Path | None, pictures: bool) -> Path:
    from edp.report import write_study_page
    from edp.storage.study_file import read_study

    return write_study_page(read_study(study), study if output is None else output, pictures).page


def _facts(result: SearchResult) -> dict[str, object]:
    return {
        "study": str(result.folder),
        "state": result.state,
        "phases": list(result.context.decided),
        "trained_now": result.trained,
        "digest": result.digest,
        "decisions": [decision.to_json() for decision in result.context.decided.values()],
        "teacher": None if result.teacher is None else str(result.teacher),
        "networks": {name: str(folder) for name, folder in result.networks.items()},
    }


def _show(result: SearchResult, page: Path) -> None:
    out.print(f"study: {result.folder}, {result.state}; {count_of(result.trained, 'training')} now")
    out.print(f"report: {page}")
    if result.teacher is None:
        out.print("next: the same command without --phase, or with a later one")
        return
    if result.networks:
        out.print(f"next: {_deploying(result)}")
    data, word = shlex.join(map(str, result.source.paths)), "or" if result.networks else "next"
    out.print(f"{word}: edp train {data} --config {result.teacher} --out runs/teacher (frozen sessions stay frozen)")


def _deploying(result: SearchResult) -> str:
    """Return the command that deploys the network chosen by phase 6."""
    facts = result.context.decided["compression"].facts
    run = result.networks.get("chosen", result.networks.get("teacher"))
    if facts["rows"][facts["chosen"]]["format"] == "w8a16":
        return f"edp quantise {run} --out {result.folder / 'w8a16'}"
    return f"edp export {run} --to c --out firmware/predictor"


def _show_status(progress: Table) -> None:
    counts = progress["counts"]
    running = f"process {progress['holder']}" if progress["holder"] else "nobody now"
    out.print(
        f"{progress['data']['path']}: {progress['data']['sessions']} sessions, {number(progress['data']['hours'], 2)} h"
    )
    out.print(f"mode {progress['mode']}, {progress['state']}, coordinated by {running}; written {progress['updated']}")
    rows = [
        (
            phase["title"],
            f"{phase['trained']}/{phase['trainings']}",
            phase.get("pruned", 0),
            phase["failed"],
            duration(phase["seconds"]),
            "decided" if phase["ended"] else "under way",
        )
        for phase in progress["phases"]
    ]
    table("phases", ["phase", "trainings", "pruned", "failed", "training time", "state"], rows)
    out.print(
        f"{count_of(counts['done'], 'training')} done, {progress['running']} running, "
        f"{counts['total'] - counts['done']} left"
    )
    for decision in progress["decisions"]:
        for sentence in decision["sentences"]:
            out.print(f"  {sentence}")
