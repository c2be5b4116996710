"""What do 8-bit weights cost a small network, and what does training with rounded numbers win back?

A teacher (preset `quick`) is pruned and distilled to a quarter of its width; that network is trained on three times for
the same updates: in float, with rounded weights and 16-bit activations, and with 8-bit activations. Each result is
judged on held-out recordings in float, in whole numbers (W8A16, weights of least error), with weights rounded to the
nearest and 16-bit activations, and the same with 8-bit activations.
"""

from __future__ import annotations

import copy
import tempfile
import time
from dataclasses import replace
from pathlib import Path

from common import finish, parser, table, verdict
from edp.config.experiment import load_experiment
from edp.data.prepared import Prepared
from edp.evaluation.controller import Budget
from edp.evaluation.judge import score_predictions
from edp.networks.narrow import student
from edp.networks.predictor import Predictor
from edp.networks.running import stream_predictions
from edp.training import fit
from edp.workflows.compression import (
    Distillation,
    NetworkRounding,
    QuantisationAware,
    RoundingSpec,
    deploy,
    prune,
    tuning,
)
from edp.workflows.train_evaluate import DataSource, SimulationOrder, prepare_data, simulate_data_set

FORMS = ("float32", "w8a16", "nearest, 16 bits", "nearest, 8 bits")


def errors(network: Predictor, data: Prepared) -> dict[str, float]:
    """Mean absolute error at the longest horizon on the held-out recordings, mm/s, by form."""
    said = {name: deploy(network, name, data.train, Budget()).predict(data.test) for name in FORMS[:2]}
    for name, bits in zip(FORMS[2:], (16, 8), strict=True):
        made = copy.deepcopy(network)
        NetworkRounding(made, bits).install(data.train)
        said[name] = stream_predictions(made, data.test)
    last = str(data.task.horizons[-1])
    skip = network.spec.window
    return {name: score_predictions(found, data, skip)["overall"][last]["mean"]["mae"] for name, found in said.items()}


def main() -> None:
    made = parser(__doc__ or "")
    made.add_argument("--minutes", type=float, default=8.0, help="of simulated recordings")
    made.add_argument("--updates", type=int, default=400, help="of the teacher and of its student")
    arguments = made.parse_args()
    quick, seed = arguments.quick, arguments.seed
    with tempfile.TemporaryDirectory() as temporary:
        folder = arguments.data or Path(temporary) / "data"
        if not folder.exists():
            minutes = 3.0 if quick else arguments.minutes
            simulate_data_set(folder, SimulationOrder(minutes=minutes, recordings=8, seed=seed))
        updates = 20 if quick else arguments.updates
        changes = [f"training.seed={seed}", f"split.seed={seed}", "training.epochs=4"]
        changes += [f"training.updates={max(1, updates // 4)}"]
        experiment = load_experiment(None, "quick", changes)
        data = prepare_data(DataSource.of(folder), experiment)
    training = experiment.training
    teacher = fit(data, experiment.model, training).predictor
    model = student(teacher.spec, units=16, levels=1)
    small = fit(
        data, model, training, strategy=Distillation([teacher], start=prune(teacher, model, data.train))
    ).predictor
    strategy = Distillation([teacher])
    further = {
        "float": Distillation([teacher], start=small),
        "rounded, 16 bits": QuantisationAware(small, strategy),
        "rounded, 8 bits": QuantisationAware(small, strategy, RoundingSpec(activation_bits=8)),
    }
    found = {"before": errors(small, data)}
    for name, way in further.items():
        began = time.process_time()
        spec = replace(tuning(training), epochs=2)
        found[f"trained on in {name}"] = errors(fit(data, model, spec, strategy=way).predictor, data)
        print(f"{name}: {time.process_time() - began:.0f} processor s", flush=True)
    table(["network", *FORMS], [[name, *row.values()] for name, row in found.items()])
    plain, rounded = (found[f"trained on in {name}"] for name in ("float", "rounded, 16 bits"))
    verdicts = [
        verdict("W8A16 against float, trained in float", plain["w8a16"], plain["float32"], "<= 1.002", "mm/s", quick),
        verdict("W8A16, trained rounded or in float", rounded["w8a16"], plain["w8a16"], "<= 1.0", "mm/s", quick),
    ]
    finish("rounding_training", verdicts, seed, found)


if __name__ == "__main__":
    main()
