"""How accurate is the demo's network on held-out recordings, against ridge ARX and persistence in the same run?

The very commands of `edp demo` are used: simulate machine M22, train with the preset `quick`, judge. Trained once for
k = 10 (100 ms) and once for k = 1 (10 ms).
"""

from __future__ import annotations

import time
from pathlib import Path

from common import DATA, Bench, benchmark, table
from edp.cli.demo import MINUTES, RECORDINGS
from edp.config.experiment import load_experiment
from edp.storage import read_json
from edp.workflows.train_evaluate import DataSource, SimulationOrder, evaluate, simulate_data_set, train

BASELINES = ("persistence", "ridge_arx", "boosted_trees", "small_mlp")


def run(folder: Path, data: Path, horizon: int, seed: int, quick: bool) -> dict[str, dict[str, float]]:
    """Mean scores of every model at `horizon`, with the seconds that each took."""
    changes = [f"task.horizons=[{horizon}]", f"training.seed={seed}", f"split.seed={seed}"]
    changes += ["training.epochs=4", "training.updates=60"] if quick else []
    out = folder / f"run_k{horizon}"
    train(DataSource.from_path(data), load_experiment(None, "quick", changes), out)
    evaluate(out, baselines=BASELINES[:2] if quick else BASELINES)
    models = read_json(out / "scores.json")["models"]
    return {
        name: {**model["overall"][str(horizon)]["mean"], "seconds": model["seconds"]} for name, model in models.items()
    }


@benchmark(DATA)
def main(bench: Bench) -> object:
    quick, seed = bench.quick, bench.seed
    folder, data = bench.folder, bench.data
    began = time.perf_counter()
    minutes, recordings = (8.0, 8) if quick else (MINUTES, RECORDINGS)
    simulate_data_set(data, SimulationOrder(minutes=minutes, recordings=recordings, seed=seed))
    print(f"simulated in {time.perf_counter() - began:.1f} s")
    details = {}
    for horizon, goals in ((10, {"ridge_arx": 0.6, "persistence": 0.4}), (1, {"ridge_arx": 0.9})):
        found = run(folder, data, horizon, seed, quick)
        details[f"k={horizon}"] = found
        print(f"\nk = {horizon}, held-out recordings, mean over three cylinders, mm/s")
        keys = ("mae", "rmse", "p95", "p99", "composite", "r2", "seconds")
        rows = sorted(found.items(), key=lambda item: item[1]["mae"])
        table(["model", *keys], [[name, *(scores[key] for key in keys)] for name, scores in rows])
        for rival, goal in goals.items():
            ours, theirs = (found[name]["mae"] for name in ("network", rival))
            bench.check(f"MAE at k={horizon} against {rival}", ours, theirs, f"<= {goal}", "mm/s")
    return details


if __name__ == "__main__":
    main()
