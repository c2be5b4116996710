"""How far is the bucket tip off in closed loop, and does tuning on a model carry over to the plant?

Machine M22 in free air, six lines on which nothing was tuned. PI with feed-forward through the measured valve map
against the inversion of a look-ahead predictor and of a twin; then with oil at 65 degC, dead bands 3 points wider, and
noise of velocities and pressures five times as large, all with the models of the plant as it was. The score is the
position error to the reference of the same time; the distance to the path stands beside it. Part o4 asks whether gains
that are better on a twin, a static valve map or ARX are better on the plant.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from common import Verdict, finish, in_folder, parser, table, verdict
from edp.config.control import ControlExperiment
from edp.config.experiment import load_experiment
from edp.config.twin import load_twin_experiment
from edp.control.controllers import CONTROLLERS
from edp.control.models import ControlModels
from edp.control.tasks import TASKS
from edp.logs.source import DataSource
from edp.sim.data_set import SimulationOrder, simulate_data_set
from edp.sim.machine.machine_checks import MACHINE_FILE
from edp.sim.machine.machine_files import load_machine
from edp.workflows.control import ControlBench, ControlSources
from edp.workflows.control.transfer_of_tuning import TransferSpec, TuningTransfer, costs_of, drawn_settings
from edp.workflows.train_evaluate import train
from edp.workflows.twin import train_twin

MACHINE = "M22"
LEAD_TICKS = 20
DEAD_BAND = 0.03
NOISE = 5.0
NOISY = ("velocity", "pressure", "joint_rate_deg")
O4_SEED = 500_000
"""First seed of the lines of part o4, which are neither those of the judgement nor those of a tuning."""


@dataclass(frozen=True)
class Size:
    """How much is simulated, trained and run."""

    minutes: float
    recordings: int
    lines: int
    variants: int
    settings: int
    o4_lines: int
    predictor: tuple[str, ...]
    twin: tuple[str, ...]


FULL = Size(90.0, 45, 6, 4, 40, 3, (), ("twin.kind=recurrent", "twin.units=48", "training.updates=[600,600,400,200]"))
QUICK = Size(
    *(3.0, 6, 1, 2, 3, 1),
    ("training.epochs=1", "training.updates=20"),
    ("twin.kind=recurrent", "twin.units=8", "training.lengths_s=[0.1,0.3]", "training.updates=[20,20]"),
)


def main() -> None:
    arguments_of = parser(__doc__ or "")
    arguments_of.add_argument("--part", choices=["all", "lines", "o4"], default="all")
    arguments = arguments_of.parse_args()
    size = QUICK if arguments.quick else FULL
    verdicts: list[Verdict] = []
    details: dict[str, Any] = {"size": asdict(size)}

    def measure(folder: Path) -> None:
        runs = trained(folder, size, arguments.seed)
        if arguments.part in ("all", "lines"):
            details["lines"] = rows = lines(folder, runs, size)
            verdicts.extend(line_verdicts(rows, arguments.quick))
        if arguments.part in ("all", "o4"):
            details["o4"] = rows = tuning(runs, size, arguments.seed)
            verdicts.extend(tuning_verdicts(rows, arguments.quick))

    in_folder(arguments.data, measure)
    name = "closed_loop" if arguments.part == "all" else f"closed_loop_{arguments.part}"
    finish(name, verdicts, arguments.seed, details)


def trained(folder: Path, size: Size, seed: int) -> dict[str, Path]:
    """Run folders of the models: ``predictor``, ``twin``, ``static`` and ``arx``; finished ones are read."""
    source = folder / "data"
    order = SimulationOrder(minutes=size.minutes, recordings=size.recordings, seed=seed + 11)
    simulate_data_set(source, order)
    changes = (f"task.horizons=[{LEAD_TICKS}]", "training.threads=1", *size.predictor)
    train(DataSource.of(source), load_experiment(None, "quick", changes), folder / "predictor")
    for name, settings in {"twin": size.twin, "static": ("twin.kind=static",), "arx": ("twin.kind=arx",)}.items():
        train_twin(DataSource.of(source), load_twin_experiment(None, settings), folder / name)
    return {name: folder / name for name in ("predictor", "twin", "static", "arx")}


def lines(folder: Path, runs: Mapping[str, Path], size: Size) -> dict[str, dict[str, Any]]:
    """Figures by variant and controller: errors a line, lever travel and times."""
    pi, inversion = CONTROLLERS["pi"](), CONTROLLERS["inversion"]()
    experiment = ControlExperiment(task=TASKS["grade"](), controller=pi, machine=MACHINE, loops=size.lines)
    known = ControlBench(experiment, ControlSources(twin=runs["twin"], predictor=runs["predictor"])).models
    contenders = {
        "pi": (pi, known),
        "inversion of a predictor": (inversion, ControlModels(predictor=known.predictor)),
        "inversion of a twin": (inversion, ControlModels(twin=known.twin)),
    }
    wider = wider_dead_band(folder)
    sensors = asdict(load_machine(MACHINE).sensors)
    variants: dict[str, tuple[str, dict[str, Any]]] = {
        "as it was": (MACHINE, {}),
        "oil at 65 degC": (MACHINE, {"oil_temperature": 65.0}),
        "dead bands 3 points wider": (str(wider), {}),
        "noise five times as large": (MACHINE, {"sensors": {name: NOISE * sensors[name] for name in NOISY}}),
    }
    rows: dict[str, dict[str, Any]] = {}
    for variant, (machine, options) in list(variants.items())[: size.variants]:
        rows[variant] = {}
        for name, (spec, models) in contenders.items():
            bench = ControlBench(replace(experiment, machine=machine), ControlSources(), models, options)
            results = bench.results(spec)
            scores = [result.score for result in results]
            times = 1e6 * np.concatenate([result.solve_s for result in results])
            rows[variant][name] = {
                "position_rms_mm": [score.position_rms_mm for score in scores],
                "position_p95_mm": [score.position_p95_mm for score in scores],
                "path_rms_mm": [score.path_rms_mm for score in scores],
                "attitude_rms_deg": [score.attitude_rms_deg for score in scores],
                "lever_travel": [score.lever_travel for score in scores],
                "energy_kj": [score.energy_kj for score in scores],
                "violations": sum(sum(score.violations.values()) for score in scores),
                "step_us": {"median": float(np.median(times)), "p99": float(np.percentile(times, 99.0))},
            }
    show_lines(rows)
    return rows


def wider_dead_band(folder: Path) -> Path:
    """A machine file of M22 with wider dead bands of the main spools."""
    machine = load_machine(MACHINE)
    valves = machine.valves
    bands = {
        name: tuple(band + DEAD_BAND for band in getattr(valves, name))
        for name in ("dead_band_extend", "dead_band_retract")
    }
    path = folder / "wider.toml"
    path.write_text(tomli_w.dumps(MACHINE_FILE.plain(replace(machine, valves=replace(valves, **bands)))))
    return path


def show_lines(rows: Mapping[str, Mapping[str, Any]]) -> None:
    heads = ["variant", "controller", "position, mm", "worst line", "path, mm", "attitude, deg", "levers", "step, us"]
    printed = [
        [
            variant, name, mean(row["position_rms_mm"]), max(row["position_rms_mm"]), mean(row["path_rms_mm"]),
            mean(row["attitude_rms_deg"]), mean(row["lever_travel"]), row["step_us"]["median"],
        ]
        for variant, by_name in rows.items()
        for name, row in by_name.items()
    ]  # fmt: skip
    table(heads, printed)


def line_verdicts(rows: Mapping[str, Mapping[str, Any]], quick: bool) -> list[Verdict]:
    verdicts = []
    for variant, by_name in rows.items():
        rival = mean(by_name["pi"]["position_rms_mm"])
        for name, row in by_name.items():
            if name != "pi":
                ours = mean(row["position_rms_mm"])
                verdicts.append(verdict(f"{name} against pi, {variant}", ours, rival, "<= 0.6", "mm", quick))
    return verdicts


def tuning(runs: Mapping[str, Path], size: Size, seed: int) -> dict[str, dict[str, Any]]:
    """Costs of drawn gains of PI on models and on the plant; all know the valve map that was measured on the plant."""
    experiment = ControlExperiment(
        task=TASKS["grade"](), controller=CONTROLLERS["pi"](), machine=MACHINE, loops=size.o4_lines, seed=O4_SEED
    )
    plant = ControlBench(experiment, ControlSources())
    settings = drawn_settings(experiment.controller, TransferSpec(size.settings, seed))
    on_plant = costs_of(plant, settings)
    rows: dict[str, dict[str, Any]] = {}
    for name in ("twin", "static", "arx"):
        model = ControlBench(experiment, ControlSources(plant=runs[name]), plant.models)
        transfer = TuningTransfer(costs_of(model, settings), on_plant)
        rows[name] = {
            "rank_correlation": transfer.rank_correlation,
            "regret": transfer.regret,
            "on_model_mm": transfer.on_model.tolist(),
            "on_plant_mm": on_plant.tolist(),
        }
    shown = [[name, row["rank_correlation"], row["regret"], min(row["on_model_mm"])] for name, row in rows.items()]
    table(["gains of pi tuned on", "rank correlation", "cost of its best over the best", "least cost, mm"], shown)
    print(f"least cost on the plant: {on_plant.min():.1f} mm")
    return rows


def tuning_verdicts(rows: Mapping[str, Mapping[str, Any]], quick: bool) -> list[Verdict]:
    ours, rival = rows["twin"], rows["static"]
    name = "o4: cost on the plant of the gains that the twin calls best, over the least cost"
    return [
        verdict("o4: rank correlation of costs on the twin", ours["rank_correlation"], 1.0, ">= 0.8", "1", quick),
        verdict(name, ours["regret"], 1.0, "<= 1.1", "1", quick),
        verdict(f"{name}, against the static map's", ours["regret"], rival["regret"], "<= 1", "1", quick),
    ]


def mean(values: list[float]) -> float:
    return float(np.mean(values))


if __name__ == "__main__":
    main()
