"""What does a search cost beside its trainings, and what does a second worker bring?

How long a ledger of 10,000 records takes to open, every checksum verified; what share of a core the coordinator takes
while trainings run; and trainings an hour with two workers against one. The trainings are real and small: the network
of the preset `quick`, a fold of simulated M22 sessions, few updates, one thread, by the function that a search calls.
Reading the data and starting the processes come before the time taken.
"""

from __future__ import annotations

import shutil
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from statistics import median

from common import DATA, Bench, benchmark, table
from edp.config.experiment import load_experiment
from edp.jobs.base import Job, complete
from edp.jobs.processes import LocalPool
from edp.storage.ledger import Ledger, Record, TrainingIdentity, TrainingStatus, digest_of
from edp.storage.provenance import environment
from edp.workflows.search.arms import Arm
from edp.workflows.search.jobs import job_of
from edp.workflows.search.trainings import TrainingRequest
from edp.workflows.train_evaluate import DataSource, SimulationOrder, simulate_data_set

OPEN_S, SHARE, SPEEDUP = 1.0, 0.02, 1.8
SETTINGS = Arm.from_experiment(load_experiment(None, "quick")).tables
HORIZONS, SCORES, SESSIONS = ("1", "10"), ("mae", "rmse", "p95", "p99", "composite"), 5


def fill(folder: Path, count: int) -> None:
    """Write records of the size that a search writes, without flushing each to disk."""
    with Ledger(folder):
        pass
    config, machine = {"settings": SETTINGS, "updates": 800}, environment(1)
    for seed in range(count):
        split = {"train": [f"session {i}" for i in range(20)], "judged": [f"session {i}" for i in range(20, 25)]}
        identity = TrainingIdentity("edp.workflows.search.jobs:train", config, split, seed, 1, "code", "data", machine)
        scores = {name: seed / (7 + i) for i, name in enumerate(SCORES)}
        result = {"sessions": {name: dict.fromkeys(HORIZONS, scores) for name in split["judged"]}, "scores": scores}
        measured = {"seconds": 12.3, "peak_mb": 456.7, "host": "host", "attempts": 1}
        record = Record(identity, TrainingStatus.DONE, result, "", measured)
        (folder / "records" / f"{record.key}.json").write_bytes(record.to_bytes())


def opening(folder: Path, count: int, repeats: int) -> tuple[list[float], list[float]]:
    """Wall and processor seconds of opening a ledger."""
    wall, processor = [], []
    for _ in range(repeats):
        began, spent = time.perf_counter(), time.process_time()
        with Ledger(folder) as ledger:
            wall.append(time.perf_counter() - began)
            processor.append(time.process_time() - spent)
            if len(ledger) != count:
                raise SystemExit(f"{len(ledger)} records of {count} came back")
    return wall, processor


def orders(data: Path, count: int, updates: int, first_seed: int) -> list[Job]:
    source = DataSource.from_path(data)
    recordings = source.read()
    digest = digest_of(sorted(recording.digest for recording in recordings))
    names = [recording.name for recording in recordings]
    found = []
    for number in range(count):
        judged = (names[number % len(names)],)
        train = tuple(name for name in names if name not in judged)
        order = TrainingRequest(SETTINGS, source.to_dict(), train, judged, first_seed + number, updates)
        found.append(job_of(order, digest))
    return found


def rate(workers: int, warm: Sequence[Job], jobs: Sequence[Job]) -> dict[str, float]:
    """Trainings an hour of a pool, and what the coordinator took of a core meanwhile."""
    with tempfile.TemporaryDirectory() as folder, Ledger(folder) as ledger, LocalPool(workers) as pool:
        complete(ledger, pool, warm[:workers])
        began, spent = time.perf_counter(), time.process_time()
        found = complete(ledger, pool, jobs)
        wall, processor = time.perf_counter() - began, time.process_time() - spent
        bad = [record.message for record in found.values() if record.status is not TrainingStatus.DONE]
        if bad:
            raise SystemExit(f"a training ended badly: {bad[0]}")
        seconds = median(record.measured["seconds"] for record in found.values())
    return {
        "workers": workers,
        "trainings an hour": 3600 * len(jobs) / wall,
        "seconds a training": seconds,
        "coordinator's share of a core": processor / wall,
        "coordinator, ms a training": 1000 * processor / len(jobs),
    }


@benchmark(DATA)
def main(bench: Bench) -> object:
    quick, seed = bench.quick, bench.seed
    count, trainings, updates, minutes = (2000, 4, 10, 2.0) if quick else (10_000, 16, 60, 6.0)
    ledger = bench.folder / "ledger"
    fill(ledger, count)
    wall, processor = opening(ledger, count, 3 if quick else 7)
    shutil.rmtree(ledger)
    data = bench.data
    simulate_data_set(data, SimulationOrder(minutes=minutes, recordings=6, seed=seed))
    warm = orders(data, 2, 1, 10_000)
    rows = []
    for turn in range(1 if quick else 3):  # in turn, so that other load of the machine meets both alike
        jobs = orders(data, trainings, updates, 100 * turn)
        rows += [rate(workers, warm, jobs) for workers in (1, 2)]
    table([f"opening {count:,} records", "least", "median"], [
        ["wall s", min(wall), median(wall)],
        ["processor s", min(processor), median(processor)],
    ])  # fmt: skip
    print()
    table(list(rows[0]), [list(row.values()) for row in rows])
    one, two = (median(row["trainings an hour"] for row in rows if row["workers"] == n) for n in (1, 2))
    share = max(row["coordinator's share of a core"] for row in rows)
    bound = OPEN_S * count / 10_000
    bench.check(f"opening {count:,} records", min(wall), bound, "<= 1", "s")
    bench.check("coordinator, fraction of a core", share, SHARE, "<= 1", "core")
    bench.check("trainings an hour, two workers against one", two, one, f">= {SPEEDUP}", "1/h")
    return {"opening_s": wall, "opening_processor_s": processor, "pools": rows}


if __name__ == "__main__":
    main()
