"""Does `edp calibrate` find a machine again whose numbers were drawn anew?

Machines of the simulator's family: geometry and bores are told, as a tape measure tells them; every other guess is
M22's, which for a machine of another size is far off. Of each number that the logs tell: the error against the truth;
of each that moved from the guess: whether its interval holds the truth. --work keeps what is finished, a file for each
machine, and --only names some of them: the parts may run apart, and a last run over all with their files in one folder
gives the tables.
"""

from __future__ import annotations

import tempfile
import time
from collections import defaultdict
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from common import DATA, WORK, Bench, PrintedProgress, benchmark, kept, option, table
from edp.config.twin import load_twin_experiment
from edp.jobs import IN_PROCESS
from edp.logs.source import DataSource
from edp.sim.data_set import SimulationOrder, simulate_data_set
from edp.sim.machine.machine import Machine
from edp.sim.machine.machine_files import load_machine
from edp.storage import write_bytes
from edp.storage.provenance import environment
from edp.training.identification.bodies import Poses, base_parameters, load_by_base
from edp.training.identification.machine_numbers import MACHINE_NUMBERS
from edp.training.identification.machine_text import machine_text
from edp.workflows.identify import Identified, identify

NEAR = 0.1
"""Of the truth: the goal."""
GOALS = ("valve curves", "dead bands", "leakage", "friction")
"""Groups of numbers that the goal names; inertia and gravity are judged by joint, over poses."""
JOINTS = ("boom", "arm", "bucket")
QUICK = (
    *("twin.fit.lengths_s=[0.1, 0.3]", "twin.fit.rounds=[3, 2]", "twin.fit.starts=1", "twin.fit.ticks=1500"),
    *("twin.fit.final_rounds=1", "twin.fit.final_ticks=1500"),
    *("twin.fit.validation_runs=8", "evaluation.duration_s=10", "evaluation.starts=2", "evaluation.at_s=[1, 10]"),
)


@benchmark(
    DATA,
    WORK,
    option("--machines", type=int, default=5, help="how many of the family"),
    option("--ticks", type=int, default=40_000, help="of a round of the fit"),
    option("--starts", type=int, default=3, help="of the first stage of the fit"),
    option("--minutes", type=float, default=40.0, help="of logs of a machine"),
    option("--short", action="store_true", help="a fit of few rounds, judged by runs of 10 s"),
    option("--only", type=int, nargs="*", help="machines of the family, from 0 on"),
)
def main(bench: Bench) -> object:
    given, work = bench.options, bench.folder
    every = range(1 if given.quick else given.machines)
    chosen, form = every if given.only is None else given.only, "_quick" if given.quick else ""
    asked: dict[str, Any] = {"ticks": given.ticks, "starts": given.starts}
    asked |= {"minutes": given.minutes, "short": True} if given.short else {}
    details: dict[str, Any] = {}
    for index in chosen:
        name = f"family-{given.seed}-{index}"
        file = work / f"{name}{form}.json"
        details[name] = kept(file, lambda name=name: one_machine(given, name) | asked | {"environment": environment(0)})
        if any(details[name].get(key) != value for key, value in asked.items()):
            raise SystemExit(f"{file} was measured with other settings: give these, or another --work folder")
        show(name, details[name])
    check(bench, details)
    # Some of the family take no whole result's place.
    bench.name, bench.keep = "identify_short" if given.short else "identify", given.only is None
    return details


def one_machine(given: Any, name: str) -> dict[str, Any]:
    """Simulate a machine of the family, identify its parameters and compare them."""
    quick, seed = given.quick, given.seed
    minutes, recordings = (4.0, 8) if quick else (given.minutes, 8 if given.short else 16)
    fit = f"twin.fit.ticks={given.ticks}", f"twin.fit.starts={given.starts}"
    changes = QUICK if quick else (*QUICK, *fit) if given.short else (*fit, "evaluation.at_s=[1, 10, 60]")
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        source = (given.data or folder) / name
        order = SimulationOrder(machine=name, minutes=minutes, recordings=recordings, seed=seed + 1)
        simulate_data_set(source, order, workers=IN_PROCESS)
        truth = load_machine(name)
        write_bytes(folder / f"{name}_measured.toml", machine_text(measured(truth), [], {}).encode())
        began = time.process_time()
        result = identify(
            DataSource.from_path(source),
            folder / f"{name}_found.toml",
            str(folder / f"{name}_measured.toml"),
            load_twin_experiment(None, ["twin.kind=greybox", *changes]),
            progress=PrintedProgress(),
        )
        return compared(truth, measured(truth), result) | {"seconds": time.process_time() - began}


def measured(truth: Machine) -> Machine:
    """M22 with the pins, lengths, bores, rods and strokes of a machine."""
    base, own = load_machine("M22"), truth.cylinders
    cylinders = replace(base.cylinders, count=own.count, bore=own.bore, rod=own.rod, stroke=own.stroke)
    pins = {name: getattr(truth, name) for name in ("boom_cylinder", "arm_cylinder", "bucket_linkage")}
    return replace(base, bodies=replace(base.bodies, length=truth.bodies.length), cylinders=cylinders, **pins)


def compared(truth: Machine, guess: Machine, result: Identified) -> dict[str, Any]:
    """Errors of each number as shares of the truth, of the joints' inertia and gravity, and the scores."""
    true = {number.label: number.read(truth) for number in MACHINE_NUMBERS}
    # No log tells pump flow and power from the volumetric efficiency, which is the guess's.
    share = truth.pumps.volumetric_efficiency / guess.pumps.volumetric_efficiency
    true |= {label: true[label] * share for label in ("pumps.max_flow", "pumps.power_limit")}
    numbers = []
    for row in result.rows:
        if true.get(row.label, 0.0) > 0.0:
            right = true[row.label]
            known = {"label": row.label, "group": row.group, "told": row.is_told, "excited": row.excited}
            errors = {"error": row.value / right - 1.0, "guess_error": row.base / right - 1.0}
            numbers.append(known | {"inside": row.low <= right <= row.high} | errors)
    joints = [
        {"joint": joint, "inertia": inertia, "gravity": gravity, "guess_inertia": first, "guess_gravity": second}
        for joint, (inertia, gravity), (first, second) in zip(
            JOINTS, joint_errors(truth, result.machine), joint_errors(truth, guess), strict=True
        )
    ]
    return {"numbers": numbers, "joints": joints, "models": result.scores}


def joint_errors(truth: Machine, other: Machine) -> list[tuple[float, float]]:
    """Error of inertia and of gravity torque of each joint, root mean square over poses as a share of the truth's."""
    strokes = np.random.default_rng(0).uniform(0.1, 0.9, (200, 3)) * np.array(truth.cylinders.stroke)
    poses = Poses.from_strokes(truth, strokes)
    by_torque, by_inertia = load_by_base(poses, truth.bodies.length, truth.gravity)
    values = []
    for machine in (truth, other):
        nine = base_parameters(machine.bodies)
        values.append((np.diagonal(by_inertia @ nine, axis1=1, axis2=2), by_torque @ nine))
    (mass, pull), (mass_2, pull_2) = values

    def apart(a: Any, b: Any) -> Any:
        return np.sqrt(np.square(a - b).mean(axis=0) / np.square(b).mean(axis=0))

    return list(zip(apart(mass_2, mass).tolist(), apart(pull_2, pull).tolist(), strict=True))


def groups_of(details: dict[str, Any]) -> dict[str, list[dict[str, Any]]]:
    """Rows of all machines by group."""
    groups: dict[str, list[dict[str, Any]]] = defaultdict(list)
    for entry in details.values():
        for row in entry["numbers"]:
            groups[row["group"]].append(row)
    return groups


def check(bench: Bench, details: dict[str, Any]) -> None:
    """Of each group that the goal names, the share of told numbers within 10 % of the truth; errors of the joints."""
    for group, rows in groups_of(details).items():
        told = [row for row in rows if row["told"]]
        if group in GOALS and told:
            share = float(np.mean([abs(row["error"]) <= NEAR for row in told]))
            bench.check(f"{group}: identifiable parameters within 10 %", share, 1.0, ">= 1", "share")
    every = [row for entry in details.values() for row in entry["numbers"]]
    told = [abs(row["error"]) <= NEAR for row in every if row["told"]]
    moved = [row["inside"] for row in every if row["excited"]]
    if told:
        bench.check("all identifiable parameters within 10 %", float(np.mean(told)), 0.9, ">= 1", "share")
    bench.check("intervals that contain the true value", float(np.mean(moved)), 0.9, ">= 1", "share")
    for what in ("inertia", "gravity"):
        worst = max(joint[what] for entry in details.values() for joint in entry["joints"])
        bench.check(f"{what} of a joint over poses: largest error", worst, NEAR, "<= 1", "share")
    for name, entry in details.items():
        ours, rivals = (entry["models"][key]["velocity_mae"]["mean"] for key in ("identified machine", "machine M22"))
        bench.check(f"{name}: velocity MAE against the initial guess", ours, rivals, "<= 1", "mm/s")


def show(name: str, entry: dict[str, Any]) -> None:
    """Print the groups, the joints and the scores of one machine."""
    print(f"\n{name}: {entry['seconds']:.0f} processor s")
    rows = []
    for group, numbers in groups_of({name: entry}).items():
        told, moved = ([row for row in numbers if row[key]] for key in ("told", "excited"))
        errors = [abs(row["error"]) for row in told]
        first = [abs(row["guess_error"]) for row in told]
        cells = [float(np.median(errors)), max(errors), float(np.median(first))] if told else ["-", "-", "-"]
        near = sum(error <= NEAR for error in errors)
        covered = f"{sum(row['inside'] for row in moved)} of {len(moved)}"
        rows.append([group, f"{len(told)} of {len(numbers)}", near, *cells, covered])
    heads = ["group", "told", "within 10 %", "median error", "largest", "guess: median", "moved, in the interval"]
    table(heads, rows)
    keys = ("joint", "inertia", "gravity", "guess_inertia", "guess_gravity")
    table([key.replace("_", ": ") for key in keys], [[joint[key] for key in keys] for joint in entry["joints"]])
    heads = ["model", "velocity MAE, mm/s", "stroke error by time, mm", "pressure NRMSE", "diverged"]
    rows = []
    for model, scores in entry["models"].items():
        strokes = " / ".join(f"{row['mean']:.3g}" for row in scores["stroke_error"])
        mae, pressure = (scores[key]["mean"] for key in ("velocity_mae", "pressure_nrmse"))
        rows.append([model, mae, strokes, pressure, scores["diverged"]])
    table(heads, rows)


if __name__ == "__main__":
    main()
