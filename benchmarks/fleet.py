"""What do more workers bring a fleet's commands, what does the coordinator take, and what does a delta lose?

* Two workers against one, for simulate, store, inspect, the inspection of screen, and evaluate. On a computer that
  others use wall time says little, so processor time is compared: that of one process for everything, against the
  coordinator's with two workers and that of the busier worker, with the readers of logs that each has. All have done
  the same with next to nothing before; what starting a worker takes (imports) is named beside it, and both workers.
* The coordinator's processor time a unit over 1,000 units, as a share of a core while two workers do units of the mean
  length of the first part.
* A delta of 64 kB of each of some machines that the network never saw, from five minutes of logs, against their full
  fine-tuning, on the ends of the logs.
* The time of a fleet of 10,000 h on 100 cores: the scheduler simulated with the measured times of units, checked with
  two workers.
"""

from __future__ import annotations

import contextlib
import heapq
import os
import shutil
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from common import WORK, Bench, benchmark, kept, table
from edp.config.experiment import Experiment, load_experiment
from edp.jobs import IN_PROCESS, Workers
from edp.jobs.base import Executor
from edp.jobs.workers import WorkUnit
from edp.logs.source import DataSource
from edp.sim.data_set import SimulationOrder, simulate_data_set
from edp.training import load_bundle
from edp.workflows.fleet.personal import PersonalOrder, finetune_fleet
from edp.workflows.train_evaluate import evaluate, train
from edp.workflows.transfer import FinetuneSpec

SPEEDUP, SHARE, NEAR = 1.8, 0.03, 1.05
UNITS = 1_000
PARTS = ("before", "full", "delta")
MIN_S = 1.0
"""Processor time of one process, below which two are not compared with it: the system counts in hundredths, and the
start of a worker differs by tenths."""
BASELINES = ("persistence", "ridge_arx", "small_mlp")
HOURS, CORES = 10_000.0, 100
NETWORK = ('model.backbone={kind="hybrid",channels=[64],kernel=4,units=64}', "task.horizons=[10]", "model.window=50")


def rest(identity: Any, where: Any) -> dict[str, Any]:
    """Run a work unit that takes no processor time, which leaves the coordinator's cost."""
    time.sleep(0.02)
    return {"number": identity.config["number"]}


@dataclass(frozen=True)
class Size:
    """How much the short and the full form do."""

    minutes: float
    recordings: int
    machines: int
    fleet_minutes: float
    updates: int


SIZES = {True: Size(1.0, 4, 3, 3.0, 20), False: Size(180.0, 72, 24, 48.0, 450)}


@dataclass(frozen=True)
class Fleet:
    """Where the benchmark stands."""

    work: Path
    seed: int
    quick: bool

    @property
    def size(self) -> Size:
        return SIZES[self.quick]

    def order(self, minutes: float, recordings: int) -> SimulationOrder:
        return SimulationOrder(minutes=minutes, recordings=recordings, seed=self.seed)

    def logs(self, name: str, order: SimulationOrder) -> Path:
        """Return the folder of simulated logs; simulate missing ones."""
        simulate_data_set(self.work / name, order, workers=IN_PROCESS)
        return self.work / name

    def experiment(self, *changes: str) -> Experiment:
        return load_experiment(None, "quick", [*NETWORK, f"training.seed={self.seed}", *changes])

    def run(self) -> Path:
        """Return a trained network for the evaluation commands."""
        logs = self.logs("many", self.order(self.size.minutes, self.size.recordings))
        updates = 10 if self.quick else 100
        experiment = self.experiment("training.epochs=1", f"training.updates={updates}")
        train(DataSource.from_path(logs), experiment, self.work / "run")
        return self.work / "run"


WORKER = b"edp.jobs.worker"
"""In the command line of a worker."""
TICK_S = 0.1
CLOCK = os.sysconf("SC_CLK_TCK")
"""Ticks a second in which the system counts processor time."""


def spent_s(process: int) -> float:
    """Processor time of a process so far, in s; 0 once it is gone."""
    with contextlib.suppress(OSError, IndexError):
        fields = Path(f"/proc/{process}/stat").read_bytes().rpartition(b")")[2].split()
        return (int(fields[11]) + int(fields[12])) / CLOCK
    return 0.0


def children(process: int) -> list[int]:
    """Return the processes that a process started, from any of its threads."""
    found = []
    with contextlib.suppress(OSError):
        for thread in Path(f"/proc/{process}/task").iterdir():
            found += [int(word) for word in (thread / "children").read_text().split()]
    return found


def tree_s(process: int) -> dict[int, float]:
    """Processor time of a process and of all below it, by process."""
    spent = {process: spent_s(process)}
    for child in children(process):
        spent |= tree_s(child)
    return spent


def is_worker(process: int) -> bool:
    with contextlib.suppress(OSError):
        return WORKER in Path(f"/proc/{process}/cmdline").read_bytes()
    return False


@dataclass
class Meter:
    """Processor time of this process with its readers, and of each worker with its own, looked at now and then."""

    begun: dict[int, float] = field(default_factory=lambda: tree_s(os.getpid()))
    seen: dict[int, dict[int, float]] = field(default_factory=dict)
    workers: set[int] = field(default_factory=set)
    done: threading.Event = field(default_factory=threading.Event)
    marked: dict[int, float] = field(default_factory=dict)
    own: list[float] = field(default_factory=lambda: [0.0, 0.0])
    """Processor time of the looking itself, in a thread of this process: in all, and until it was marked."""

    def look(self) -> None:
        own = os.getpid()
        for child in children(own):
            # A worker looks like this process until it runs its own program, and like nothing once it was ended.
            if is_worker(child):
                self.workers.add(child)
                self.seen.setdefault(own, {}).pop(child, None)
            place = self.seen.setdefault(child if child in self.workers else own, {})
            for process, spent in tree_s(child).items():
                place[process] = max(place.get(process, 0.0), spent)
        self.seen.setdefault(own, {})[own] = spent_s(own)

    def watch(self) -> None:
        while not self.done.wait(TICK_S):
            self.look()
            self.own[0] = time.thread_time()

    def mark(self) -> None:
        """Reset the processor time to zero."""
        self.look()
        self.own[1] = self.own[0]
        self.marked = {process: spent for place in self.seen.values() for process, spent in place.items()}

    def here(self) -> float:
        """Of this process and what is no worker, since the meter began or was marked; looking does not count."""
        return self._since(self.seen.get(os.getpid(), {})) - (self.own[0] - self.own[1])

    def busiest(self) -> float:
        """Of the worker that took most, likewise."""
        return max(self.each(), default=0.0)

    def each(self) -> list[float]:
        """Of each worker, likewise."""
        return [self._since(spent) for process, spent in self.seen.items() if process != os.getpid()]

    def _since(self, place: dict[int, float]) -> float:
        before = self.begun | self.marked
        return sum(spent - before.get(process, 0.0) for process, spent in place.items())


@contextlib.contextmanager
def metered() -> Iterator[Meter]:
    meter = Meter()
    looking = threading.Thread(target=meter.watch, daemon=True)
    looking.start()
    yield meter
    meter.look()
    meter.done.set()
    looking.join()


Command = Callable[[Workers, Path, str], object]


def commands(fleet: Fleet) -> dict[str, Command]:
    """Each command on the data of a name: ``many`` for the measure, ``few`` for what starting takes."""
    size = fleet.size
    orders = {"many": fleet.order(size.minutes, size.recordings), "few": fleet.order(0.2, 2)}
    run = Path() if fleet.quick or (fleet.work / "command_evaluate.json").exists() else fleet.run()
    for name, order in orders.items():
        fleet.logs(name, order)

    def source(name: str) -> DataSource:
        return DataSource.from_path(fleet.work / name)

    if fleet.quick:  # starting processes takes longest: two commands stand for all
        return {
            "simulate": lambda workers, out, name: simulate_data_set(out / "logs", orders[name], workers),
            "store": lambda workers, out, name: source(name).store(out / "store", workers),
        }

    def evaluate_copy(workers: Workers, out: Path, name: str) -> object:
        shutil.copytree(run, out / "run")
        return evaluate(out / "run", source(name), BASELINES, workers=workers)

    return {
        "simulate": lambda workers, out, name: simulate_data_set(out / "logs", orders[name], workers),
        "store": lambda workers, out, name: source(name).store(out / "store", workers),
        "inspect": lambda workers, out, name: source(name).inspect(workers=workers),
        "evaluate": evaluate_copy,
    }


class WarmPool(Workers):
    """Workers whose processes stay from one command to the next, so that starting them is done once."""

    pools: ClassVar[list[Executor]] = []

    def open(self) -> Executor:
        if not self.pools:
            self.pools.append(super().open())
        return contextlib.nullcontext(self.pools[0])  # type: ignore[return-value]

    def end(self) -> None:
        while self.pools:
            self.pools.pop().close()


def in_turn(command: Command, workers: Workers) -> tuple[float, float, list[float]]:
    """Processor time of starting (the busiest process on next to nothing), then of this process and of each worker."""
    with metered() as meter, tempfile.TemporaryDirectory() as out:
        for name in ("few", "many"):
            (Path(out) / name).mkdir()
        command(workers, Path(out) / "few", "few")
        meter.look()
        started = meter.busiest()
        meter.mark()
        command(workers, Path(out) / "many", "many")
        meter.look()
        return started, meter.here(), meter.each()


def two_against_one(command: Command) -> dict[str, Any]:
    """Processor time of a command in one process and in two workers."""
    _, alone, _ = in_turn(command, Workers())
    two = WarmPool(count=2)
    try:
        started, here, workers = in_turn(command, two)
    finally:
        two.end()
    return {
        "one process, s": alone, "two: coordinator, s": here, "two: busier worker, s": max(workers),
        "two: both workers, s": sum(workers), "starting a worker, s": started,
        "times": alone / (here + max(workers)) if alone >= MIN_S else None,
    }  # fmt: skip


def coordinating(workers: int) -> dict[str, float]:
    """Measure the coordinator's processor time per work unit, over many empty units."""
    units = [WorkUnit("fleet:rest", f"unit {n}", {"number": n}) for n in range(UNITS)]
    began, wall = time.process_time(), time.perf_counter()
    list(Workers(count=workers).map(units))
    spent = time.process_time() - began
    return {
        "units": UNITS,
        "processor_s": spent,
        "ms_a_unit": 1e3 * spent / UNITS,
        "wall_s": time.perf_counter() - wall,
    }


def fleet_orders(fleet: Fleet) -> dict[str, SimulationOrder]:
    """Machines that train, and machines never seen with six minutes each."""
    size = fleet.size
    soil: dict[str, Any] = {"materials": {"air": 1.0, "sandy_loam": 1.0}, "scatter": 2.0}
    own = 2 if fleet.quick else 3
    train_set = SimulationOrder(
        minutes=size.fleet_minutes, recordings=2 * size.machines, family=size.machines, seed=fleet.seed + 1, **soil
    )
    unseen = SimulationOrder(
        minutes=6.0 * own if not fleet.quick else 4.0, recordings=2 * own, family=own, seed=fleet.seed + 2, **soil
    )
    return {"fleet": train_set, "unseen": unseen}


def trained(fleet: Fleet, name: str, order: SimulationOrder) -> Path:
    """One network over the machines of a data set; parameters and updates are the same for all."""
    epochs = 2 if fleet.quick else 6
    lengths = (f"training.epochs={epochs}", f"training.updates={max(1, fleet.size.updates // epochs)}")
    experiment = fleet.experiment('split.kind="machines"', *lengths)
    out = fleet.work / "runs" / name
    train(DataSource.from_path(fleet.logs(name, order)), experiment, out)
    return out


def deltas(fleet: Fleet) -> dict[str, Any]:
    """Errors of base, full fine-tuning and delta on machines never seen, in mm/s."""
    orders = fleet_orders(fleet)
    base = trained(fleet, "fleet", orders["fleet"])
    store = fleet.work / "unseen_store"
    DataSource.from_path(fleet.logs("unseen", orders["unseen"])).store(store)
    found: dict[str, Any] = {"parameters": sum(p.numel() for p in load_bundle(base).predictor.parameters())}
    spec = FinetuneSpec(single_phase_epochs=3 if fleet.quick else 10)
    content = finetune_fleet(Workers(), base, store, PersonalOrder(method="full", spec=spec), fleet.work / "own")
    rows = [(name, error.before, error.full, error.delta) for name, error in content.errors.items()]
    found["full"] = {
        "machines": [list(row) for row in rows],
        "bytes": max(row.bytes or 0 for row in content.machines),
        "trained_min": float(np.mean([row.trained_min for row in content.machines if row.trained_min is not None])),
        **{part: float(np.mean([row[1 + n] for row in rows])) for n, part in enumerate(("before", "full", "delta"))},
    }
    return found


def makespan(seconds: Sequence[float], workers: int) -> float:
    """When the last of some units ends that are handed out in order to whoever is free first."""
    free = [0.0] * workers
    heapq.heapify(free)
    for one in seconds:
        heapq.heappush(free, heapq.heappop(free) + one)
    return max(free)


def unit_seconds(fleet: Fleet) -> list[float]:
    """Processor seconds of the units of a simulation, one by one in this process."""
    seconds: list[float] = []
    with tempfile.TemporaryDirectory() as out:
        last = [time.process_time()]

        def note(simulated: Any, there: bool) -> None:
            seconds.append(time.process_time() - last[0])
            last[0] = time.process_time()

        order = fleet.order(fleet.size.minutes, fleet.size.recordings)
        simulate_data_set(Path(out) / "logs", order, IN_PROCESS, note)
    return seconds


def cost(fleet: Fleet, rows: Sequence[dict[str, Any]], coordinator_ms: float) -> dict[str, float]:
    """Estimate the cost of a fleet of 10,000 h on 100 cores; compare the estimate for two workers with a run."""
    seconds = unit_seconds(fleet)
    hours = fleet.size.minutes / 60.0
    simulated = next(row for row in rows if row["command"] == "simulate")
    measured = simulated["two: busier worker, s"]
    draw = np.random.default_rng(fleet.seed)
    many = round(HOURS / hours * len(seconds))
    large = list(draw.choice(seconds, many))
    # One coordinator: units cannot end faster than it can hear of them.
    heard = many * coordinator_ms / 1e3
    each = {row["command"]: row["one process, s"] / hours for row in rows}
    told = [name for name in ("simulate", "store", "inspect") if name in each]
    return {
        "unit_mean_s": float(np.mean(seconds)),
        "two_foretold_s": makespan(seconds, 2),
        "two_measured_s": measured,
        "units": float(many),
        "hours_of_100_cores": makespan(large, CORES) / 3600.0,
        "efficiency": sum(large) / CORES / makespan(large, CORES),
        "coordinator_h": heard / 3600.0,
        "processor_h": sum(each[name] for name in told) * HOURS / 3600.0,
    }


def measure(fleet: Fleet) -> dict[str, Any]:
    def part(name: str, found: Callable[[], Any]) -> Any:
        return kept(fleet.work / f"{name}.json", lambda: {"found": found()})["found"]

    found: dict[str, Any] = {"coordinator": part("coordinator", lambda: coordinating(2))}
    found["deltas"] = part("deltas", lambda: deltas(fleet))
    rows = []
    for name, command in commands(fleet).items():
        rows.append({"command": name, **part(f"command_{name}", partial(two_against_one, command))})
        print(rows[-1], flush=True)
    found["commands"] = rows
    return found | {"cost": part("cost", lambda: cost(fleet, rows, found["coordinator"]["ms_a_unit"]))}


@benchmark(WORK)
def main(bench: Bench) -> object:
    found = measure(Fleet(bench.folder, bench.seed, bench.quick))
    short = "too short to compare"
    table(
        list(found["commands"][0]),
        [[short if value is None else value for value in row.values()] for row in found["commands"]],
    )
    cost_of, coordinator = found["cost"], found["coordinator"]
    share = coordinator["ms_a_unit"] / 1e3 * 2 / cost_of["unit_mean_s"]
    print(f"coordinator: {coordinator['ms_a_unit']:.2f} ms a unit")
    print(f"10,000 h on 100 cores: {cost_of}")
    tuned = found["deltas"]["full"]
    for row in found["commands"]:
        if row["times"] is not None:
            bench.check(f"{row['command']}: two workers against one", row["times"], 1.0, f">= {SPEEDUP}", "times")
    bench.check("coordinator, fraction of a core", share, SHARE, "<= 1", "core")
    bench.check(
        "error of a compressed difference against full fine-tuning", tuned["delta"], tuned["full"], f"<= {NEAR}", "mm/s"
    )
    bench.check("size of a compressed difference", tuned["bytes"], 65536, "<= 1", "B")
    bench.check(
        "two workers, measured against predicted time",
        cost_of["two_measured_s"],
        cost_of["two_foretold_s"],
        "<= 1.2",
        "s",
    )
    return found


if __name__ == "__main__":
    main()
