"""Compilation of the simulator, the twins and the controllers ahead of their first use."""

from __future__ import annotations

import importlib.util
import tempfile
from pathlib import Path

from edp.config.control import load_control_experiment
from edp.config.twin import load_twin_experiment
from edp.logs import write_recording
from edp.logs.source import DataSource
from edp.progress import SILENT, Progress
from edp.sim import Scenario, simulate
from edp.workflows.control import ControlSources, control_loops
from edp.workflows.twin import train_twin

RECORDINGS = 5
"""Number of simulated recordings: three for training, one each for validation and test."""
JUDGED = ("evaluation.duration_s=2", "evaluation.starts=1", "evaluation.at_s=[1]")
TWINS = {
    "greybox": ("twin.curve_segments=5", "twin.fit.lengths_s=[0.1]", "twin.fit.rounds=[1]", "twin.fit.starts=1",
                "twin.fit.steps=1", "twin.fit.final_rounds=0", "twin.fit.ticks=100", "twin.fit.validation_s=0.5"),
    "recurrent": ("twin.units=2", "training.updates=[1]", "training.lengths_s=[0.2]", "training.validation_s=0.5"),
}  # fmt: skip
"""Settings of a short training by type of twin."""


def compile_ahead(progress: Progress = SILENT) -> None:
    """Compile the machine code of simulator, twins and controllers into the user's cache.

    Simulates, trains and controls for a few seconds each. Code that the cache already has is not compiled again.
    Controllers are omitted if their package is not installed.

    Args:
        progress: receives one step per part.
    """
    stage = progress.stage("compiling", 2 + len(TWINS))
    with tempfile.TemporaryDirectory(prefix="edp_") as folder:
        logs = Path(folder) / "logs"
        logs.mkdir()
        for seed in range(RECORDINGS):
            scenario = Scenario(excitation="dig", material="sandy_loam", duration_s=20.0, seed=seed)
            write_recording(simulate(scenario), logs / f"{seed}.parquet")
        stage.step(1)
        for number, (kind, changes) in enumerate(TWINS.items(), start=2):
            experiment = load_twin_experiment(None, [f"twin.kind={kind}", *JUDGED, *changes])
            train_twin(DataSource.from_path(logs), experiment, Path(folder) / kind)
            stage.step(number)
        if importlib.util.find_spec("daqp") is None:
            return
        controlled = load_control_experiment(None, ["controller.kind=nmpc", "loops=1"])
        control_loops(controlled, Path(folder) / "control", ControlSources(twin=Path(folder) / "greybox"))
        stage.step(2 + len(TWINS))
