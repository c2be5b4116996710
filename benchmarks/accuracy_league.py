"""How far is our best configuration ahead of the thesis's networks and of what a user would pick instead?

All see the same simulated recordings of machine M22 and are judged on the same held-out ones. Ours is the preset
``standard`` on chunks, with a loss that is nearly linear (Huber, 0.1 deviations); the rivals are the thesis's networks
of Table B.1 and of Table 4.8 (k = 10 teacher) on windows of 50 from reset, as it trained them, each with the better of
two rates, and the baselines. Beside them stands the limit of predictability, from the true state branched into many
futures.

Two questions. At equal processor time: every network gets ``--budget`` seconds. At convergence (``--converge``
horizons): the thesis's teacher trains, its rate halved after five looks without a better validation error, until
twelve looks in a row bring nothing, at most ``--cap`` seconds, and ours gets a tenth of the time that it took. Ours at
k = 10 gets ``--long`` seconds once more, to see how much of the gap to the limit it closes. One network for all
horizons gets the time of the networks that it replaces, and once more that of one of them.

Processor time is counted in updates: what an update of each network costs is measured once, by turns and as the least
of several, and kept, so that other work on the machine changes neither a budget nor a result.

Every training is a cell, kept below ``--work`` when it is done, so that a long league can be stopped and goes on.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import statistics
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from common import Verdict, finish, in_folder, kept, parser, table, verdict
from edp.config.experiment import Experiment, load_experiment
from edp.data.prepared import Prepared
from edp.evaluation.footprint import footprint
from edp.evaluation.judge import JudgeSpec, judge
from edp.sim.data_set import find_data_set_limit
from edp.sim.predictability import LimitSpec
from edp.storage import make_folder
from edp.training import TrainingProgress, fit
from edp.training.schedules import Plateau
from edp.workflows.train_evaluate import DataSource, SimulationOrder, prepare_data, simulate_data_set

ROOT = Path(__file__).resolve().parents[1]
THESIS = ROOT / "examples" / "thesis"
GAP_AT = 10  # horizon at which the gap to the limit is judged
LOOKS = 12  # validations in a training of given length
VALIDATED = 8  # recordings that validate: a look at all of them costs large networks more than training does
ROUNDS = 3  # turns in which the costs of updates are measured
TEACHER = "thesis teacher"
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


OURS = Contender("ours", "standard", changes=("training.loss.delta=0.1",))
# Each horizon weighs 0.6 of the one before it: alike, the far ones, of which most is chance, hold the near ones back.
JOINT = Contender("ours, near first", OURS.preset, changes=(*OURS.changes, "training.horizon_decay=0.6"))
RATES = (1e-3, 3e-4)  # the best of a first look at window training, and the thesis's own
RIVALS = tuple(
    Contender(f"{name}, {rate:g}", "thesis", file, (f"training.optimizer.learning_rate={rate}",))
    for name, file in (("thesis Table B.1", "table_b1.toml"), ("thesis teacher", "k10_teacher.toml"))
    for rate in RATES
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

        def measure() -> dict[str, Any]:
            found = self._measure(contender, horizons, budget_s, patience)
            maes = ", ".join(f"k={k}: {mae:.3f}" for k, mae in found["mae"].items())
            print(f"{label}: {found['cpu_s']:.0f} processor s, {maes} mm/s", flush=True)
            return found

        return self._kept(label, measure)

    def _kept(self, label: str, measure: Callable[[], dict[str, Any]]) -> dict[str, Any]:
        return kept(self.work / f"{label.replace(' ', '_').replace(',', '')}.json", measure)

    def cost(self, contender: Contender, outputs: int) -> float:
        """Processor seconds of an update with so many horizons: the least of some turns with the other networks."""

        def measure() -> dict[str, Any]:
            everyone = (OURS, *(rival for rival in RIVALS if rival.name.endswith(f"{RATES[0]:g}")))
            data = {one: prepare_data(self.source, one.experiment(list(range(1, outputs + 1)), 0)) for one in everyone}
            turns: dict[str, list[float]] = {one.family: [] for one in everyone}
            for _ in range(ROUNDS if self.looks == LOOKS else 1):
                for one in everyone:
                    turns[one.family].append(update_cost(data[one], one.experiment(list(range(1, outputs + 1)), 0)))
            return {family: min(found) for family, found in turns.items()}

        return float(self._kept(f"costs of updates with {outputs} horizons", measure)[contender.family])

    def _measure(self, contender: Contender, horizons: list[int], budget_s: float, patience: int) -> dict[str, Any]:
        experiment = contender.experiment(horizons, self.seed)
        data = prepare_data(self.source, experiment)
        data = dataclasses.replace(data, validation=data.validation[:VALIDATED])
        # Costs are measured at different moments: an update for several horizons is not cheaper than for one.
        cost = max(self.cost(contender, outputs) for outputs in {1, len(horizons)})
        looks = 4 * self.looks if patience else self.looks
        updates = max(1, int(budget_s / looks / cost))
        training = dataclasses.replace(experiment.training, updates=updates, epochs=looks, patience=patience)
        if patience:  # where a schedule over the whole length would have ended is not known
            training = dataclasses.replace(training, schedule=Plateau(shrink=0.5, patience=5))
        curve: list[tuple[float, float]] = []
        began = time.process_time()

        def on_event(event: TrainingProgress) -> None:
            if event.row is not None:
                curve.append((event.row["updates"] * cost, event.row["validation_mae"]))

        fitted = fit(data, experiment.model, training, on_event=on_event)
        scores = judge(fitted.predictor, data, JudgeSpec(baselines=()), contender.name).scores["models"]["network"]
        counted = footprint(fitted.predictor)
        return {
            "mae": {str(k): scores["overall"][str(k)]["mean"]["mae"] for k in horizons},
            "validation": min(mae for _, mae in curve),
            "cpu_s": curve[-1][0],
            "cpu_at_best_s": min(curve, key=lambda point: point[1])[0],
            "cpu_measured_s": time.process_time() - began,
            "cost_of_update_s": cost,
            "curve": curve,
            "parameters": counted.parameters,
            "macs_tick": counted.macs_tick,
            "macs_window": counted.macs_window,
        }

    def baselines(self, horizon: int, names: tuple[str, ...]) -> dict[str, float]:
        """Held-out error of baselines."""

        def measure() -> dict[str, Any]:
            experiment = OURS.experiment([horizon], self.seed)
            data = prepare_data(self.source, experiment)
            training = dataclasses.replace(experiment.training, epochs=1, updates=1)
            fitted = fit(data, experiment.model, training)
            models = judge(fitted.predictor, data, JudgeSpec(baselines=names), "").scores["models"]
            return {name: models[name]["overall"][str(horizon)]["mean"]["mae"] for name in names}

        return self._kept(f"baselines k={horizon}", measure)


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


def chosen_rivals(league: League, arguments: argparse.Namespace) -> list[Contender]:
    """Each of the thesis's networks with the rate that validates better at one horizon, with the first seed."""
    first = [arguments.rate_at]
    cells = {rival: league.cell(rival, first, arguments.budget) for rival in arguments.rivals}
    families = sorted({rival.family for rival in cells})
    return [
        min((rival for rival in cells if rival.family == family), key=lambda rival: cells[rival]["validation"])
        for family in families
    ]


def equal_time(
    league: League, horizon: int, rivals: list[Contender], arguments: argparse.Namespace, limit: float
) -> dict[str, Any]:
    """All contenders at one horizon after the same processor time."""
    return {
        "ours": league.cell(OURS, [horizon], arguments.budget),
        "baselines": league.baselines(horizon, arguments.baselines),
        "limit": limit,
        "rivals": {rival.family: league.cell(rival, [horizon], arguments.budget) for rival in rivals},
    }


def at_convergence(
    league: League, horizon: int, rivals: list[Contender], arguments: argparse.Namespace
) -> dict[str, Any]:
    """The teacher until it gets no better, and ours in a tenth of that time."""
    teacher = next(rival for rival in rivals if rival.family == TEACHER)
    grown = league.cell(teacher, [horizon], arguments.cap, patience=12)
    return {"converged": grown, "ours_tenth": league.cell(OURS, [horizon], round(grown["cpu_s"] / 10))}


def show_horizon(horizon: int, found: dict[str, Any]) -> None:
    """Print the table of a horizon."""
    key, ridge, limit = str(horizon), found["baselines"]["ridge_arx"], found["limit"]
    rows = [("ours", found["ours"]), *((f"{family} (window)", cell) for family, cell in found["rivals"].items())]
    if "converged" in found:
        rows += [(f"{TEACHER}, converged", found["converged"]), ("ours, a tenth of its time", found["ours_tenth"])]
    if "ours_long" in found:
        rows += [("ours, long", found["ours_long"])]
    print(f"\nk = {horizon}: held-out mean absolute error, mm/s; the limit is {limit:.3g}")
    lines = [
        [name, cell["mae"][key], cell["cpu_s"], cell["parameters"], closed(cell["mae"][key], ridge, limit)]
        for name, cell in rows
    ]
    lines += [[name, mae, "-", "-", closed(mae, ridge, limit)] for name, mae in found["baselines"].items()]
    table(["model", "MAE", "processor s", "parameters", "gap closed"], sorted(lines, key=lambda line: line[1]))


def closed(mae: float, ridge: float, limit: float) -> float:
    """Share of the gap between ridge ARX and the limit of predictability that a model closes."""
    return (ridge - mae) / (ridge - limit)


def verdicts_of(found: dict[int, dict[str, Any]], joint: dict[str, float] | None, quick: bool) -> Iterator[Verdict]:
    """Every goal that this run can speak to."""
    for horizon, cells in found.items():
        ours, key = cells["ours"], str(horizon)
        teacher = cells["rivals"][TEACHER]
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
        if horizon == GAP_AT:
            best = min(ours["mae"][key], cells.get("ours_long", ours)["mae"][key])
            share = closed(best, cells["baselines"]["ridge_arx"], cells["limit"])
            yield verdict(f"share of ridge-to-limit gap closed at k={GAP_AT}", share, 1.0, ">= 0.8", "1", quick)
            yield verdict(
                "parameters against the teacher's", ours["parameters"], teacher["parameters"], "<= 0.25", "1", quick
            )
        if "converged" in cells:
            yield verdict(
                f"{name}, a tenth of the time, against the converged teacher",
                cells["ours_tenth"]["mae"][key], cells["converged"]["mae"][key], "<= 0.95", "mm/s", quick,
            )  # fmt: skip
        if joint is not None:
            yield verdict(f"{name}, one net for all horizons", joint[key], ours["mae"][key], "<= 1.02", "mm/s", quick)


def limits_of(folder: Path, order: SimulationOrder, horizons: list[int], quick: bool) -> dict[int, float]:
    """The limit of predictability at each horizon, mm/s, mean over the cylinders."""
    spec = LimitSpec(horizons=tuple(horizons), **({"moments": 8, "branches": 4} if quick else {}))
    name = f"limit_k={'_'.join(map(str, horizons))}.json"
    found = kept(folder.parent / name, lambda: find_data_set_limit(folder, order, spec))
    return {k: float(row[-1]) for k, row in zip(found["horizons"], found["commands_unknown"]["mae"], strict=True)}


def run(arguments: argparse.Namespace, folder: Path) -> None:
    """The whole league in `folder`."""
    quick, horizons = arguments.quick, arguments.horizons
    data = arguments.data or folder / "data"
    minutes, recordings = (6.0, 6) if quick else (arguments.minutes, int(arguments.minutes / 3))
    order = SimulationOrder(minutes=minutes, recordings=recordings, seed=arguments.seed)
    simulate_data_set(data, order)
    limits = limits_of(data, order, sorted(horizons), quick)
    joints: list[dict[str, float]] = []
    rounds: list[dict[int, dict[str, Any]]] = []
    leagues = [
        League(DataSource.of(data), make_folder(folder / "cells"), seed, 2 if quick else LOOKS)
        for seed in range(arguments.seed, arguments.seed + arguments.seeds)
    ]
    rivals = chosen_rivals(leagues[0], arguments)
    for league in leagues:
        found = {k: equal_time(league, k, rivals, arguments, limits[k]) for k in horizons}
        if len(horizons) > 1:
            alone = league.cell(JOINT, sorted(horizons), arguments.budget)["mae"]
            joints.append(league.cell(JOINT, sorted(horizons), arguments.budget * len(horizons))["mae"])
            print("one net for all horizons:", joints[-1], "in the time of one specialist:", alone)
        for horizon in (k for k in arguments.converge if k in horizons):
            found[horizon] |= at_convergence(league, horizon, rivals, arguments)
        if arguments.long and GAP_AT in horizons:
            found[GAP_AT]["ours_long"] = league.cell(OURS, [GAP_AT], arguments.long)
        for horizon, cells in found.items():
            show_horizon(horizon, cells)
        rounds.append(found)
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
    made.add_argument("--budget", type=float, default=300.0, help="processor seconds of each training")
    made.add_argument("--minutes", type=float, default=600.0, help="minutes of simulated recordings")
    made.add_argument("--horizons", type=int, nargs="+", default=[1, 10, 20, 50])
    made.add_argument("--seeds", type=int, default=3)
    made.add_argument("--rate-at", type=int, default=10, help="horizon at which the rivals' rates are chosen")
    made.add_argument("--converge", type=int, nargs="*", default=[10], help="horizons with a teacher at convergence")
    made.add_argument("--cap", type=float, default=3600.0, help="longest training to convergence, processor seconds")
    made.add_argument("--long", type=float, default=3600.0, help="ours once more, processor seconds; 0 for not")
    made.set_defaults(rivals=RIVALS, baselines=BASELINES)
    arguments = made.parse_args()
    if arguments.quick:
        short = {"budget": 1.0, "horizons": [10], "seeds": 1, "converge": [], "long": 0.0}
        vars(arguments).update(short | {"rivals": RIVALS[-1:], "baselines": BASELINES[:2]})
    in_folder(arguments.work, lambda work: run(arguments, work))


if __name__ == "__main__":
    main()
