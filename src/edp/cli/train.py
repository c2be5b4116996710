"""``edp train``: recordings to a bundle."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from edp.cli.console import JsonFlag, Steps, count_text, duration, emit, err, left_text, out, progress, table
from edp.cli.options import MOST_WORKERS, LogsArgument, MapOption, RepairOption, check_effects, source_of
from edp.wording import figure, number, percent

if TYPE_CHECKING:
    from rich.progress import Progress

    from edp.logs.source import DataSource
    from edp.training import Bundle, TrainingProgress

AUTO = "auto"
"""`edp.config.experiment.AUTO`, known here without loading that module."""
MOST_EXPECTED = 12
"""Outputs of which the terminal says what to expect; the report has all."""


def train(
    context: typer.Context,
    data: LogsArgument,
    folder: Annotated[Path, typer.Option("--out", help="Run folder; an unfinished run continues.")],
    config: Annotated[Path | None, typer.Option(help="Settings (TOML) that override the preset.")] = None,
    preset: Annotated[
        str | None,
        typer.Option(
            help="auto tries several models and keeps the best; quick, small, committee, standard, thesis, "
            "pressures, positions. "
            "Default: auto, or standard where the settings name a network or how to train it."
        ),
    ] = None,
    minutes: Annotated[
        float | None, typer.Option(help="Of the preset auto: processor time to spend on training; default 5.")
    ] = None,
    changes: Annotated[list[str], typer.Option("--set", help="One setting, for example training.epochs=10.")] = [],  # noqa: B006
    signal_map: MapOption = None,
    repair: RepairOption = [],  # noqa: B006
    workers: Annotated[
        int, typer.Option(min=0, max=MOST_WORKERS, help="Of the preset auto: parallel trainings; 0: one for each core.")
    ] = 0,
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
    check_effects(context, {"minutes": preset == AUTO, "workers": preset == AUTO})
    if preset == AUTO:
        own = [] if minutes is None else [f"auto.minutes={minutes!r}"]
        _train_auto(source, folder, config, [*changes, *own], workers, as_json)
        return
    bundle, best = run(data, folder, config, preset, changes, source, as_json)
    facts = {
        "run": str(folder),
        "bundle": str(folder / "bundle"),
        "parameters": sum(parameter.numel() for parameter in bundle.predictor.parameters()),
        "seconds": bundle.provenance["seconds"],
        "validation_mae": best,
    }

    def show() -> None:
        tail = "" if best is None else f", validation MAE {figure(best)} (report units)"
        out.print(f"trained in {duration(bundle.provenance['seconds'])}{tail}; bundle in {folder / 'bundle'}")
        out.print(f"next: edp evaluate {folder}")

    emit(as_json, facts, show)


def _train_auto(
    source: DataSource, folder: Path, config: Path | None, changes: Sequence[str], workers: int, quiet: bool
) -> None:
    """Train the portfolio with a progress display, and say what was chosen."""
    from edp.workflows.auto import load_auto, train_auto

    settings = load_auto(config, changes)
    if not quiet:
        limit = f"{figure(settings.auto.minutes)} min"
        err.print(f"train: reads the logs, then trains for at most about {limit} of processor time (--minutes)")
    with progress(quiet) as shown:
        display = TrainingDisplay(shown, Steps(quiet))
        result = train_auto(source, settings, folder, display.on_event, display.on_candidate, workers)
    facts = {"run": str(folder), "bundle": str(folder / "bundle"), **result.facts}

    def show() -> None:
        out.print(result.sentence)
        for note in result.facts.get("notes", ()):
            out.print(note)
        _promise_table(result.facts)
        _expected_table(result.facts)
        out.print(f"bundle in {folder / 'bundle'}")
        out.print(f"next: edp evaluate {folder}")

    emit(quiet, facts, show)


def _promise_table(facts: dict[str, Any]) -> None:
    """Print what each candidate promises, by output."""
    rows = []
    for name, one in facts["candidates"].items():
        mark = "*" if name == facts["chosen"] else ""
        share = percent(math.expm1(facts["excess"][name] - facts["excess"][facts["chosen"]]), signed=True)
        rows.append([f"{one['label']} {mark}".strip(), f"{one['parameters']:,}", duration(one["seconds"]), share])
    title = f"error on left-out data against the model that is kept (*), within {figure(facts['minutes'])} min"
    table(title, ["model", "parameters", "trained in", "error"], rows)


def _expected_table(facts: dict[str, Any]) -> None:
    """Print the error to expect of each output at the longest horizon."""
    if "interval" not in facts:
        return  # a run of an earlier version
    promised, interval, skill = facts["candidates"][facts["chosen"]]["promise"], facts["interval"], facts["skill"]
    horizon = max(promised, key=int)
    expected = [promised[horizon], interval["low"][horizon], interval["high"][horizon]]
    rows = [
        [
            target,
            *(figure(values[target]) for values in expected),
            number(skill["promise"][horizon][target], 2),
        ]
        for target in list(promised[horizon])[:MOST_EXPECTED]
    ]
    beside = "persistence's" if skill["against"] == "persistence" else "the linear model's"
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
    from edp.workflows.train_evaluate import train as run_training

    experiment = load_experiment(config, preset, changes)
    with progress(quiet) as shown:
        display = TrainingDisplay(shown, Steps(quiet))
        bundle = run_training(source or DataSource.of(data), experiment, folder, display.on_event)
    return bundle, display.best


class TrainingDisplay:
    """Shows training events as a bar on a terminal, as lines elsewhere."""

    def __init__(self, shown: Progress, steps: Steps) -> None:
        self.shown, self.steps = shown, steps
        self.bar = shown.add_task("train", total=1.0, note="")
        self.best: float | None = None
        self.model = ""

    def on_candidate(self, label: str, done: int, count: int) -> None:
        """The training of another model begins, after `done` of `count`."""
        self.best, self.model = None, f"{label} ({count_text(done + 1, count)}), "
        self.steps.say(f"train: {label}, model {count_text(done + 1, count)}", force=True)

    def on_event(self, event: TrainingProgress) -> None:
        """Show one event."""
        if event.row is not None and event.row["best"]:
            self.best = event.row["validation_mae"]
        score = "" if self.best is None else f", validation MAE {figure(self.best)}"
        stage = "refit, " if event.refit else ""
        epoch = count_text(event.epoch, event.epochs, "/")
        note = f"{self.model}{stage}epoch {epoch}, {number(event.targets_per_s, 0)} targets/s{score}"
        self.shown.update(self.bar, completed=event.share, note=note)
        self.steps.say(f"train: {note}{left_text(event.seconds_left)}", force=event.row is not None)


class SeriesDisplay:
    """Shows which of several trainings is at work, and the time left of it.

    Args:
        shown: progress display.
        quiet: print nothing on standard output or error.
        command: name of the command.
        each: what one of them is made for, such as ``method``.
    """

    def __init__(self, shown: Progress, quiet: bool, command: str, each: str) -> None:
        self.shown, self.quiet, self.command, self.each = shown, quiet, command, each
        self.steps = Steps(quiet)
        self.bar = shown.add_task(command, total=1.0, note="reading recordings")
        self.done, self.count = 0, 1

    def on_note(self, text: str) -> None:
        """Print a sentence."""
        if not self.quiet:
            out.print(text)

    def on_next(self, name: str, done: int, count: int) -> None:
        """Another one begins, after `done` of at most `count`."""
        self.done, self.count = done, max(1, count)
        self.shown.update(self.bar, completed=done / self.count, note=name)
        self.steps.say(f"{self.command}: {self.each} {count_text(done + 1, count)}, {name}", force=True)

    def on_training(self, name: str, event: TrainingProgress) -> None:
        """Show an event of the training that is at work."""
        epoch = count_text(event.epoch, event.epochs, "/")
        note = f"{name}, {self.each} {count_text(self.done + 1, self.count)}, epoch {epoch}"
        self.shown.update(self.bar, completed=(self.done + event.share) / self.count, note=note)
        left = left_text(event.seconds_left)
        self.steps.say(f"{self.command}: {note}{left and f'{left} of it'}", force=event.row is not None)
