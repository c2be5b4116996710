"""What accuracy does a network give up to fit the controller, and what do the thesis's ways of making it smaller?

A full-size teacher (preset ``standard``, Huber 0.1) learns 1 or 10 ticks ahead on simulated recordings of machine
M22. ``edp.workflows.compression`` then makes a network of 68 units, the widest multiple of four whose constants fit in
whole numbers (W8A16), and the rival in the same run: the variants of the thesis's Table 4.9 of the same teacher (with
seed 0, judged on the validation part). The chosen network is put into whole numbers, exported, compiled for a
Cortex-M4F and run on an emulated one: bytes of constants, program, state and stack are those of that where compiler and
emulator are there, else the estimates. Students have as many updates as their teacher, and a third of that with rounded
numbers. All choices rest on the validation part. The test part is a second test set: nothing was chosen or judged on it
before, and it is opened once, for the teacher and the chosen network. Seeds are those of weights and of the split; the
recordings stay.

Every training is a run below ``--work``: a benchmark that was stopped goes on.
"""

from __future__ import annotations

import argparse
import shutil
import statistics
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import controller_memory
import program_bytes
from common import DATA, WORK, Bench, benchmark, option, table
from edp.config.experiment import Experiment, load_experiment
from edp.evaluation.controller import Budget
from edp.training import load_bundle
from edp.workflows.compression import (
    FORMATS,
    CompressedRow,
    CompressionResult,
    CompressionSearchRequest,
    CompressionSearchSpec,
    search,
)
from edp.workflows.compression.planning import RECIPES
from edp.workflows.compression.quantise import quantise
from edp.workflows.train_evaluate import DataSource, SimulationOrder, simulate_data_set, train

BUDGET = Budget()  # thesis 3.5.2: 720,000 cycles, 100 KB of parameters
TIGHT = 360_000  # cycles, half the slice
MEMORY = 64_000  # bytes of state and stack
FORMAT = "w8a16"


def settings(horizon: int, seed: int, epochs: int, updates: int) -> Experiment:
    """Return the settings of the teacher."""
    changes = [f"task.horizons=[{horizon}]", f"training.seed={seed}", f"split.seed={seed}", "training.loss.delta=0.1"]
    changes += [f"training.epochs={epochs}", f"training.updates={updates}", "training.patience=0", "training.threads=1"]
    return load_experiment(None, "standard", changes)


def one(source: DataSource, horizon: int, seed: int, folder: Path, arguments: argparse.Namespace) -> CompressionResult:
    """Train a teacher and search for the best network within the budget."""
    epochs, updates = (1, 5) if arguments.quick else (5, max(1, arguments.updates // 5))
    run = folder / f"k{horizon}_seed{seed}"
    train(source, settings(horizon, seed, epochs, updates), run / "teacher")
    spec = CompressionSearchSpec(
        budget=BUDGET,
        units=tuple(arguments.units),
        formats=(FORMAT,),
        recipes=tuple(arguments.recipes),
        thesis=seed == 0 and not arguments.quick,
    )
    return search(run / "teacher", CompressionSearchRequest(spec=spec), run / "small")


def rows_of(found: CompressionResult, horizon: int) -> list[list[object]]:
    """Lines of a table in the form of Table 4.9."""
    lines = []
    for place, row in enumerate([found.teacher, *found.rows]):
        mae = row.scores[str(horizon)]["mae"]
        mark = "* " if place and place - 1 == found.chosen else "  "
        cells = [
            mark + row.name,
            mae,
            100.0 * (row.error - 1.0),
            row.resource_usage.parameters,
            row.resource_usage.parameter_bytes,
        ]
        cells += [
            FORMATS[row.number_format].label,
            row.resource_usage.cycles[2],
            "fits" if row.fits else ", ".join(row.over),
        ]
        lines.append(cells)
    return lines


def facts_of(found: CompressionResult, horizon: int, made: dict[str, int]) -> dict[str, Any]:
    """Return the figures of a search that are stored."""

    def plain(row: CompressedRow) -> dict[str, Any]:
        mae = row.scores[str(horizon)]["mae"]
        return {"name": row.name, "format": row.number_format, "mae": mae, "over_teacher": row.error, "fits": row.fits,
                "parameters": row.resource_usage.parameters, "bytes": row.resource_usage.parameter_bytes,
                "cycles": list(row.resource_usage.cycles), "memory": memory(row)}  # fmt: skip

    box = {"error": found.held_out_test.error, "scores": found.held_out_test.scores} if found.best else {}
    return {"teacher": plain(found.teacher), "rows": [plain(row) for row in found.rows], "held_out_test": box,
            "chosen": found.best.name if found.best else None, "compiled": made,
            "notes": list(found.notes)}  # fmt: skip


def compiled(best: CompressedRow, folder: Path) -> dict[str, int]:
    """Bytes of the chosen network as exported, compiled for a Cortex-M4F and run; empty without the programs for it."""
    if any(shutil.which(program) is None for program in ("arm-none-eabi-gcc", "qemu-system-arm")):
        print("needs the Debian packages gcc-arm-none-eabi libnewlib-arm-none-eabi qemu-system-arm: estimates are kept")
        return {}
    quantise(best.run, folder)
    bundle = load_bundle(folder)
    constants, program, _ = program_bytes.measured(bundle)
    state, stack = controller_memory.measured(bundle)
    return {"constants": constants, "program": program, "state": state, "stack": stack}


def memory(row: CompressedRow) -> int:
    """Bytes of state and stack: the weights of a stored network stay in flash."""
    return row.resource_usage.ram_bytes - row.resource_usage.parameter_bytes


def check(bench: Bench, found: Sequence[CompressionResult], objects: Sequence[dict[str, int]], horizon: int) -> None:
    """Add the verdicts at one horizon: the largest size and the median error over the seeds.

    Args:
        bench: of the run.
        found: the searches.
        objects: of each search what was compiled; empty where nothing was.
        horizon: in ticks.
    """
    best = [one.best for one in found if one.best is not None]
    if len(best) < len(found):
        raise SystemExit(f"k = {horizon}: no network fits in {len(found) - len(best)} of {len(found)} searches")
    key = str(horizon)

    def boxed(name: str) -> float:
        return statistics.median(one.held_out_test.scores[name][key]["mae"] for one in found)

    taken = [(row.resource_usage.parameter_bytes, memory(row)) for row in best]
    if all(objects):
        taken = [(one["constants"], one["state"] + one["stack"]) for one in objects]
    bytes_, used = (max(column) for column in zip(*taken, strict=True))
    cycles = max(row.resource_usage.cycles[2] for row in best)
    name = f"k={horizon}:"
    bench.check(f"{name} constants", bytes_, 100_000, "<= 1.0", "bytes")
    bench.check(f"{name} cycles, high estimate, M4F", cycles, BUDGET.cycles, "<= 1.0", "cycles")
    bench.check(f"{name} state and stack", used, MEMORY, "<= 1.0", "bytes")
    against = "sealed test set MAE against the teacher"
    bench.check(f"{name} {against}", boxed("chosen"), boxed("teacher"), "<= 1.05", "mm/s")
    tight = [[row for row in one.rows if row.fits and row.resource_usage.cycles[2] <= TIGHT] for one in found]
    if all(tight):
        error = statistics.median(min(row.error for row in rows) for rows in tight)
        bench.check(f"{name} validation MAE within {TIGHT:,} cycles", error, 1.0, "<= 1.1", "1")
    rivals = {row.name for one in found for row in one.rows if row.number_format != FORMAT}
    if rivals:
        errors = [[row.error for one in found for row in one.rows if row.name == way] for way in rivals]
        rival = min(map(statistics.median, errors))
        ours = statistics.median(row.error for row in best)
        against = "validation MAE against the best of Table 4.9's ways"
        bench.check(f"{name} {against}", ours, rival, "<= 1.0", "of the teacher's")


@benchmark(
    WORK,
    DATA,
    option("--units", type=int, nargs="*", default=[], help="widths of the smaller networks; default 68"),
    option("--recipes", nargs="+", default=list(RECIPES), choices=RECIPES, help="how they are made; default all"),
    option("--updates", type=int, default=4000, help="of the teacher and of each student"),
    option("--minutes", type=float, default=300.0, help="minutes of simulated recordings"),
    option("--horizons", type=int, nargs="+", default=[10, 1]),
    option("--seeds", type=int, default=2),
)
def main(bench: Bench) -> object:
    quick, folder, data, arguments = bench.quick, bench.folder, bench.data, bench.options
    arguments.units = arguments.units or ([24] if quick else [68])
    horizons, seeds = ([10], 1) if quick else (arguments.horizons, arguments.seeds)
    minutes, recordings = (4.0, 6) if quick else (arguments.minutes, int(arguments.minutes / 3))
    simulate_data_set(data, SimulationOrder(minutes=minutes, recordings=recordings))
    searches: dict[int, list[CompressionResult]] = {horizon: [] for horizon in horizons}
    objects: dict[int, list[dict[str, int]]] = {horizon: [] for horizon in horizons}
    for seed in range(bench.seed, bench.seed + seeds):
        for horizon in horizons:
            found = one(DataSource.from_path(data), horizon, seed, folder, arguments)
            searches[horizon].append(found)
            chosen = folder / f"k{horizon}_seed{seed}" / "chosen_w8a16"
            objects[horizon].append(compiled(found.best, chosen) if found.best else {})
            print(f"\nk = {horizon}, seed {seed}: validation part; * is chosen", flush=True)
            table(["network", "MAE mm/s", "over teacher %", "parameters", "bytes", "format", "cycles", "budget"],
                  rows_of(found, horizon))  # fmt: skip
            box = found.held_out_test.scores if found.best else {}
            print("compiled:", objects[horizon][-1])
            print("sealed test set:", {name: round(score[str(horizon)]["mae"], 4) for name, score in box.items()})
    for k, found in searches.items():
        check(bench, found, objects[k], k)
    return {
        f"k={k}": [facts_of(one, k, made_of) for one, made_of in zip(found, objects[k], strict=True)]
        for k, found in searches.items()
    }


if __name__ == "__main__":
    main()
