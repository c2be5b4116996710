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
from typing import Any

import numpy as np
from numpy.typing import NDArray

from common import Bench, benchmark, table
from edp.sim import Scenario, Simulation, load_machine
from edp.sim.environment import EnvironmentSpec, ExcavatorEnv, VectorExcavatorEnv
from edp.sim.machine import layout as at
from edp.sim.physics.plant import Plant
from edp.sim.sensors import sensors

Array = NDArray[np.float64]
BATCH, WINDOW = 64, 100
TICKS, SINGLES, NAIVE = 400, 4, 40
"""Ticks of a run from the start, runs of a turn one by one, and ticks of a turn of the naive loop."""
EPISODE_S = 10.0
"""Longer than a run: no reset is timed."""
GOAL_BATCH, GOAL_SINGLE = 150_000.0, 40_000.0
OWN_STEP_S = EnvironmentSpec().step_s
STEPS_S = (OWN_STEP_S, 1e-3)
EXACT_STEP_S, JUDGED_STEPS_S = 2.5e-4, (OWN_STEP_S, 2e-3, 1e-3)
MACHINES = ("M22", "C14")


Turn = Callable[[], float]
"""A turn of one form: ticks per processor second. Turns are short and alternate, so that other work on the machine
meets all forms alike."""


def levers_of(seed: int, ticks: int) -> Array:
    """Random levers that stay for 0.2 s, shape (tick, machine, 3)."""
    levels = np.random.default_rng(seed).uniform(-1.0, 1.0, (ticks // 20 + 1, BATCH, 3))
    return np.repeat(levels, 20, axis=0)[:ticks]


def timed(step: Callable[[Array], Any], rows: Array, ticks_a_row: int) -> float:
    """Ticks per processor second of `step` on every row."""
    began = time.process_time()
    for row in rows:
        step(row)
    return ticks_a_row * len(rows) / (time.process_time() - began)


def side_by_side(levers: Array, seed: int, **settings: Any) -> Turn:
    env, actions = VectorExcavatorEnv(BATCH, **settings), levers.astype(np.float32)
    env.reset(seed=seed)
    moments = [env.snapshot(index) for index in range(BATCH)]

    def turn() -> float:
        # Each turn does the same work: near the ends of the stroke steps are shorter.
        for index, moment in enumerate(moments):
            env.restore(index, moment)
        return timed(env.step, actions, BATCH)

    return turn


def one_by_one(levers: Array, seed: int, **settings: Any) -> Turn:
    env, actions = ExcavatorEnv(**settings), levers.astype(np.float32)
    env.reset(seed=seed)
    moment = env.snapshot()

    def turn() -> float:
        rates = []
        for index in range(SINGLES):
            env.restore(moment)
            rates.append(timed(env.step, actions[:, index], 1))
        return statistics.harmonic_mean(rates)

    return turn


def plant_alone(levers: Array, machine: str, step_s: float) -> Turn:
    """Return the plant without sensors, one sample at a time: the lower bound for a loop in Python."""
    parameters = load_machine(machine)

    def turn() -> float:
        plant = Plant(parameters, np.full(at.AXES, 0.5), step_s=step_s)
        return timed(plant.run, levers[:, :1], 1)

    return turn


def naive(levers: Array, seed: int, machine: str, step_s: float) -> Turn:
    """Return the plant with sensors that are recomputed over the last rows at each sample."""
    parameters, rng = load_machine(machine), np.random.default_rng(seed)

    def turn() -> float:
        plant, rows = Plant(parameters, np.full(at.AXES, 0.5), step_s=step_s), [np.zeros((0, at.LOG_COLUMNS))]

        def step(lever: Array) -> None:
            rows[0] = np.concatenate((rows[0][1 - WINDOW :], plant.run(lever)))
            sensors.measure_signals(rows[0], parameters, 100.0, rng, rows[0][:, at.LOG_OIL] + 273.15)

        return timed(step, levers[:NAIVE, :1], 1)

    return turn


def step_errors(seconds: float, seed: int) -> dict[str, list[float]]:
    """Deviation from steps of 0.25 ms by machine and step: rms of velocities (mm/s), most of the tip (mm)."""
    errors = {}
    for machine in MACHINES:
        for excitation in ("combined", "reversals"):
            simulation = Simulation(Scenario(machine, excitation, seconds, seed=seed))
            simulation.run(simulation.scenario.samples)
            exact, *coarse = (
                Plant(simulation.machine, np.full(at.AXES, 0.5), 100.0, step_s).follow(simulation.targets)
                for step_s in (EXACT_STEP_S, *JUDGED_STEPS_S)
            )
            for step_s, log in zip(JUDGED_STEPS_S, coarse, strict=True):
                error = 1e3 * (log - exact)
                velocity = error[:, at.LOG_VELOCITY : at.LOG_VELOCITY + at.AXES]
                tip = error[:, at.LOG_TIP : at.LOG_TIP + 2]
                errors[f"{machine} {excitation}, {1e3 * step_s:g} ms"] = [
                    float(np.sqrt(np.mean(velocity**2))),
                    float(np.abs(tip).max()),
                ]
    return errors


@benchmark()
def main(bench: Bench) -> object:
    quick, seed = bench.quick, bench.seed
    turns = 5 if quick else 61
    levers = levers_of(seed, TICKS)
    forms: dict[str, Turn] = {}
    for step_s in STEPS_S:
        settings = {"step_s": step_s, "duration_s": EPISODE_S}
        name = f"M22, {1e3 * step_s:g} ms"
        forms[f"side by side, {name}"] = side_by_side(levers, seed, **settings)
        forms[f"one by one, {name}"] = one_by_one(levers, seed, **settings)
        forms[f"naive loop, {name}"] = naive(levers, seed, "M22", step_s)
        forms[f"plant alone by samples, {name}"] = plant_alone(levers, "M22", step_s)
    for label, changes in (("C14", {"machine": "C14"}), ("M22 in clay", {"material": "clay"})):
        name = f"side by side, {label}, {1e3 * OWN_STEP_S:g} ms"
        forms[name] = side_by_side(levers, seed, duration_s=EPISODE_S, **changes)
    figures: dict[str, list[float]] = {name: [] for name in forms}
    for number in range(turns + 1):
        for name, turn in forms.items():
            ticks_a_second = turn()
            # The first turn compiles and is left out.
            if number > 0:
                figures[name].append(ticks_a_second)
    print("ticks per processor second, one thread")
    rows = [[name, statistics.median(v), min(v), max(v), len(v)] for name, v in figures.items()]
    table(["", "median", "least", "most", "turns"], rows)
    errors = step_errors(10.0 if quick else 60.0, seed)
    print()
    table(["against steps of 0.25 ms", "velocities, mm/s rms", "tip, mm at most"], [[k, *v] for k, v in errors.items()])
    check(bench, {name: statistics.median(v) for name, v in figures.items()}, errors)
    return {"ticks per processor second": figures, "errors of steps": errors}


def check(bench: Bench, middle: dict[str, float], errors: dict[str, list[float]]) -> None:
    """Verdicts: the goals at either step, the rival, and the error of the longer step against the sensors' noise."""
    for step_s in STEPS_S:
        name = f"M22, {1e3 * step_s:g} ms"
        forms = ("side by side", "one by one", "naive loop", "plant alone by samples")
        many, one, rival, alone = (middle[f"{form}, {name}"] for form in forms)
        unit = "ticks / processor s"
        bench.check(f"64 environments in a batch, {name}", many, GOAL_BATCH, ">= 1", unit)
        bench.check(f"single environments, {name}", one, GOAL_SINGLE, ">= 1", unit)
        bench.check(f"single environments against a naive loop, {name}", one, rival, ">= 5", unit)
        bench.check(f"single environments against the plant alone, {name}", one, alone, ">= 0.7", unit)
    worst = max(v[0] for k, v in errors.items() if k.endswith(f"{1e3 * OWN_STEP_S:g} ms"))
    noise = 1e3 * load_machine("M22").sensors.velocity
    bench.check("error of the integration step against sensor noise", worst, noise, "<= 0.5", "mm/s")


if __name__ == "__main__":
    main()
