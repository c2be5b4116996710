"""Is the default at least as good as every simple rival on public measured recordings, and does it keep its promise?

`edp train` with no settings but the task, on each set of ``examples/real``: its root-mean-square error on the test part
beside the stated linear floor, beside the best of all baselines fitted in the same run, and beside the error that
left-out data promised. Nothing is chosen per set, and the test part is opened once a seed. The full form also distils
each committee (`edp compress distil --units 64`) and holds its student against it.

The recordings are no part of the repository: their folder is given by --shared or EDP_SHARED_DATA.
"""

from __future__ import annotations

import math
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from common import EXAMPLES, SHARED, Bench, benchmark, option, table
from edp.evaluation.baselines import BASELINES
from edp.settings.tree import read_toml
from edp.storage import read_json
from edp.workflows.auto import load_auto, train_auto
from edp.workflows.compression import DistilRequest, DistilSpec, distil
from edp.workflows.train_evaluate import DataSource, evaluate

KEPT = 0.1
"""How far the test error may lie from the promise."""
QUICK_SETS, QUICK = ("sjoberg.toml", "tanks.toml"), ("auto.time_budget_min=0.05",)
STUDENT_UNITS, STUDENT_LOSS = 64, 0.02
"""Width of a student's two perceptrons, and how much more error than its committee it may have."""

ENDS, SKILLS = ("low", "high"), ("promise", "test")
"""Keys of a promise's interval, and of a skill, in ``auto.json``."""


@dataclass(frozen=True)
class Task:
    """One target at one horizon of one set: medians over seeds, in the units of the floors.

    Attributes:
        ours: on the test part.
        floor: the better of the stated linear floor and persistence.
        rival: the best baseline of the same run, by the test part.
        rival_name: which one.
        promise: what left-out data promised.
        low: lower end of its 90 % interval; `high` the upper one.
        skill_promised: error relative to the linear model (or to persistence), promised; `skill` on the test part.
        student: of the committee's student; None where none was made.
    """

    title: str
    target: str
    horizon: int
    ours: float
    floor: float
    rival: float
    rival_name: str
    promise: float
    low: float
    high: float
    skill_promised: float
    skill: float
    student: float | None


@dataclass(frozen=True)
class Training:
    """One set trained with one seed; what its tasks are made of.

    Attributes:
        scores: of the run, every baseline among them.
        choice: what `edp train` wrote of its choice (``auto.json``).
        chosen: the candidate.
        promise: its errors on left-out data, by horizon and target.
        seconds: that training took, wall clock.
        taught: scores of the committee's student; None where none was made.
        student: its number of parameters.
    """

    scores: dict[str, Any]
    choice: dict[str, Any]
    chosen: str
    promise: dict[str, Any]
    seconds: float
    taught: dict[str, Any] | None
    student: int | None


def train_set(entry: dict[str, Any], seed: int, changes: Sequence[str], distilled: bool) -> Training:
    """Train and judge one set with one seed."""
    taught, size = None, None
    with tempfile.TemporaryDirectory() as folder:
        began = time.perf_counter()
        settings = load_auto(EXAMPLES / entry["settings"], [f"auto.seed={seed}", *changes])
        facts = train_auto(
            DataSource.from_path(EXAMPLES / entry["data"]), settings, Path(folder) / "run"
        ).choice.to_table()
        seconds = round(time.perf_counter() - began, 1)
        scores = read_json(evaluate(Path(folder) / "run", baselines=tuple(BASELINES)) / "scores.json")
        choice = read_json(Path(folder) / "run" / "auto.json")
        if distilled and facts["chosen"] == "committee":
            request = DistilRequest(spec=DistilSpec(units=STUDENT_UNITS))
            student = distil(Path(folder) / "run", request, Path(folder) / "student").predictor
            size = sum(weights.numel() for weights in student.parameters())
            # A baseline beside it, whose history sets the first tick that counts: the rows of its committee.
            taught = read_json(evaluate(Path(folder) / "student", baselines=("persistence",)) / "scores.json")
    promise = facts["candidates"][facts["chosen"]]["promise"]
    return Training(scores, choice, facts["chosen"], promise, seconds, taught, size)


def rmse(scores: dict[str, Any], model: str, target: str, horizon: int) -> float:
    """Root-mean-square error of a model in report units."""
    return float(scores["models"][model]["overall"][str(horizon)][target]["rmse"])


def tasks_of(entry: dict[str, Any], trainings: Sequence[Training]) -> list[Task]:
    """Medians over the seeds of one set."""
    tasks = []
    taught = [one.taught for one in trainings if one.taught is not None]
    for target, horizon, persistence, linear in entry["rows"]:
        errors = {
            model: float(np.median([rmse(one.scores, model, target, horizon) for one in trainings]))
            for model in ("network", *BASELINES)
        }
        ours = errors.pop("network")
        best = min(errors, key=lambda model: errors[model])
        promise = median_of([one.promise for one in trainings], horizon, target)
        low, high = (median_of([one.choice["interval"][side] for one in trainings], horizon, target) for side in ENDS)
        told, shown = (median_of([one.choice["skill"][part] for one in trainings], horizon, target) for part in SKILLS)
        floor = min(persistence, linear)
        student = [rmse(scores, "network", target, horizon) for scores in taught]
        of_student = float(np.median(student)) if student else None
        where, promised = (entry["title"], target, horizon), (promise, low, high, told)
        tasks.append(Task(*where, ours, floor, errors[best], best, *promised, shown, of_student))
    return tasks


def notes_of(trainings: Sequence[Training]) -> dict[str, Any]:
    """Return the chosen model, its training time and its number of parameters for every seed."""
    return {
        "chosen": [one.chosen for one in trainings],
        "seconds": [one.seconds for one in trainings],
        "student": [one.student for one in trainings if one.student is not None],
    }


def median_of(errors: Sequence[dict[str, Any]], horizon: int, target: str) -> float:
    """Of the seeds."""
    return float(np.median([one[str(horizon)][target] for one in errors]))


def check(bench: Bench, tasks: Sequence[Task]) -> None:
    """How many tasks meet each goal, of how many; the means."""
    count = len(tasks)
    titles = list(dict.fromkeys(task.title for task in tasks))
    logs = [float(np.mean([math.log(t.ours / t.floor) for t in tasks if t.title == title])) for title in titles]
    mean = math.exp(float(np.mean(logs)))
    skill = "an expected skill (error relative to the linear model) within 10 % of the test"
    for name, goal, met in (
        ("at least as good as the linear baseline", count, [t.ours <= t.floor for t in tasks]),
        ("at least as good as the best baseline", count - 2, [t.ours <= t.rival for t in tasks]),
        ("with an expected error within 10 % of the test error", count - 5,
         [abs(t.promise / t.ours - 1) <= KEPT for t in tasks]),
        (f"with {skill}", count - 5, [abs(t.skill_promised / t.skill - 1) <= KEPT for t in tasks]),
        ("with the test error in the 90 % interval of the expected error", round(0.9 * count),
         [t.low <= t.ours <= t.high for t in tasks]),
    ):  # fmt: skip
        bench.check(f"tasks {name}", sum(met), goal, ">= 1", "tasks")
    bench.check("error relative to the linear baseline, geometric mean over sets", mean, 1.0, "<= 0.8", "ratio")
    students = [task.student / task.ours for task in tasks if task.student is not None]
    if students:
        close = sum(ratio <= 1 + STUDENT_LOSS for ratio in students)
        bench.check("students at most 2 % worse than their ensemble", close, count - 5, ">= 1", "tasks")
    worst = max(task.ours / task.rival for task in tasks)
    bench.check("worst error relative to the best baseline", worst, 1.0, "<= 1.02", "ratio")


def show(tasks: Sequence[Task], notes: dict[str, dict[str, Any]]) -> None:
    """Print a row a task, and a row a set."""
    headings = ["set", "target", "k", "ours", "ours/floor", "best rival", "ours/rival", "promise/ours"]
    headings += ["90 % from", "to", "skill promised", "skill", "student/ours"]
    lines = []
    for t in tasks:
        ratios = (t.ours / t.floor, t.rival_name, t.ours / t.rival, t.promise / t.ours, t.low, t.high)
        skills = (t.skill_promised, t.skill)
        student = "" if t.student is None else f"{t.student / t.ours:.3f}"
        lines.append([t.title, t.target, t.horizon, t.ours, *ratios, *skills, student])
    table(headings, lines)
    print()
    table(
        ["set", "chosen", "training, s", "student, parameters"],
        [[name, *map(str, note.values())] for name, note in notes.items()],
    )


@benchmark(
    SHARED,
    option("--seeds", type=int, default=5, help="how many seeds, from --seed on"),
    option("--workers", type=int, default=1, help="trainings side by side, each a process of its own"),
)
def main(bench: Bench) -> object:
    seeds = range(bench.seed, bench.seed + (1 if bench.quick else bench.options.seeds))
    entries = read_toml(EXAMPLES / "leagues.toml")["floors"]
    entries = [entry for entry in entries if not bench.quick or entry["data"] in QUICK_SETS]
    changes = QUICK if bench.quick else ()
    tasks: list[Task] = []
    notes: dict[str, dict[str, Any]] = {}
    # Processes of their own, so that the compiled parts and pools of one training are not those of another.
    with ProcessPoolExecutor(bench.options.workers, mp_context=get_context("spawn")) as pool:
        begun = [[pool.submit(train_set, entry, s, changes, not bench.quick) for s in seeds] for entry in entries]
        for entry, futures in zip(entries, begun, strict=True):
            trainings = [future.result() for future in futures]
            of_set, notes[entry["title"]] = tasks_of(entry, trainings), notes_of(trainings)
            show(of_set, {entry["title"]: notes[entry["title"]]})
            print(flush=True)
            tasks += of_set
    show(tasks, notes)
    check(bench, tasks)
    return {"seeds": list(seeds), "sets": notes, "tasks": [vars(task) for task in tasks]}


if __name__ == "__main__":
    main()
