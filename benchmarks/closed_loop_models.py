"""Recordings and models of the closed-loop benchmark: twins of M22, their rivals, and twins that go on with C14."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from common import table
from edp.config.twin import load_twin_experiment
from edp.data.series import Series
from edp.evaluation.ahead import EACH, look_ahead
from edp.jobs import IN_PROCESS
from edp.logs.source import DataSource
from edp.networks.twin import Twin
from edp.networks.twin.disturbance_observer import DisturbanceObserver
from edp.sim.data_set import SimulationOrder, simulate_data_set
from edp.training.twin_bundle import load_twin
from edp.workflows.twin import train_twin
from edp.workflows.twin.prepare_twin import prepare_twin
from twin import write_guess

MIX: Mapping[str, float] = {
    "isolated": 0.15,
    "combined": 0.21,
    "grading": 0.28,
    "dig": 0.12,
    "aprbs": 0.12,
    "end_stops": 0.05,
    "reversals": 0.07,
}
SOILS: Mapping[str, float] = {"air": 0.5, "dry_sand": 0.15, "sandy_loam": 0.2, "clay": 0.15}
"""Of the recordings that work the ground; all others move in free air."""
JUDGED = (
    *(
        "evaluation.duration_s=20",
        "evaluation.at_s=[1.0,5.0,10.0]",
        "evaluation.coverage_at_s=[0.1,1.0,10.0]",
        "evaluation.baselines=[]",
    ),
    *("evaluation.horizon=20", "training.patience=0"),
)
AHEAD = (1, 5, 10, 20, 50)
"""Ticks ahead of measured ports at which the twin is judged, told the commands."""
GROUND = ("dry_sand", "sandy_loam", "clay")


@dataclass(frozen=True)
class GreySize:
    """How much a grey box of M22 in free air is fitted to.

    Attributes:
        minutes: of logs.
        recordings: of them.
        fit: settings.
    """

    minutes: float
    recordings: int
    fit: tuple[str, ...]


# Without what takes fits longer and nearer: the kept results are of this grey box.
SHORT = ("twin.curve_segments=5", "twin.fit.final_rounds=0", "twin.fit.starts=1")
GREY = GreySize(45.0, 15, ("twin.fit.ticks=8000", *SHORT))
QUICK_GREY = GreySize(
    *(6.0, 6, ("twin.fit.ticks=1000", "twin.fit.lengths_s=[0.1,0.3]", "twin.fit.rounds=[1,1]", *SHORT))
)


@dataclass(frozen=True)
class ModelSize:
    """How much is simulated and trained.

    Attributes:
        minutes: of M22.
        recordings: of M22.
        twin: settings of its twin.
        other: minutes of C14 from which a twin goes on.
    """

    minutes: float
    recordings: int
    twin: tuple[str, ...]
    other: int


FULL = ModelSize(180.0, 60, ("twin.kind=recurrent", "twin.units=96"), 20)
QUICK = ModelSize(
    *(20.0, 20, ("twin.kind=recurrent", "twin.units=8", "training.lengths_s=[0.1,0.3]", "training.updates=[20,20]")), 5
)


class Models:
    """Run folders below a folder; what is there already is read.

    Args:
        folder: where recordings and runs lie.
        size: how much is simulated and trained.
        seed: of the recordings and trainings.
    """

    def __init__(self, folder: Path, size: ModelSize, seed: int) -> None:
        self.folder, self.size, self.seed = folder, size, seed

    def recordings(self) -> DataSource:
        """Of M22, in free air and in soil."""
        order = SimulationOrder(
            minutes=self.size.minutes, recordings=self.size.recordings, seed=self.seed + 11, mix=MIX, materials=SOILS
        )
        return self._simulated("recordings", order)

    def twin(self) -> Path:
        return self._twin(self.recordings(), "good_twin", self.size.twin)

    def grey(self, size: GreySize) -> Path:
        """Return the run folder of M22's grey box: known linkage, body priors 10 to 50 % off, logs in free air."""
        order = SimulationOrder(
            minutes=size.minutes, recordings=size.recordings, seed=self.seed + 31, mix=MIX, materials={"air": 1.0}
        )
        return self._grey(self._simulated("air", order), "m22", self.folder / "guess.toml", "grey_twin", size.fit)

    def other_grey(self, fit: Sequence[str]) -> Path:
        """Return the run folder of a grey box of C14, fitted on minutes of its own logs in free air."""
        name, order = f"c14_air_{self.size.other}", self._of_other(41, {"air": 1.0})
        guess = self.folder / "guess_c14.toml"
        return self._grey(self._simulated(name, order), "c14", guess, f"c14_grey_{self.size.other}", fit)

    def other_twin(self) -> Path:
        """Return the run folder of the M22 twin, fine-tuned with minutes of C14 in free air and in soil."""
        name, settings = f"c14_{self.size.other}", [one for one in self.size.twin if not one.startswith("twin.")]
        return self._twin(self._simulated(name, self._of_other(21, SOILS)), f"{name}_twin", settings, self.twin())

    def _of_other(self, draw: int, materials: Mapping[str, float]) -> SimulationOrder:
        minutes = self.size.other
        return SimulationOrder(
            machine="C14", minutes=float(minutes), recordings=max(5, minutes // 2), seed=self.seed + draw, mix=MIX,
            materials=materials,
        )  # fmt: skip

    def _grey(self, source: DataSource, machine: str, guess: Path, name: str, fit: Sequence[str]) -> Path:
        write_guess(machine, guess)
        return self._twin(source, name, ("twin.kind=greybox", f"twin.linkage={guess}", *fit))

    def _simulated(self, name: str, order: SimulationOrder) -> DataSource:
        simulate_data_set(self.folder / name, order, workers=IN_PROCESS)
        return DataSource.from_path(self.folder / name)

    def _twin(self, source: DataSource, name: str, settings: Sequence[str], start: Path | None = None) -> Path:
        experiment = load_twin_experiment(None, (*settings, *JUDGED))
        train_twin(source, experiment, self.folder / name, workers=IN_PROCESS, start=start)
        return self.folder / name


def ahead_errors(models: Models, run: Path, load: float = 0.0) -> dict[str, Any]:
    """Errors of the velocities, mm/s, ahead of measured ports on held-out recordings, told the commands.

    Args:
        models: of the benchmark.
        run: of the twin.
        load: where not zero, what is ahead is also asked with forces estimated as `nmpc` does.
    """
    experiment = load_twin_experiment(None, ("twin.kind=recurrent",))
    _, data = prepare_twin(models.recordings(), experiment)
    twin = load_twin(run).twin
    parts = {
        "all": data.test,
        "free air": [series for series in data.test if not series.name.endswith(GROUND)],
        "free air, no jumps of the levers": [
            series for series in data.test if series.name.split("_", 2)[2] in ("isolated", "combined", "grading")
        ],
    }
    rows: dict[str, Any] = {}
    for part, series in parts.items():
        if series:
            rows[part] = {str(ticks): _velocity_error(look_ahead(twin, series, ticks)) for ticks in AHEAD}
            if load:
                rows[f"{part}, load estimated"] = _with_load(twin, series, load)
    table(
        ["velocities ahead, mm/s", *(f"{n} ticks" for n in AHEAD)],
        [[name, *row.values()] for name, row in rows.items()],
    )
    return rows


def _with_load(twin: Twin, series: Sequence[Series], share: float) -> dict[str, float]:
    """Errors as those of `look_ahead`, at its moments, where forces are estimated from all ticks before."""
    count, longest = len(twin.channels.velocities), max(AHEAD)
    errors: dict[int, list[Any]] = {ticks: [] for ticks in AHEAD}
    for part in series:
        runner, first = twin.runner(), np.zeros(1, np.int64)
        estimate = DisturbanceObserver(runner, np.arange(count), share)
        state = twin.reset(part.inputs[None, : twin.prefix_ticks], part.targets[None, : twin.prefix_ticks])
        moments = np.linspace(twin.prefix_ticks, part.samples - longest - 1, EACH).astype(np.int64)
        for tick in range(twin.prefix_ticks, int(moments[-1]) + 1):
            row = part.targets[tick]
            estimate.update(row[:count].astype(float))
            if tick in moments:
                answers = runner.branches(part.inputs[None, tick : tick + longest], state, row, first)[0, :, :count]
                for ticks in AHEAD:
                    errors[ticks].append(np.abs(answers[ticks - 1] - part.targets[tick + ticks, :count]))
            before, state = state, runner.step(part.inputs[tick], state, row)
            estimate.expect(part.inputs[tick], row, before, state)
    return {str(ticks): 1e3 * float(np.mean(values)) for ticks, values in errors.items()}


def _velocity_error(ahead: Any) -> float:
    """Mean absolute error over actuators and moments, mm/s."""
    count = len(ahead.channels.velocities)
    return 1e3 * float(np.abs(ahead.answers[:, :count] - ahead.truth[:, :count]).mean())
