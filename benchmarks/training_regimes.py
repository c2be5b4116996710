"""What does training on chunks gain over training on windows, for the same network on the same data?

Two questions. Targets per second of the update loop; and the processor time that chunk training needs to reach the
best validation error of a whole window run, which ends when the error has stopped falling. Both run on one thread;
processor time, not wall time, is counted, since machines are shared.
"""

from __future__ import annotations

import contextlib
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

from common import finish, parser, table, verdict
from edp.config.experiment import load_experiment
from edp.data.chunks import ChunkSpec
from edp.data.prepared import Prepared
from edp.training import TrainingProgress, fit
from edp.training.optimizers import AdamW, Soap
from edp.training.schedules import Constant
from edp.workflows.train_evaluate import DataSource, SimulationOrder, prepare_data, simulate_data_set


class ReachedError(Exception):
    """The wanted validation error was reached."""


def measure(
    name: str, data: Prepared, model: Any, training: Any, budget_s: float, wanted: float | None = None
) -> tuple[float, list[tuple[float, float]]]:
    """Targets per second, and (processor seconds, validation MAE) after each epoch.

    Ends where the training ends by itself, after `budget_s`, or at an error of `wanted`.
    """
    curve: list[tuple[float, float]] = []
    rates: list[float] = []
    began = time.process_time()

    def on_event(event: TrainingProgress) -> None:
        if event.row is None:
            return
        curve.append((time.process_time() - began, event.row["validation_mae"]))
        rates.append(event.targets_per_s)
        print(f"{name}: {curve[-1][0]:.0f} processor s, validation MAE {curve[-1][1]:.3f} mm/s", flush=True)
        if curve[-1][0] >= budget_s or (wanted is not None and curve[-1][1] <= wanted):
            raise ReachedError

    with contextlib.suppress(ReachedError):
        fit(data, model, training, on_event=on_event)
    return rates[-1], curve


def main() -> None:
    arguments = parser(__doc__ or "").parse_args()
    quick, seed = arguments.quick, arguments.seed
    budget = 8.0 if quick else 900.0
    with tempfile.TemporaryDirectory() as temporary:
        source = arguments.data or Path(temporary) / "data"
        minutes, recordings = (8.0, 8) if quick else (40.0, 20)
        simulate_data_set(source, SimulationOrder(minutes=minutes, recordings=recordings, seed=seed))
        experiment = load_experiment(None, "quick", [f"training.seed={seed}"])
        data = prepare_data(DataSource.of(source), experiment)
        base = replace(experiment.training, epochs=10_000, patience=0, threads=1)
        # A constant rate, so that no run is helped or hurt by where a schedule would have ended. Windows get both
        # optimisers, the thesis's and ours: the better one is the rival in each question.
        base = replace(base, schedule=Constant())
        windows = ChunkSpec(regime="window", length=50, batch=32)
        rivals = {
            "window, AdamW 1e-3": replace(base, chunks=windows, optimizer=AdamW(learning_rate=1e-3)),
            "window, SOAP 3e-3": replace(base, chunks=windows, optimizer=Soap(learning_rate=3e-3)),
        }
        # A window run ends itself when 12 looks at the validation error in a row brought nothing better.
        updates, patience = (60, 0) if quick else (300, 12)
        rates, curves = {}, {}
        for name, spec in rivals.items():
            rates[name], curves[name] = measure(
                name, data, experiment.model, replace(spec, updates=updates, patience=patience), budget
            )
        best, at_best, name = min((mae, seconds, name) for name in rivals for seconds, mae in curves[name])
        chunk = replace(base, updates=40 if quick else 80)
        rates["chunk, preset"], curves["chunk, preset"] = measure(
            "chunk, preset", data, experiment.model, chunk, budget, best
        )
        rate_chunk, rate_window = rates["chunk, preset"], max(rates[name] for name in rivals)
        needed = next((seconds for seconds, mae in curves["chunk, preset"] if mae <= best), float("inf"))
        print(f"best of the window runs: {name}, validation MAE {best:.4g} mm/s after {at_best:.0f} processor s")
        print(f"chunk training reaches it after {needed:.1f} processor s")
        table(["run", "targets per s"], list(rates.items()))
        for run, curve in curves.items():
            table([f"{run}: processor s", "validation MAE, mm/s"], curve[:: max(1, len(curve) // 8)])
        verdicts = [
            verdict("targets per second, chunk against window", rate_chunk, rate_window, ">= 15", "1/s", quick),
            verdict("processor time to the window run's best error", needed, at_best, "<= 0.1", "s", quick),
        ]
        finish("training_regimes", verdicts, seed, {"targets_per_s": rates, "curves": curves})


if __name__ == "__main__":
    main()
