"""Practice for the twin of a predictive controller: its own loops, from which it goes on to learn.

Lines of the task grade that nothing else uses, run by nmpc itself on the twin as it is, with drawn weights and oil: in
free air, in free air from or to an outstretched arm, where it falls, and in soils.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from edp.config.control import ControlExperiment
from edp.control.controllers import CONTROLLERS
from edp.control.loop import TRUE, LoopResult, run_loop
from edp.control.plant import PILOTS, PlantInterface, interface_of
from edp.control.plants import plant_of
from edp.control.tasks import TASKS, draw_task
from edp.logs import read_recording, write_recording
from edp.logs.source import DataSource
from edp.recording import Recording
from edp.signals import VOCABULARY
from edp.storage import make_folder
from edp.training.twin_bundle import load_twin
from edp.workflows.control import ControlBench, ControlSources

FIRST_SEED = 7_000_000
"""Lines of practice; those that judge begin at 0, tunings and choices use seeds from 1,000,000 to 4,000,000."""
OUTSTRETCHED = 0.2
"""Share of the arm's stroke below which it is outstretched, at either end of a line."""
SOILS = ("sandy_loam", "dry_sand", "sandy_loam", "clay")
OIL_DEGC = (35.0, 60.0)
LONGEST_S = 40.0
DRAWN: Mapping[str, tuple[float, ...]] = {
    "change": (0.1, 0.2, 0.3),
    "along": (0.3, 0.5, 1.0),
    "smoothing": (0.0, 0.02, 0.04),
}
"""Weights around the defaults: one setting would show one way of driving."""


@dataclass(frozen=True)
class Practice:
    """How much is practised.

    Attributes:
        air: lines in free air.
        hard: lines in free air that begin or end at an outstretched arm.
        soil: lines in soil.
        every: of the twin's own training recordings every which one is learned from again, so that nothing is lost.
    """

    air: int
    hard: int
    soil: int
    every: int


FULL = Practice(36, 30, 48, 3)
QUICK = Practice(1, 1, 1, 4)


def practised(folder: Path, recordings: DataSource, twin: Path, size: Practice, seed: int) -> DataSource:
    """Recordings of loops of nmpc on a twin, and of some that the twin was trained on; finished ones are read."""
    out = make_folder(folder)
    done = out / "practised.txt"
    if not done.is_file():
        spec = CONTROLLERS["nmpc"]()
        experiment = ControlExperiment(task=TASKS["grade"](), controller=spec, loops=1, seed=FIRST_SEED)
        bench = ControlBench(experiment, ControlSources(twin=twin))
        channels = bench.models.needed_twin("nmpc").channels
        own_names = sorted(load_twin(twin).provenance["data"]["names"]["train"])
        trained = [recordings.path / f"{name}.parquet" for name in own_names]
        wanted = {channel.name for channel in (*channels.answers, *channels.commands)}
        names = [name for name in read_recording(trained[0]).channel_names if name in wanted]
        env = plant_of(experiment.machine, LONGEST_S, experiment.rate_hz)
        rng = np.random.default_rng(FIRST_SEED + seed)
        for kind, line, material in lines(bench.plant, size, rng):
            task = draw_task(TASKS["grade"](material=material), bench.plant.geometry, experiment.rate_hz, line)
            weights = {name: float(rng.choice(values)) for name, values in DRAWN.items()}
            controller = CONTROLLERS["nmpc"](**weights).build(interface_of(env), task.limits, bench.models)
            oil = {"oil_temperature": float(rng.uniform(*OIL_DEGC))}
            result = run_loop(env, controller, task, line, oil)
            recording = as_log(result, bench.plant, names, (kind, line, material))
            write_recording(recording, out / f"{recording.name}.parquet")
        for path in trained[:: size.every]:
            whole = read_recording(path)
            values = np.ascontiguousarray(whole.select(names), dtype=np.float32)
            kept = tuple(VOCABULARY[name] for name in names)
            own = Recording(path.stem, kept, values, whole.rate_hz, whole.source, dict(whole.meta))
            write_recording(own, out / path.name)
        done.write_text("all loops were run\n")
    return DataSource.of(out)


def lines(plant: PlantInterface, size: Practice, rng: Any) -> list[tuple[str, int, str]]:
    """Kind, seed and soil of each line: as many of each kind as are asked for, in the order of their seeds."""
    left = {"air": size.air, "hard": size.hard, "soil": size.soil}
    found: list[tuple[str, int, str]] = []
    seed, soils = FIRST_SEED, 0
    while any(left.values()):
        seed += 1
        reference = draw_task(TASKS["grade"](), plant.geometry, plant.rate_hz, seed).reference
        arm = reference.strokes[[0, -1], 1].min() / plant.geometry.full_m[1]
        if arm < OUTSTRETCHED and left["hard"]:
            kind = "hard"
        else:
            kind = "soil" if left["soil"] and rng.random() < 0.5 else "air"
            if not left[kind]:
                if left["hard"]:
                    continue
                kind = "soil" if left["soil"] else "air"
        left[kind] -= 1
        found.append((kind, seed, SOILS[soils % len(SOILS)] if kind == "soil" else ""))
        soils += kind == "soil"
    return found


def as_log(result: LoopResult, plant: PlantInterface, names: list[str], what: tuple[str, int, str]) -> Recording:
    """A loop as a simulated recording: pilot pressures beside the state from which they act on, none a tick late."""
    recording, columns = result.recording, []
    levers = recording.select(("Lever_1", "Lever_2", "Lever_3")).astype(float)
    commands = plant.commands(levers)
    for channel in names:
        if channel in PILOTS:
            columns.append(commands[:, PILOTS.index(channel)])
        else:  # what no sensor of the loop shows, such as pump pressures, without noise
            shown = channel if channel in recording.channel_names else f"{channel}{TRUE}"
            columns.append(recording.column(shown))
    values = np.ascontiguousarray(np.stack(columns, axis=1), dtype=np.float32)
    kind, line, material = what
    meta = {"machine": plant.geometry.machine.name, "excitation": f"loop_{kind}"}
    name = "_".join(part for part in ("m22_loop", kind, str(line), material) if part)
    channels = tuple(VOCABULARY[channel] for channel in names)
    return Recording(name, channels, values, recording.rate_hz, recording.source, meta)
