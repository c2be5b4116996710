"""How fast is the environment? Ticks of 10 ms per processor second on one thread, sensor noise on.

Side by side (64 machines in one compiled call) and one by one through `step`. Beside both, in turns in the same run,
what one would write without them: a `Plant` run a sample at a time, whose last second of rows the sensors measure anew
at each tick; and that plant without any sensors. All move the same machine by the same levers. Figures are given at the
environment's own integration step and at the simulator's 1 ms; what the longer step costs in accuracy stands beside
them. Processor time is quoted because cores are often shared.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from common import finish, parser, table, verdict
from edp.sim import Scenario, Simulation, load_machine
from edp.sim.environment import EnvironmentSpec, ExcavatorEnv, VectorExcavatorEnv
from edp.sim.machine import layout as at
from edp.sim.physics.plant import Plant
from edp.sim.sensors import sensors

Array = NDArray[np.float64]
BATCH, WINDOW = 64, 100
EPISODE_S = 100.0
"""Longer than all turns: no reset is timed."""
GOAL_BATCH, GOAL_SINGLE = 150_000.0, 40_000.0
OWN_STEP_S = EnvironmentSpec().step_s
STEPS_S = (OWN_STEP_S, 1e-3)
EXACT_STEP_S = 2.5e-4
MACHINES = ("M22", "C14")


def levers_of(seed: int, ticks: int) -> Array:
    """Random levers that stay for 0.2 s, shape (tick, machine, 3)."""
    levels = np.random.default_rng(seed).uniform(-1.0, 1.0, (ticks // 20 + 1, BATCH, 3))
    return np.repeat(levels, 20, axis=0)[:ticks]


def rate(work: Callable[[], int]) -> float:
    """Ticks, which `work` returns, per processor second."""
    began = time.process_time()
    ticks = work()
    return ticks / (time.process_time() - began)


def side_by_side(levers: NDArray[np.float32], seed: int, **settings: Any) -> Callable[[], int]:
    env = VectorExcavatorEnv(BATCH, **settings)

    def work() -> int:
        for row in levers:
            env.step(row)
        return BATCH * len(levers)

    env.reset(seed=seed)
    return work


def one_by_one(levers: NDArray[np.float32], seed: int, **settings: Any) -> Callable[[], int]:
    env = ExcavatorEnv(**settings)

    def work() -> int:
        for row in levers:
            env.step(row[0])
        return len(levers)

    env.reset(seed=seed)
    return work


def plant_alone(levers: Array, machine: str, step_s: float) -> Callable[[], int]:
    """The plant a sample at a time without any sensors: what a loop in Python cannot go below."""
    plant = Plant(load_machine(machine), np.full(at.AXES, 0.5), step_s=step_s)

    def work() -> int:
        for row in levers:
            plant.run(row[:1])
        return len(levers)

    return work


def naive(levers: Array, seed: int, machine: str, step_s: float) -> Callable[[], int]:
    """The plant a sample at a time, and the sensors anew over the last rows at each tick."""
    parameters, rng = load_machine(machine), np.random.default_rng(seed)

    def work() -> int:
        plant = Plant(parameters, np.full(at.AXES, 0.5), step_s=step_s)
        rows = np.zeros((0, at.LOG_COLUMNS))
        for row in levers:
            rows = np.concatenate((rows[1 - WINDOW :], plant.run(row[:1])))
            sensors.measured_signals(rows, parameters, 100.0, rng, rows[:, at.LOG_OIL] + 273.15)[-1]
        return len(levers)

    return work


def step_errors(seconds: float, seed: int) -> dict[str, list[float]]:
    """Deviation from steps of 0.25 ms by machine and step: rms of velocities (mm/s), most of the tip (mm)."""
    errors = {}
    for machine in MACHINES:
        for excitation in ("combined", "reversals"):
            simulation = Simulation(Scenario(machine, excitation, seconds, seed=seed))
            simulation.run(simulation.scenario.samples)
            exact, *coarse = (
                Plant(simulation.machine, np.full(at.AXES, 0.5), 100.0, step_s).follow(simulation.targets)
                for step_s in (EXACT_STEP_S, *STEPS_S)
            )
            for step_s, log in zip(STEPS_S, coarse, strict=True):
                error = 1e3 * (log - exact)
                velocity = error[:, at.LOG_VELOCITY : at.LOG_VELOCITY + at.AXES]
                tip = error[:, at.LOG_TIP : at.LOG_TIP + 2]
                errors[f"{machine} {excitation}, {1e3 * step_s:g} ms"] = [
                    float(np.sqrt(np.mean(velocity**2))),
                    float(np.abs(tip).max()),
                ]
    return errors


def main() -> None:
    arguments = parser(__doc__ or "").parse_args()
    quick, seed = arguments.quick, arguments.seed
    ticks, turns = (100, 3) if quick else (400, 15)
    levers = levers_of(seed, ticks)
    actions = levers.astype(np.float32)
    works: dict[str, Callable[[], int]] = {}
    for step_s in STEPS_S:
        settings = {"step_s": step_s, "duration_s": EPISODE_S}
        name = f"{1e3 * step_s:g} ms"
        works[f"side by side, M22, {name}"] = side_by_side(actions, seed, **settings)
        works[f"one by one, M22, {name}"] = one_by_one(actions, seed, **settings)
        works[f"naive loop, M22, {name}"] = naive(levers, seed, "M22", step_s)
        works[f"plant alone by samples, M22, {name}"] = plant_alone(levers, "M22", step_s)
    for label, changes in (("C14", {"machine": "C14"}), ("M22 in clay", {"material": "clay"})):
        works[f"side by side, {label}, {1e3 * OWN_STEP_S:g} ms"] = side_by_side(
            actions, seed, duration_s=EPISODE_S, **changes
        )
    for work in works.values():
        work()
    figures: dict[str, list[float]] = {name: [] for name in works}
    for _ in range(turns):
        for name, work in works.items():
            figures[name].append(rate(work))
    print("ticks per processor second, one thread")
    rows = [[name, statistics.median(v), min(v), max(v), len(v)] for name, v in figures.items()]
    table(["", "median", "least", "most", "turns"], rows)
    errors = step_errors(10.0 if quick else 60.0, seed)
    print()
    table(["against steps of 0.25 ms", "velocities, mm/s rms", "tip, mm at most"], [[k, *v] for k, v in errors.items()])
    verdicts = judged({name: statistics.median(v) for name, v in figures.items()}, errors, quick)
    finish("environment_speed", verdicts, seed, {"ticks per processor second": figures, "errors of steps": errors})


def judged(middle: dict[str, float], errors: dict[str, list[float]], quick: bool) -> list[Any]:
    """Verdicts: the goals at either step, the rival, and the error of the longer step against the sensors' noise."""
    judge = partial(verdict, unit="ticks / processor s", quick=quick)
    verdicts = []
    for step_s in STEPS_S:
        name = f"M22, {1e3 * step_s:g} ms"
        many, one, rival, alone = (
            middle[f"{form}, {name}"] for form in ("side by side", "one by one", "naive loop", "plant alone by samples")
        )
        verdicts += [
            judge(f"64 side by side against the goal, {name}", many, GOAL_BATCH, ">= 1"),
            judge(f"one by one against the goal, {name}", one, GOAL_SINGLE, ">= 1"),
            judge(f"one by one against the naive loop, {name}", one, rival, ">= 5"),
            judge(
                f"one by one against the plant alone, {name}", one, middle[f"plant alone by samples, {name}"], ">= 0.7"
            ),
        ]
    worst = max(v[0] for k, v in errors.items() if k.endswith(f"{1e3 * OWN_STEP_S:g} ms"))
    noise = 1e3 * load_machine("M22").sensors.velocity
    verdicts.append(
        verdict("error of the environment's step against M22's noise", worst, noise, "<= 0.5", "mm/s", quick)
    )
    return verdicts


if __name__ == "__main__":
    main()
