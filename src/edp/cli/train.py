"""``edp train``: recordings to a bundle."""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from edp.cli import finetune, pretrain
from edp.cli.console import JsonFlag, duration, emit, err, out, table
from edp.cli.groups import RUN, RunByDefault
from edp.cli.options import (
    MAX_WORKERS,
    ClusterOption,
    LogsArgument,
    MapOption,
    OpenOption,
    RepairOption,
    check_effects,
    complete_from,
    parse_minutes,
    source_of,
    workers_of,
)
from edp.cli.progress import show_progress
from edp.wording import figure, number, percent

if TYPE_CHECKING:
    from edp.jobs import Workers
    from edp.logs.source import DataSource
    from edp.report.run.choice import AutoChoice
    from edp.training import Bundle


class Focus(StrEnum):
    """Purpose of a trained model. `edp.cli.names` turns `simulation` into the command `edp twin`."""

    PREDICTION = "prediction"
    SIMULATION = "simulation"


AUTO = "auto"
"""`edp.config.experiment.AUTO`, known here without loading that module."""
MAX_EXPECTED = 12
"""Outputs of which the terminal says what to expect; the report has all."""


app = typer.Typer(
    cls=RunByDefault,
    no_args_is_help=True,
    rich_markup_mode="markdown",
    help="Train a model on recordings. `edp train DATA` is short for `edp train run DATA`.",
)
app.command("finetune")(finetune.finetune)
app.command("pretrain")(pretrain.pretrain)


@app.command(RUN)
def train(
    context: typer.Context,
    data: LogsArgument,
    folder: Annotated[Path, typer.Option("--out", help="Run folder; an unfinished run continues.")],
    focus: Annotated[
        Focus,
        typer.Option(
            help="prediction: a network that predicts some samples ahead. simulation: a plant model that runs on "
            "commands alone, with the options of edp twin."
        ),
    ] = Focus.PREDICTION,
    config: Annotated[Path | None, typer.Option(help="Settings (TOML) that override the preset.")] = None,
    preset: Annotated[
        str | None,
        typer.Option(
            autocompletion=complete_from("edp.config.experiment", "PRESET_NAMES"),
            help="auto tries several models and keeps the best; quick, small, ensemble, standard, thesis, "
            "pressures, positions. "
            "Default: auto, or standard where the settings name a network or how to train it.",
        ),
    ] = None,
    time_budget: Annotated[
        float | None,
        typer.Option(
            parser=parse_minutes,
            metavar="TIME",
            help="Processor time of the preset auto with a unit, such as 30min; default: 5min.",
        ),
    ] = None,
    changes: Annotated[list[str], typer.Option("--set", help="One setting, for example training.epochs=10.")] = [],  # noqa: B006
    signal_map: MapOption = None,
    repair: RepairOption = [],  # noqa: B006
    workers: Annotated[
        int, typer.Option(min=0, max=MAX_WORKERS, help="Of the preset auto: parallel trainings; 0: one for each core.")
    ] = 0,
    cluster: ClusterOption = "",
    open_cluster: OpenOption = False,
    as_json: JsonFlag = False,
) -> None:
    """Train a causal network on recordings and write a bundle.

    The preset auto, the default, tries several models, keeps the simplest of those that predict left-out recordings
    best, and says which one and why. Ends with exit code 4 where the training diverged; the bundle then holds the best
    weights before that.

    Example: `edp train data/m22 --out runs/first --set "task.horizons=[1, 10]"`
    """
    from edp.workflows.auto import usual_preset

    source = source_of(data, signal_map, repair)
    preset = preset or usual_preset(config, changes)
    check_effects(context, dict.fromkeys(("time_budget", "workers", "cluster"), preset == AUTO))
    if preset == AUTO:
        own = [] if time_budget is None else [f"auto.time_budget_min={time_budget!r}"]
        divided = workers_of(workers, cluster, open_cluster, usual=0)
        _train_auto(source, folder, config, [*changes, *own], divided, as_json)
        return
    bundle, best = run(data, folder, config, preset, changes, source, as_json)
    seconds = bundle.provenance.seconds or 0.0
    facts = {
        "run": str(folder),
        "bundle": str(folder / "bundle"),
        "parameters": sum(parameter.numel() for parameter in bundle.predictor.parameters()),
        "seconds": seconds,
        "validation_mae": best,
    }

    def show() -> None:
        tail = "" if best is None else f", validation MAE {figure(best)} (report units)"
        out.print(f"trained in {duration(seconds)}{tail}; bundle in {folder / 'bundle'}")
        out.print(f"next: edp evaluate {folder}")

    emit(as_json, facts, show)


def _train_auto(
    source: DataSource, folder: Path, config: Path | None, changes: Sequence[str], workers: Workers, quiet: bool
) -> None:
    """Train the portfolio with a progress display, and print the chosen candidate."""
    from edp.workflows.auto import load_auto, train_auto

    settings = load_auto(config, changes)
    if not quiet:
        limit = f"{figure(settings.auto.time_budget_min)} min"
        err.print(f"train: reads the logs, then trains for at most about {limit} of processor time (--time-budget)")
    with show_progress("train", quiet) as progress:
        result = train_auto(source, settings, folder, progress, workers)
    facts = {"run": str(folder), "bundle": str(folder / "bundle"), **result.choice.to_table()}

    def show() -> None:
        out.print(result.sentence)
        for note in result.choice.notes or ():
            out.print(note)
        _promise_table(result.choice)
        _print_expected_errors(result.choice)
        out.print(f"bundle in {folder / 'bundle'}")
        out.print(f"next: edp evaluate {folder}")

    emit(quiet, facts, show)


def _promise_table(choice: AutoChoice) -> None:
    """Print the expected error of each candidate by output."""
    rows = []
    for name, one in choice.candidates.items():
        mark = "*" if name == choice.chosen else ""
        share = percent(math.expm1(choice.excess[name] - choice.excess[choice.chosen]), signed=True)
        rows.append([f"{one.label} {mark}".strip(), f"{one.parameters:,}", duration(one.seconds), share])
    title = f"error on left-out data against the model that is kept (*), within {figure(choice.minutes)} min"
    table(title, ["model", "parameters", "trained in", "error"], rows)


def _print_expected_errors(choice: AutoChoice) -> None:
    """Print the error to expect of each output at the longest horizon."""
    interval, skill = choice.interval, choice.skill
    if interval is None or skill is None:
        return  # a run of an earlier version
    promised = choice.candidates[choice.chosen].promise
    horizon = max(promised, key=int)
    expected = [promised[horizon], interval.low[horizon], interval.high[horizon]]
    rows = [
        [
            target,
            *(figure(values[target]) for values in expected),
            number(skill.promise[horizon][target], 2),
        ]
        for target in list(promised[horizon])[:MAX_EXPECTED]
    ]
    beside = "persistence's" if skill.against == "persistence" else "the linear model's"
    heads = ["output", "error", "90 % of tests: from", "to", f"over {beside}"]
    table(f"error (RMSE) to expect of tests that are like the training, k = {horizon}", heads, rows)


def run(
    data: Path | Sequence[Path],
    folder: Path,
    config: Path | None = None,
    preset: str = "standard",
    changes: Sequence[str] = (),
    source: DataSource | None = None,
    quiet: bool = False,
) -> tuple[Bundle, float | None]:
    """Train with a progress display; returns the bundle and the best validation error."""
    from edp.config.experiment import load_experiment
    from edp.logs.source import DataSource
    from edp.training.progress_steps import training_steps
    from edp.workflows.train_evaluate import train as run_training

    experiment = load_experiment(config, preset, changes)
    with show_progress("train", quiet) as progress:
        bundle = run_training(source or DataSource.from_path(data), experiment, folder, training_steps(progress))
    return bundle, progress.display.measured("validation_mae")
