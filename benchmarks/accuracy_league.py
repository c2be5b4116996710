"""How far is our best configuration ahead of the thesis's networks and of what a user would pick instead?

All see the same simulated recordings of machine M22 and are judged on the same held-out ones. Ours is the preset
``standard`` on chunks; the rivals are the thesis's networks of Table B.1 and of Table 4.8 (k = 10 teacher) on windows
of 50 from reset, as it trained them, each with the better of two rates, and the baselines. Beside them stands the
limit of predictability, from the true state branched into many futures.

Two questions for each horizon. At equal processor time: every network gets ``--budget`` seconds. At convergence
(``--converge``): the thesis's networks train until twelve looks at the validation error in a row bring nothing, at
most ``--cap`` seconds, and ours gets a tenth of the time that the rival took.

Every training is a cell, kept below ``--work`` when it is done, so that a long league can be stopped and goes on.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import statistics
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from common import Verdict, finish, parser, table, verdict
from edp.config import Experiment, load_experiment
from edp.data.prepared import Prepared
from edp.data_sets import find_data_set_limit
from edp.evaluation.footprint import footprint
from edp.evaluation.judge import JudgeSpec, judge
from edp.sim.limit import LimitSpec
from edp.storage import make_folder, read_json, write_json
from edp.training import Event, fit
from edp.training.schedules import Constant
from edp.workflow import DataSource, SimulationOrder, prepare_data, simulate_data_set

ROOT = Path(__file__).resolve().parents[1]
THESIS = ROOT / "examples" / "thesis"
LOOKS = 24  # validations in a training of given length
BASELINES = ("persistence", "ridge_arx", "boosted_trees", "small_mlp")


@dataclass(frozen=True)
class Contender:
    """A network and how it is trained.

    Attributes:
        name: as the table calls it.
        preset: preset of its settings.
        file: settings laid over it; empty for none.
        changes: further changes, as ``--set`` takes them.
    """

    name: str
    preset: str
    file: str = ""
    changes: tuple[str, ...] = ()

    @property
    def family(self) -> str:
        """The network, whatever its rate."""
        return self.name.partition(",")[0]

    def experiment(self, horizons: list[int], seed: int) -> Experiment:
        """Its settings for these horizons."""
        path = THESIS / self.file if self.file else None
        fixed = (f"task.horizons={horizons}", f"training.seed={seed}", "training.threads=1")
        return load_experiment(path, self.preset, [*self.changes, *fixed])


OURS = Contender("ours", "standard")
RIVALS = tuple(
    Contender(f"{name}, {rate:g}", "thesis", file, (f"training.optimizer.learning_rate={rate}",))
    for name, file in (("thesis Table B.1", "table_b1.toml"), ("thesis teacher", "k10_teacher.toml"))
    for rate in (3e-4, 1e-3)  # the thesis's own rate, and the best of a first look at window training
)


@dataclass(frozen=True)
class League:
    """Where the league stands: data, folder of finished cells, and lengths."""

    source: DataSource
    work: Path
    seed: int
    looks: int

    def cell(self, contender: Contender, horizons: list[int], budget_s: float, patience: int = 0) -> dict[str, Any]:
        """Train and judge a contender, or take what an earlier run of this league found.

        Args:
            contender: the network.
            horizons: look-ahead in samples.
            budget_s: processor seconds; the longest where `patience` is given.
            patience: looks without a better validation error before the end; 0 for a training of given length.
        """
        label = f"{contender.name} k={'+'.join(map(str, horizons))} {budget_s:g}s p{patience} seed{self.seed}"
        kept = self.work / f"{label.replace(' ', '_').replace(',', '')}.json"
        if kept.exists():
            found: dict[str, Any] = read_json(kept)
            return found
        found = self._measure(contender, horizons, budget_s, patience)
        write_json(kept, found)
        maes = ", ".join(f"k={k}: {mae:.3f}" for k, mae in found["mae"].items())
        print(f"{label}: {found['cpu_s']:.0f} processor s, {maes} mm/s", flush=True)
        return found

    def _measure(self, contender: Contender, horizons: list[int], budget_s: float, patience: int) -> dict[str, Any]:
        experiment = contender.experiment(horizons, self.seed)
        data = prepare_data(self.source, experiment)
        updates = max(1, int(budget_s / self.looks / update_cost(data, experiment)))
        training = dataclasses.replace(experiment.training, updates=updates, epochs=self.looks, patience=patience)
        if patience:  # A constant rate: where a schedule would have ended is not known.
            training = dataclasses.replace(training, epochs=10_000, schedule=Constant())
        curve: list[tuple[float, float]] = []
        began = time.process_time()

        def on_event(event: Event) -> None:
            if event.row is not None:
                curve.append((time.process_time() - began, event.row["validation_mae"]))

        fitted = fit(data, experiment.model, training, on_event=on_event)
        scores = judge(fitted.predictor, data, JudgeSpec(baselines=()), contender.name).scores["models"]["network"]
        cost = footprint(fitted.predictor)
        return {
            "mae": {str(k): scores["overall"][str(k)]["mean"]["mae"] for k in horizons},
            "validation": min(mae for _, mae in curve),
            "cpu_s": curve[-1][0],
            "cpu_at_best_s": min(curve, key=lambda point: point[1])[0],
            "curve": curve,
            "parameters": cost.parameters,
            "macs_tick": cost.macs_tick,
            "macs_window": cost.macs_window,
        }

    def baselines(self, horizon: int, names: tuple[str, ...]) -> dict[str, float]:
        """Held-out error of baselines."""
        kept = self.work / f"baselines_k={horizon}.json"
        if not kept.exists():
            experiment = OURS.experiment([horizon], self.seed)
            data = prepare_data(self.source, experiment)
            training = dataclasses.replace(experiment.training, epochs=1, updates=1)
            fitted = fit(data, experiment.model, training)
            models = judge(fitted.predictor, data, JudgeSpec(baselines=names), "").scores["models"]
            write_json(kept, {name: models[name]["overall"][str(horizon)]["mean"]["mae"] for name in names})
        found: dict[str, float] = read_json(kept)
        return found


def update_cost(data: Prepared, experiment: Experiment) -> float:
    """Processor seconds of an update, from short trainings that are thrown away."""
    short = dataclasses.replace(data, validation=data.validation[:1])

    def seconds(updates: int) -> float:
        began = time.process_time()
        fit(short, experiment.model, dataclasses.replace(experiment.training, epochs=1, updates=updates))
        return time.process_time() - began

    seconds(1)  # the first call of all pays for start-up
    fixed, updates = seconds(1), 8
    while (spent := seconds(updates) - fixed) < 0.5:
        updates *= 2
    return spent / (updates - 1)


def best_rival(cells: dict[str, dict[str, Any]], family: str) -> dict[str, Any]:
    """The better-validated of a network's trainings."""
    return min((cell for name, cell in cells.items() if name.startswith(family)), key=lambda cell: cell["validation"])


def judge_horizon(league: League, horizon: int, arguments: argparse.Namespace, limit: float) -> dict[str, Any]:
    """All contenders at one horizon, their table printed."""
    key = str(horizon)
    ours = league.cell(OURS, [horizon], arguments.budget)
    rivals = {rival.name: league.cell(rival, [horizon], arguments.budget) for rival in arguments.rivals}
    baselines = league.baselines(horizon, arguments.baselines)
    found: dict[str, Any] = {"ours": ours, "baselines": baselines, "limit": limit, "rivals": rivals}
    rows = [("ours", ours)]
    families = sorted({rival.family for rival in arguments.rivals})
    rows += [(f"{family} (window)", best_rival(rivals, family)) for family in families]
    if arguments.converge:
        grown = {rival.name: league.cell(rival, [horizon], arguments.cap, patience=12) for rival in arguments.rivals}
        rival = best_rival(grown, "thesis teacher")
        found["converged"] = grown
        found["ours_tenth"] = league.cell(OURS, [horizon], round(rival["cpu_s"] / 10))
        rows += [("thesis teacher, converged", rival), ("ours, a tenth of its time", found["ours_tenth"])]
    ridge = found["baselines"]["ridge_arx"]
    print(f"\nk = {horizon}: held-out mean absolute error, mm/s; the limit is {limit:.3g}")
    lines = [
        [name, cell["mae"][key], cell["cpu_s"], cell["parameters"], closed(cell["mae"][key], ridge, limit)]
        for name, cell in rows
    ]
    lines += [[name, mae, "-", "-", closed(mae, ridge, limit)] for name, mae in found["baselines"].items()]
    table(["model", "MAE", "processor s", "parameters", "gap closed"], sorted(lines, key=lambda line: line[1]))
    return found


def closed(mae: float, ridge: float, limit: float) -> float:
    """Share of the gap between ridge ARX and the limit of predictability that a model closes."""
    return (ridge - mae) / (ridge - limit)


def verdicts_of(found: dict[int, dict[str, Any]], joint: dict[str, float] | None, quick: bool) -> Iterator[Verdict]:
    """Every goal that this run can speak to."""
    for horizon, cells in found.items():
        ours, key = cells["ours"], str(horizon)
        teacher = best_rival(cells["rivals"], "thesis teacher")
        name = f"MAE at k={horizon}"
        if horizon in (10, 20):
            yield verdict(
                f"{name}, equal time, against the teacher",
                ours["mae"][key],
                teacher["mae"][key],
                "<= 0.8",
                "mm/s",
                quick,
            )
        if horizon == 10:
            share = closed(ours["mae"][key], cells["baselines"]["ridge_arx"], cells["limit"])
            yield verdict("share of ridge-to-limit gap closed at k=10", share, 1.0, ">= 0.8", "1", quick)
            yield verdict(
                "parameters against the teacher's", ours["parameters"], teacher["parameters"], "<= 0.25", "1", quick
            )
        if "converged" in cells:
            rival = best_rival(cells["converged"], "thesis teacher")
            yield verdict(
                f"{name}, a tenth of the time, against the converged teacher",
                cells["ours_tenth"]["mae"][key], rival["mae"][key], "<= 0.95", "mm/s", quick,
            )  # fmt: skip
        if joint is not None:
            yield verdict(f"{name}, one net for all horizons", joint[key], ours["mae"][key], "<= 1.02", "mm/s", quick)


def limits_of(folder: Path, order: SimulationOrder, horizons: list[int], quick: bool) -> dict[int, float]:
    """The limit of predictability at each horizon, mm/s, mean over the cylinders."""
    spec = LimitSpec(horizons=tuple(horizons), **({"moments": 8, "branches": 4} if quick else {}))
    found = find_data_set_limit(folder, order, spec)
    return {k: float(row[-1]) for k, row in zip(found["horizons"], found["commands_unknown"]["mae"], strict=True)}


def run(arguments: argparse.Namespace, folder: Path) -> None:
    """The whole league in `folder`."""
    quick, horizons = arguments.quick, arguments.horizons
    data = arguments.data or folder / "data"
    minutes, recordings = (6.0, 6) if quick else (arguments.minutes, int(arguments.minutes / 3))
    order = SimulationOrder(minutes=minutes, recordings=recordings, seed=arguments.seed)
    simulate_data_set(data, order)
    limits = limits_of(data, order, horizons, quick)
    joints: list[dict[str, float]] = []
    rounds: list[dict[int, dict[str, Any]]] = []
    for seed in range(arguments.seed, arguments.seed + arguments.seeds):
        league = League(DataSource.of(data), make_folder(folder / "cells"), seed, 2 if quick else LOOKS)
        rounds.append({k: judge_horizon(league, k, arguments, limits[k]) for k in horizons})
        if len(horizons) > 1:
            joints.append(league.cell(OURS, horizons, arguments.budget)["mae"])
            print("one net for all horizons:", joints[-1])
    each = [
        list(verdicts_of(found, joint, quick))
        for found, joint in zip(rounds, joints or [None] * len(rounds), strict=True)
    ]
    medians = [median_of(same) for same in zip(*each, strict=True)]
    finish("accuracy_league", medians, arguments.seed, {"limits": limits, "rounds": rounds, "joint": joints})


def median_of(same: tuple[Verdict, ...]) -> Verdict:
    """One verdict over the seeds: medians of both figures."""
    ours, rival = (statistics.median(getattr(v, part) for v in same) for part in ("ours", "rival"))
    first = same[0]
    return verdict(first.name, ours, rival if math.isfinite(rival) else 1.0, first.goal, first.unit, first.quick)


def main() -> None:
    made = parser(__doc__ or "")
    made.add_argument("--work", type=Path, default=None, help="folder that keeps data and finished cells")
    made.add_argument("--budget", type=float, default=900.0, help="processor seconds of each training")
    made.add_argument("--minutes", type=float, default=600.0, help="minutes of simulated recordings")
    made.add_argument("--horizons", type=int, nargs="+", default=[1, 10, 20, 50])
    made.add_argument("--seeds", type=int, default=3)
    made.add_argument(
        "--converge", action="store_true", help="train the thesis's networks until they stop getting better"
    )
    made.add_argument("--cap", type=float, default=36_000.0, help="longest training to convergence, processor seconds")
    made.set_defaults(rivals=RIVALS, baselines=BASELINES)
    arguments = made.parse_args()
    if arguments.quick:
        short = {"budget": 1.0, "horizons": [10], "seeds": 1, "converge": False}
        vars(arguments).update(short | {"rivals": RIVALS[-1:], "baselines": BASELINES[:2]})
    if arguments.work is not None:
        run(arguments, make_folder(arguments.work))
        return
    with tempfile.TemporaryDirectory() as temporary:
        run(arguments, Path(temporary))


if __name__ == "__main__":
    main()
