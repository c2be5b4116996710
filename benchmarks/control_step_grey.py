"""What does a tick of a predictive controller on a grey box cost in C, and does it fit into 10 ms of a Cortex-M7?

The grey box of M22 of `closed_loop.py --part grey` (fitted where --data has none; under a processor minute with
--quick, on fewer logs), and a controller `nmpc` on it, written by `edp export --to controller`. A line on the simulator
is graded by the controller in Python; its observations are fed to the compiled one, whose levers are compared tick by
tick from the same memory. Then the compiled one grades the 18 lines of `closed_loop.py` in free air and in loam.

Time, instructions and their cycles on a Cortex-M7 are measured as in `control_step.py`. The table of the Cortex-M4
knows no double precision, in which this controller computes: the careful estimate adds 2 cycles to each product or sum
in it and 16 to each division or root, and takes no second instruction a cycle.
"""

from __future__ import annotations

import ctypes
import re
import subprocess
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

import closed_loop_models as models_of
import closed_loop_nmpc as nmpc_of
import control_step as step_of
from common import finish, in_folder, kept, parser, table, verdict
from control_step_rival import Rival
from controller_cycles import traced_image
from edp.config.control import ControlExperiment
from edp.control.controllers import CONTROLLERS
from edp.control.loop import run_loop
from edp.control.tasks import TASKS
from edp.evaluation.controller import CORES
from edp.export.controller import write_controller
from edp.storage import make_folder
from edp.training.twin_bundle import TwinBundle, load_twin
from edp.workflows.control import ControlBench, ControlSources
from edp.workflows.control.export_controller import parts_of

PROGRAMS = ("gcc", "arm-none-eabi-gcc", "arm-none-eabi-size", "qemu-system-arm")

PLANS = ((2, 3, 4, 6, 10, 15), (3, 7, 10, 20), (4, 12, 24))
GRADED = {
    "as it was": ("", CONTROLLERS["nmpc"]()),
    "in loam": (nmpc_of.LOAM, CONTROLLERS["nmpc"]()),
    "as it was, attitude_m = 2": ("", CONTROLLERS["nmpc"](attitude_m=2.0)),
    "in loam, attitude_m = 2": (nmpc_of.LOAM, CONTROLLERS["nmpc"](attitude_m=2.0)),
}
"""Plants and controllers; the heavier weight of the attitude was chosen on lines that are not judged."""
DOUBLE = (2, 16)
"""Cycles that a product or sum, and a division or root, may take more in double precision on a Cortex-M7."""
RIVAL_TICKS = (30, 60, 90)
"""Of the loop, at which CasADi solves the same problem."""
TRACED, SHORT = (2, 3), (2, 4, 6)
"""Ticks of two traces, and the plan that is traced: 3 million instructions of one tick are as many lines."""


def main() -> None:
    arguments_of = parser(__doc__ or "", PROGRAMS)
    arguments_of.add_argument("--twin", type=Path, default=None, help="run folder of a grey box, in place of a fit")
    arguments = arguments_of.parse_args()
    found: dict[str, Any] = {}

    def measure(folder: Path) -> None:
        models = models_of.Models(folder, models_of.FULL, arguments.seed)
        run = arguments.twin or models.grey(models_of.QUICK_GREY if arguments.quick else models_of.GREY)
        twin, own = load_twin(run), make_folder(folder / "controllers")
        # What a run of this benchmark has left here is read.
        found.update(kept(own / "costs.json", lambda: costs(twin, own, arguments.seed, arguments.quick)))
        found["rival"] = kept(own / "rival.json", lambda: rivalled(twin, own / "rival", arguments.seed))
        found["lines"] = kept(own / "lines.json", lambda: graded(run, twin, own / "lines", arguments.quick))

    in_folder(arguments.data, measure)
    first = found["plans"][0]
    rows = [
        ("p99 of a tick in C on this machine", found["host_us"]["p99"] / 1000.0, 2.0, "ms"),
        ("estimated ms on a Cortex-M7 at 480 MHz, as a rule", first["typical_ms"], step_of.TICK_MS, "ms"),
        ("the same, careful", first["careful_ms"], step_of.TICK_MS, "ms"),
        ("largest difference of a lever from that in Python, from the same memory", found["lever"], 2e-3, "1"),
    ]
    air = found["lines"]["as it was"]
    rows += [
        ("path error in C, mean of the lines in free air", float(np.mean(air["path_rms_mm"])), 3.0, "mm"),
        ("p99 of a tick in C along the lines", air["tick_ms"]["p99"], 2.0, "ms"),
    ]
    rival = found["rival"]
    name = "a tick of the controller in C against one iteration of CasADi's sqpmethod"
    ratio = verdict(name, rival["ours_ms"], float(np.median(rival["rival_ms"])), "<= 0.1", "ms", arguments.quick)
    verdicts = [verdict(name, ours, goal, "<= 1", unit, arguments.quick) for name, ours, goal, unit in rows]
    finish("control_step_grey", [ratio, *verdicts], arguments.seed, found)


def costs(twin: TwinBundle, folder: Path, seed: int, quick: bool) -> dict[str, Any]:
    """Figures of the default plan, and costs by plan."""
    bench = step_of.LoopBench(seed)
    plans, host, lever, calls = [], np.zeros((1, 2)), 0.0, 0
    each: Mapping[str, float] = {}
    for blocks in PLANS[:1] if quick else PLANS:
        own = folder / "_".join(map(str, blocks))
        bench.exported(twin, blocks, own)
        if not plans:
            host, calls, lever = step_of.host_times(own), step_of.callgrind(own), self_test(own)
            bench.exported(twin, SHORT, folder / "short")
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
    """The lines of `closed_loop.py`, graded by the compiled controller, in free air and in loam."""
    rows: dict[str, dict[str, Any]] = {}
    for name, (material, spec) in list(GRADED.items())[: 1 if quick else None]:
        rows[name] = row = {"path_rms_mm": [], "position_rms_mm": [], "attitude_rms_deg": [], "violations": 0}
        compiled: list[Compiled] = []
        for first in nmpc_of.DRAWS[:1] if quick else nmpc_of.DRAWS:
            experiment = ControlExperiment(
                task=TASKS["grade"](material=material), controller=spec, machine="M22",
                loops=1 if quick else nmpc_of.FULL.lines, seed=first,
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


def rivalled(twin: TwinBundle, folder: Path, seed: int) -> dict[str, Any]:
    """Milliseconds of CasADi's `sqpmethod` and of the C on one problem, and how far their steps are apart.

    Forces are not estimated here: the exported form of the twin has none to be told of.
    """
    bench = step_of.LoopBench(seed)
    recorded, parts = bench.exported(twin, PLANS[0], folder / "c", load=0.0)
    rival = Rival(recorded, parts, folder / "casadi")
    spent, apart = rival.compare(recorded, RIVAL_TICKS)
    host = step_of.host_times(folder / "c")
    print(f"CasADi's sqpmethod: {np.median(spent):.1f} ms an iteration, its step within {apart:.1e} m/s of ours")
    return {"rival_ms": spent, "apart_m_s": apart, "ours_ms": float(np.median(host[:, 0])) / 1000.0}


def as_library(bench: ControlBench, experiment: ControlExperiment, twin: TwinBundle, folder: Path) -> Path:
    """The controller of a bench as a shared library; valve maps of other draws are others."""
    own = folder / str(experiment.seed)
    write_controller(parts_of(experiment, bench.plant, bench.models, twin), "machine", own)
    (own / "program.c").write_text("")
    sources = step_of.sources_of(own)[1:]
    step_of.run(["gcc", *step_of.FLAGS, "-fPIC", "-shared", *sources, "-lm", "-o", "machine.so"], own)
    return own / "machine.so"


def self_test(folder: Path) -> float:
    """Largest difference of a lever that the exported test has seen; it must pass."""
    step_of.run(["gcc", *step_of.FLAGS, *step_of.sources_of(folder)[1:], "host_test.c", "-lm", "-o", "tested"], folder)
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
            step_of.built_for_m7(folder, f"-DTICKS={ticks}u")
            counts.append(traced_image(folder, step_of.QEMU, double))
        (few, short), (many, long) = counts
        found[name] = (long - short) / (many - few)
    return found


def on_m7(folder: Path, blocks: tuple[int, ...], each: Mapping[str, float]) -> dict[str, Any]:
    """Instructions, milliseconds and bytes."""
    core, count = CORES["cortex_m7"], step_of.m7_instructions(folder)
    ms = count / (step_of.CLOCK_MHZ * 1000.0)
    flash, state = sizes_of(folder)
    return {
        "blocks": blocks, "instructions": count, "low_ms": ms * each["table"] * core.low,
        "typical_ms": ms * each["table"] * core.typical, "careful_ms": ms * each["careful"],
        "flash_bytes": flash, "state_bytes": state,
    }  # fmt: skip


def sizes_of(folder: Path) -> tuple[int, int]:
    """Bytes of code and constants on a Cortex-M7, and of the state."""
    made = []
    for source in step_of.sources_of(folder)[1:]:
        made.append(f"{Path(source).stem}_m7.o")
        step_of.run(["arm-none-eabi-gcc", *step_of.FLAGS, *step_of.M7, "-c", source, "-o", made[-1]], folder)
    lines = step_of.run(["arm-none-eabi-size", *made], folder).splitlines()[1:]
    flash = sum(int(line.split()[0]) + int(line.split()[1]) for line in lines)
    (folder / "state.c").write_text('#include "machine_control.h"\nchar state[sizeof(machine_control)];\n')
    step_of.run(["arm-none-eabi-gcc", *step_of.FLAGS, *step_of.M7, "-c", "state.c", "-o", "state_m7.o"], folder)
    told = step_of.run(["arm-none-eabi-size", "state_m7.o"], folder).splitlines()[1]
    return flash, int(told.split()[2])


if __name__ == "__main__":
    main()
