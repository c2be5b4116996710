"""A plant with the tasks of an experiment: any controller is run on it, by any number of settings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from edp.config.control import ControlExperiment
from edp.control.base import list_unused_models
from edp.control.controllers import CONTROLLERS, ControllerSpec
from edp.control.guard import LoopGuard
from edp.control.loop import LoopResult, run_loop, start_options
from edp.control.models import ControlModels
from edp.control.plant import interface_of
from edp.control.plants import plant_of, twin_of
from edp.control.tasks import draw_task
from edp.control.valve_map import RUN_S, ValveMap, check_levers, measure_valve_map
from edp.errors import ConfigError
from edp.jobs import IN_PROCESS, Workers
from edp.jobs.packing import pack, unpack
from edp.jobs.workers import WorkUnit
from edp.progress import SILENT, Progress
from edp.storage.headers import model_digest
from edp.storage.ledger import TrainingIdentity, WithState
from edp.storage.paths import is_folder_at
from edp.training.bundle import load_bundle
from edp.wording import setting_text, typed


@dataclass(frozen=True)
class ControlSources:
    """Run folders that closed loops read; None if unused.

    Attributes:
        plant: folder of a twin, or an FMU, that replaces the simulator.
        twin: folder of the controller's twin.
        predictor: folder of the controller's look-ahead predictor.
        trusted: whether the native code of an FMU may run here with the rights of this process.
    """

    plant: Path | None = None
    twin: Path | None = None
    predictor: Path | None = None
    # Not a setting of the run: it decides whether there is one.
    trusted: bool = field(default=False, repr=False)

    def digests(self) -> dict[str, str]:
        """Return a hash of the content of each source, as part of the key of a run.

        Raises:
            StorageError: a file cannot be read.
        """
        named = {"plant": self.plant, "twin": self.twin, "predictor": self.predictor}
        return {name: model_digest(path) for name, path in named.items() if path is not None}


class ControlBench:
    """One plant, and the tasks of an experiment's seeds on it.

    Args:
        experiment: machine, task, seeds and controller.
        sources: models and plant.
        models: models for controllers. None measures a valve map on the plant and loads the models of the sources.
        options: further options of the environment's reset, such as ``oil_temperature``.

    Attributes:
        tasks: tasks in the order of the seeds.
        models: models for controllers.
        plant: interface of the plant for controllers.

    Raises:
        EdpError: settings or models cannot be used.
    """

    def __init__(
        self,
        experiment: ControlExperiment,
        sources: ControlSources,
        models: ControlModels | None = None,
        options: Mapping[str, object] | None = None,
    ) -> None:
        _check_used(experiment, sources)
        self.experiment, self.sources, self._options = experiment, sources, options
        rate = experiment.rate_hz
        probe = plant_of(experiment.machine, RUN_S + 1.0, rate, sources.plant, sources.trusted)
        geometry = interface_of(probe).geometry
        seeds = range(experiment.seed, experiment.seed + experiment.loops)
        self.tasks = [draw_task(experiment.task, geometry, rate, seed) for seed in seeds]
        # A loop steps the plant after its last row, too.
        longest = (max(task.reference.ticks for task in self.tasks) + 1) / rate
        self._env = plant_of(experiment.machine, longest, rate, sources.plant, sources.trusted)
        self.plant = interface_of(self._env)
        self.models = models or self._prepare_models(probe, sources)

    def _prepare_models(self, probe: Any, sources: ControlSources) -> ControlModels:
        """Return the models of the sources, and a valve map where one is needed.

        Measured before the loops, on the plant.
        """
        valve_map: ValveMap | None = None
        if "valve_map" in self.experiment.controller.needs:
            valve_map = measure_valve_map(probe, self.plant, self.experiment.seed)
        twin = None if sources.twin is None else twin_of(sources.twin, self.plant.geometry.machine)
        predictor = None if sources.predictor is None else load_bundle(_bundle_of(sources.predictor))
        return ControlModels(valve_map, twin, predictor)

    def results(
        self,
        spec: ControllerSpec | None = None,
        progress: Progress = SILENT,
        guard: LoopGuard | None = None,
        divided: DividedLoops | None = None,
    ) -> list[LoopResult]:
        """Run every loop with a controller; the default is the controller of the experiment.

        Args:
            spec: settings of the controller.
            progress: receiver of the progress; its units are loops.
            guard: guard of every loop, reset before each.
            divided: who runs the loops, and where results are kept; this process keeps none by default.

        Raises:
            ConfigError: plant and controller, or plant and guard, do not fit.
        """
        shared = divided or DividedLoops()
        units = self._units(spec or self.experiment.controller, guard, "run_loop_unit", shared)
        loops = progress.stage("loop", len(units))
        results = shared.workers.map_in_order(units, loops, shared.folder)
        return [unpack(result.content or b"", LoopResult) for result in results]

    def run(self, number: int, spec: ControllerSpec, guard: LoopGuard | None = None) -> LoopResult:
        """Run one loop.

        Args:
            number: index of the task.
            spec: settings of the controller.
            guard: guard of the loop.

        Raises:
            ConfigError: see `results`.
        """
        task = self.tasks[number]
        controller = spec.build(self.plant, task.limits, self.models)
        late = 1e-3 * self.experiment.deadline_ms
        return run_loop(self._env, controller, task, task.seed, self._options, guard, late)

    def _units(
        self, spec: ControllerSpec, guard: LoopGuard | None, function: str, divided: DividedLoops
    ) -> list[WorkUnit]:
        where: dict[str, Any] = {"spec": spec, "guard": guard}
        if divided.workers.are_alone:
            where["bench"] = self
        else:
            where["parts"] = (self.experiment, self.sources, self.models, self._options)
        arguments = {"run": divided.key, "controller": repr(spec)}
        return [
            WorkUnit(
                f"{__name__}:{function}", f"{task.name} {task.seed}", {**arguments, "task": number}, divided.key,
                {**where, "task": number},
            )
            for number, task in enumerate(self.tasks)
        ]  # fmt: skip

    def check(self) -> None:
        """Build the controller of the experiment and hold its limits to references and plant, for a refusal only.

        Raises:
            ConfigError: plant and controller do not fit, a model is missing, limits contradict what is asked, or the
                controller could not control the plant.
        """
        controller = self.experiment.controller.build(self.plant, self.tasks[0].limits, self.models)
        for task in self.tasks:
            if self.models.valve_map is not None:
                check_levers(self.models.valve_map, task.reference, task.limits)
        first = self.tasks[0]
        options = {**start_options(first, self.plant.geometry), **(self._options or {})}
        row = np.asarray(self._env.reset(seed=first.seed, options=options)[0], float)
        for channel, value in zip(self.plant.channels, row, strict=True):
            if channel.name.startswith("CylPressures_") and value > first.limits.pressure_pa:
                raise ConfigError(
                    f"limits: pressure_pa = {setting_text(first.limits.pressure_pa)} Pa, but the machine rests with "
                    f"{channel.name} at {typed(value, 3)} Pa; allow more"
                )
        measured = row[self.plant.columns(controller.reads)]
        # A channel that is missing at the start is named where the loop begins.
        if np.isfinite(measured).all():
            controller.check(measured)

    def cost(self, spec: ControllerSpec, divided: DividedLoops | None = None) -> float:
        """Return the position error of the tip, rms, mean over the loops, mm."""
        return float(np.mean(list(self.costs(spec, divided).values())))

    def costs(self, spec: ControllerSpec, divided: DividedLoops | None = None) -> dict[str, float]:
        """Return the position error of the tip, rms, mm, of each reference by its name."""
        shared = divided or DividedLoops()
        units = self._units(spec, None, "find_cost_unit", shared)
        results = shared.workers.map_in_order(units, folder=shared.folder)
        return {unit.label: float(result.values["cost_mm"]) for unit, result in zip(units, results, strict=True)}


@dataclass(frozen=True)
class DividedLoops:
    """Who runs the loops of a run.

    Attributes:
        workers: who runs them; nodes see plants and models under the same paths.
        folder: folder for the results of single loops; None to store none.
        key: key of the run, with the index of the bench if there are several.
    """

    workers: Workers = IN_PROCESS
    folder: Path | None = None
    key: str = ""


def run_loop_unit(identity: TrainingIdentity, where: Mapping[str, Any]) -> WithState:
    """Run the loop of a unit."""
    return WithState({}, pack(_bench(identity.data, where).run(where["task"], where["spec"], where["guard"])))


def find_cost_unit(identity: TrainingIdentity, where: Mapping[str, Any]) -> dict[str, str]:
    """Return the position error of the loop of a unit."""
    result = _bench(identity.data, where).run(where["task"], where["spec"])
    # As text: plain values of a unit are finite.
    return {"cost_mm": repr(float(result.score.position_rms_mm))}


_benches: dict[str, ControlBench] = {}
"""Bench of the last units of this process, by its key: plants and models take seconds to load."""


def _bench(key: str, where: Mapping[str, Any]) -> ControlBench:
    if "bench" in where:
        bench: ControlBench = where["bench"]
        return bench
    if key not in _benches:
        _benches.clear()
        _benches[key] = ControlBench(*where["parts"])
    return _benches[key]


def _check_used(experiment: ControlExperiment, sources: ControlSources) -> None:
    """Raise ConfigError for models that the controller of an experiment does not use."""
    needs, kind = experiment.controller.needs, CONTROLLERS.name_of(experiment.controller)
    available = [name for name in ("twin", "predictor") if getattr(sources, name) is not None]
    for name in list_unused_models(needs, available):
        uses = " and a ".join(need.replace("_", " ") for need in needs)
        raise ConfigError(
            f"--{name}: it has no effect with the controller '{kind}', which uses a {uses}; "
            f"leave --{name} out, or choose another controller"
        )


def _bundle_of(run: Path) -> Path:
    """Return the bundle of a run folder, or the folder itself if it is a bundle.

    Raises:
        ConfigError: there is no such folder.
    """
    if not is_folder_at(run):
        raise ConfigError(f"--predictor {run}: there is no such folder; give the run folder of edp train")
    inner = run / "bundle"
    return inner if is_folder_at(inner) else run
