"""What does a smaller network lose, and what do a teacher, a hint and a start from the pruned teacher win back?

A teacher (preset `quick`) and its students are trained in the same run on the same simulated recordings, for the same
number of updates each. Scores are of held-out recordings; cycles are estimates (docs/compress.md).
"""

from __future__ import annotations

import tempfile
import time
from dataclasses import replace
from pathlib import Path

from common import finish, parser, table, verdict
from edp.config.experiment import load_experiment
from edp.data.prepared import Prepared
from edp.evaluation.footprint import footprint
from edp.evaluation.judge import JudgeSpec, judge
from edp.networks.narrow import student
from edp.networks.predictor import Predictor
from edp.training import TrainingSpec, fit
from edp.workflows.compression import Distillation, DistillationSpec, dynamic_int8, prune
from edp.workflows.train_evaluate import DataSource, SimulationOrder, prepare_data, simulate_data_set


def error(predictor: Predictor, data: Prepared) -> float:
    """Mean absolute error at the longest horizon on the held-out recordings, mm/s."""
    scores = judge(predictor, data, JudgeSpec(baselines=()), "network").scores
    return float(scores["models"]["network"]["overall"][str(data.task.horizons[-1])]["mean"]["mae"])


def ways(teacher: Predictor, data: Prepared, training: TrainingSpec, units: int) -> dict[str, tuple[Predictor, float]]:
    """Each smaller network by the way it was made, and the processor seconds that took."""
    model = student(teacher.spec, units)
    made: dict[str, tuple[Predictor, float]] = {"teacher, dynamic int8": (dynamic_int8(teacher).predictor, 0.0)}
    began = time.process_time()
    pruned = prune(teacher, model, data.train)
    made["pruned, not trained on"] = (pruned, time.process_time() - began)
    lessons = {
        "student": None,
        "distilled": Distillation([teacher]),
        "distilled, teacher alone": Distillation([teacher], DistillationSpec(truth=0.0)),
        "distilled with hint": Distillation([teacher], DistillationSpec(hint=0.1)),
        "pruned and distilled": Distillation([teacher], start=pruned),
    }
    for name, strategy in lessons.items():
        began = time.process_time()
        fitted = fit(data, model, training, strategy=strategy).predictor
        made[name] = (fitted, time.process_time() - began)
        print(f"{name}: {made[name][1]:.0f} processor s", flush=True)
    return made


def main() -> None:
    made = parser(__doc__ or "")
    made.add_argument("--units", type=int, default=32, help="of the students; the teacher has 64")
    made.add_argument("--updates", type=int, default=3000, help="of the teacher and of each student")
    arguments = made.parse_args()
    quick, seed = arguments.quick, arguments.seed
    with tempfile.TemporaryDirectory() as temporary:
        folder = arguments.data or Path(temporary) / "data"
        if not folder.exists():
            minutes, recordings = (4.0, 6) if quick else (180.0, 60)
            simulate_data_set(folder, SimulationOrder(minutes=minutes, recordings=recordings, seed=seed))
        changes = [f"training.seed={seed}", f"split.seed={seed}", "training.epochs=5"]
        changes += [f"training.updates={5 if quick else max(1, arguments.updates // 5)}"]
        experiment = load_experiment(None, "quick", changes)
        data = prepare_data(DataSource.of(folder), experiment)
    began = time.process_time()
    teacher = fit(data, experiment.model, experiment.training).predictor
    networks = {"teacher": (teacher, time.process_time() - began)}
    networks |= ways(teacher, data, replace(experiment.training, seed=seed + 1), arguments.units)
    rows, errors = [], {}
    for name, (network, seconds) in networks.items():
        counts = footprint(network)
        errors[name] = error(network, data)
        cycles = {entry.number_format: entry.cycles["cortex_m4f"][2] for entry in counts.estimates}
        rows.append([name, errors[name], counts.parameters, counts.macs_tick, cycles["w8a16"], round(seconds)])
    table(["network", "MAE mm/s", "parameters", "MACs per tick", "cycles w8a16", "training s"], rows)
    ours, units = errors["pruned and distilled"], arguments.units
    verdicts = [
        verdict(f"{units} units, pruned and distilled, against the teacher", ours, errors["teacher"], "<= 1.05", "mm/s",
                quick),
        verdict("the same against the student that is only trained", ours, errors["student"], "<= 1.0", "mm/s", quick),
    ]  # fmt: skip
    finish("smaller_networks", verdicts, seed, {name: {"mae": value} for name, value in errors.items()})


if __name__ == "__main__":
    main()
