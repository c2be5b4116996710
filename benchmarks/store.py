"""What does a data-set store save over logs, and what does a store of 10, 100 or 1,000 hours take of memory and time?

The logs hold random walks of 45 channels at 100 Hz in Parquet: memory and time do not depend on what the numbers mean.
Ten hours are written, stored and trained on as a user does it, once on the logs and once on the store, each in a
process of its own. Stores of more hours list the same ten hours again and again under other names: 1,000 hours of
numbers would take 65 GB of disk. So what a command holds in memory is that of so many hours, and so is the time that it
computes; the time to read from a disk is not, since ten hours stay in the system's cache.

With ``--at-most HOURS`` it is only asked what commands take on the largest store where they look at so many hours of
it: `inspect`, `screen`, and `evaluate` of a run that was trained on the base, judged on that store.

Memory is what a process holds beside files that the system may drop and read again (anonymous memory), looked at every
0.2 s. The time of an update is the difference of two trainings of one epoch, in processor time.
"""

from __future__ import annotations

import resource
import subprocess
import sys
import time
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from safetensors.numpy import load_file

from common import PLACE, Bench, benchmark, option, table
from edp.data.chunks import ChunkSampler, ChunkSpec
from edp.data.gathered import read_stored_columns
from edp.data.series import Series
from edp.evaluation.guard import BEATEN
from edp.logs.store import read_store
from edp.logs.store.index import INDEX
from edp.signals import TABLE_A1
from edp.storage import read_json, write_json
from memory import CHANNELS, RATE_HZ, write_logs

GOAL_S_AN_HOUR = 3.0
"""Processor time of building a store for an hour of logs."""
GOAL_MB = 2048.0
BASE_HOURS = 10.0
UPDATES = (50, 350)
COMMANDS = ("train", "evaluate", "screen", "inspect")
Row = tuple[Any, ...]
"""Name, hours, processor s, memory in MB, and of a training s an update."""


def used_s() -> float:
    """Processor time of processes that ended, in s."""
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def anonymous_mb(process: int) -> float:
    """Memory of a process that no file backs, in MB; 0 once it ended."""
    try:
        lines = Path(f"/proc/{process}/status").read_text(encoding="ascii").splitlines()
    except (OSError, ProcessLookupError):
        return 0.0
    return sum(float(line.split()[1]) / 1024 for line in lines if line.startswith("RssAnon:"))


def run(command: list[str]) -> tuple[float, float]:
    """Run `edp` to its end: processor time in s and most anonymous memory in MB."""
    before, peak = used_s(), 0.0
    with subprocess.Popen([sys.executable, "-m", "edp", *command, "--json"], stdout=subprocess.DEVNULL) as process:
        while process.poll() is None:
            peak = max(peak, anonymous_mb(process.pid))
            time.sleep(0.2)
    # A run that a baseline beats, as one of so few updates is, was judged all the same.
    if process.returncode not in (0, BEATEN):
        raise SystemExit(f"edp {' '.join(command)} ended with {process.returncode}")
    return used_s() - before, peak


def training(data: Path, out: Path, updates: int, epochs: int = 2) -> list[str]:
    """Return the command of a training of preset `quick` with the given updates per epoch."""
    sets = [f"training.epochs={epochs}", f"training.updates={updates}"]
    return ["train", str(data), "--out", str(out), "--preset", "quick", *(w for text in sets for w in ("--set", text))]


def repeated(store: Path, out: Path, times: int) -> Path:
    """Create a store that lists the recordings of another store several times under new names."""
    out.mkdir()
    (out / "rows").symlink_to((store / "rows").resolve())
    index = read_json(store / INDEX)
    index["recordings"] = [
        {**entry, "name": f"{entry['name']}_{turn}", "log": f"/{turn}/{entry['log']}", "log_key": f"{turn}"}
        for turn in range(times)
        for entry in index["recordings"]
    ]
    write_json(out / INDEX, index)
    return out


def of_hours(store: Path, folder: Path, times: int, hours: float, commands: list[str], quick: bool) -> list[Row]:
    """Measure commands on a store: name, hours, processor time (s), memory (MB); for trainings also s per update."""
    data = repeated(store, folder / f"store_{hours:g}", times)
    few, many = (2, 20) if quick else UPDATES
    rows: list[Row] = []
    short = run(training(data, folder / f"short_{hours:g}", few, 1))
    long = run(training(data, folder / f"long_{hours:g}", many, 1))
    rows.append(("train", hours, long[0], max(short[1], long[1]), (long[0] - short[0]) / (many - few)))
    orders = {
        "evaluate": ["evaluate", str(folder / f"long_{hours:g}"), "--baselines", "persistence,ridge_arx"],
        "evaluate, all baselines": ["evaluate", str(folder / f"long_{hours:g}"), "--baselines", "all"],
        "screen": ["screen", str(data), "--out", str(folder / f"screened_{hours:g}"), "--no-pictures"],
        "inspect": ["inspect", str(data)],
    }
    for name in commands:
        if name in orders:
            rows.append((name, hours, *run(orders[name]), float("nan")))
        print(*rows[-1], flush=True)
    return rows


def of_a_part(bench: Bench, base: float, hours: float, at_most: float) -> object:
    """Measure commands that read some hours of a store, and store their verdicts in a separate file."""
    folder, quick = bench.folder, bench.quick
    store, data = folder / "store", folder / f"store_{hours:g}"
    write_logs(folder / "logs", base, 20, bench.seed)
    run(["data", "store", "build", str(folder / "logs"), "--out", str(store), "--workers", "1"])
    repeated(store, data, max(1, round(hours / base)))
    run(training(store, folder / "trained", 2 if quick else UPDATES[0], 1))
    part = ["--at-most", f"{at_most:g}"]
    names = "persistence,ridge_arx"
    orders = {
        "inspect": ["inspect", str(data), *part],
        "screen": ["screen", str(data), "--out", str(folder / "screened"), "--no-pictures", *part],
        "evaluate": ["evaluate", str(folder / "trained"), "--data", str(data), "--baselines", names, *part],
    }
    rows: list[Row] = []
    for name, order in orders.items():
        rows.append((name, hours, at_most, *run(order)))
        print(*rows[-1], flush=True)
    table([f"{CHANNELS} channels, {RATE_HZ:g} Hz", "hours", "looked at, h", "processor s", "anonymous MB"], rows)
    for row in rows:
        bench.check(f"memory of {row[0]} on {at_most:g} of {hours:g} h", row[4], GOAL_MB, "<= 1", "MB")
    bench.name = "store_part"
    return {"rows": rows, "base_hours": base}


def draw_ms(store: Path, in_memory: bool) -> tuple[float, float]:
    """Processor time to plan an epoch of the preset quick in s, and to draw each of 300 batches of it in ms."""
    names = tuple(TABLE_A1)
    targets = [name for name in names if name.startswith("CylVels")]
    series = []
    for recording in read_store(store):
        inputs, outputs = (read_stored_columns(recording, part, (), 0, None) for part in (names, targets))
        if in_memory:
            inputs, outputs = np.array(inputs), np.array(outputs)
        series.append(Series(recording.name, inputs, outputs))
    sampler = ChunkSampler(series, [10], ChunkSpec(length=128, batch=8, burn_in=50), 0)
    began = time.process_time()
    batches = sampler.epoch(0)
    next(batches)
    planned = time.process_time()
    for _ in islice(batches, 300):
        pass
    return planned - began, 1e3 * (time.process_time() - planned) / 300


@benchmark(
    PLACE,
    option("--hours", type=float, nargs="*", default=[10.0, 100.0, 1000.0], help="of the stores"),
    option("--commands", nargs="*", default=list(COMMANDS), help="which commands to measure at each size"),
    option("--at-most", type=float, help="only commands that look at so many hours"),
    option("--base", type=float, default=2.0, help="with --at-most: hours that are listed again and again"),
)
def main(bench: Bench) -> object:
    if bench.options.at_most is not None:
        base, hours = (0.1, 0.4) if bench.quick else (bench.options.base, bench.options.hours[-1])
        return of_a_part(bench, base, hours, bench.options.at_most)
    base, updates = (0.2, 20) if bench.quick else (BASE_HOURS, 300)
    # Screening alone would take half of the minute.
    sizes, commands = ([0.4], ["evaluate", "inspect"]) if bench.quick else (bench.options.hours, bench.options.commands)
    folder = bench.folder
    write_logs(folder / "logs", base, 20, bench.seed)
    build_s, build_mb = run(
        ["data", "store", "build", str(folder / "logs"), "--out", str(folder / "store"), "--workers", "1"]
    )
    logs_s, logs_mb = run(training(folder / "logs", folder / "from_logs", updates))
    store_s, store_mb = run(training(folder / "store", folder / "from_store", updates))
    weights = [load_file(next((folder / name).rglob("*.safetensors"))) for name in ("from_logs", "from_store")]
    # An update where all samples are in memory, as a training on logs has them.
    few, many = (2, 20) if bench.quick else UPDATES
    spent = [run(training(folder / "logs", folder / f"memory_{n}", n, 1))[0] for n in (few, many)]
    rows = [
        ("build the store", base, build_s, build_mb, float("nan")),
        ("train on the logs", base, logs_s, logs_mb, (spent[1] - spent[0]) / (many - few)),
        ("train on the store", base, store_s, store_mb, float("nan")),
    ]
    drawn = [("in memory", base, *draw_ms(folder / "store", in_memory=True))]
    for hours in sizes:
        listed = repeated(folder / "store", folder / f"listed_{hours:g}", max(1, round(hours / base)))
        drawn.append(("in a store", hours, *draw_ms(listed, in_memory=False)))
    for hours in sizes:
        times = max(1, round(hours / base))
        rows += of_hours(folder / "store", folder, times, hours, commands, bench.quick)
    same = all(np.array_equal(weights[0][name], weights[1][name]) for name in weights[0] | weights[1])
    table([f"{CHANNELS} channels, {RATE_HZ:g} Hz", "hours", "processor s", "anonymous MB", "s an update"], rows)
    table(["batches of 8 x 128 ticks", "hours", "plan of an epoch, s", "a batch, ms"], drawn)
    print(f"weights of both trainings: {'the same bits' if same else 'NOT the same'}")
    return conclude(bench, rows, base, sizes[-1], same)


def conclude(bench: Bench, rows: list[Row], base: float, most: float, same: bool) -> object:
    """Hold the figures against the goals; returns the details of the result."""
    figures = {(row[0], row[1]): row for row in rows}
    build, in_memory, stored = (
        figures[name, base] for name in ("build the store", "train on the logs", "train on the store")
    )
    update = figures["train", most][4]
    bench.check("processor time of building, an hour of logs", build[2] / base, GOAL_S_AN_HOUR, "<= 1", "s")
    bench.check("memory of training, store against logs", stored[3], in_memory[3], "<= 0.5", "MB")
    bench.check("trainings with the same weights", float(same), 1.0, ">= 1", "")
    bench.check(f"an update on {most:g} h, over one in memory", update, in_memory[4], "<= 1.05", "s")
    for (name, hours), row in figures.items():
        if hours == most and name not in ("build the store", "train on the logs", "train on the store"):
            bench.check(f"memory of {name} on {most:g} h", row[3], GOAL_MB, "<= 1", "MB")
    return {"rows": rows}


if __name__ == "__main__":
    main()
