"""Practice for the twin of a predictive controller: its own loops, from which it goes on to learn.

Lines of the task grade that nothing else uses, run by nmpc itself on the twin as it is, with drawn weights and oil: in
free air, in free air from or to an outstretched arm, where it falls, and in soils.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
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
        outstretched: lines in free air that begin or end at an outstretched arm.
        soil: lines in soil.
        every: of the twin's own training recordings every which one is learned from again, so that nothing is lost.
    """

    air: int
    outstretched: int
    soil: int
    every: int


FULL = Practice(36, 30, 48, 3)
QUICK = Practice(1, 1, 1, 4)


def practised(folder: Path, recordings: DataSource, twin: Path, size: Practice, seed: int) -> DataSource:
    """Recordings of loops of nmpc on a twin, and of some that the twin was trained on; finished ones are read."""
    out = make_folder(folder)
    done = out / "practised.txt"
    if not done.is_file():
        experiment = ControlExperiment(task=TASKS["grade"](), controller=CONTROLLERS["nmpc"](), loops=1)
        bench = ControlBench(experiment, ControlSources(twin=twin))
        answers = [channel.name for channel in bench.models.needed_twin("nmpc").channels.answers]
        names = [*answers, *PILOTS]
        env = plant_of(experiment.machine, LONGEST_S, experiment.rate_hz)
        rng = np.random.default_rng(FIRST_SEED + seed)
        for kind, line, material in lines(bench.plant, size, rng):
            task = draw_task(TASKS["grade"](material=material), bench.plant.geometry, experiment.rate_hz, line)
            weights = {name: float(rng.choice(values)) for name, values in DRAWN.items()}
            controller = CONTROLLERS["nmpc"](**weights).build(interface_of(env), task.limits, bench.models)
            oil = {"oil_temperature": float(rng.uniform(*OIL_DEGC))}
            result = run_loop(env, controller, task, line, oil)
            recording = as_log(result, bench.plant, names, f"m22_loop_{kind}_{line}_{material or 'air'}")
            write_recording(recording, out / f"{recording.name}.parquet")
        trained = sorted(load_twin(twin).provenance["data"]["names"]["train"])
        for name in trained[:: size.every]:
            whole = read_recording(recordings.path / f"{name}.parquet")
            values = np.ascontiguousarray(whole.select(names), dtype=np.float32)
            channels = tuple(VOCABULARY[channel] for channel in names)
            own = Recording(name, channels, values, whole.rate_hz, whole.source, dict(whole.meta))
            write_recording(own, out / f"{name}.parquet")
        done.write_text("all loops were run\n")
    return DataSource.of(out)


def lines(plant: PlantInterface, size: Practice, rng: Any) -> Iterator[tuple[str, int, str]]:
    """Kind, seed and soil of each line, until there are as many of each kind as are asked for."""
    left = {"air": size.air, "outstretched": size.outstretched, "soil": size.soil}
    seed, soils = FIRST_SEED, 0
    while any(left.values()):
        seed += 1
        reference = draw_task(TASKS["grade"](), plant.geometry, plant.rate_hz, seed).reference
        arm = reference.strokes[[0, -1], 1].min() / plant.geometry.full_m[1]
        others = [kind for kind in ("air", "soil") if left[kind]]
        if arm < OUTSTRETCHED and left["outstretched"]:
            kind = "outstretched"
        elif others:
            kind = str(rng.choice(others))
        else:
            continue
        left[kind] -= 1
        material = SOILS[soils % len(SOILS)] if kind == "soil" else ""
        soils += kind == "soil"
        yield kind, seed, material


def as_log(result: LoopResult, plant: PlantInterface, names: list[str], name: str) -> Recording:
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
    meta = {
        "machine": plant.geometry.machine.name,
        "excitation": "loop",
        "full_strokes_m": list(plant.geometry.machine.cylinders.stroke),
    }
    channels = tuple(VOCABULARY[channel] for channel in names)
    return Recording(name, channels, values, recording.rate_hz, recording.source, meta)
