"""``--loop``: a controller in closed loop with the simulator along a task, as `edp loop run` runs it."""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from edp.config.control import load_control_experiment
from edp.control.loop import LEVERS, REFERENCE, run_loop, start_options
from edp.control.plants import plant_of
from edp.workflows.control.bench import ControlBench, ControlSources
from edp.workflows.live.sources.base import SOURCES, LiveSource, Needs, Sink, SourceOptions
from edp.workflows.live.sources.sim import COMPILING


@SOURCES.register("loop")
class LoopSource(LiveSource):
    """Loops of an experiment, one behind the other, without an end: the references of its seeds again and again.

    Args:
        bench: plant, tasks, controller.
        sources: models and plant.

    Raises:
        EdpError: settings or models cannot be used.
    """

    options: ClassVar[frozenset[str]] = frozenset(
        {"controller", "twin", "plant", "predictor", "machine", "seed", "speed", "yes"}
    )
    preparing: ClassVar[str] = COMPILING

    def __init__(self, bench: ControlBench, sources: ControlSources) -> None:
        bench.check()
        experiment = bench.experiment
        self._bench = bench
        longest = (max(task.reference.ticks for task in bench.tasks) + 1) / experiment.rate_hz
        self._env = plant_of(experiment.machine, longest, experiment.rate_hz, sources.plant, sources.trusted)
        self.channels = (*bench.plant.channels, *REFERENCE, *LEVERS)
        self.rate_hz, self.machine = experiment.rate_hz, experiment.machine
        self.text = f"closed loop, {bench.tasks[0].name}, {bench.plant.geometry.machine.name}"

    @classmethod
    def from_options(cls, options: SourceOptions, needs: Needs) -> LoopSource:
        """Return `SourceOptions.value` is the name of a task, or a file of settings of `edp loop run` (TOML).

        Settings: ``controller`` (a name), ``twin`` and ``predictor`` (run folders that it uses) and ``plant`` (a
        twin's run folder, or an FMU whose native code is trusted, in the simulator's place).
        """
        file = Path(options.value)
        is_file = file.suffix == ".toml"
        table: dict[str, object] = {} if is_file else {"task": {"kind": options.value}}
        if options.machine:
            table["machine"] = options.machine
        if options.settings.get("controller"):
            table["controller"] = {"kind": options.settings["controller"]}
        if options.seed is not None:
            table["seed"] = options.seed
        experiment = load_control_experiment(file if is_file else None, [], table)
        plant, twin, predictor = (options.settings.get(name) for name in ("plant", "twin", "predictor"))
        sources = ControlSources(plant, twin, predictor, trusted=True)
        return cls(ControlBench(experiment, sources), sources)

    def prepare(self) -> None:
        """Compile the plant (see `LiveSource`); each loop begins with a reset."""
        task = self._bench.tasks[0]
        self._env.reset(seed=task.seed, options=start_options(task, self._bench.plant.geometry))
        self._env.step(np.zeros(len(LEVERS), np.float32))

    def run(self, sink: Sink) -> None:
        """See `LiveSource`."""
        bench = self._bench
        while True:
            for task in bench.tasks:
                controller = bench.experiment.controller.build(bench.plant, task.limits, bench.models)
                sink.note("note", f"loop along {task.name}, seed {task.seed}")
                sink.begin_anew()
                result = run_loop(_Tapped(self._env, sink, task.reference), controller, task, task.seed)
                for event in result.events:
                    sink.note("warning", f"controller, from tick {event.tick} of the loop: {event.text}")
                sink.note("note", f"position error of the tip {result.score.position_rms_mm:.1f} mm (rms)")


class _Tapped:
    """An environment whose rows go to a sink as they come."""

    def __init__(self, env: Any, sink: Sink, reference: Any) -> None:
        self._env, self._sink, self._reference, self._tick = env, sink, reference, 0
        self._observation: Any = None

    def reset(self, **options: Any) -> Any:
        """Reset the environment."""
        self._tick = 0
        self._observation, info = self._env.reset(**options)
        return self._observation, info

    def step(self, levers: Any) -> Any:
        """Step the environment, after the previous row with reference and levers is shown."""
        at = min(self._tick, self._reference.ticks - 1)
        parts = [self._observation, self._reference.strokes[at], self._reference.tip[at], levers]
        self._sink.take(np.concatenate(parts))
        self._tick += 1
        result = self._env.step(levers)
        self._observation = result[0]
        return result
