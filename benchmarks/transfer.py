"""How much is a simulated machine worth to another, worn one in soil, by minutes of its logs?

The source is the preset ``standard`` trained on M22 in free air, the target the C14 with its full sensor model in air
and soil. Every log of the target is a minute that trains and validates and a quarter of a minute that tests; with fewer
minutes there are fewer logs, and the test parts stay those of all. Asked are: each method's error by minutes of logs;
all methods with all logs, in both worlds (the form of Table 4.10); what becomes of it in a soil that no log holds; and
whether a physics base carries over from one machine to the other (RQ1 of the thesis), with the geometry of the source
and with that of the target. With ``--foundation`` a network of many machines (``edp pretrain``) is a second start.

A seed draws the logs with which the few minutes begin, and every training. Intervals are over the logs that test.
Every training is a cell, kept below ``--work`` when it is done, so that a long benchmark can be stopped and goes on.
"""

from __future__ import annotations

import argparse
import hashlib
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from common import finish, in_folder, kept, parser
from edp.config.experiment import load_experiment
from edp.data.prepared import Prepared, prepare
from edp.networks.predictor import build_model
from edp.report.common.picture import write_drawings
from edp.sim.data_set import find_data_set_limit
from edp.sim.physics.soil import material_names
from edp.sim.predictability import LimitSpec
from edp.storage import make_folder
from edp.training.bundle import blank_scaler, weights_digest
from edp.workflows.train_evaluate import DataSource, SimulationOrder, simulate_data_set, train
from edp.workflows.transfer import METHODS, FinetuneSpec
from edp.workflows.transfer.case import TransferCase
from edp.workflows.transfer.methods import Made
from edp.workflows.transfer.scores import errors_of, measure
from edp.workflows.transfer.source import SourceModel, read_source, target_experiment
from transfer_views import HORIZON, KEYS, NONE, OURS, SOILS, WORLDS, draw, interval, show, verdicts_of

ROOT = Path(__file__).resolve().parents[1]
SCENARIO = ROOT / "examples" / "scenarios" / "c14_soil.toml"
SKIP = 50  # ticks of start-up that are not judged
LOG_MIN = 1.25  # of a log, of which four fifths train and validate
MAIN = (OURS, "scratch", "ridge_arx")  # with every seed
BASES = {  # as options of the network
    "none": "",
    "kinematic": '{kind="kinematic", pose="strokes"}',
    "force": '{kind="hybrid", coupled=true, fade_s=0.03, pose="strokes"}',
    "kinematic of angles": '{kind="kinematic", pose="angles"}',
}


@dataclass(frozen=True)
class Size:
    """How long everything is.

    Attributes:
        preset: of the source's network.
        source_min: simulated minutes of the source.
        source: changes of its training.
        spec: how networks are trained on.
        rehearsed: updates of an epoch of methods that rehearse the source, whose recordings are longer.
        grid: minutes of logs by method; 0 is direct transfer.
        rest: methods that are tried with all logs only.
        seeds: trainings of each.
        small: changes of the preset ``quick`` for the networks with physics bases.
        soil_min: minutes of each soil.
        bases: physics bases that are tried.
    """

    preset: str
    source_min: float
    source: tuple[str, ...]
    spec: FinetuneSpec
    rehearsed: int
    grid: dict[str, tuple[int, ...]]
    rest: tuple[str, ...]
    seeds: int
    small: tuple[str, ...]
    soil_min: float
    bases: tuple[str, ...] = tuple(BASES)

    @property
    def logs(self) -> int:
        """How many logs of the target there are."""
        return max(minutes for sizes in self.grid.values() for minutes in sizes)


FULL = Size(
    preset="standard",
    source_min=240.0,
    source=("training.epochs=12", "training.updates=600"),
    spec=FinetuneSpec(),
    rehearsed=400,
    grid={
        OURS: (1, 2, 5, 10, 20, 45),
        "scratch": (1, 2, 5, 10, 20, 45),
        "ridge_arx": (1, 2, 5, 10, 20, 45),
        "two_phase": (5, 45),
        "low_rank": (1, 5, 45),
        "linear_probe": (1, 5, 45),
    },
    rest=("rehearsal", "rehearsal_distilled", "adversarial"),
    seeds=2,
    small=("training.epochs=6", "training.updates=200"),
    soil_min=10.0,
)
QUICK = replace(
    FULL,
    preset="quick",
    source_min=12.0,
    source=("training.epochs=1", "training.updates=4"),
    spec=FinetuneSpec(rounds=1),
    rehearsed=2,
    grid={OURS: (1, 2), "scratch": (2,), "ridge_arx": (1, 2), "rehearsal": (2,)},
    rest=(),
    seeds=1,
    small=("training.epochs=1", "training.updates=2"),
    soil_min=2.5,
    bases=("none", "kinematic of angles"),
)


@dataclass(frozen=True, eq=False)
class World:
    """A source, the logs of a target, and where finished cells lie."""

    source: SourceModel
    logs: DataSource
    data: Prepared
    work: Path
    size: Size

    def cell(self, method: str, minutes: int, seed: int) -> dict[str, Any]:
        """Scores of a method with so many minutes of logs, in both worlds, or what an earlier run found."""
        label = f"{method} {minutes} min seed {seed}"

        def found() -> dict[str, Any]:
            began = time.process_time()
            made = self.made(method, minutes, seed)
            cell = {"cpu_s": time.process_time() - began, "learned": made.learned} | self.scores(
                made, minutes in (0, len(self.data.train))
            )
            print(f"{label}: {cell['cpu_s']:.0f} processor s, {cell['target']['mean']['mae']:.3f} mm/s", flush=True)
            return cell

        return kept(self.work / "cells" / f"{label.replace(' ', '_')}.json", found)

    def made(self, method: str, minutes: int, seed: int) -> Made:
        """What a method comes to; a training that is done is read."""
        shorter = (f"training.updates={self.size.rehearsed}",) if METHODS[method].needs_source else ()
        experiment = target_experiment(self.source, (f"training.seed={seed}", *shorter))
        folder = self.work / "runs" / f"{method}_{minutes}_{seed}"
        data = shortened(self.data, minutes, seed) if minutes else self.data
        case = TransferCase(self.source, self.logs, data, experiment, self.size.spec, folder)
        return METHODS[method]().make(case)

    def scores(self, made: Made, both: bool) -> dict[str, Any]:
        """In the target, in each log of it (mean absolute error, mm/s), and in the source if asked for."""
        said = made.predict(self.data)
        found: dict[str, Any] = {"target": measure(said, self.data, SKIP)[HORIZON], "logs": []}
        for ground, places in grounds(self.data).items():
            parts = replace(self.data, test=[self.data.test[i] for i in places])
            found[ground] = measure([said[i] for i in places], parts, SKIP)[HORIZON]
        for place, part in enumerate(self.data.test):
            error = errors_of(said[place : place + 1], replace(self.data, test=[part]), SKIP)[HORIZON]
            found["logs"].append(float(np.abs(error).mean()))
        if both and self.source.data is not None:
            found["source"] = measure(made.predict(self.source.data), self.source.data, SKIP)[HORIZON]
        return found


def grounds(data: Prepared) -> dict[str, list[int]]:
    """Places of the logs in free air and of those in soil, whose names end with its material."""
    soil = [any(part.name.split("[")[0].endswith(material) for material in material_names()) for part in data.test]
    found = {"air": [i for i, dug in enumerate(soil) if not dug], "soil": [i for i, dug in enumerate(soil) if dug]}
    return {ground: places for ground, places in found.items() if places}


def shortened(data: Prepared, minutes: int, seed: int) -> Prepared:
    """The training and validation parts of so many logs, one after the other from one that the seed draws."""
    count = len(data.train)
    first = int(np.random.default_rng(seed).integers(count))
    chosen = [(first + i) % count for i in range(minutes)]
    digest = hashlib.blake2b(f"{data.digest} {chosen}".encode(), digest_size=16).hexdigest()
    train_parts, validation = ([parts[i] for i in chosen] for parts in (data.train, data.validation))
    return replace(data, train=train_parts, validation=validation, digest=digest)


def order_of(minutes: float, logs: int, seed: int, **changes: Any) -> SimulationOrder:
    """Logs of the target."""
    return SimulationOrder.of(
        SCENARIO, minutes=minutes, recordings=logs, seed=seed, suffix=".parquet", layout="", **changes
    )


def world_of(work: Path, size: Size, seed: int) -> World:
    """Simulate both machines and train the source, or take what an earlier run left."""
    m22, c14 = work / "m22", work / "c14"
    simulate_data_set(m22, SimulationOrder(minutes=size.source_min, recordings=int(size.source_min / 3), seed=seed))
    simulate_data_set(c14, order_of(LOG_MIN * size.logs, size.logs, seed + 100))
    fixed = ("training.loss.delta=0.1", "task.horizons=[10]", "training.threads=1", "training.patience=0")
    train(DataSource.of(m22), load_experiment(None, size.preset, [*fixed, *size.source]), work / "source")
    source, logs = read_source(work / "source"), DataSource.of(c14)
    return World(source, logs, divided(source, logs), work, size)


def divided(source: SourceModel, logs: DataSource) -> Prepared:
    """The logs of the target, each divided by time."""
    experiment = target_experiment(source)
    return prepare(logs.read(), source.bundle.task, experiment.split, source.predictor.spec.window)


def curves_of(world: World, size: Size, seeds: Sequence[int]) -> dict[str, Any]:
    """Each method by minutes: mean over seeds, each seed, and the interval over the logs that test."""
    grid = {NONE: (0,), **size.grid, **dict.fromkeys(size.rest, (size.logs,))}
    cells: dict[str, dict[int, list[dict[str, Any]]]] = {name: {m: [] for m in sizes} for name, sizes in grid.items()}
    for seed in seeds:
        for method, sizes in cells.items():
            again = seed > seeds[0]
            for minutes in (m for m in sizes if not (again and (method not in MAIN or once(method, m, size)))):
                cells[method][minutes].append(world.cell(method, minutes, seed))
    return {method: {m: together(same) for m, same in sizes.items()} for method, sizes in cells.items()}


def once(method: str, minutes: int, size: Size) -> bool:
    """Whether chance has no part in it."""
    return method == NONE or (method == "ridge_arx" and minutes == size.logs)


def together(cells: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Means over seeds."""
    maes = [cell["target"]["mean"]["mae"] for cell in cells]
    logs = np.mean([cell["logs"] for cell in cells], axis=0)
    own = {world: averaged([cell[world] for cell in cells]) for world in WORLDS if world in cells[0]}
    cost = float(np.mean([cell["cpu_s"] for cell in cells]))
    figures = {"mae": float(np.mean(maes)), "seeds": maes, "interval": interval(logs), "cpu_s": cost}
    return figures | {"worlds": own, "logs": logs.tolist()}


def averaged(scores: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Scores of several seeds, entry by entry."""
    return {
        target: {key: float(np.mean([score[target][key] for score in scores])) for key in KEYS if key in row}
        for target, row in scores[0].items()
    }


def foundation_of(world: World, run: Path, seeds: Sequence[int]) -> dict[str, Any]:
    """The same as `curves_of` from a network of many machines: as it is, and fine-tuned."""
    begun = read_source(run / "bundle")  # without its run, whose recordings are of many machines
    place = make_folder(world.work / f"foundation_{weights_digest(begun.predictor)[:12]}")
    size = replace(world.size, grid={OURS: world.size.grid[OURS]}, rest=())
    return curves_of(replace(world, source=begun, data=divided(begun, world.logs), work=place, size=size), size, seeds)


def soils_of(world: World, size: Size, seed: int) -> dict[str, dict[str, float]]:
    """Error in digs and levelling of one soil that the logs hold and of one that they do not, mm/s, by method."""
    made = {name: world.made(name, 0 if name == NONE else size.logs, seed) for name in (NONE, OURS, "ridge_arx")}
    found: dict[str, dict[str, float]] = {}
    for soil in SOILS:
        logs, folder = max(2, int(size.soil_min / LOG_MIN)), world.work / soil
        order = order_of(LOG_MIN * logs, logs, seed + 200, mix={"dig": 0.6, "grading": 0.4}, materials={soil: 1.0})
        simulate_data_set(folder, order)
        series = [world.source.bundle.task.series(recording) for recording in DataSource.of(folder).read()]
        unseen = replace(world, data=replace(world.data, test=series))
        found[soil] = {
            name: float(measure(one.predict(unseen.data), unseen.data, SKIP)[HORIZON]["mean"]["mae"])
            for name, one in made.items()
        }
    return found


def physics_of(world: World, size: Size, seed: int) -> dict[str, dict[str, float]]:
    """Small networks with and without a base: on their own machine, as they are on the other, and after its logs."""
    found: dict[str, dict[str, float]] = {}
    # The scenario's logs hold no pose, as those of most machines; a base has to read one.
    logs = DataSource.of(world.work / "c14_pose")
    simulate_data_set(logs.path, order_of(LOG_MIN * size.logs, size.logs, seed + 100, truth="with"))
    for base, options in ((name, BASES[name]) for name in size.bases):
        fixed = ["task.horizons=[10]", "training.threads=1", "training.patience=0", *size.small]
        changes = [*fixed, *([f"model.physics={options}"] if options else [])]
        folder = make_folder(world.work / f"physics_{base.replace(' ', '_')}")
        train(DataSource.of(world.work / "m22"), load_experiment(None, "quick", changes), folder / "source")
        source = read_source(folder / "source")
        machines = ("M22", "C14") if options else ("M22",)
        for machine in machines:
            begun = source if machine == "M22" else of_machine(source, machine)
            place = make_folder(folder / machine)
            other = replace(world, source=begun, logs=logs, data=divided(begun, logs), work=place)
            few = min(5, size.logs)
            cells = {NONE: other.cell(NONE, 0, seed), OURS: other.cell(OURS, few, seed)}
            found[f"{base}, {machine}" if options else base] = {
                "own": cells[NONE]["source"]["mean"]["mae"],
                **{name: cell["target"]["mean"]["mae"] for name, cell in cells.items()},
            }
    return found


def of_machine(source: SourceModel, machine: str) -> SourceModel:
    """The source with the geometry of another machine in its physics base, its weights as they are."""
    old = source.predictor
    physics = replace(old.spec.physics, machine=machine)
    moved = build_model(old.task, replace(old.spec, physics=physics), blank_scaler(old.task), 0)
    weights = {name: value for name, value in old.state_dict().items() if not name.startswith("physics.geometry")}
    moved.load_state_dict(weights, strict=False)
    return replace(source, bundle=replace(source.bundle, predictor=moved.eval()))


def run(arguments: argparse.Namespace, work: Path) -> None:
    """All parts, in `work`."""
    quick, seed = arguments.quick, arguments.seed
    size = QUICK if quick else replace(FULL, seeds=arguments.seeds)
    world = world_of(work, size, seed)
    spec = LimitSpec(horizons=(10,), **({"moments": 4, "branches": 4} if quick else {"moments": 120}))
    order = order_of(LOG_MIN * size.logs, size.logs, seed + 100)
    limit = find_data_set_limit(work / "c14", order, spec)["commands_unknown"]["mae"][0][-1]
    seeds = range(seed, seed + size.seeds)
    curves = curves_of(world, size, seeds)
    foundation = foundation_of(world, arguments.foundation, seeds) if arguments.foundation else {}
    found = {
        "foundation": foundation,
        "limit": limit,
        "curves": curves,
        "soils": kept(work / "cells" / "soils.json", lambda: soils_of(world, size, seed)),
        "physics": kept(work / "cells" / "physics.json", lambda: physics_of(world, size, seed)),
    }
    show(found, size.logs)
    write_drawings(arguments.pictures or work, {"transfer_curves": lambda figure: draw(figure, curves, limit)})
    finish("transfer", list(verdicts_of(curves, foundation, size.logs, quick)), seed, found)


def main() -> None:
    """Command line."""
    made = parser(__doc__ or "")
    made.add_argument("--work", type=Path, default=None, help="folder that keeps data and finished cells")
    made.add_argument("--seeds", type=int, default=2, help="trainings of the main methods")
    made.add_argument("--foundation", type=Path, default=None, help="run folder of edp pretrain; a second start")
    made.add_argument("--pictures", type=Path, default=None, help="folder of the chart; else that of --work")
    arguments = made.parse_args()
    in_folder(arguments.work, lambda work: run(arguments, work))


if __name__ == "__main__":
    main()
