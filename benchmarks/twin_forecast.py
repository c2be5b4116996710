"""How much of the gap to the limit of predictability does a grey box close that looks ahead, with a network behind it?

Machine M22 in free air. A grey box that is told the linkage is fitted to training recordings; forecasts of it, by an
observer and with the commands held, become channels of the logs, which a network of the preset ``standard`` reads.
Beside it the same network without forecasts, which trains for as long as fit, forecasts and network take together,
ridge ARX and persistence; all on the same held-out recordings. All read what the grey box reads, velocities, strokes,
pressures and pilots, and the accelerations, but no channel that a simulation alone knows. The limit is that of
futures from the true state, with the commands unknown. A smaller network on the forecasts, which a controller has room
for, is judged in float and in integer arithmetic (W8A16).

The simulator has the structure of the grey box, which flatters it.
"""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import Any

from common import WORK, Bench, benchmark, option, table
from edp.config.experiment import Experiment, load_experiment
from edp.config.twin import load_twin_experiment
from edp.data.prepared import Prepared
from edp.evaluation.footprint import footprint
from edp.evaluation.judge import JudgeSpec, judge
from edp.export.c.sizes import constant_bytes
from edp.logs.source import DataSource
from edp.networks.integer import integer_predictor
from edp.networks.predictor import Predictor
from edp.networks.twin import fit_scales
from edp.networks.twin.greybox import GreyFitSpec
from edp.settings.provenance import DataOrigin, Provenance
from edp.signals import TABLE_A1
from edp.sim.data_set import SimulationOrder, find_data_set_limit, simulate_data_set
from edp.sim.predictability import LimitSpec
from edp.training.fit import fit
from edp.training.twin_bundle import TwinBundle, save_twin
from edp.workflows.train_evaluate import prepare_data
from edp.workflows.twin import forecast_logs
from edp.workflows.twin.forecast_logs import AHEAD
from edp.workflows.twin.prepare_twin import prepare_twin
from twin import QUICK_FIT, fitted_linkage

HORIZONS = (1, 10, 20)
GOALS = {1: 0.75, 10: 0.90, 20: 0.80}
"""Share of the gap from ridge ARX to the limit that is to be closed, by horizon."""
SOON = 0.83
"""The same at ten ticks after five minutes of processor time, which the grey box alone has."""
LOOKS = 6
VALIDATED = 4
"""Recordings that validate: a look at all of them would cost as much as training."""
SMALL = 60
"""Channels and units of the smaller network: the widest multiple of four whose constants take 100,000 bytes."""
MOST_PARAMETERS, MOST_BYTES = 166_000, 100_000
BYPASS_OF = (
    'model.blocks=[{{kind="temporal_difference"}},'
    ' {{kind="linear_bypass", taps={taps}, start="crossed", trained=false}}]'
)
MEASURED = (*TABLE_A1, "PumpPressure_1", "PumpPressure_2", "CylStroke_1", "CylStroke_2", "CylStroke_3")
"""Spools, displacements, joint rates and events, which stand in the same logs, no sensor of a machine shows."""
TARGETS = ("CylVels_1", "CylVels_2", "CylVels_3")
CHANGES = (
    *("training.loss.delta=0.1", "training.horizon_decay=0.6", "training.threads=1"),
    # Both start from a ridge regression: on forecasts alone it is hard to better.
    BYPASS_OF.format(taps=20),
)


@benchmark(
    WORK,
    option("--minutes", type=float, default=90.0, help="of recordings of 3 min each"),
    option("--budget", type=float, default=300.0, help="processor seconds of the network on forecasts"),
)
def main(bench: Bench) -> object:
    quick, seed, work = bench.quick, bench.seed, bench.folder
    minutes, budget = (1.0, 0.5) if quick else (bench.options.minutes, bench.options.budget)
    logs, ahead = work / "logs", work / "ahead"
    order = SimulationOrder(minutes=minutes, recordings=6 if quick else round(minutes / 3), seed=seed + 1)
    simulate_data_set(logs, order)
    spec = LimitSpec(horizons=HORIZONS, **({"moments": 8, "branches": 4} if quick else {}))
    limit = bench.part("limit", lambda: find_data_set_limit(logs, order, spec).to_table())
    limits = {k: float(row[-1]) for k, row in zip(limit["horizons"], limit["commands_unknown"]["mae"], strict=True)}
    twin = bench.part("twin", lambda: forecasts(logs, ahead, work / "grey", seed, quick))
    settings, settings_ahead = experiment(seed, quick), experiment(seed, quick, ahead=True)
    plain = prepare_data(DataSource.from_path(logs), settings)
    extended = prepare_data(DataSource.from_path(ahead), settings_ahead)
    if [s.name for s in plain.test] != [s.name for s in extended.test] or sorted(twin["test"]) != sorted(
        s.name for s in plain.test
    ):
        raise SystemExit("the three divisions of the recordings differ; nothing can be compared")
    before = twin["fit_s"] + twin["forecast_s"]
    rows = {"grey box, looks ahead": {"mae": forecast_error(extended), "seconds": twin["fit_s"]}}
    rows["network on its forecasts"] = bench.part("extended", lambda: trained(extended, settings_ahead, budget, before))
    rows["network without them"] = bench.part(
        "plain", lambda: trained(plain, settings, rows["network on its forecasts"]["seconds"], 0.0)
    )
    small = bench.part("small", lambda: trained(extended, smaller(settings_ahead), budget / 2, before, True))
    rows["smaller network on its forecasts"] = small
    rows["the same in W8A16"] = {"mae": small["integer"], "seconds": small["seconds"]}
    rows["ridge ARX on its forecasts"] = {"mae": rows["network on its forecasts"]["ridge_arx"], "seconds": before}
    rows["ridge ARX"] = {"mae": rows["network without them"]["ridge_arx"], "seconds": 0.0}
    rows["persistence"] = {"mae": rows["network without them"]["persistence"], "seconds": 0.0}
    check(bench, rows, limits)
    return {"limits": limits, "twin": twin, "models": rows}


def closed(mae: float, ridge: float, limit: float) -> float:
    """Share of the gap between ridge ARX and the limit of predictability that a model closes."""
    return (ridge - mae) / (ridge - limit)


def update_cost(data: Prepared, settings: Experiment) -> float:
    """Processor seconds of an update, from short trainings that are thrown away."""
    short = replace(data, validation=data.validation[:1])

    def seconds(updates: int) -> float:
        began = time.process_time()
        fit(short, settings.model, replace(settings.training, epochs=1, updates=updates))
        return time.process_time() - began

    seconds(1)  # the first call of all pays for start-up
    fixed, updates = seconds(1), 8
    while (spent := seconds(updates) - fixed) < 0.5:
        updates *= 2
    return spent / (updates - 1)


def experiment(seed: int, quick: bool, ahead: bool = False) -> Experiment:
    """Of the network without forecasts, or with them where `ahead` asks for them."""
    # Regressions on 50 ticks of all channels alone would take more than the short form's minute.
    short = ("evaluation.history=8", BYPASS_OF.format(taps=8)) if quick else ()
    forecast = tuple(f"{target}{AHEAD}{k}" for k in HORIZONS for target in TARGETS) if ahead else ()
    channels = f"task.features={{name='measured', channels={[*MEASURED, *forecast]}}}"
    changes = [*CHANGES, *short, channels, f"task.horizons={list(HORIZONS)}", f"training.seed={seed}"]
    return load_experiment(None, "quick" if quick else "standard", changes)


def smaller(settings: Experiment) -> Experiment:
    """Return the settings with fewer channels and units."""
    backbone = replace(settings.model.backbone, channels=(SMALL,), units=SMALL)
    return replace(settings, model=replace(settings.model, backbone=backbone))


def forecasts(logs: Path, ahead: Path, grey: Path, seed: int, quick: bool) -> dict[str, Any]:
    """Fit the grey box, write the logs anew; processor seconds of both, and the recordings that no fit saw."""
    settings = load_twin_experiment(None, ("twin.kind=greybox",))
    channels, data = prepare_twin(DataSource.from_path(logs), settings)
    spec = QUICK_FIT if quick else GreyFitSpec(ticks=5000, starts=1)
    twin, seconds = fitted_linkage((channels, fit_scales(channels, data.train), data), seed, spec)
    names = {part: [s.name for s in getattr(data, part)] for part in ("train", "validation", "test")}
    save_twin(TwinBundle(twin.spec, twin, Provenance(data=DataOrigin(names=names))), grey)
    began = time.process_time()
    # The choice of a gain alone would take a quarter of the short form's minute.
    written = forecast_logs(grey, DataSource.from_path(logs), HORIZONS, ahead, gain=0.3 if quick else None)
    return {
        "fit_s": seconds,
        "forecast_s": time.process_time() - began,
        "gain": written.gain,
        "numbers": len(twin.numbers),
        "test": names["test"],
    }


def forecast_error(data: Prepared) -> dict[str, float]:
    """Mean absolute error of the forecasts as they stand in the logs, by horizon, mm/s."""
    names, errors = [channel.name for channel in data.inputs], {}
    for k in HORIZONS:
        columns = [names.index(f"{target}{AHEAD}{k}") for target in data.task.targets]
        parts = [abs(s.inputs[:-k, columns] - s.targets[k:]).mean(axis=0) * (s.samples - k) for s in data.test]
        errors[str(k)] = 1e3 * float(sum(parts).mean() / sum(s.samples - k for s in data.test))
    return errors


def trained(
    data: Prepared, settings: Experiment, budget_s: float, before_s: float, rounded: bool = False
) -> dict[str, Any]:
    """Train for a budget of processor seconds counted in updates, and judge; in integer arithmetic too if asked."""
    cost = update_cost(data, settings)
    updates = max(1, int(budget_s / cost / LOOKS))
    short = replace(data, validation=data.validation[:VALIDATED])
    training = replace(settings.training, epochs=LOOKS, updates=updates)
    net = fit(short, settings.model, training).predictor
    rivals = () if rounded else ("persistence", "ridge_arx")
    errors = judged(net, data, replace(settings.evaluation, baselines=rivals))
    found: dict[str, Any] = {"mae": errors.pop("network"), **errors, "updates": LOOKS * updates}
    found |= {"cost_of_update_s": cost, "parameters": footprint(net).parameters}
    if rounded:
        integers = integer_predictor(net, data.train)
        found["integer"] = judged(integers, data, replace(settings.evaluation, baselines=()))["network"]
        found["bytes"] = constant_bytes(integers.integers, None)
    print(f"{LOOKS * updates} updates of {cost:.3f} s: {found['mae']}", flush=True)
    return found | {"seconds": before_s + LOOKS * updates * cost}


def judged(net: Predictor, data: Prepared, spec: JudgeSpec) -> dict[str, dict[str, float]]:
    """Mean absolute error of the network and of baselines by horizon, mm/s."""
    models = judge(net, data, spec, "network").scores["models"]
    return {name: {str(k): row["overall"][str(k)]["mean"]["mae"] for k in HORIZONS} for name, row in models.items()}


def check(bench: Bench, rows: dict[str, Any], limits: dict[int, float]) -> None:
    """Print the table and add the verdicts."""
    ridge = {k: rows["ridge ARX"]["mae"][str(k)] for k in HORIZONS}
    share = {name: {k: closed(row["mae"][str(k)], ridge[k], limits[k]) for k in HORIZONS} for name, row in rows.items()}
    lines = [
        [name, row["seconds"], *(x for k in HORIZONS for x in (row["mae"][str(k)], f"{share[name][k]:.0%}"))]
        for name, row in rows.items()
    ]
    lines.append(["limit of predictability", 0.0, *(x for k in HORIZONS for x in (limits[k], "100%"))])
    table(["mm/s", "processor s", *(x for k in HORIZONS for x in (f"k = {k}", "gap closed"))], lines)
    alone, network = "grey box, looks ahead", "network on its forecasts"
    for k, goal in GOALS.items():
        best = max(share[network][k], share[alone][k])
        bench.check(f"share of the gap closed at k = {k}", best, 1.0, f">= {goal}", "1")
    name = "share of the gap closed at k = 10 by the grey box alone"
    bench.check(name, share[alone][10], 1.0, f">= {SOON}", "1")
    bench.check("processor time of the grey-box fit", rows[alone]["seconds"], 300.0, "<= 1", "s")
    small = rows["smaller network on its forecasts"]
    bench.check("parameters of the smaller network", small["parameters"], MOST_PARAMETERS, "<= 1", "1")
    bench.check("constants of the smaller network in W8A16", small["bytes"], MOST_BYTES, "<= 1", "bytes")
    for k, goal in GOALS.items():
        whole, floats = small["integer"][str(k)], rows[network]["mae"][str(k)]
        bench.check(
            f"share of the gap closed at k = {k}, smaller network in W8A16",
            share["the same in W8A16"][k],
            1.0,
            f">= {goal}",
            "1",
        )
        bench.check(
            f"MAE at k = {k}, smaller network in W8A16 against the network in float", whole, floats, "<= 1.05", "mm/s"
        )
    mae = (rows[name]["mae"]["10"] for name in (network, "network without them"))
    bench.check("MAE at k = 10 with forecasts against without, equal time", *mae, "<= 0.8", "mm/s")


if __name__ == "__main__":
    main()
