"""``edp search``: the phased model search, its state, its page and its export."""

from __future__ import annotations

import json
import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from edp.cli.console import JsonFlag, duration, emit, out, table
from edp.cli.groups import RUN, RunByDefault
from edp.cli.options import MAX_SECONDS, LogsArgument, MapOption, RepairOption, check_effects, source_of, within
from edp.cli.progress import show_progress
from edp.errors import count_of
from edp.settings.bounds import above
from edp.wording import number

if TYPE_CHECKING:
    from edp.workflows.search.runner import SearchResult
    from edp.workflows.search.study_log import StudyStatus

MAX_MEMORY_MB = 1e9
StudyArgument = Annotated[Path, typer.Argument(help="Folder of a study, as in edp search --out.")]


app = typer.Typer(
    cls=RunByDefault,
    no_args_is_help=True,
    rich_markup_mode="markdown",
    help="Search for the best network in tested phases. `edp search DATA` is short for `edp search run DATA`.",
)


@app.command(RUN)
def run(
    context: typer.Context,
    data: LogsArgument,
    study: Annotated[Path, typer.Option("--out", help="Folder of the study; an unfinished study continues.")],
    preset: Annotated[str, typer.Option(help="Extent of the search: quick, standard or thesis.")] = "quick",
    config: Annotated[
        Path | None, typer.Option(help="Settings (TOML) that override the preset, with [search].")
    ] = None,
    changes: Annotated[
        list[str],
        typer.Option("--set", help="One setting, such as search.mode=thesis or model.window=40."),
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
    seconds: Annotated[
        float | None,
        typer.Option(
            "--max-seconds", callback=within(above(0.0, MAX_SECONDS)), help="Time limit of a training, in seconds."
        ),
    ] = None,
    memory: Annotated[
        float | None,
        typer.Option(
            "--max-memory", callback=within(above(0.0, MAX_MEMORY_MB)), help="Memory limit of a training, in MB."
        ),
    ] = None,
    signal_map: MapOption = None,
    repair: RepairOption = [],  # noqa: B006
    as_json: JsonFlag = False,
) -> None:
    """Search for the network: from which features and backbone to which modules, each step tested.

    Each log is a session; too few logs are divided into sessions.

    Stop it at any moment (Ctrl-C, or a power failure): the same command continues, and repeats no training.

    Example: `edp search logs/ --out studies/first --preset quick`

    Example: `edp search logs/ --out studies/first --phase screening --set search.features='["FG2", "own.toml"]'`
    """
    from edp.workflows.search.plan import load_plan
    from edp.workflows.search.runner import Resources, run_search

    # JSON quotes the path as TOML wants it.
    changes = [*changes, f"search.compression.budget={json.dumps(str(budget))}"] if budget is not None else changes
    plan = load_plan(config, preset, changes)
    check_effects(context, {"budget": plan.spec.compression.enabled})
    resources = Resources(
        count=workers,
        threads=threads,
        seconds=seconds,
        memory_mb=memory,
        cluster=cluster,
        open_cluster=open_cluster,
    )
    source = source_of(data, signal_map, repair)
    with show_progress("search", as_json, "trainings done") as progress:
        result = run_search(source, plan, study, resources, phase, progress)
        # Pictures take long; an unfinished study is drawn when it is asked for.
        page = _write_report(study, None, pictures=result.state == "finished")
    emit(as_json, _facts(result) | {"report": str(page)}, lambda: _show(result, page))


@app.command("status")
def status(study: StudyArgument, as_json: JsonFlag = False) -> None:
    """Show the progress of a study: phases, trainings done, running and left, decisions. Nothing is changed.

    Example: `edp search status studies/first`
    """
    from edp.workflows.search.study_log import look_at

    state = look_at(study)
    emit(as_json, state.to_json(), lambda: _show_status(state))


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

    def show() -> None:
        out.print(f"{len(names)} studies in {file}")
        out.print(f"next: optuna-dashboard {file}")

    emit(as_json, {"journal": str(file), "studies": names}, show)


def _write_report(study: Path, output: Path | None, pictures: bool) -> Path:
    from edp.evaluation.study import read_study
    from edp.report import write_study_page

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
    from edp.workflows.search.phases import PHASES

    for decision in result.context.decided.values():
        out.print(PHASES[decision.phase].title, style="bold")
        for sentence in decision.sentences:
            out.print(f"  {sentence}")
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
    from edp.evaluation.study_facts import SmallerFacts

    facts = result.context.facts(SmallerFacts)
    run = result.networks.get("chosen", result.networks.get("teacher"))
    if facts.chosen is not None and facts.rows[facts.chosen].format == "w8a16":
        return f"edp compress quantise {run} --out {result.folder / 'w8a16'}"
    return f"edp export {run} --format c --out firmware/predictor"


def _show_status(state: StudyStatus) -> None:
    study = state.study
    running = f"process {state.holder}" if state.holder else "nobody now"
    out.print(f"{study.data.path}: {study.data.sessions} sessions, {number(study.data.hours, 2)} h")
    out.print(f"mode {study.mode}, {study.state}, coordinated by {running}; written {study.updated}")
    rows = [
        (
            phase.title,
            f"{phase.trained}/{phase.trainings}",
            phase.pruned,
            phase.failed,
            duration(phase.seconds),
            "decided" if phase.ended else "under way",
        )
        for phase in study.phases
    ]
    table("phases", ["phase", "trainings", "pruned", "failed", "training time", "state"], rows)
    counts = study.counts
    out.print(f"{count_of(counts.done, 'training')} done, {state.running} running, {counts.total - counts.done} left")
    for decision in study.decisions:
        for sentence in decision.sentences:
            out.print(f"  {sentence}")
