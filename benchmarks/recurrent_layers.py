"""Which recurrent layer of the hybrid predicts best after the same processor time?

Every layer trains for as many updates as fit into the budget at its own measured speed, with the learning-rate
schedule stretched over them; error on held-out recordings, same data and seeds for all. One thread.
"""

from __future__ import annotations

import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from common import finish, parser, table, verdict
from edp.config.experiment import load_experiment
from edp.data.prepared import Prepared
from edp.networks.cells import CELLS
from edp.networks.streaming import parameters_of
from edp.training import fit
from edp.training.validation import validation_scores
from edp.workflows.train_evaluate import DataSource, SimulationOrder, prepare_data, simulate_data_set

EPOCHS = 6


def seconds_per_update(data: Prepared, model: Any, training: Any, updates: int) -> float:
    """Processor seconds of one update: a longer run less a shorter one, so that start and validation cancel."""
    spent = []
    for count in (updates, 4 * updates):
        began = time.process_time()
        fit(data, model, replace(training, epochs=1, updates=count))
        spent.append(time.process_time() - began)
    return (spent[1] - spent[0]) / (3 * updates)


def main() -> None:
    made = parser(__doc__ or "")
    made.add_argument("--cells", nargs="+", choices=list(CELLS), default=list(CELLS), help="layers beside the LSTM")
    made.add_argument("--budget", type=float, default=None, help="processor seconds of each run")
    arguments = made.parse_args()
    quick = arguments.quick
    cells = ["lstm", *(name for name in arguments.cells if name != "lstm")]
    budget = arguments.budget or (2.0 if quick else 60.0)
    seeds = 1 if quick else 2
    minutes, recordings = (8.0, 8) if quick else (40.0, 20)
    errors: dict[str, list[float]] = {name: [] for name in cells}
    facts: dict[str, dict[str, Any]] = {}
    with tempfile.TemporaryDirectory() as temporary:
        source = arguments.data or Path(temporary) / "data"
        simulate_data_set(source, SimulationOrder(minutes=minutes, recordings=recordings, seed=arguments.seed))
        experiment = load_experiment(None, "quick", [])
        data = prepare_data(DataSource.of(source), experiment)
        training = replace(experiment.training, patience=0, threads=1)
        fit(data, experiment.model, replace(training, epochs=1, updates=2))  # loads what the first run loads
        for name in cells:
            backbone = replace(experiment.model.backbone, cell=CELLS[name]())  # type: ignore[type-var]
            model = replace(experiment.model, backbone=backbone)
            cost = seconds_per_update(data, model, training, 4 if quick else 20)
            updates = max(1, round(budget / cost / EPOCHS))
            for seed in range(arguments.seed, arguments.seed + seeds):
                began = time.process_time()
                fitted = fit(data, model, replace(training, epochs=EPOCHS, updates=updates, seed=seed))
                spent = time.process_time() - began
                errors[name].append(validation_scores(fitted.predictor, data.test, training, data)[1])
                print(f"{name}, seed {seed}: {spent:.0f} processor s, test MAE {errors[name][-1]:.3f} mm/s", flush=True)
            facts[name] = {
                "parameters": parameters_of(fitted.predictor),
                "ms_per_update": 1e3 * cost,
                "updates": EPOCHS * updates,
                "processor_s": spent,
                "test_mae_mm_s": errors[name],
            }
    heads = ["recurrent layer", "parameters", "ms per update", "updates", "processor s", "test MAE, mm/s"]
    table(heads, [[name, *list(row.values())[:4], float(np.mean(errors[name]))] for name, row in facts.items()])
    plain = float(np.mean(errors["lstm"]))
    verdicts = [
        verdict(f"held-out MAE, {name} against the LSTM", float(np.mean(errors[name])), plain, "<= 1", "mm/s", quick)
        for name in cells[1:]
    ]
    finish("recurrent_layers", verdicts, arguments.seed, facts)


if __name__ == "__main__":
    main()
