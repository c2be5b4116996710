"""``edp data screen``: which channels to feed a model, with how much memory, and why."""

from __future__ import annotations

import shlex
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from edp.cli.console import JsonFlag, Steps, count_text, emit, format_time_left, out, print_table, progress
from edp.cli.options import (
    TRIAL_TABLES,
    ClusterOption,
    LogsArgument,
    MapOption,
    OpenOption,
    RepairOption,
    WorkersOption,
    check_effects,
    source_of,
    workers_of,
)
from edp.cli.progress import Display, StageDisplay
from edp.cli.quality import MaxHoursOption, show_between, verdict_text
from edp.errors import count_of
from edp.wording import figure, percent

if TYPE_CHECKING:
    from rich.progress import Progress as Bars
    from rich.progress import TaskID

    from edp.config.experiment import FeatureSettings
    from edp.jobs import Workers
    from edp.settings.tree import Change
    from edp.table import Table
    from edp.training import TrainingProgress
    from edp.workflows.feature_selection.select import Selection, SelectionOrder

# A terminal's page; everything is in the files.
SHOWN = 40
SHOWN_FLAGS = 20
TOLD_SHARE = 0.005
"""Of the work, what must be done before the time left is reported."""


def screen(
    context: typer.Context,
    data: LogsArgument,
    folder: Annotated[Path, typer.Option("--out", help="Folder for page, pictures, feature sets and figures.")],
    targets: Annotated[str, typer.Option(help="Channels to predict: a,b. Default: the velocities.")] = "",
    horizon: Annotated[
        int | None, typer.Option(help="How many samples ahead the model will predict; default: 10.")
    ] = None,
    signal_map: MapOption = None,
    repair: RepairOption = [],  # noqa: B006
    exclude: Annotated[str, typer.Option(help="Channels to leave out of the candidates: a,b.")] = "",
    truth: Annotated[bool, typer.Option(help="Accept channels that exist only in a simulation as candidates.")] = False,
    changes: Annotated[
        list[str], typer.Option("--set", help='One setting, such as screen.max_lag=200 or screen.measured=["lever"].')
    ] = [],  # noqa: B006
    pictures: Annotated[bool, typer.Option(help="Write the pictures as SVG and PNG too.")] = True,
    trials: Annotated[
        bool, typer.Option(help="Also train a network on each set, and compare their held-out errors.")
    ] = False,
    config: Annotated[
        Path | None,
        typer.Option(help="Settings (TOML): [screen], and with --trials [trials] and what overrides the preset."),
    ] = None,
    preset: Annotated[str, typer.Option(help="With --trials: quick, small, standard or thesis.")] = "quick",
    own: Annotated[
        list[Path], typer.Option("--features", help="With --trials: further feature-set file; may be repeated.")
    ] = [],  # noqa: B006
    max_hours: MaxHoursOption = None,
    workers: WorkersOption = 1,
    cluster: ClusterOption = "",
    open_cluster: OpenOption = False,
    as_json: JsonFlag = False,
) -> None:
    """Screen recordings for the channels a model needs: a ranked, reasoned proposal with its evidence.

    Without a map every column of numbers is a candidate. Writes a page, pictures, feature sets (TOML) and JSON.

    Example: `edp data screen logs/ --out screen --targets v_boom,v_arm --horizon 10`

    Example: `edp data screen logs/ --out screen --set 'screen.measured=["lever"]' --set screen.forest.trees=60`

    Example: `edp train logs/ --config screen/settings.toml --out runs/first`
    """
    from edp.config.commands import TRAINING_TABLES, command_settings
    from edp.config.experiment import load_experiment
    from edp.data.screening import ScreeningSpec
    from edp.workflows.feature_selection.select import SelectionOrder
    from edp.workflows.feature_selection.trials import TrialSpec

    check_effects(context, {f"changes.{table}": trials for table in TRIAL_TABLES})
    asked = {"targets": _names(targets) or None, "horizon": horizon}
    layers: list[Change] = [*changes, {"screen": {key: value for key, value in asked.items() if value is not None}}]
    spec, others = command_settings("screen", ScreeningSpec, config, layers, ("trials", *TRAINING_TABLES))
    trial_spec, _ = command_settings("trials", TrialSpec, None, others, TRAINING_TABLES)
    order = SelectionOrder(spec=spec, exclude=tuple(_names(exclude)), truth=truth, pictures=pictures)
    if trials:
        order = replace(
            order,
            experiment=load_experiment(config, preset, changes, aside=("screen", "trials")),
            trials=trial_spec,
            sets=_own_sets(own),
        )
    source = replace(source_of(data, signal_map, repair), at_most_h=max_hours)
    selection = run_screening(source, folder, order, as_json, workers_of(workers, cluster, open_cluster))
    command = next_command(data, signal_map, repair, selection)

    def show() -> None:
        show_between(selection.quality)
        out.print(verdict_text(selection.quality))
        out.print()
        show_selection(selection)
        out.print(f"next: {command}")

    emit(as_json, facts_of(selection) | {"next": command}, show)


def run_screening(
    source: Any, folder: Path, order: SelectionOrder, quiet: bool = False, workers: Workers | None = None
) -> Selection:
    """Screen with a progress display."""
    from edp.jobs import IN_PROCESS
    from edp.workflows.feature_selection.select import Listeners, select_features

    with progress(quiet) as shown:
        display = ScreeningDisplay(shown, Steps(quiet))
        logs = StageDisplay(Display(shown, Steps(quiet), "read"))
        listeners = Listeners(logs=logs, on_progress=display.on_progress, on_trial=display.on_trial)
        return select_features(source, folder, order, listeners, workers or IN_PROCESS)


class ScreeningDisplay:
    """Shows the stages of a screening and the trainings of its trials."""

    def __init__(self, shown: Bars, steps: Steps) -> None:
        self.shown, self.steps = shown, steps
        self.bars: dict[str, TaskID] = {}
        self.began: dict[str, tuple[float, float]] = {}
        self.shares: dict[str, float] = {}
        self.trained = False

    def on_progress(self, stage: str, share: float) -> None:
        """Show a stage."""
        self._show("screen", share, stage)

    def on_trial(self, name: str, done: int, total: int, event: TrainingProgress | None) -> None:
        """Show a training."""
        part, note = 0.0, f"{name}, training {count_text(done + 1, total)}"
        if event is not None:
            part = event.share
            note += f", epoch {count_text(event.epoch, event.epochs, '/')}"
        elif not self.trained:
            # Trainings that are in the folder already take no time, and say nothing about the others.
            self.began.pop("trials", None)
        self.trained = self.trained or event is not None
        self._show("trials", (done + part) / max(1, total), note)

    def _show(self, what: str, share: float, note: str) -> None:
        now = time.monotonic()
        if what not in self.bars:
            self.bars[what] = self.shown.add_task(what, total=1.0, note="")
        self.shares[what] = share = max(min(share, 1.0), self.shares.get(what, 0.0))  # a refit begins its epochs again
        first_share, began = self.began.setdefault(what, (share, now))
        gained, elapsed = share - first_share, now - began
        tail = format_time_left(elapsed / gained * (1.0 - share)) if gained >= TOLD_SHARE else ""
        self.shown.update(self.bars[what], completed=share, note=note)
        self.steps.say(f"{what}: {note}, {percent(share)}{tail}")


def show_selection(selection: Selection) -> None:
    """Print the proposal, the flags and where everything is."""
    from edp.report.screening import tables

    screening, page = selection.screening, selection.files["page"]
    proposed, flags = tables.tabulate_kept(screening), tables.flags_table(screening)
    _print_first(proposed, f"keep: {len(proposed.rows)} of {count_of(len(screening.channels), 'channel')}", SHOWN, page)
    if flags.rows:
        _print_first(flags, f"flags: {len(flags.rows)}", SHOWN_FLAGS, page)
    print_table(tables.ranges_table(screening))
    out.print()
    window = screening.proposal.window
    out.print(
        f"memory: W = {window} samples ({figure(1e3 * window / screening.rate_hz)} ms): "
        f"{screening.proposal.window_reason}"
    )
    for note in (*screening.proposal.notes, *selection.notes):
        out.print(f"note: {note}")
    if selection.trials is not None:
        out.print()
        print_table(tables.trials_table(selection.trials))
        for note in selection.trials.notes:
            out.print(f"note: {note}")
        out.print()
    out.print(f"page: {page}")
    out.print(f"feature sets: {selection.files['sets']}")


def _print_first(table: Table, caption: str, most: int, page: Path) -> None:
    """Print the first rows of a table, and where the others are."""
    print_table(replace(table, caption=caption, rows=table.rows[:most]))
    if len(table.rows) > most:
        out.print(f"  ... and {len(table.rows) - most} more in {page}")
    out.print()


def facts_of(selection: Selection) -> dict[str, object]:
    """Return the result for scripts; the full result is in the files."""
    proposal = selection.screening.proposal
    return {
        "kept": list(proposal.kept),
        "dropped": list(proposal.dropped),
        "window": proposal.window,
        "flags": [
            {"channel": flag.channel, "kind": str(flag.kind), "source": flag.source, "lag": flag.lag}
            for flag in selection.screening.flags
        ],
        "verdict": selection.quality.verdict,
        "repeats": [repeat.to_json() for repeat in selection.quality.repeats],
        "notes": [*proposal.notes, *selection.notes],
        "seconds": selection.screening.seconds,
        "trials": None if selection.trials is None else selection.trials.to_table(),
        "files": {name: str(path) for name, path in selection.files.items()},
    }


def next_command(data: Sequence[Path], signal_map: Path | None, repair: Sequence[str], selection: Selection) -> str:
    """Return the training command that uses the proposal."""
    chosen = signal_map or selection.map
    parts = [f"edp train {shlex.join(map(str, data))}"] + ([f"--map {chosen}"] if chosen is not None else [])
    parts += [f"--repair {entry}" for entry in repair]
    return " ".join([*parts, f"--config {selection.files['settings']}", "--out runs/first"])


def _names(text: str) -> list[str]:
    return [name.strip() for name in text.split(",") if name.strip()]


def _own_sets(paths: Sequence[Path]) -> dict[str, FeatureSettings]:
    """Feature sets of files, by name."""
    from edp.config.experiment import FeatureSettings, build
    from edp.data.feature_files import read_set_table

    sets = (build(FeatureSettings, read_set_table(path), f"'{path}'") for path in paths)
    return {features.name: features for features in sets}
