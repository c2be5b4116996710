"""``edp loop run``: a controller in closed loop with a plant, along tasks of the bucket tip."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from edp.cli.consent import ask_for_fmus
from edp.cli.console import JsonFlag, emit, out, table
from edp.cli.options import MOST_LOOPS, ClusterOption, OpenOption, WorkersOption, complete_from, workers_of
from edp.cli.progress import show_progress
from edp.cli.verdicts import end_with, show_verdict, verdict_facts
from edp.storage.paths import full_path
from edp.wording import figure, number

if TYPE_CHECKING:
    from edp.control.run_file import ControlFile

TaskOption = Annotated[
    str,
    typer.Option(
        "--task",
        autocompletion=complete_from("edp.control.tasks", "TASKS"),
        help="What to follow: grade, corners, level, point or dig.",
    ),
]
MachineOption = Annotated[str, typer.Option("--machine", help="Machine name or file (.toml).")]
ControllerOption = Annotated[
    str,
    typer.Option(
        "--controller",
        autocompletion=complete_from("edp.control.controllers", "CONTROLLERS"),
        help="Controller of the levers, such as pi or inversion.",
    ),
]
LoopsOption = Annotated[
    int | None,
    typer.Option(
        "--loops", min=1, max=MOST_LOOPS, help="Number of closed-loop runs, each along its own reference; default: 6."
    ),
]
PlantOption = Annotated[
    Path | None, typer.Option("--plant", help="Run folder of a twin, or an FMU (.fmu), that is the plant instead.")
]
YesOption = Annotated[bool, typer.Option("--yes", help="Run the native code of an FMU without confirmation.")]
TwinOption = Annotated[
    Path | None,
    typer.Option("--twin", help="Run folder of a twin that the controller uses, best a grey box of the machine."),
]
PredictorOption = Annotated[
    Path | None, typer.Option("--predictor", help="Run folder of edp train that the controller uses.")
]
MonitorOption = Annotated[
    Path | None,
    typer.Option("--monitor", help="Folder of a monitor: its alarms take channels away and ask for the fallback."),
]
ConfigOption = Annotated[Path | None, typer.Option("--config", help="Settings (TOML).")]
ChangesOption = Annotated[list[str], typer.Option("--set", help="One setting, for example task.slope_deg=45.")]


def control(
    folder: Annotated[Path, typer.Argument(metavar="RUN", help="Run folder to write.")],
    task: TaskOption = "",
    machine: MachineOption = "",
    controller: ControllerOption = "",
    loops: LoopsOption = None,
    plant: PlantOption = None,
    twin: TwinOption = None,
    predictor: PredictorOption = None,
    monitor: MonitorOption = None,
    config: ConfigOption = None,
    changes: ChangesOption = [],  # noqa: B006
    yes: YesOption = False,
    workers: WorkersOption = 1,
    cluster: ClusterOption = "",
    open_cluster: OpenOption = False,
    as_json: JsonFlag = False,
) -> None:
    """Run a controller in closed loop; write scores, recordings and a page with paths, errors and levers.

    The plant is the simulator, or with --plant a twin or an FMU, whose native code it asks about first. Position
    errors are to the reference of the same time; the distance to the path stands beside them.

    Example: `edp loop run runs/grade --task grade --machine M22 --controller pi --loops 6`
    """
    from edp.config.control import load_control_experiment
    from edp.workflows.control import ControlSources, control_loops

    ask_for_fmus(yes, plant)
    guard = None
    if monitor is not None:
        from edp.workflows.monitor.loop_guard import monitor_guard

        guard = monitor_guard(monitor)
    experiment = load_control_experiment(config, changes, _options(task, machine, controller, loops))
    with show_progress("control", as_json, "loops run") as progress:
        sources = ControlSources(plant, twin, predictor, trusted=True)
        divided = workers_of(workers, cluster, open_cluster)
        run = control_loops(experiment, folder, sources, progress, guard, divided)

    def show() -> None:
        out.print(run.content.sentence)
        score_table(run.content)
        for loop in run.content.loops:
            for warning in loop.warnings:
                out.print(f"{loop.name}: monitor from tick {warning.tick}: {warning.text}")
        out.print(f"page: {full_path(run.page)}")

    emit(as_json, {"run": str(folder), "page": str(run.page), **run.content.to_table()}, show)


def tune(
    folder: Annotated[Path, typer.Argument(metavar="RUN", help="Run folder to write.")],
    task: TaskOption = "",
    machine: MachineOption = "",
    controller: ControllerOption = "",
    evaluation_loops: Annotated[
        int | None,
        typer.Option(
            min=1, max=MOST_LOOPS, help="Number of evaluation runs, each along its own reference; default: 6."
        ),
    ] = None,
    tuning_plant: Annotated[
        Path | None, typer.Option(help="Run folder of a twin, or an FMU, on which to tune; default: the simulator.")
    ] = None,
    plant: PlantOption = None,
    twin: TwinOption = None,
    predictor: PredictorOption = None,
    trials: Annotated[int, typer.Option(min=1, max=MOST_LOOPS, help="Number of controller settings to try.")] = 40,
    tuning_loops: Annotated[
        int, typer.Option(min=1, max=MOST_LOOPS, help="Number of references for each of these settings.")
    ] = 4,
    config: ConfigOption = None,
    changes: ChangesOption = [],  # noqa: B006
    yes: YesOption = False,
    workers: WorkersOption = 1,
    cluster: ClusterOption = "",
    open_cluster: OpenOption = False,
    as_json: JsonFlag = False,
) -> None:
    """Tune a controller's gains on the simulator or on a twin and evaluate them on the plant.

    References of the tuning are never those of the judgement. The tuned settings are for `edp loop run --config`.

    Example: `edp loop tune runs/tuned --task grade --controller pi --tuning-plant runs/twin`
    """
    from edp.config.control import load_control_experiment
    from edp.evaluation.guard import tuning_verdict
    from edp.workflows.control import ControlSources, TuningSpec, tune_gains
    from edp.workflows.control.tune_gains import TUNED

    ask_for_fmus(yes, tuning_plant, plant)
    experiment = load_control_experiment(config, changes, _options(task, machine, controller, evaluation_loops))
    with show_progress("tune", as_json, "trials run") as progress:
        tuned_on, judged_on = (ControlSources(where, twin, predictor, trusted=True) for where in (tuning_plant, plant))
        tuning_spec, divided = TuningSpec(trials=trials, loops=tuning_loops), workers_of(workers, cluster, open_cluster)
        tuning = tune_gains(experiment, folder, tuned_on, judged_on, tuning_spec, progress, divided)
    judged = tuning.content.judged_mm
    verdict = tuning_verdict(judged)

    def show() -> None:
        show_verdict(verdict)
        gains = ", ".join(f"{name} {figure(value, 3)}" for name, value in tuning.content.gains.items())
        out.print(
            f"position error of the tip on the plant: {number(judged.after, 1)} mm (rms), "
            f"{number(judged.before, 1)} mm before"
        )
        out.print(f"gains: {gains}")
        out.print(f"next: edp loop run RUN --config {folder / TUNED}")

    places = {"run": str(folder), "settings": str(folder / TUNED)}
    emit(as_json, places | tuning.content.to_table() | verdict_facts(verdict), show)
    end_with(verdict)


def _options(task: str, machine: str, controller: str, loops: int | None) -> dict[str, object]:
    """Return the settings of the given options."""
    options: dict[str, object] = {"machine": machine} if machine else {}
    options |= {} if loops is None else {"loops": loops}
    options |= {"task": {"kind": task}} if task else {}
    return options | ({"controller": {"kind": controller}} if controller else {})


def score_table(content: ControlFile) -> None:
    """Print one row per loop."""
    rows = []
    for loop in content.loops:
        score = loop.score
        cells = [number(error, 1) for error in (score.position_rms_mm, score.position_max_mm)]
        cells += [number(error, 1) for error in (score.path_rms_mm, score.path_max_mm)]
        arrived = "-" if score.arrived_s is None else number(score.arrived_s, 2)
        energy = "-" if score.energy_kj is None else number(score.energy_kj, 0)
        cells += [number(score.attitude_rms_deg, 2), arrived, energy, number(score.lever_travel, 1)]
        rows.append([loop.name, *cells, sum(score.violations.values())])
    # Short: the table fits into 80 columns.
    heads = ["tip, mm", "max", "path, mm", "max", "deg", "s", "kJ", "levers", "over"]
    title = (
        "errors to the reference of the same time and to the path (rms and largest), of the attitude (deg); arrival "
        "(s), energy (kJ), lever travel, ticks over limits"
    )
    table(title, ["", *heads], rows)
