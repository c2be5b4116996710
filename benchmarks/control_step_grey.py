"""What does a tick of a predictive controller on a grey box cost in C, and does it fit into 10 ms of a Cortex-M7?

The grey box of M22 of `closed_loop.py --part grey` (fitted where --data has none; under a processor minute with
--quick, on fewer logs), and a controller `nmpc` on it, written by `edp export --format controller`. A line on the
simulator is graded by the controller in Python; its observations are fed to the compiled one, whose levers are
compared tick by tick from the same memory. Then the compiled one grades the 18 lines of `closed_loop.py` in free air
and in loam.

Time is processor time on this computer, one thread, a tick at a time. Instructions are counted by Callgrind here, and
by QEMU on a Cortex-M7 with double precision, the mean over ticks behind the first 25. Ticks of a small plan are traced
on the emulated M7, and each instruction is given its cycles on a Cortex-M4 as in `controller_cycles.py` (double
precision counts as single); a Cortex-M7 takes 0.5 of these cycles at best and 0.68 as a rule
(`edp.evaluation.controller`). That table knows no double precision, in which this controller computes: the careful
estimate adds 2 cycles to each product or sum in it and 16 to each division or root, and takes no second instruction a
cycle. Memory has no wait states in this estimate: on a board the numbers of the twin must lie in cache or tightly
coupled memory.
"""

from __future__ import annotations

import ctypes
import re
import subprocess
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import closed_loop as loops
import closed_loop_models as models_of
from board import M7, QEMU_M7, build_image, callgrind, listed_sources, run, run_image, sizes_on_m7
from common import DATA_AND_PARTS, Bench, benchmark, kept, option, table
from controller_cycles import traced_image
from edp.config.control import ControlExperiment
from edp.control.controllers import CONTROLLERS
from edp.control.controllers.nmpc import PredictiveControl
from edp.control.loop import run_loop
from edp.control.models import ControlModels
from edp.control.plant import interface_of
from edp.control.plants import plant_of
from edp.control.tasks import TASKS, draw_task
from edp.control.tasks.grade import Grade
from edp.control.valve_map import ValveMap
from edp.evaluation.controller import CORES
from edp.export.controller import ControllerParts, write_controller
from edp.sim.excitation.levers import speed_table
from edp.storage import make_folder
from edp.training.twin_bundle import TwinBundle, load_twin
from edp.workflows.control import ControlBench, ControlSources
from edp.workflows.control.export_controller import golden_loop, parts_of
from edp.workflows.control.kept import KeptController

PROGRAMS = ("gcc", "valgrind", "arm-none-eabi-gcc", "arm-none-eabi-size", "arm-none-eabi-objdump", "qemu-system-arm")

WARM, MOST = 25, 120
"""Ticks before anything is counted (the look-back begins after 20), and of the loop that is kept."""
CLOCK_MHZ, TICK_MS = 480.0, 10.0
FLAGS = ("-std=gnu99", "-O2", "-ffp-contract=off", "-fno-tree-loop-vectorize", "-I.")
PLANS = ((2, 3, 4, 6, 10, 15), (3, 7, 10, 20), (4, 12, 24))
GRADED = {
    "nominal machine": ("", CONTROLLERS["nmpc"]()),
    "in loam": (loops.LOAM, CONTROLLERS["nmpc"]()),
    "nominal machine, attitude_m = 2": ("", CONTROLLERS["nmpc"](attitude_m=2.0)),
    "in loam, attitude_m = 2": (loops.LOAM, CONTROLLERS["nmpc"](attitude_m=2.0)),
}
"""Plants and controllers; the heavier weight of the attitude was chosen on lines that are not judged."""
DOUBLE = (2, 16)
"""Cycles that a product or sum, and a division or root, may take more in double precision on a Cortex-M7."""
TRACED, SHORT = (2, 3), (2, 4, 6)
"""Ticks of two traces, and the plan that is traced: 3 million instructions of one tick are as many lines."""


PROGRAM = """
#include "machine_control.h"
#include "machine_control_golden.h"
#include <stdio.h>
#ifdef __arm__
#define SYST_CSR (*(volatile uint32_t *)0xE000E010u)
#define SYST_RVR (*(volatile uint32_t *)0xE000E014u)
#define SYST_CVR (*(volatile uint32_t *)0xE000E018u)
#else
#include <time.h>
static double now_us(void) {
    struct timespec t;
    (void)clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &t);
    return 1e6 * (double)t.tv_sec + 1e-3 * (double)t.tv_nsec;
}
#endif
static machine_control control;
static const edp_reference reference = {GOLDEN_ROWS, golden_strokes, golden_tip};
int main(void) {
    float levers[EDP_AXES];
    unsigned long long total = 0u;
    (void)total;
    (void)machine_control_begin(&control, golden_measured[0], &reference);
    for (unsigned tick = 0; tick < TICKS; tick++) {
#if defined(__arm__) && defined(COUNTED)
        SYST_RVR = 0xFFFFFFu;
        SYST_CVR = 0u;
        SYST_CSR = 5u;
        const uint32_t start = SYST_CVR;
#elif defined(TIMED)
        const double start = now_us();
#endif
        (void)machine_control_step(&control, golden_measured[tick], levers);
#if defined(__arm__) && defined(COUNTED)
        total += (tick < SKIPPED) ? 0u : (((start - SYST_CVR) & 0xFFFFFFu) * 40u);
#elif defined(TIMED)
        (void)printf("%.3f %u\\n", now_us() - start, (unsigned)control.iterations);
#endif
    }
#ifdef COUNTED
    (void)printf("%lu", (unsigned long)(total / (TICKS - SKIPPED)));
#endif
    return (int)(control.neutral + control.fallbacks);
}
"""


@benchmark(
    DATA_AND_PARTS, option("--twin", type=Path, help="run folder of a grey box, in place of a fit"), programs=PROGRAMS
)
def main(bench: Bench) -> object:
    models = models_of.Models(bench.folder, models_of.FULL, bench.seed)
    run_of = bench.options.twin or models.grey(models_of.QUICK_GREY if bench.quick else models_of.GREY)
    twin, own = load_twin(run_of), make_folder(bench.folder / "controllers")
    # What a run of this benchmark has left here is read.
    found = kept(own / "costs.json", lambda: costs(twin, own, bench.seed, bench.quick))
    found["lines"] = kept(own / "lines.json", lambda: graded(run_of, twin, own / "lines", bench.quick))
    first, air = found["plans"][0], found["lines"]["nominal machine"]
    for name, ours, goal, unit in (
        ("99th percentile of a time step in C on a desktop", found["host_us"]["p99"] / 1000.0, 2.0, "ms"),
        ("estimated ms on a Cortex-M7 at 480 MHz, typical", first["typical_ms"], TICK_MS, "ms"),
        ("estimated ms on a Cortex-M7 at 480 MHz, pessimistic", first["careful_ms"], TICK_MS, "ms"),
        ("largest difference of a lever from Python, from equal states", found["lever"], 2e-3, "1"),
        ("path error in C, mean of the lines in free air", float(np.mean(air["path_rms_mm"])), 3.0, "mm"),
        ("99th percentile of a time step in C along the lines", air["tick_ms"]["p99"], 2.0, "ms"),
    ):
        bench.check(name, ours, goal, "<= 1", unit)
    return found


class LoopBench:
    """One line on the simulator, and what controllers on it export.

    Args:
        seed: of the line.
    """

    def __init__(self, seed: int) -> None:
        self.env = plant_of("M22", 40.0, 100.0)
        self.plant = interface_of(self.env)
        self.valves = ValveMap(*speed_table(self.env.machine))
        self.task = Grade(length_m=(0.8, 1.0), speed_m_s=0.4, lead_s=0.2, hold_s=0.2)
        self.drawn = draw_task(self.task, self.plant.geometry, 100.0, seed)
        self._observed: np.ndarray | None = None

    def exported(
        self, twin: TwinBundle, blocks: tuple[int, ...], folder: Path, **options: float
    ) -> tuple[KeptController, ControllerParts]:
        """Export a controller on this twin as C with the loop of the first controller."""
        spec = PredictiveControl(blocks=blocks, **options)
        models = ControlModels(self.valves, twin.twin)
        experiment = ControlExperiment(task=self.task, controller=spec)
        if self._observed is None:
            controller = spec.build(self.plant, self.drawn.limits, models)
            result = run_loop(self.env, controller, self.drawn, 0)
            self._observed = result.recording.values[:MOST, : len(self.plant.channels)].astype(float)
        reference = self.drawn.reference
        kept = KeptController(experiment, self.plant, models, twin, self._observed,
                              np.zeros((len(self._observed), 3)), reference.strokes, reference.tip)  # fmt: skip
        parts = parts_of(experiment, self.plant, models, twin)
        write_controller(replace(parts, golden=golden_loop(parts, kept)), "machine", folder)
        (folder / "program.c").write_text(PROGRAM)
        return kept, parts


def host_times(folder: Path) -> np.ndarray:
    """Microseconds of processor and iterations of each tick behind the first ones, the fastest of three runs each."""
    run(["gcc", *FLAGS, "-DTIMED", f"-DTICKS={MOST}u", *controller_sources(folder), "-lm", "-o", "timed"], folder)
    runs = [np.array([line.split() for line in run(["./timed"], folder).splitlines()], float) for _ in range(3)]
    best = runs[0].copy()
    best[:, 0] = np.min([each[:, 0] for each in runs], axis=0)
    return best[WARM:]


def host_instructions(folder: Path) -> int:
    """Instructions of a tick on this computer."""
    counts = []
    for ticks in (WARM, WARM + 20):
        run(["gcc", *FLAGS, f"-DTICKS={ticks}u", *controller_sources(folder), "-lm", "-o", "program"], folder)
        counts.append(callgrind(folder))
    return (counts[1] - counts[0]) // 20


def controller_sources(folder: Path) -> list[str]:
    """Return the test program and the C files of the controller."""
    return ["program.c", *listed_sources(folder)]


def built_for_m7(folder: Path, *flags: str) -> None:
    build_image(folder, M7, controller_sources(folder), "-fno-tree-loop-vectorize", *flags)


def m7_instructions(folder: Path) -> int:
    """Return the executed instructions of one sample on the M7, averaged over four samples after the first ones."""
    built_for_m7(folder, "-DCOUNTED", f"-DTICKS={WARM + 4}u", f"-DSKIPPED={WARM}u")
    return int(run_image(folder, QEMU_M7)[-1])


def costs(twin: TwinBundle, folder: Path, seed: int, quick: bool) -> dict[str, Any]:
    """Figures of the default plan, and costs by plan."""
    loop = LoopBench(seed)
    plans, host, lever, calls = [], np.zeros((1, 2)), 0.0, 0
    each: Mapping[str, float] = {}
    for blocks in PLANS[:1] if quick else PLANS:
        own = folder / "_".join(map(str, blocks))
        loop.exported(twin, blocks, own)
        if not plans:
            host, calls, lever = host_times(own), host_instructions(own), self_test(own)
            loop.exported(twin, SHORT, folder / "short")
            each = cycles_of(folder / "short")
        plans.append(on_m7(own, blocks, each))
    table(
        ["blocks", "M7 instructions", "ms, best", "ms, as a rule", "ms, careful", "code and constants", "state, bytes"],
        [[",".join(map(str, row["blocks"])), row["instructions"], row["low_ms"], row["typical_ms"], row["careful_ms"],
          row["flash_bytes"], row["state_bytes"]] for row in plans],
    )  # fmt: skip
    times = {"median": float(np.median(host[:, 0])), "p99": float(np.percentile(host[:, 0], 99))}
    print(f"{times['median']:.0f} us a tick, p99 {times['p99']:.0f}; {calls:,} instructions on this processor")
    return {"host_us": times, "callgrind": calls, "lever": lever, "cycles_by_instruction": dict(each), "plans": plans}


class Compiled:
    """The exported controller with the interface that a loop needs.

    Args:
        library: the controller as a shared library.
        python: the controller in Python, whose plant and channels it has.
    """

    class Reference(ctypes.Structure):
        """``edp_reference``."""

        _fields_ = (("ticks", ctypes.c_uint32), ("strokes", ctypes.c_void_p), ("tip", ctypes.c_void_p))

    def __init__(self, library: Path, python: Any) -> None:
        self.plant, self.before = python.plant, np.zeros(3)
        self.events: list[Any] = []
        self.info: dict[str, float] = {}
        self.statuses: list[int] = []
        self.seconds: list[float] = []
        self._columns = python.plant.columns(python.reads)
        loaded = ctypes.CDLL(str(library))
        self._begin, self._step = loaded.machine_control_begin, loaded.machine_control_step
        self._state = ctypes.create_string_buffer(1_000_000)

    def reset(self, observation: np.ndarray, reference: Any) -> None:
        """Begin a reference."""
        self._rows = [np.ascontiguousarray(rows, np.float32) for rows in (reference.strokes, reference.tip)]
        self._reference = self.Reference(reference.ticks, *(rows.ctypes.data for rows in self._rows))
        if self._begin(self._state, self._row(observation), ctypes.byref(self._reference)):
            raise RuntimeError("the exported controller refuses the reference")

    def step(self, observation: np.ndarray, tick: int, verdict: Any = None) -> np.ndarray:
        """Levers of a tick."""
        levers, row = np.zeros(3, np.float32), self._row(observation)
        began = time.thread_time()
        self.statuses.append(self._step(self._state, row, levers.ctypes.data_as(ctypes.c_void_p)))
        self.seconds.append(time.thread_time() - began)
        self.before = levers.astype(float)
        return self.before

    def _row(self, observation: np.ndarray) -> Any:
        self._last = np.ascontiguousarray(np.asarray(observation)[self._columns], np.float32)
        return self._last.ctypes.data_as(ctypes.c_void_p)


def graded(run: Path, twin: TwinBundle, folder: Path, quick: bool) -> dict[str, dict[str, Any]]:
    """Evaluate the compiled controller on the lines of `closed_loop.py`, in free air and in loam."""
    rows: dict[str, dict[str, Any]] = {}
    for name, (material, spec) in list(GRADED.items())[: 1 if quick else None]:
        rows[name] = row = {"path_rms_mm": [], "position_rms_mm": [], "attitude_rms_deg": [], "violations": 0}
        compiled: list[Compiled] = []
        for first in loops.DRAWS[:1] if quick else loops.DRAWS:
            experiment = ControlExperiment(
                task=TASKS["grade"](material=material), controller=spec, machine="M22",
                loops=1 if quick else loops.FULL.lines, seed=first,
            )  # fmt: skip
            bench = ControlBench(experiment, ControlSources(twin=run))
            library = as_library(bench, experiment, twin, folder / name.replace(" ", "_"))
            for task in bench.tasks:
                python = experiment.controller.build(bench.plant, task.limits, bench.models)
                compiled.append(Compiled(library, python))
                score = run_loop(bench._env, compiled[-1], task, task.seed).score  # type: ignore[arg-type]
                for figure in ("path_rms_mm", "position_rms_mm", "attitude_rms_deg"):
                    row[figure].append(getattr(score, figure))
                row["violations"] += sum(score.violations.values())
        times = 1e3 * np.concatenate([one.seconds for one in compiled])
        row["tick_ms"] = {
            "median": float(np.median(times)),
            "p99": float(np.percentile(times, 99)),
            "ticks": len(times),
        }
        row["not_of_the_plan"] = sum(status != 0 for one in compiled for status in one.statuses)
    table(
        ["in C", "path, mm", "worst", "position, mm", "attitude, deg", "violations", "ms", "p99", "fallbacks"],
        [[name, np.mean(row["path_rms_mm"]), max(row["path_rms_mm"]), np.mean(row["position_rms_mm"]),
          np.mean(row["attitude_rms_deg"]), row["violations"], row["tick_ms"]["median"], row["tick_ms"]["p99"],
          row["not_of_the_plan"]] for name, row in rows.items()],
    )  # fmt: skip
    return rows


def as_library(bench: ControlBench, experiment: ControlExperiment, twin: TwinBundle, folder: Path) -> Path:
    """Compile the controller of a bench as a shared library; each random draw has valve maps of its own."""
    own = folder / str(experiment.seed)
    write_controller(parts_of(experiment, bench.plant, bench.models, twin), "machine", own)
    (own / "program.c").write_text("")
    sources = listed_sources(own)
    run(["gcc", *FLAGS, "-fPIC", "-shared", *sources, "-lm", "-o", "machine.so"], own)
    return own / "machine.so"


def self_test(folder: Path) -> float:
    """Largest difference of a lever that the exported test has seen; it must pass."""
    run(["gcc", *FLAGS, *listed_sources(folder), "host_test.c", "-lm", "-o", "tested"], folder)
    said = subprocess.run(["./tested"], cwd=folder, capture_output=True, text=True, check=False)
    worst = re.search(r"difference of a lever: (\S+)", said.stdout)
    if said.returncode or worst is None:
        raise RuntimeError(f"the self-test of the controller failed: {said.stdout[-500:]}")
    return float(worst[1])


def cycles_of(folder: Path) -> dict[str, float]:
    """Cycles of an instruction by the table of the M4, doubles as singles and with what they may take more."""
    found = {}
    for name, double in {"table": (0, 0), "careful": DOUBLE}.items():
        counts = []
        for ticks in TRACED:
            built_for_m7(folder, f"-DTICKS={ticks}u")
            counts.append(traced_image(folder, QEMU_M7, double))
        (few, short), (many, long) = counts
        found[name] = (long - short) / (many - few)
    return found


def on_m7(folder: Path, blocks: tuple[int, ...], each: Mapping[str, float]) -> dict[str, Any]:
    """Instructions, milliseconds and bytes."""
    core, count = CORES["cortex_m7"], m7_instructions(folder)
    ms = count / (CLOCK_MHZ * 1000.0)
    flash, state = sizes_on_m7(folder, listed_sources(folder), "machine_control.h", "machine_control")
    return {
        "blocks": blocks, "instructions": count, "low_ms": ms * each["table"] * core.low,
        "typical_ms": ms * each["table"] * core.typical, "careful_ms": ms * each["careful"],
        "flash_bytes": flash, "state_bytes": state,
    }  # fmt: skip


if __name__ == "__main__":
    main()
