"""Does a search lose or repeat trainings when its workers and its coordinator are killed, and does it end the same?

A study of many tiny trainings runs once undisturbed. Then it runs again while workers, and at the end of each round the
coordinator, are killed with signal 9 at drawn moments; it is started anew each time until it ends. Each training notes
its starts, and whether its record was there already. Last, the finished study is started once more.
"""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from common import Bench, benchmark, table
from edp.jobs.base import Job, complete
from edp.jobs.processes import LocalPool
from edp.storage.ledger import Ledger, TrainingIdentity, known, read_records

STUDY = "study"
"""First argument of the coordinator's own process."""


def tiny(identity: TrainingIdentity, where: Mapping[str, Any]) -> dict[str, Any]:
    """Run gradient descent on a random quadratic for some milliseconds."""
    folder = Path(where["study"])
    word = "twice" if known(folder, identity.key) else "start"
    _note(where, f"{word} {identity.seed}")
    time.sleep(identity.config["seconds"])
    draw = random.Random(identity.seed)
    curvature, weight = [draw.uniform(0.1, 1.9) for _ in range(50)], [draw.gauss(0, 1) for _ in range(50)]
    for _ in range(200):
        weight = [w - 0.5 * c * w for w, c in zip(weight, curvature)]
    _note(where, f"end {identity.seed}")
    return {"loss": sum(c * w * w for w, c in zip(weight, curvature)), "weights": weight}


def _note(where: Mapping[str, Any], line: str) -> None:
    with Path(where["log"]).open("a") as log:
        log.write(line + "\n")


def coordinate(study: str, log: str, trainings: int, seconds: float) -> None:
    """Run all trainings through the ledger and write the digest; this process is killed."""
    with Ledger(study) as ledger, LocalPool(2) as pool:
        settings, where = {"seconds": seconds}, {"study": study, "log": log}
        words = ("code", "data", {"threads": "1"})
        jobs = [Job(TrainingIdentity("kill_storm:tiny", settings, {}, n, 1, *words), where) for n in range(trainings)]
        complete(ledger, pool, jobs)
        print(ledger.digest())


class Round:
    """One life of the coordinator."""

    def __init__(self, folder: Path, trainings: int, seconds: float) -> None:
        self.log, self.seconds = folder / "log", seconds
        command = [sys.executable, __file__, STUDY, str(folder), str(self.log), str(trainings), str(seconds)]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)

    def ends(self) -> int:
        return self.log.read_text().count("end ") if self.log.exists() else 0

    def workers(self) -> list[int]:
        """Return the child processes of the coordinator."""
        found = []
        for state in Path("/proc").glob("[0-9]*/stat"):
            try:
                fields = state.read_text().rpartition(")")[2].split()
            except OSError:
                continue
            if int(fields[1]) == self.process.pid and fields[0] != "Z":
                found.append(int(state.parent.name))
        return found

    def storm(self, draw: random.Random, until: int) -> int:
        """Kill workers at drawn moments until so many trainings ended, then the coordinator; how many were killed."""
        killed, goal = 0, self.ends() + draw.randint(1, 4)
        while self.process.poll() is None and (ends := self.ends()) < until:
            time.sleep(0.01)
            if ends >= goal:
                time.sleep(draw.uniform(0, self.seconds))
                for pid in self.workers()[: draw.randint(1, 2)]:
                    os.kill(pid, signal.SIGKILL)
                    killed += 1
                goal = ends + draw.randint(1, 6)
        time.sleep(draw.uniform(0, self.seconds))
        orphans = self.workers()
        self.process.kill()
        self.process.communicate()
        patience = time.monotonic() + 60
        while any(Path(f"/proc/{pid}").exists() for pid in orphans):
            if time.monotonic() > patience:
                raise SystemExit("workers outlive their coordinator")
            time.sleep(0.01)
        return killed

    def result(self) -> str:
        return self.process.communicate()[0].strip()


def run(work: Path, trainings: int, seconds: float, rounds: int, seed: int) -> dict[str, Any]:
    draw = random.Random(seed)
    began = time.monotonic()
    wanted = Round(work / "quiet", trainings, seconds).result()
    quiet = time.monotonic() - began
    storm, workers_killed, rows = work / "storm", 0, []
    began = time.monotonic()
    for number in range(1, rounds + 1):
        one = Round(storm, trainings, seconds)
        killed = one.storm(draw, trainings * number // (rounds + 1))
        workers_killed += killed
        rows.append([number, killed, one.ends(), len(read_records(storm)[0])])
    last = Round(storm, trainings, seconds).result()
    stormy = time.monotonic() - began
    lines = (storm / "log").read_text().splitlines()
    again = Round(storm, trainings, seconds).result()
    records, damaged = read_records(storm)
    table(["round", "workers killed", "trainings ended so far", "records"], rows)
    ends = [line.split()[1] for line in lines if line.startswith("end")]
    return {
        "trainings": trainings,
        "records": len(records),
        "damaged": len(damaged),
        "coordinators killed": rounds,
        "workers killed": workers_killed,
        "starts": sum(line.startswith(("start", "twice")) for line in lines),
        "starts of what had a record": sum(line.startswith("twice") for line in lines),
        "ended, killed before the record was written": len(ends) - len(set(ends)),
        "starts of the finished study": len((storm / "log").read_text().splitlines()) - len(lines),
        "same hash": last == wanted and again == wanted and bool(wanted),
        "seconds in peace": round(quiet, 1),
        "seconds in the storm": round(stormy, 1),
    }


@benchmark()
def main(bench: Bench) -> object:
    trainings, seconds, rounds = (40, 0.1, 3) if bench.quick else (300, 0.2, 12)
    found = run(bench.folder, trainings, seconds, rounds, bench.seed)
    print()
    table(["", "count"], list(found.items()))
    again, finished = (1 + found[f"starts of {what}"] for what in ("what had a record", "the finished study"))
    bench.check("trainings with a record", found["records"], trainings, ">= 1", "trainings")
    bench.check("restarts of recorded trainings, plus one", again, 1, "<= 1", "starts")
    bench.check("starts in a finished study, plus one", finished, 1, "<= 1", "starts")
    bench.check("same hash as an undisturbed study", float(found["same hash"]), 1, ">= 1", "yes")
    return found


if __name__ == "__main__":
    if sys.argv[1:2] == [STUDY]:
        coordinate(sys.argv[2], sys.argv[3], int(sys.argv[4]), float(sys.argv[5]))
    else:
        main()
