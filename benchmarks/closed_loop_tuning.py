"""Part o4 of the closed-loop benchmark: are gains that are better on a model better on the plant?"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import spearmanr

from closed_loop_models import BESIDE, Models
from common import Verdict, table, verdict
from edp.config.control import ControlExperiment
from edp.control.controllers import CONTROLLERS, ControllerSpec
from edp.control.models import ControlModels
from edp.control.tasks import TASKS
from edp.training.twin_bundle import load_twin
from edp.workflows.control import ControlBench, ControlSources
from edp.workflows.control.transfer_of_tuning import TransferSpec, TuningTransfer, costs_of, drawn_settings

SEED, OTHER_SEED = 500_000, 600_000
"""First seeds of the lines, which neither judge a controller nor tune one; the others ask how far lines differ."""
MACHINE, OTHER, SOIL = "M22", "C14", "sandy_loam"
GROUNDS = (0, 1_000_000, 2_000_000, 3_000_000)
"""Added to the seeds of loops, not to those of lines: draws of the ground's heights and strength, and of the noise."""


@dataclass(frozen=True)
class TuningSize:
    """How many settings, and lines for each of them."""

    settings: int
    lines: int


FULL, QUICK = TuningSize(80, 3), TuningSize(3, 1)


def tuning(models: Models, size: TuningSize, seed: int) -> dict[str, dict[str, Any]]:
    """M22 in free air: all models know the valve map that was measured on the plant."""
    experiment = ControlExperiment(
        task=TASKS["grade"](), controller=CONTROLLERS["pi"](), machine=MACHINE, loops=size.lines, seed=SEED
    )
    plant = ControlBench(experiment, ControlSources())
    settings = drawn_settings(experiment.controller, TransferSpec(size.settings, seed))
    on_plant = costs_of(plant, settings)
    other = costs_of(ControlBench(replace(experiment, seed=OTHER_SEED), ControlSources(), plant.models), settings)
    rows: dict[str, dict[str, Any]] = {}
    runs = {"twin": models.twin(), **{name: models.beside(name) for name in BESIDE}}
    for name, run in runs.items():
        rows[name] = _row(costs_on(run, experiment, plant.models, settings), on_plant)
    rows["the plant, along other lines"] = _row(other, on_plant)
    show("gains of pi, M22 in free air", rows)
    return rows


def tuning_on(run: Path, size: TuningSize, seed: int) -> dict[str, Any]:
    """The same settings and lines on one twin."""
    experiment = ControlExperiment(
        task=TASKS["grade"](), controller=CONTROLLERS["pi"](), machine=MACHINE, loops=size.lines, seed=SEED
    )
    plant = ControlBench(experiment, ControlSources())
    settings = drawn_settings(experiment.controller, TransferSpec(size.settings, seed))
    row = _row(costs_on(run, experiment, plant.models, settings), costs_of(plant, settings))
    show("gains of pi, M22 in free air", {"twin": row})
    return row


def tuning_other(models: Models, size: TuningSize, seed: int) -> dict[str, dict[str, Any]]:
    """C14 in soil, on models of M22 that went on with minutes of its logs or were fitted to them.

    They know no soil but that of their logs.
    """
    runs: dict[str, Path] = {}
    for minutes in sorted(models.size.other):
        runs[after("twin", minutes)] = models.other_twin(minutes)
        for name, title in BESIDE.items():
            runs[after(title, minutes)] = models.other_beside(name, minutes)
    return tuning_in_soil(runs, size, seed)


def after(model: str, minutes: int) -> str:
    """Title of a model's row."""
    return f"{model} after {minutes} min"


def other_verdicts(rows: Mapping[str, Mapping[str, Any]], minutes: Sequence[int], quick: bool) -> list[Verdict]:
    """Of the twins of C14, each beside the other models of its minutes."""
    verdicts: list[Verdict] = []
    for count in sorted(minutes):
        own = {name: rows[after(title, count)] for name, title in {"twin": "twin", **BESIDE}.items()}
        verdicts += tuning_verdicts(own, quick, f", C14 in loam, after {count} min")
    return verdicts


def tuning_in_soil(runs: Mapping[str, Path], size: TuningSize, seed: int) -> dict[str, dict[str, Any]]:
    """C14 in soil, on twins of it, which know no soil but that of their logs, or a ground of their own."""
    experiment, plant, settings = _in_soil(size, seed)
    on_plant = costs_of(plant, settings)
    air = without_soil(ControlBench(experiment, ControlSources(), plant.models))
    rows = {"the plant, in free air": _row(costs_of(air, settings), on_plant)}
    for name, run in runs.items():
        bench = ControlBench(experiment, ControlSources(plant=run), plant.models)
        if load_twin(run).ground is None:
            bench = without_soil(bench)
        rows[name] = _row(costs_of(bench, settings), on_plant)
    show("gains of pi, C14 in loam", rows)
    return rows


def over_grounds(size: TuningSize, seed: int, first: Mapping[str, Any]) -> dict[str, Any]:
    """C14 in soil, the mean over draws of its ground, and beside it each draw by itself.

    A model knows none of the draws; how the others rank the settings of a draw says how much of the order is chance.

    Args:
        size: how many settings and lines.
        seed: of the drawing of the settings.
        first: row of a model on the first draw.
    """
    _, plant, settings = _in_soil(size, seed)
    on_model = first["on_model_mm"]
    tasks, by_draw = plant.tasks, [np.array(first["on_plant_mm"])]
    for shift in GROUNDS[1:]:
        plant.tasks = [replace(task, seed=task.seed + shift) for task in tasks]
        by_draw.append(costs_of(plant, settings))
    costs = np.array(by_draw)
    others = [np.delete(costs, n, axis=0).mean(0) for n in range(len(costs))]
    row = _row(np.array(on_model), costs.mean(0))
    row["each_draw"] = [TuningTransfer(np.array(on_model), draw).rank_correlation for draw in costs]
    row["draw_by_draw"] = [[TuningTransfer(a, b).rank_correlation for a in costs] for b in costs]
    row["each_draw_by_the_mean_of_the_others"] = [
        TuningTransfer(other, draw).rank_correlation for other, draw in zip(others, costs, strict=True)
    ]
    show("C14 in loam, mean over draws of the ground", {"twin": row})
    for name in ("each_draw", "each_draw_by_the_mean_of_the_others"):
        print(name, [round(value, 3) for value in row[name]])
    return row | {"each_draw_mm": costs.tolist()}


def _in_soil(size: TuningSize, seed: int) -> tuple[ControlExperiment, ControlBench, list[ControllerSpec]]:
    """C14 in soil: the experiment, the plant, and the settings to rank."""
    experiment = ControlExperiment(
        task=TASKS["grade"](material=SOIL), controller=CONTROLLERS["pi"](), machine=OTHER, loops=size.lines, seed=SEED
    )
    settings = drawn_settings(experiment.controller, TransferSpec(size.settings, seed))
    return experiment, ControlBench(experiment, ControlSources()), settings


def without_soil(bench: ControlBench) -> ControlBench:
    """A bench with the same lines at the surface of the ground, and no ground: a twin has none to be told of."""
    bench.tasks = [replace(task, material="") for task in bench.tasks]
    return bench


def costs_on(run: Path, experiment: ControlExperiment, known: ControlModels, settings: list[ControllerSpec]) -> Any:
    """Costs on a twin as the plant."""
    return costs_of(ControlBench(experiment, ControlSources(plant=run), known), settings)


def _row(on_model: Any, on_plant: Any) -> dict[str, Any]:
    transfer = TuningTransfer(on_model, on_plant)
    calm = on_plant <= np.median(on_plant)
    better = on_model[calm], on_plant[calm]
    return {
        "rank_correlation": transfer.rank_correlation,
        "better_half": float(spearmanr(*better).statistic) if np.ptp(better[0]) and np.ptp(better[1]) else 0.0,
        "regret": transfer.regret,
        "on_model_mm": on_model.tolist(),
        "on_plant_mm": on_plant.tolist(),
    }


def show(title: str, rows: Mapping[str, Mapping[str, Any]]) -> None:
    heads = [title, "rank correlation", "in the better half", "cost of its best over the best", "least cost, mm"]
    shown = [
        [name, row["rank_correlation"], row["better_half"], row["regret"], min(row["on_model_mm"])]
        for name, row in rows.items()
    ]
    table(heads, shown)
    on_plant = next(iter(rows.values()))["on_plant_mm"]
    print(
        f"cost on the plant: least {min(on_plant):.1f}, median {np.median(on_plant):.1f}, most {max(on_plant):.1f} mm"
    )


def tuning_verdicts(rows: Mapping[str, Mapping[str, Any]], quick: bool, where: str = "") -> list[Verdict]:
    """Of the model `twin` beside the others; `where` closes the questions."""
    ours = rows["twin"]
    rivals = [row["rank_correlation"] for name, row in rows.items() if name in BESIDE]
    name = f"o4: cost on the plant of the gains that the twin calls best, over the least cost{where}"
    ranks = f"o4: rank correlation of costs on the twin{where}"
    verdicts = [
        verdict(ranks, ours["rank_correlation"], 1.0, ">= 0.9", "1", quick),
        verdict(name, ours["regret"], 1.0, "<= 1.15", "1", quick),
    ]
    if rivals:
        name = f"o4: rank correlation against the best of static, arx, one step{where}"
        verdicts.append(verdict(name, ours["rank_correlation"], max(rivals), ">= 1", "1", quick))
    return verdicts
