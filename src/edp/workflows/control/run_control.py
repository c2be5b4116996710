"""Closed loops of one controller on one task: a run folder with scores, recordings and a page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from edp import __version__
from edp.config.control import CONTROL_SETTINGS, ControlExperiment, control_toml
from edp.control.controllers import CONTROLLERS
from edp.control.guard import LoopGuard
from edp.control.loop import LoopResult
from edp.control.run_file import ControlFile, ControlSummary, LoopEntry, StepTimes
from edp.control.tasks import TASKS, ControlTask
from edp.jobs import IN_PROCESS, Workers
from edp.jobs.workers import UNITS, forget_units
from edp.logs import write_recording
from edp.progress import SILENT, Progress
from edp.report import ControlFacts, build_control_page
from edp.report.animation.page import scene_of
from edp.report.common.provenance import provenance_rows
from edp.settings.provenance import Provenance, new_provenance
from edp.storage import make_folder, write_json
from edp.storage.provenance import PROVENANCE
from edp.storage.runs import Run, check_claimable, check_free, run_key
from edp.workflows.control.bench import ControlBench, ControlSources, DividedLoops
from edp.workflows.control.kept import keep_controller

PAGE, LOOPS = "control.html", "loops"


@dataclass(frozen=True, eq=False)
class ControlRun:
    """Result of `control_loops`.

    Attributes:
        content: content of ``results.json``.
        results: the loops, in the order of their seeds.
        page: file of the page.
    """

    content: ControlFile
    results: Sequence[LoopResult]
    page: Path


def control_loops(
    experiment: ControlExperiment,
    out: str | Path,
    sources: ControlSources | None = None,
    progress: Progress = SILENT,
    guard: LoopGuard | None = None,
    workers: Workers = IN_PROCESS,
) -> ControlRun:
    """Run loops and write a run folder: ``results.json``, ``loops/NAME.parquet``, ``control.html``, ``controller``.

    Args:
        experiment: the settings.
        out: run folder; loops of the same settings are run again.
        sources: models and plant.
        progress: receiver of the progress; its units are loops.
        guard: guard that permits or forbids the use of models, such as a monitor.
        workers: who runs the loops; nodes see models and run folder under the same paths. A stopped call continues
            after the loops that are done.

    Raises:
        EdpError: settings, models, guard or folder cannot be used.
    """
    chosen = sources or ControlSources()
    check_claimable(out, "control")
    check_free(out, "edp loop run")
    # Before the folder is claimed: a reference or plant that is refused must not keep the corrected command out.
    bench = ControlBench(experiment, chosen)
    bench.check()
    if guard is not None:
        guard.reset(bench.plant)
    models = {"sources": chosen.digests(), "guard": None if guard is None else repr(guard)}
    key = run_key(CONTROL_SETTINGS.to_dict(experiment) | models, "")
    with Run.create(out, "control", key, control_toml(experiment)) as run:
        units = run.file(UNITS)
        results = bench.results(progress=progress, guard=guard, divided=DividedLoops(workers, units, key))
        folder = make_folder(run.file(LOOPS))
        for result in results:
            write_recording(result.recording, folder / f"{result.recording.name}.parquet")
        keep_controller(run.path, bench.plant, bench.models, chosen.twin, (bench.tasks[0], results[0]))
        content = _content(experiment, bench.tasks, results)
        content.write(run.path)
        provenance = replace(new_provenance(), seed=experiment.seed).add_entries(
            machine=content.machine,
            plant=content.plant if chosen.plant is None else str(chosen.plant),
            twin=str(chosen.twin or ""),
            predictor=str(chosen.predictor or ""),
        )
        write_json(run.file(PROVENANCE), provenance.to_table())
        page = build_control_page(_facts(run.path.name, content, results, provenance)).write(run.file(PAGE))
    forget_units(units)
    return ControlRun(content, results, page)


def _content(experiment: ControlExperiment, tasks: Sequence[ControlTask], results: Sequence[LoopResult]) -> ControlFile:
    plain = CONTROL_SETTINGS.to_dict(experiment)
    summary = _summary(results)
    return ControlFile(
        edp=__version__,
        sentence=_sentence(summary, CONTROLLERS.name_of(experiment.controller), plain["task"]["kind"], len(results)),
        task=plain["task"],
        controller=plain["controller"],
        machine=str(results[0].recording.meta["machine"]),
        plant=results[0].recording.source.removeprefix("loop:"),
        summary=summary,
        loops=tuple(_loop(task, result) for task, result in zip(tasks, results, strict=True)),
    )


def _summary(results: Sequence[LoopResult]) -> ControlSummary:
    scores = [result.score for result in results]
    energies = [score.energy_kj for score in scores]
    return ControlSummary(
        position_rms_mm=_mean([score.position_rms_mm for score in scores]),
        position_worst_mm=max(score.position_rms_mm for score in scores),
        path_rms_mm=_mean([score.path_rms_mm for score in scores]),
        path_worst_mm=max(score.path_rms_mm for score in scores),
        attitude_rms_deg=_mean([score.attitude_rms_deg for score in scores]),
        lever_travel=_mean([score.lever_travel for score in scores]),
        energy_kj=None if None in energies else _mean([energy for energy in energies if energy is not None]),
        violations=sum(sum(score.violations.values()) for score in scores),
        missed=sum(score.missed for score in scores),
        solve_us_median=float(np.median(np.concatenate([result.solve_s for result in results]) * 1e6)),
    )


def _sentence(summary: ControlSummary, controller: str, task: str, count: int) -> str:
    loops = f"{count} loops" if count > 1 else "one loop"
    worst = f", {summary.position_worst_mm:.1f} mm in the worst" if count > 1 else ""
    return (
        f"{controller} keeps the bucket tip {summary.position_rms_mm:.1f} mm (rms) from its reference in {loops} of "
        f"{TASKS.what} '{task}'{worst}, and {summary.path_rms_mm:.1f} mm from the path"
    )


def _loop(task: ControlTask, result: LoopResult) -> LoopEntry:
    times = result.solve_s * 1e6
    median, p99 = float(np.median(times)), float(np.percentile(times, 99.0))
    return LoopEntry(
        name=result.recording.name,
        seed=task.seed,
        seconds=task.reference.duration_s,
        score=result.score,
        solve_us=StepTimes(median=median, p99=p99, max=float(times.max())),
        events=result.events,
        warnings=result.warnings,
    )


def _mean(values: Sequence[float]) -> float:
    return float(np.mean(values))


def _facts(title: str, content: ControlFile, results: Sequence[LoopResult], provenance: Provenance) -> ControlFacts:
    recordings = [result.recording for result in results]
    scene = scene_of(recordings[0], content.machine)
    solve_us = [result.solve_s * 1e6 for result in results]
    return ControlFacts(title, content, recordings, solve_us, scene, provenance_rows(provenance))
