"""What does a tick of an exported predictive controller cost, and does it fit into 10 ms of a Cortex-M7 at 480 MHz?

A controller `nmpc` with its defaults (40 ticks in six blocks, 18 variables) grades a line on the simulated M22; its
plan rests on a recurrent twin that nobody trained (drawn weights, pulled to a static map where the map is named), since
costs hardly depend on weights. Observations of that loop are fed to the compiled controller again.

Time is processor time on this computer, one thread, a tick at a time. Instructions are counted by Callgrind here, and
by QEMU on a Cortex-M7 with double precision, the mean over ticks behind the first 25. Two ticks of a small plan are
traced on the emulated M7, and each instruction is given its cycles on a Cortex-M4 as in `controller_cycles.py` (double
precision counts as single); a Cortex-M7 takes 0.5 of these cycles at best and 0.68 as a rule
(`edp.evaluation.controller`). Memory has no wait states in this estimate: on a board the weights of the twin must lie
in cache or tightly coupled memory.

The rival is CasADi's `sqpmethod` on the same problem: the same twin (`edp export --to casadi`), horizon, blocks, valve
map, kinematics, reference, cost, bounds and state, with DAQP and the Gauss-Newton Hessian, one iteration from the same
plan. Its step is compared with that of the controller in Python.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from common import finish, parser, table, verdict
from control_step_rival import Rival, plan_of
from controller_cycles import traced_image
from edp.config.control import ControlExperiment
from edp.control.controllers.nmpc import PredictiveControl
from edp.control.loop import run_loop
from edp.control.models import ControlModels
from edp.control.plant import interface_of
from edp.control.plants import plant_of
from edp.control.tasks import draw_task
from edp.control.tasks.grade import Grade
from edp.control.valve_map import ValveMap
from edp.evaluation.controller import CORES
from edp.export.controller import ControllerParts, write_controller
from edp.networks.twin.recurrent import Recurrent
from edp.sim.excitation.levers import speed_table
from edp.testing.control import sample_recurrent_twin
from edp.training.twin_bundle import TwinBundle
from edp.workflows.control.export_controller import golden_loop, parts_of
from edp.workflows.control.kept import KeptController
from embedded_step import BOARD

PROGRAMS = ("gcc", "valgrind", "arm-none-eabi-gcc", "qemu-system-arm")

WARM, MOST = 25, 120
"""Ticks before anything is counted (the look-back begins after 20), and of the loop that is kept."""
CLOCK_MHZ, TICK_MS = 480.0, 10.0
DEFAULT = (2, 3, 4, 6, 10, 15)
FLAGS = ("-std=gnu99", "-O2", "-ffp-contract=off", "-fno-tree-loop-vectorize", "-I.")
M7 = ("-mthumb", "-mcpu=cortex-m7", "-mfloat-abi=hard", "-mfpu=fpv5-d16", "--specs=rdimon.specs", "-nostartfiles")
QEMU = ("qemu-system-arm", "-M", "mps2-an500", "-nographic", "-semihosting-config", "enable=on,target=native")
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


def main() -> None:
    arguments = parser(__doc__ or "", PROGRAMS).parse_args()
    quick, seed = arguments.quick, arguments.seed
    units = 16 if quick else 48
    bench = LoopBench(seed)
    with tempfile.TemporaryDirectory() as temporary:
        root = Path(temporary)
        main_folder = root / "main"
        kept, parts = bench.exported(sample_recurrent_twin(units), DEFAULT, main_folder)
        timed = host_times(main_folder)
        print(f"twin of {units} units on a map: {np.median(timed[:, 0]):.0f} us a tick, p99 "
              f"{np.percentile(timed[:, 0], 99):.0f}; iterations {timed[:, 1].mean():.1f}, "
              f"most {timed[:, 1].max():.0f}; "
              f"{callgrind(main_folder):,} instructions on this processor")  # fmt: skip
        rival = Rival(kept, parts, root / "casadi")
        rival_ms, apart = rival.compare(kept, (30, 60) if quick else (30, 45, 60, 75, 90))
        each = cycles_each(bench, root / "trace")
        rows = sized(bench, root, quick, each)
    sizes_table(rows)
    ours = float(np.median(timed[:, 0])) / 1000.0
    name = "a tick of the controller in C against one iteration of CasADi's sqpmethod"
    verdicts = [verdict(name, ours, float(np.median(rival_ms)), "<= 0.1", "ms", quick)]
    default = next(row for row in rows if row["blocks"] == DEFAULT and row["units"] == units)
    name = f"width {units}, default plan: estimated ms on a Cortex-M7 at 480 MHz, as a rule"
    verdicts.append(verdict(name, default["typical_ms"], TICK_MS, "<= 1", "ms", quick))
    name = "p99 of a tick in C on this machine"
    verdicts.append(verdict(name, float(np.percentile(timed[:, 0], 99)) / 1000.0, 2.0, "<= 1", "ms", quick))
    details = {
        "host_us": {"median": float(np.median(timed[:, 0])), "p99": float(np.percentile(timed[:, 0], 99))},
        "iterations": {"mean": float(timed[:, 1].mean()), "most": float(timed[:, 1].max())},
        "rival_ms": [float(value) for value in rival_ms],
        "first_step_apart_m_s": apart,
        "m4_cycles_by_instruction": each,
        "sizes": rows,
    }
    print(f"first step of both apart by at most {apart:.2e} m/s; {each:.3f} cycles an instruction on the M4's table")
    finish("control_step", verdicts, seed, details)


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
        """A controller on this twin, written as C with the loop of the first one."""
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


def sources_of(folder: Path) -> list[str]:
    """The program, and the C files of the controller as its CMake file lists them."""
    listed = re.search(r"add_library\(machine_control STATIC (.*)\)", (folder / "CMakeLists.txt").read_text())
    if listed is None:
        raise RuntimeError("the CMake file of an exported controller has another form")
    return ["program.c", *listed[1].split()]


def run(command: list[str], folder: Path) -> str:
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(f"{command[0]} ended with {done.returncode}: {(done.stdout + done.stderr)[-1000:]}")
    return done.stdout + done.stderr


def host_times(folder: Path) -> np.ndarray:
    """Microseconds of processor and iterations of each tick behind the first ones, the fastest of three runs each."""
    run(["gcc", *FLAGS, "-DTIMED", f"-DTICKS={MOST}u", *sources_of(folder), "-lm", "-o", "timed"], folder)
    runs = [np.array([line.split() for line in run(["./timed"], folder).splitlines()], float) for _ in range(3)]
    best = runs[0].copy()
    best[:, 0] = np.min([each[:, 0] for each in runs], axis=0)
    return best[WARM:]


def callgrind(folder: Path) -> int:
    """Instructions of a tick on this computer."""
    counts = []
    for ticks in (WARM, WARM + 20):
        run(["gcc", *FLAGS, f"-DTICKS={ticks}u", *sources_of(folder), "-lm", "-o", "counted"], folder)
        told = run(["valgrind", "--tool=callgrind", "--callgrind-out-file=calls", "./counted"], folder)
        found = re.search(r"Collected : (\d+)", told)
        counts.append(int(found[1]) if found else 0)
    return (counts[1] - counts[0]) // 20


def built_for_m7(folder: Path, *flags: str) -> None:
    rest = [*sources_of(folder), str(BOARD / "startup.c"), "-lm", "-lrdimon", "-o", "image.elf"]
    run(["arm-none-eabi-gcc", *FLAGS, *M7, *flags, "-T", str(BOARD / "mps2.ld"), *rest], folder)


def m7_instructions(folder: Path) -> int:
    """Executed instructions of a tick on the M7, the mean over four behind the first ones."""
    built_for_m7(folder, "-DCOUNTED", f"-DTICKS={WARM + 4}u", f"-DSKIPPED={WARM}u")
    return int(run([*QEMU, "-icount", "shift=0", "-kernel", "image.elf"], folder).split()[-1])


def cycles_each(bench: LoopBench, folder: Path) -> float:
    """Cycles of an instruction by the table of the M4, in two ticks of a short plan on a twin of 48 units."""
    bench.exported(drawn_twin(48), (2, 3), folder)
    counts = []
    for ticks in (2, 4):
        built_for_m7(folder, f"-DTICKS={ticks}u")
        counts.append(traced_image(folder, QEMU))
    (few, short), (many, long) = counts
    return (long - short) / (many - few)


def drawn_twin(units: int) -> TwinBundle:
    """A recurrent twin as `edp twin` makes it, without a map and untrained."""
    sample = sample_recurrent_twin(units).twin
    spec = Recurrent(units=units)
    twin = spec.start(sample.channels, sample.scales, [], 0)
    return TwinBundle(spec, twin)


SIZES = (
    *((48, DEFAULT), (48, (3, 5, 8)), (48, (4, 8)), (32, DEFAULT), (32, (3, 5, 8)), (24, (3, 5, 8, 14))),
    *((16, DEFAULT), (16, (3, 7, 10, 20)), (16, (4, 12, 24))),
)
"""Units and blocks; the short form counts the default plan of 16 units alone."""


def sized(bench: LoopBench, root: Path, quick: bool, each: float) -> list[dict[str, Any]]:
    """Cost of a tick by width and plan."""
    rows, core = [], CORES["cortex_m7"]
    for units, blocks in ((16, DEFAULT),) if quick else SIZES:
        folder = root / f"size_{len(rows)}"
        _, parts = bench.exported(drawn_twin(units), blocks, folder)
        count = m7_instructions(folder)
        ms = count * each / (CLOCK_MHZ * 1000.0)
        rows.append({
            "units": units, "blocks": blocks, "horizon": sum(blocks), "lane_ticks": plan_of(parts).lane_ticks,
            "instructions": count, "low_ms": ms * core.low, "typical_ms": ms * core.typical, "high_ms": ms,
        })  # fmt: skip
        shutil.rmtree(folder)
    return rows


def sizes_table(rows: list[dict[str, Any]]) -> None:
    heads = ["units", "blocks", "ticks ahead", "twin's ticks", "M7 instructions", "ms, best", "ms, as a rule", "fits"]
    lines = [
        [row["units"], ",".join(map(str, row["blocks"])), row["horizon"], row["lane_ticks"], row["instructions"],
         row["low_ms"], row["typical_ms"], "yes" if row["typical_ms"] <= TICK_MS else "no"]
        for row in rows
    ]  # fmt: skip
    table(heads, lines)


if __name__ == "__main__":
    main()
