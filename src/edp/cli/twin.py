"""``edp twin`` and ``edp rollout``: a plant model that runs free, and a free run along a log."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from edp.cli.console import JsonFlag, duration, emit, out, table
from edp.cli.options import (
    MAX_MINUTES,
    MAX_SECONDS,
    MAX_WORKERS,
    ClusterOption,
    LogsArgument,
    MapOption,
    OpenOption,
    RepairOption,
    check_effects,
    parse_minutes,
    source_of,
    within,
    workers_of,
)
from edp.cli.progress import show_progress
from edp.cli.verdicts import end_with, show_verdict, verdict_facts
from edp.errors import count_of
from edp.settings.bounds import MIN_MINUTES, above, span
from edp.settings.results import plain_value
from edp.storage.paths import full_path, is_file_at
from edp.wording import figure, number, percent

if TYPE_CHECKING:
    from edp.evaluation.free_run_file import CandidateRow, ChannelErrors, FreeRunScores
    from edp.workflows.twin import TrainedTwin


def twin(
    context: typer.Context,
    data: LogsArgument,
    folder: Annotated[Path, typer.Option("--out", help="Run folder; an unfinished run continues.")],
    config: Annotated[Path | None, typer.Option(help="Settings (TOML).")] = None,
    changes: Annotated[list[str], typer.Option("--set", help="One setting, for example twin.kind=recurrent.")] = [],  # noqa: B006
    signal_map: MapOption = None,
    repair: RepairOption = [],  # noqa: B006
    start: Annotated[Path | None, typer.Option(help="Run folder of a twin that goes on with these recordings.")] = None,
    workers: Annotated[int, typer.Option(min=0, max=MAX_WORKERS, help="Parallel trainings; 0: one for each core.")] = 0,
    cluster: ClusterOption = "",
    open_cluster: OpenOption = False,
    time_budget: Annotated[
        float | None,
        typer.Option(
            parser=parse_minutes,
            metavar="TIME",
            callback=within(span(MIN_MINUTES, MAX_MINUTES)),
            help="Maximum processor time of the networks without twin.kind, such as 30min; default: no bound.",
        ),
    ] = None,
    as_json: JsonFlag = False,
) -> None:
    """Train a plant model that runs on commands alone: velocities, strokes and pressures over a minute.

    Without settings, several formulations are fitted, and free runs that the fits had not seen choose; twin.kind names
    one. Judged on held-out recordings beside a static valve map, ARX and N4SID. Ends with exit code 4 where the
    training diverged, with 6 where one of these floors has less error there than the twin.

    With --start a recurrent twin goes on, such as with minutes of another machine's logs; free runs of the validation
    part say for how long, or that it is better as it is. With --set ground=drag it is a grey box of free air that
    learns the resistance of the ground from logs in soil.

    Example: `edp twin data/m22 --out runs/twin`
    """
    from edp.config.twin import has_choice, limit_processor_time, load_twin_experiment, trains_several
    from edp.evaluation.guard import twin_verdict
    from edp.report.twin.candidates import choice_sentence, read_candidates
    from edp.workflows.twin import train_twin

    experiment = load_twin_experiment(config, changes)
    effects = {
        "time_budget": has_choice(experiment) and start is None,
        **dict.fromkeys(("workers", "cluster"), trains_several(experiment) or start is not None),
    }
    check_effects(context, {name: effect and not experiment.ground for name, effect in effects.items()})
    if time_budget is not None:
        experiment = limit_processor_time(experiment, time_budget)
    divided = workers_of(workers, cluster, open_cluster, usual=0)
    with show_progress("twin", as_json) as progress:
        source = source_of(data, signal_map, repair)
        trained = train_twin(source, experiment, folder, progress, divided, start)
    seconds = trained.bundle.provenance.seconds or 0.0
    verdict = twin_verdict(trained.scores)
    facts = {
        "run": str(folder),
        "twin": str(folder / "twin"),
        "seconds": seconds,
        "models": plain_value(trained.scores),
    }
    facts |= verdict_facts(verdict)
    candidates = read_candidates(folder)
    facts["candidates"] = plain_value(candidates)

    if trained.bundle.ground is not None:
        facts["ground"] = trained.bundle.provenance.more.get("ground")

    def show() -> None:
        show_verdict(verdict)
        if candidates:
            candidate_table(candidates)
            out.print(f"chosen: {choice_sentence(candidates)}")
        show_trained(trained)
        out.print(f"trained in {duration(seconds)} of processor time; twin in {folder / 'twin'}")
        if is_file_at(folder / "datasheet.txt"):
            out.print(f"numbers of the machine with units and intervals in {folder / 'datasheet.txt'}")
        out.print(f"next: edp report {folder}, or edp rollout {folder} LOG --rollout-seconds 60")

    emit(as_json, facts, show)
    end_with(verdict)


def show_trained(trained: TrainedTwin) -> None:
    """Print the free-run errors of a trained twin and the results of its training."""
    from edp.evaluation.beyond import describe_excess
    from edp.report.twin.facts import ground_line

    provenance = trained.bundle.provenance
    if trained.bundle.ground is not None:
        out.print(ground_line(provenance))
    if note := describe_excess(trained.scores["twin"].beyond if trained.scores else {}):
        out.print(note, style="bold")
    score_table(trained.scores)
    network = provenance.more.get("residual")
    if network and not network["helps"]:
        out.print("the network does not help on the validation part: this twin is its grey box alone")


def rollout(
    run: Annotated[Path, typer.Argument(help="Run folder of edp twin.")],
    log: Annotated[Path, typer.Argument(help="One log.")],
    seconds: Annotated[
        float,
        typer.Option(
            "--rollout-seconds", callback=within(above(0.0, MAX_SECONDS)), help="Length of the simulation, in seconds."
        ),
    ] = 60.0,
    start_s: Annotated[
        float | None,
        typer.Option(
            "--from",
            callback=within(span(0.0, MAX_SECONDS)),
            help="Start in the log, in seconds; default: as early as possible.",
        ),
    ] = None,
    measured: Annotated[list[str], typer.Option(help="A channel that stays measured; give it again for more.")] = [],  # noqa: B006
    file: Annotated[
        Path | None, typer.Option("--out", help="File for measured and free-run values (.parquet, .csv, ...).")
    ] = None,
    plots: Annotated[Path | None, typer.Option(help="Folder for plots of the run (SVG and PNG).")] = None,
    page: Annotated[Path | None, typer.Option(help="File for a page of the run with its intervals (HTML).")] = None,
    signal_map: MapOption = None,
    repair: RepairOption = [],  # noqa: B006
    as_json: JsonFlag = False,
) -> None:
    """Simulate a plant model along a log: from a given time on, with the commands only.

    Prints the error by the time since then. Channels of the written file that end in _twin are the twin's, those
    that end in _twin_low and _twin_high are its intervals.

    Example: `edp rollout runs/twin logs/monday.parquet --rollout-seconds 60 --from 12.5 --out monday_free.parquet`
    """
    from edp.evaluation.beyond import describe_excess
    from edp.workflows.twin import RolloutRequest, rollout_log

    request = RolloutRequest(seconds=seconds, start_s=start_s, measured=measured, out=file, plots=plots, page=page)
    result = rollout_log(run, source_of(log, signal_map, repair), request)
    written = {"file": file and str(file), "plots": plots and str(plots), "page": page and str(page)}
    facts = {"start_s": result.start_s, "calibrated_s": result.calibrated_s, **written}
    facts |= plain_value(result.scores) | {"beyond": plain_value(result.beyond)}

    def show() -> None:
        if result.beyond:
            out.print(describe_excess(result.beyond), style="bold")
        error_table(result.scores)
        if result.coverage is not None and result.calibrated_s is not None:
            promise = f"{percent(result.coverage)} up to {figure(result.calibrated_s)} s"
            out.print(f"intervals in _twin_low and _twin_high are meant to hold {promise}")
        if file is not None:
            out.print(f"{result.recording.samples:,} ticks in {file}")
        if plots is not None:
            out.print(f"plots in {plots}")
        if page is not None:
            out.print(f"page: {full_path(page)}")

    emit(as_json, facts, show)


def candidate_table(candidates: Sequence[CandidateRow]) -> None:
    """Print a row a formulation that was tried: its error over the static map's, and why one could not be fitted."""
    rows = [
        [
            ("* " if row.chosen else "  ") + row.label,
            "-" if row.error is None else number(row.error, 3),
            duration(row.seconds),
        ]
        for row in candidates
    ]
    table("error of free runs that the fits had not seen, over the static map's", ["", "error", "processor time"], rows)
    for row in candidates:
        if row.why:
            out.print(f"{row.label} was left out: {row.why}")


def score_table(models: Mapping[str, FreeRunScores]) -> None:
    """Print one row per model: errors of velocities, strokes by time, pressures, and the fraction of diverged runs.

    Actuators of different units have no mean over them: each has a table of its own.
    """
    first = next(iter(models.values()))
    if first.velocity_mae.units:
        actuator_tables(models)
        return
    velocity, strokes = first.velocity_mae, first.stroke_error
    rows = [[_add_unit("velocity", velocity), *(_number(one.velocity_mae.mean) for one in models.values())]]
    for k, row in enumerate(strokes):
        name = _add_unit(f"stroke after {figure(row.at_s)} s", row)
        rows.append([name, *(_number(one.stroke_error[k].mean) for one in models.values())])
    rows.append(["pressure, deviations", *(_number(one.pressure_nrmse.mean) for one in models.values())])
    rows.append(["diverged runs", *(percent(one.diverged) for one in models.values())])
    out.print(
        f"{count_of(first.runs, 'free run')} of {figure(first.seconds)} s on commands alone, mean over actuators "
        "and runs:"
    )
    # A column a model: with a column a time it would be too wide for a terminal of 80.
    table("MAE of velocities, stroke error by time, NRMSE of pressures", ["", *models], rows)


def actuator_tables(models: Mapping[str, FreeRunScores]) -> None:
    """Print one table per actuator: errors of velocity and of stroke by time, one row per model."""
    first = next(iter(models.values()))
    strokes = first.stroke_error
    out.print(f"{count_of(first.runs, 'free run')} of {figure(first.seconds)} s on commands alone, mean over runs:")
    places = zip(first.velocity_mae.by_channel, strokes[0].by_channel, strict=True)
    for velocity, stroke in places:
        unit, length = first.velocity_mae.unit_of(velocity), strokes[0].unit_of(stroke)
        every = models.values()
        rows = [[f"velocity, {unit}", *(_number(one.velocity_mae.by_channel[velocity]) for one in every)]]
        for k, row in enumerate(strokes):
            errors = (one.stroke_error[k].by_channel[stroke] for one in every)
            rows.append([f"after {figure(row.at_s)} s, {length}", *map(_number, errors)])
        rows.append(["diverged runs", *(percent(one.diverged) for one in every)])
        table(f"{velocity}: its MAE, and the error of {stroke} by time", ["", *models], rows)
    if first.pressure_nrmse.mean is not None:
        listed = ", ".join(f"{name} {_number(one.pressure_nrmse.mean)}" for name, one in models.items())
        out.print(f"NRMSE of pressures: {listed}")


def error_table(scores: FreeRunScores) -> None:
    """Print the errors of one run: a row a time with the error of each stroke, then velocities and pressures."""
    strokes = scores.stroke_error
    rows = [[f"{figure(row.at_s)} s", *map(_number, row.by_channel.values())] for row in strokes]
    unit = "" if strokes[0].unit is None else f", {strokes[0].unit}"
    units = strokes[0].units
    heads = [f"{name}, {units[name]}" if name in units else name for name in strokes[0].by_channel]
    table(f"error after{unit}", ["", *heads], rows)
    velocity, pressures = scores.velocity_mae, scores.pressure_nrmse
    unit = "" if velocity.unit is None else f", {velocity.unit}"
    units = velocity.units
    errors = [f"{name} {_number(value)} {units.get(name, '')}".rstrip() for name, value in velocity.by_channel.items()]
    out.print(f"MAE{unit}: " + ", ".join(errors))
    if pressures.by_channel:
        out.print("NRMSE: " + ", ".join(f"{name} {_number(value)}" for name, value in pressures.by_channel.items()))


def coverage_table(scores: FreeRunScores) -> None:
    """Print the fraction of free runs inside the intervals, by time and kind of channel."""
    intervals = scores.intervals
    if intervals is None or not intervals.at:
        return
    parts = list(intervals.at[0].parts())
    rows = [[f"{figure(row.at_s)} s", *(percent(part.share) for part in row.parts().values())] for row in intervals.at]
    table(f"share of free runs in intervals meant to hold {percent(intervals.coverage)}", ["", *parts], rows)


def situation_table(scores: FreeRunScores) -> None:
    """Print the errors at end stops, at standstill and in motion."""
    rows = []
    for name, row in scores.situations.items():
        strokes = None if row.stroke_error is None else row.stroke_error.mean
        cells = [percent(row.share), *map(_number, (row.velocity_mae.mean, strokes, row.pressure_nrmse.mean))]
        rows.append([name.replace("_", " "), *cells])
    heads = ["", "share of the time", _add_unit("velocity", scores.velocity_mae), "stroke", "pressure (NRMSE)"]
    table("errors by what the actuators did", heads, rows)


def print_ahead_table(scores: FreeRunScores) -> None:
    """Print the k-step-ahead errors, next to the errors of a predictor if one was given."""
    ahead, beside = scores.ahead, scores.beside
    if ahead is not None:
        velocity = ahead.velocity_mae
        unit = "" if velocity.unit is None else f" {velocity.unit}"
        mae = f"{_number(velocity.mean)}{unit}"
        out.print(f"{figure(ahead.seconds)} s ahead, told the commands: MAE of velocities {mae}")
    if beside is not None:
        rows = [
            [part, row.predictor.unit or "", _number(row.twin.mean), _number(row.predictor.mean)]
            for part, row in beside.errors.items()
        ]
        title = f"MAE {figure(beside.seconds)} s ahead at the same {beside.moments:,} moments"
        table(title, ["", "unit", "twin, told the commands", beside.label], rows)
        if beside.trained_on:
            out.print(f"the predictor was trained on {len(beside.trained_on)} of these recordings: it is flattered")


def _add_unit(text: str, row: ChannelErrors) -> str:
    return text if row.unit is None else f"{text}, {row.unit}"


def _number(value: float | None) -> str:
    # Mixed units have no mean; the JSON has each channel.
    return "-" if value is None else figure(value, 3)
