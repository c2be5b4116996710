"""How fast is the simulator? Simulated seconds per CPU second of one core, in free air and in soil.

Ours is the whole loop at 1 ms: operator, dead time, valves, pumps, plant, soil, sensors, logging. Beside it, in turns
in the same run: SciPy's Radau on the plain NumPy model of the parity test, and MuJoCo's bare step of the same three
bodies, without cylinders, oil or friction. CPU time is quoted because cores are often shared.
"""

from __future__ import annotations

import importlib.util
import multiprocessing
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import mujoco
import numpy as np
from scipy.integrate import solve_ivp

from common import Bench, benchmark, table
from edp.sim import Scenario, load_machine, plan_data_set, simulate, simulate_many

PARITY = Path(__file__).parents[1] / "tests" / "parity"
START = "from edp.sim import Scenario, simulate; simulate(Scenario(duration_s=1.0))"
MUJOCO_STEP_S = 1e-3
GOAL, START_S, TEN_HOURS_S = 500.0, 3.0, 120.0


def parity_module(name: str) -> ModuleType:
    """One of the parity tests, for the reference model that it holds."""
    spec = importlib.util.spec_from_file_location(name, PARITY / f"{name}.py")
    if spec is None or spec.loader is None:
        raise FileNotFoundError(PARITY / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def speed(work: Callable[[], float]) -> float:
    """Measure simulated seconds, which `work` returns, per processor second."""
    began = time.process_time()
    simulated = work()
    return simulated / (time.process_time() - began)


def ours(seconds: float, seed: int, material: str, excitation: str) -> Callable[[], float]:
    """Return the complete loop with a fixed seed, so that every repetition does the same work."""
    scenario = Scenario(duration_s=seconds, seed=seed, material=material, excitation=excitation)

    def work() -> float:
        simulate(scenario)
        return seconds

    return work


def bare_mujoco(seconds: float) -> Callable[[], float]:
    """MuJoCo's Euler step of boom, arm and bucket alone, at 1 ms."""
    model = parity_module("test_sim_mujoco").front(load_machine("M22"))
    model.opt.timestep, model.opt.integrator = MUJOCO_STEP_S, mujoco.mjtIntegrator.mjINT_EULER
    data = mujoco.MjData(model)

    def work() -> float:
        mujoco.mj_resetData(model, data)
        mujoco.mj_step(model, data, round(seconds / MUJOCO_STEP_S))
        return seconds

    return work


def radau(seconds: float) -> Callable[[], float]:
    """Radau at rtol 1e-8 on the NumPy model, from rest under constant levers."""
    module = parity_module("test_sim_radau")
    model = module.Reference(module.smooth(load_machine("M22")), module.LEVERS[0])
    start = np.concatenate((module.run_plant("M22", 1e-3)[0], np.zeros(24)))

    def work() -> float:
        solve_ivp(model, (0.0, seconds), start, "Radau", rtol=1e-8, atol=module.scales(1e-8), first_step=1e-5)
        return seconds

    return work


def start_seconds() -> float:
    """Wall time of a fresh process that simulates one second, its code being cached."""
    began = time.perf_counter()
    subprocess.run([sys.executable, "-c", START], check=True)
    return time.perf_counter() - began


def ten_hours(seed: int) -> tuple[float, float]:
    """Wall time of 10 h of M22 on two processes, and the processor time of these two."""
    began, spent = time.perf_counter(), os.times()
    for _ in simulate_many(plan_data_set("M22", minutes=600.0, recordings=60, seed=seed), workers=2):
        pass
    while multiprocessing.active_children():  # their time counts once they have ended
        time.sleep(0.05)
    now = os.times()
    busy = now.children_user + now.children_system - spent.children_user - spent.children_system
    return time.perf_counter() - began, busy


@benchmark()
def main(bench: Bench) -> object:
    quick, seed = bench.quick, bench.seed
    seconds, turns, starts = (50.0, 3, 2) if quick else (200.0, 11, 3)
    works = {
        "ours, free air": ours(seconds, seed, "", "combined"),
        "ours, soil (dig cycles, sandy loam)": ours(seconds, seed, "sandy_loam", "dig"),
        "MuJoCo bare step, 1 ms": bare_mujoco(seconds / 2),
    }
    for work in works.values():
        work()  # compile
    found: dict[str, list[float]] = {name: [] for name in works}
    for _ in range(turns):
        for name, work in works.items():
            found[name].append(speed(work))
    found["SciPy Radau, rtol 1e-8"] = [speed(radau(0.05 if quick else 0.2))]
    print("simulated seconds per CPU second, one core")
    table(
        ["", "median", "least", "most", "turns"],
        [[name, statistics.median(v), min(v), max(v), len(v)] for name, v in found.items()],
    )
    middle = {name: statistics.median(v) for name, v in found.items()}
    air, soil, bare, stiff = middle.values()
    start = min(start_seconds() for _ in range(starts))
    unit = "simulated s / CPU s"
    bench.check("full loop in free air", air, GOAL, ">= 1", unit)
    bench.check("full loop in soil", soil, GOAL, ">= 1", unit)
    bench.check("full loop in free air against SciPy's Radau", air, stiff, ">= 100", unit)
    bench.check("full loop in free air against MuJoCo's bare step", air, bare, ">= 1", unit)
    bench.check("full loop in soil against MuJoCo's bare step", soil, bare, ">= 1", unit)
    bench.check("second start, one second simulated", start, START_S, "<= 1", "s")
    if not quick:
        wall, busy = ten_hours(seed)
        found["10 h of M22 on two cores, wall and processor s"] = [wall, busy]
        print(f"10 h of M22 took two processes {busy:.0f} s of processor time, {wall:.0f} s by the clock")
        bench.check("10 h of M22 on two cores", wall, TEN_HOURS_S, "<= 1", "s")
    return found


if __name__ == "__main__":
    main()
