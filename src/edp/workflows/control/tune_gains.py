"""Gains tuned on one plant, such as a twin, and evaluated on another, along other references."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, cast

import numpy as np

from edp.config.control import CONTROL_SETTINGS, ControlExperiment, control_toml
from edp.control.controllers import CONTROLLERS, ControllerSpec
from edp.errors import ConfigError, StorageError
from edp.evaluation.tuning_file import ErrorChange, TipErrors, TuningFile, TuningTrial
from edp.jobs import IN_PROCESS, Workers
from edp.jobs.workers import UNITS, forget_units
from edp.progress import SILENT, Progress
from edp.settings.bounds import check_bounds, integer
from edp.storage import write_bytes
from edp.storage.runs import Run, check_claimable, check_free, run_key
from edp.wording import listed
from edp.workflows.control.bench import ControlBench, ControlSources, DividedLoops
from edp.workflows.search.space import Real
from edp.workflows.search.study import SamplerSpec, Study

TUNING_SEED = 1_000_000
"""First seed of the references that gains are tuned on; those that evaluate begin at 0 and never come so far."""
TUNED = "tuned.toml"


@dataclass(frozen=True)
class TuningSpec:
    """Settings of a tuning of gains.

    Attributes:
        trials: settings tried, the present ones first.
        loops: references that each of them is run along.
        sampler: see `edp.workflows.search.study.SamplerSpec`.
        seed: seed of the sampler.
    """

    trials: int = 40
    loops: int = 4
    sampler: str = "gp"
    seed: int = 0

    def __post_init__(self) -> None:
        check_bounds("tuning", self, trials=integer(1, 10_000), loops=integer(1, 1_000), seed=integer(0, 2**31))


@dataclass(frozen=True, eq=False)
class Tuning:
    """Result of `tune_gains`.

    Attributes:
        best: the controller with the least cost where it was tuned.
        content: content of ``tuning.json``.
    """

    best: ControllerSpec
    content: TuningFile


def tune_gains(
    experiment: ControlExperiment,
    out: str | Path,
    tuned_on: ControlSources,
    judged_on: ControlSources,
    tuning: TuningSpec | None = None,
    progress: Progress = SILENT,
    workers: Workers = IN_PROCESS,
) -> Tuning:
    """Tune a controller and write a run folder: ``tuning.json``, and ``tuned.toml`` for ``edp loop run --config``.

    Args:
        experiment: task, machine, the controller to begin with, and the seeds that evaluate.
        out: run folder; a stopped tuning continues after its last trial, and a finished one is read.
        tuned_on: plant and models of the tuning.
        judged_on: plant and models of the evaluation.
        tuning: settings of the tuning.
        progress: receiver of the progress; its units are trials.
        workers: who runs the loops of a trial; nodes see models and run folder under the same paths.

    Raises:
        EdpError: settings, models or folder cannot be used.
    """
    chosen = tuning or TuningSpec()
    space = dict(experiment.controller.space)
    if not space:
        name = CONTROLLERS.name_of(experiment.controller)
        raise ConfigError(f"controller '{name}' has no gains to tune; give another one")
    if experiment.seed + experiment.loops > TUNING_SEED:
        raise ConfigError(
            f"seed = {experiment.seed}: references from {TUNING_SEED} on are for tuning; choose lower ones"
        )
    check_claimable(out, "tuning")
    check_free(out, "edp loop tune")
    # Both before the first trial, and before the folder is claimed: what is refused is refused at once.
    bench = ControlBench(replace(experiment, seed=TUNING_SEED, loops=chosen.loops), tuned_on)
    judge = ControlBench(experiment, judged_on)
    bench.check()
    judge.check()
    sources = {"tuned_on": tuned_on.digests(), "judged_on": judged_on.digests()}
    key = run_key(CONTROL_SETTINGS.to_dict(experiment) | sources | {"tuning": asdict(chosen)}, "")
    with Run.create(out, "tuning", key, control_toml(experiment)) as run, workers.stay() as staying:
        if run.is_finished:
            content = TuningFile.read(run.path)
            if content.gains.keys() != space.keys():
                raise StorageError(
                    f"'{run.file(TuningFile.NAME)}': got gains {listed(content.gains)}, expected {listed(space)}; "
                    f"{TuningFile.ADVICE}"
                )
            return Tuning(set_gains(experiment.controller, content.gains), content)
        study = Study(
            {name: Real(*ends) for name, ends in space.items()}, chosen.seed, SamplerSpec(kind=chosen.sampler)
        )
        study.suggest({name: _clip(getattr(experiment.controller, name), ends) for name, ends in space.items()})
        rows: list[TuningTrial] = []
        units = run.file(UNITS)
        tuned = DividedLoops(staying, units, f"{key} tuned on")
        best, trials = experiment.controller, progress.stage("trial", chosen.trials)
        for number in range(chosen.trials):
            trials.note(f"trial {number + 1}")
            trial = study.ask(1)[0]
            spec = set_gains(experiment.controller, trial.values)
            cost = bench.cost(spec, tuned)
            study.tell(trial.number, [cost])
            best = spec if not rows or cost < min(row.cost_mm for row in rows) else best
            rows.append(TuningTrial(gains={name: float(value) for name, value in trial.values.items()}, cost_mm=cost))
            trials.step(number + 1)
        judged = DividedLoops(staying, units, f"{key} judged on")
        before, after = judge.costs(experiment.controller, judged), judge.costs(best, judged)
        content = TuningFile(
            controller=CONTROLLERS.name_of(best),
            gains={name: getattr(best, name) for name in space},
            tuned_cost_mm=min(row.cost_mm for row in rows),
            judged_mm=TipErrors(
                before=float(np.mean(list(before.values()))),
                after=float(np.mean(list(after.values()))),
                by_reference={name: ErrorChange(before=before[name], after=after[name]) for name in before},
            ),
            trials=tuple(rows),
        )
        content.write(run.path)
        write_bytes(run.file(TUNED), control_toml(replace(experiment, controller=best)).encode())
    forget_units(units)
    return Tuning(best, content)


def set_gains(spec: ControllerSpec, gains: Mapping[str, Any]) -> ControllerSpec:
    """Return a controller with some of its options changed."""
    values = {name: float(np.round(value, 6)) for name, value in gains.items()}
    return cast(ControllerSpec, replace(cast(Any, spec), **values))


def _clip(value: float, ends: tuple[float, float]) -> float:
    return float(min(max(value, ends[0]), ends[1]))
