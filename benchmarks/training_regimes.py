"""What does training on chunks gain over training on windows, for the same network on the same data?

Two questions. Targets per second of the update loop; and the processor time that chunk training needs to reach the
best validation error that window training reaches in its whole budget. Both run on one thread; processor time, not
wall time, is counted, since machines are shared.
"""

from __future__ import annotations

import contextlib
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

from common import finish, parser, table, verdict
from edp.config import load_experiment
from edp.data.chunks import ChunkSpec
from edp.data.prepared import Prepared
from edp.training import Event, fit
from edp.training.schedules import Constant
from edp.workflow import DataSource, prepare_data, simulate_data_set


class ReachedError(Exception):
    """The wanted validation error was reached."""


def measure(
    data: Prepared, model: Any, training: Any, budget_s: float, wanted: float | None
) -> tuple[float, list[tuple[float, float]]]:
    """Targets per second, and (processor seconds, validation MAE) after each epoch, until `budget_s` or `wanted`."""
    curve: list[tuple[float, float]] = []
    rates: list[float] = []
    began = time.process_time()

    def on_event(event: Event) -> None:
        if event.row is None:
            return
        curve.append((time.process_time() - began, event.row["validation_mae"]))
        rates.append(event.targets_per_s)
        if curve[-1][0] >= budget_s or (wanted is not None and curve[-1][1] <= wanted):
            raise ReachedError

    with contextlib.suppress(ReachedError):
        fit(data, model, training, on_event=on_event)
    return rates[-1], curve


def main() -> None:
    arguments = parser(__doc__ or "").parse_args()
    quick, seed = arguments.quick, arguments.seed
    budget = 12.0 if quick else 600.0
    with tempfile.TemporaryDirectory() as temporary:
        source = arguments.data or Path(temporary) / "data"
        simulate_data_set(source, "M22", 8.0 if quick else 40.0, 8 if quick else 20, seed)
        experiment = load_experiment(None, "quick", [f"training.seed={seed}"])
        data = prepare_data(DataSource.of(source), experiment)
        base = replace(experiment.training, epochs=10_000, patience=0, threads=1)
        # Each regime gets the optimiser settings that suit it: the thesis's for windows, the preset's for chunks. A
        # constant rate, so that neither is helped or hurt by where a schedule would have ended.
        updates = 100 if quick else 400
        window = replace(
            base,
            chunks=ChunkSpec(regime="window", length=50, batch=32),
            optimizer=replace(base.optimizer, learning_rate=1e-3),
            schedule=Constant(),
            updates=updates,
        )
        chunk = replace(base, schedule=Constant(warmup=0.0), updates=50)
        rate_window, curve_window = measure(data, experiment.model, window, budget, None)
        best = min(mae for _, mae in curve_window)
        at_best = next(seconds for seconds, mae in curve_window if mae == best)
        rate_chunk, curve_chunk = measure(data, experiment.model, chunk, budget, best)
        needed = next((seconds for seconds, mae in curve_chunk if mae <= best), float("inf"))
        print(f"window training: {rate_window:,.0f} targets/s; best validation MAE {best:.4g} mm/s")
        print(f"chunk training: {rate_chunk:,.0f} targets/s; the same error after {needed:.1f} processor s")
        table(["window: processor s", "validation MAE, mm/s"], curve_window[:: max(1, len(curve_window) // 12)])
        table(["chunk: processor s", "validation MAE, mm/s"], curve_chunk[:: max(1, len(curve_chunk) // 12)])
        verdicts = [
            verdict("targets per second, chunk against window", rate_chunk, rate_window, ">= 15", "1/s", quick),
            verdict("processor time to the window run's best error", needed, at_best, "<= 0.1", "s", quick),
        ]
        finish("training_regimes", verdicts, seed, {"window": curve_window, "chunk": curve_chunk})


if __name__ == "__main__":
    main()
