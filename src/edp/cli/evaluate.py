"""Command ``edp evaluate``: scores on held-out recordings, compared with baselines."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from edp.cli.console import JsonFlag, emit, out, print_table, table
from edp.cli.options import (
    MAX_HOURS,
    MAX_MINUTES,
    ClusterOption,
    DataOption,
    MapOption,
    OpenOption,
    RepairOption,
    WorkersOption,
    check_effects,
    parse_minutes,
    source_if_given,
    within,
    workers_of,
)
from edp.cli.progress import show_progress
from edp.cli.verdicts import end_with, show_verdict, verdict_facts
from edp.settings.bounds import above, span
from edp.wording import figure, number, percent, setting_text

if TYPE_CHECKING:
    from edp.evaluation.channel_importance import ChannelImportances
    from edp.evaluation.scores_file import ScoresFile
    from edp.jobs import Workers
    from edp.logs.source import DataSource


def evaluate(
    context: typer.Context,
    run: Annotated[Path, typer.Argument(help="Run folder of edp train or edp twin.")],
    data: DataOption = [],  # noqa: B006
    baselines: Annotated[
        str | None, typer.Option(help="Comma-separated names, 'all' or 'none'; default: those of the settings.")
    ] = None,
    signal_map: MapOption = None,
    repair: RepairOption = [],  # noqa: B006
    channel_importance: Annotated[
        bool, typer.Option(help="Also measure channel importance: the growth of the error when a channel is removed.")
    ] = False,
    time_budget: Annotated[
        float | None,
        typer.Option(
            parser=parse_minutes,
            metavar="TIME",
            callback=within(span(0.0, MAX_MINUTES)),
            help="Processor time, such as 30min, after which no other baseline is started; fast baselines come first.",
        ),
    ] = None,
    max_hours: Annotated[
        float | None,
        typer.Option(
            callback=within(above(0.0, MAX_HOURS)),
            help="Evaluate on evenly spaced segments with a total length of about this many hours.",
        ),
    ] = None,
    predictor: Annotated[
        Path | None, typer.Option(help="Of a twin: run folder of a look-ahead predictor to compare with.")
    ] = None,
    workers: WorkersOption = 1,
    cluster: ClusterOption = "",
    open_cluster: OpenOption = False,
    as_json: JsonFlag = False,
) -> None:
    """Evaluate a trained model on held-out recordings and compare it with baselines.

    Ends with exit code 6 where a baseline has less error than the network.

    Example: `edp evaluate runs/first` or `edp evaluate runs/first --data logs/monday --map mine.toml`
    """
    from edp.training.twin_bundle import holds_twin

    source = source_if_given(data, signal_map, repair)
    divided = workers_of(workers, cluster, open_cluster)
    names = None if baselines is None else baseline_names(baselines)
    is_twin = holds_twin(run)
    of_networks = ("baselines", "max_hours", "channel_importance", "workers", "cluster")
    effects = {"predictor": is_twin, "time_budget": not is_twin and names != [] and divided.are_alone}
    check_effects(context, effects | dict.fromkeys(of_networks, not is_twin))
    if is_twin:
        evaluate_twin_run(run, source, predictor, as_json)
        return
    from edp.evaluation.guard import network_verdict
    from edp.report.run.choice import promise_line, read_choice
    from edp.report.run.outputs import describe_evaluation, losses_line, minutes_of, situation_line
    from edp.settings.provenance import read_provenance

    folder, scores = run_evaluation(run, source, names, as_json, time_budget, divided, max_hours)
    verdict = network_verdict(scores, minutes_of(run))
    lost, judged = losses_line(scores), describe_evaluation(scores, read_provenance(run))
    choice = read_choice(run) if source is None else None
    beyond, promise = situation_line(scores), "" if choice is None else promise_line(choice)
    importances = run_importance(run, source, as_json, max_hours) if channel_importance else None

    def show() -> None:
        show_verdict(verdict)
        if lost:
            out.print(lost)
        show_scores(scores, (promise, beyond, judged), time_budget)
        out.print(f"scores in {folder / 'scores.json'}")
        if importances is not None:
            importance_table(importances)
            out.print(f"importance of the channels in {folder / 'channel_importance.json'}")
        out.print(f"next: edp report {folder}")

    sentences = {"losses": lost, "tests": judged, "promise": promise, "situation_line": beyond}
    facts = {"folder": str(folder), **verdict_facts(verdict), **sentences, **scores.to_table()}
    importance_json = {} if importances is None else {"channel_importance": importances.to_json()}
    emit(as_json, facts | importance_json, show)
    end_with(verdict)


def show_scores(scores: ScoresFile, sentences: Sequence[str], minutes: float | None) -> None:
    """Print the tables of an evaluation, its messages, and the parts omitted for lack of time."""
    score_table(scores)
    print_situation_table(scores)
    for sentence in sentences:
        if sentence:
            out.print(sentence)
    if scores.drawn is not None:
        out.print(f"judged on {scores.drawn.what}; leave --max-hours out for all")
    if scores.left_out:
        left = ", ".join(scores.left_out)
        out.print(
            f"left out after --time-budget {setting_text(minutes)}min: {left}; to evaluate them, leave the option out"
        )


def baseline_names(text: str) -> list[str]:
    """Names of baselines from the text of ``--baselines``."""
    if text == "all":
        from edp.evaluation.baselines import BASELINES

        return list(BASELINES)
    return [name.strip() for name in text.split(",") if name.strip() and name.strip() != "none"]


def evaluate_twin_run(run: Path, source: DataSource | None, predictor: Path | None, as_json: bool) -> None:
    """Judge a twin with a progress display, and print its scores."""
    from edp.cli.twin import coverage_table, print_ahead_table, score_table, situation_table
    from edp.evaluation.beyond import describe_excess
    from edp.evaluation.free_run_file import TWIN, FreeRunFile
    from edp.evaluation.guard import twin_verdict
    from edp.workflows.twin import evaluate_twin

    with show_progress("evaluate", as_json) as progress:
        folder = evaluate_twin(run, source, predictor, progress)
    scores = FreeRunFile.read(folder)
    verdict = twin_verdict(scores.models)

    def show() -> None:
        show_verdict(verdict)
        if note := describe_excess(scores.models[TWIN].beyond):
            out.print(note, style="bold")
        score_table(scores.models)
        for show_table in (coverage_table, situation_table, print_ahead_table):
            show_table(scores.models[TWIN])
        out.print(f"scores in {folder / FreeRunFile.NAME}")
        out.print(f"next: edp report {folder}")

    emit(as_json, {"folder": str(folder), **verdict_facts(verdict), **scores.to_table()}, show)
    end_with(verdict)


def run_evaluation(
    run: Path,
    source: DataSource | None = None,
    names: list[str] | None = None,
    quiet: bool = False,
    minutes: float | None = None,
    workers: Workers | None = None,
    at_most_h: float | None = None,
) -> tuple[Path, ScoresFile]:
    """Judge with a progress display; returns the folder of the scores and the scores."""
    from edp.evaluation.scores_file import ScoresFile
    from edp.jobs import IN_PROCESS
    from edp.workflows.train_evaluate import evaluate as judge_run

    with show_progress("evaluate", quiet, timed=True) as progress:
        folder = judge_run(run, source, names, progress, minutes, workers or IN_PROCESS, at_most_h)
    return folder, ScoresFile.read(folder)


def run_importance(
    run: Path, source: DataSource | None = None, quiet: bool = False, at_most_h: float | None = None
) -> ChannelImportances:
    """Take channels away with a progress display."""
    from edp.workflows.train_evaluate import channel_importance

    with show_progress("channel importance", quiet, "removed") as progress:
        importances, _ = channel_importance(run, source, progress=progress, at_most_h=at_most_h)
    return importances


def importance_table(importances: ChannelImportances) -> None:
    """Print one table per horizon: the error increase without each channel, largest first."""
    unit = importances.units["mean"]
    for horizon, error in importances.error.items():
        rows = []
        for row in importances.ranked(int(horizon)):
            bounds = f"{figure(row.renewed.low, 3)} to {figure(row.renewed.high, 3)}"
            figures = [
                f"{figure(row.renewed.mean, 3)}",
                bounds,
                f"{figure(row.exchanged.mean, 3)}",
                percent(row.explained),
            ]
            rows.append([", ".join(row.members), *figures])
        title = f"growth of the error at k = {horizon} (MAE {figure(error['mean'])} {unit}) without the channel, {unit}"
        table(title, ["channel", "its own", "95 %", "with all it shares", "explained by others"], rows)


def score_table(scores: ScoresFile) -> None:
    """Print one table per horizon: mean scores of every model, best first."""
    from edp.evaluation.guard import MEASURE, MEASURE_NAME
    from edp.evaluation.scores_file import MEAN, metric

    units = {target.unit for target in scores.targets}
    unit = units.pop() if len(units) == 1 else "mixed units"
    if len(scores.targets) > 1 and unit in ("mixed units", "1"):
        _tables_by_output(scores)
        interval_rows(scores, unit)
        return
    for horizon in scores.task.horizons:
        rows = []
        for model in scores.models.values():
            s = model.overall[str(horizon)][MEAN]
            r2 = "-" if s["r2"] is None else number(s["r2"], 4)
            figures = [figure(metric(s, key)) for key in (MEASURE, "mae", "p95", "p99", "composite")]
            rows.append((metric(s, MEASURE), [model.label, *figures, r2]))
        rows.sort(key=lambda row: row[0])
        ahead = _horizon_text(scores, horizon)
        heads = ["model", MEASURE_NAME, "MAE", "P95", "P99", "composite", "R2"]
        table(f"{ahead}, mean over outputs, {unit}", heads, [row for _, row in rows])
    interval_rows(scores, unit)
    for name, model in scores.models.items():
        for target, integral_scores in model.integrated.items():
            out.print(
                f"free run of the integral of {target}, {name}: RMSE {figure(metric(integral_scores, 'rmse'))} {unit} s"
            )


def _horizon_text(scores: ScoresFile, horizon: int) -> str:
    rate = scores.task.rate_hz
    return f"k = {horizon}" if rate is None else f"{number(1e3 * horizon / rate, 0)} ms ahead (k = {horizon})"


def print_situation_table(scores: ScoresFile) -> None:
    """Print the network's error by motion of the axes, at the longest horizon, if the scores contain it."""
    from edp.report.run.tables import situation_table

    horizon = max(scores.task.horizons)
    situations = situation_table(scores, horizon)
    if situations is not None:
        print_table(replace(situations, caption=f"{situations.caption}, k = {horizon}"))


def _tables_by_output(scores: ScoresFile) -> None:
    """Print one table per horizon with one column per output, for outputs in different units, which have no mean."""
    from edp.evaluation.guard import MEASURE, MEASURE_NAME
    from edp.evaluation.scores_file import metric

    targets = scores.targets
    heads = ["model", *(f"{t.name}{'' if t.unit == '1' else ', ' + t.unit}" for t in targets)]
    for horizon in scores.task.horizons:
        errors = {
            model.label: [metric(model.overall[str(horizon)][t.name], MEASURE) for t in targets]
            for model in scores.models.values()
        }
        ahead = _horizon_text(scores, horizon)
        rows = [[label, *(figure(value) for value in values)] for label, values in errors.items()]
        table(f"{ahead}, {MEASURE_NAME} of each output", heads, rows)
    for name, model in scores.models.items():
        for target, integral_scores in model.integrated.items():
            out.print(f"free run of the integral of {target}, {name}: RMSE {figure(metric(integral_scores, 'rmse'))}")


def interval_rows(scores: ScoresFile, unit: str) -> None:
    """Print how much of the truth the network's intervals hold, where it states any."""
    network = scores.models["network"]
    rows = [
        [f"k = {horizon}", percent(row.coverage), percent(row.covered["mean"]), figure(row.width["mean"])]
        for horizon, entries in network.intervals.items()
        for row in entries
    ]
    if rows:
        table(f"intervals of the network, mean over outputs, {unit}", ["ahead", "meant", "holds", "mean width"], rows)
    for horizon, score in network.weighted_interval_score.items():
        out.print(f"weighted interval score, k = {horizon}: {figure(score['mean'])} {unit} (a point: its MAE)")
