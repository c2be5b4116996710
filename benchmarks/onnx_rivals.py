"""The same network as our ONNX graphs in other hands: C by emx-onnx-cgen on a Cortex-M4F, and ONNX Runtime here."""

from __future__ import annotations

import json
import re
import subprocess
import sys
import time
from importlib.metadata import version
from pathlib import Path

import numpy as np

from edp.export.golden import random_inputs
from edp.export.onnx import OnnxTarget
from edp.training.bundle import Bundle

BUILD = "import sys; from emx_onnx_cgen.cli import main; sys.exit(main(sys.argv[1:]))"
PLAIN = ("--large-temp-threshold", "0", "--large-weight-threshold", "0")
"""Nothing on the heap, constants in the code: what a controller needs, and what ours does."""
COUNT = """
#include "predictor_golden.h"
#include <math.h>
#include <stdio.h>
#define SYST_CSR (*(volatile uint32_t *)0xE000E010u)
#define SYST_RVR (*(volatile uint32_t *)0xE000E014u)
#define SYST_CVR (*(volatile uint32_t *)0xE000E018u)
#define PER_COUNT (1000000000u / CLOCK_HZ)
%(buffers)s
static float found[%(runs)d][sizeof golden_tolerance / sizeof(float)];
int main(void) {
%(starts)s
    SYST_RVR = 0xFFFFFFu;
    SYST_CVR = 0u;
    SYST_CSR = 5u;
    const uint32_t start = SYST_CVR;
    for (int run = 0; run < %(runs)d; run += 2) {
        %(first)s
        %(second)s
    }
    const uint32_t passed = (start - SYST_CVR) & 0xFFFFFFu;
    float worst = 0.0f;
    for (int run = 0; run < %(runs)d; run++) {
        for (unsigned n = 0; n < sizeof golden_tolerance / sizeof(float); n++) {
            worst = fmaxf(worst, fabsf(found[run][n] - %(wanted)s) / golden_tolerance[n]);
        }
    }
    (void)printf("%%lu %%d\\n", (unsigned long)(passed * PER_COUNT / %(runs)du), (int)(1000.0f * worst));
    return 0;
}
"""


def write(bundle: Bundle, folder: Path) -> dict[str, object]:
    """Write the graphs and have them compiled to C; returns versions of the rivals."""
    OnnxTarget().write(bundle, "predictor", folder)
    for kind in ("step", "window"):
        names = ["--model-name", f"emx_{kind}", f"predictor_{kind}.onnx", f"emx_{kind}.c"]
        command = [sys.executable, "-c", BUILD, "compile", *PLAIN, *names]
        subprocess.run(command, cwd=folder, check=True, capture_output=True)
    return {name: version(name) for name in ("emx-onnx-cgen", "onnxruntime")}


def counting(folder: Path, kind: str, runs: int) -> tuple[str, ...]:
    """Write the program that counts instructions of `runs` (an even number of) calls; returns its sources."""
    head = re.search(rf"^void emx_{kind}\((.*?)\)", (folder / f"emx_{kind}.c").read_text(), re.M)
    if head is None:
        raise RuntimeError(f"emx_{kind}.c has no function emx_{kind}")
    given = [re.fullmatch(r"(const )?float (\w+)\[restrict (\d+)\]\[(\d+)\]", part) for part in head[1].split(", ")]
    sizes = {part[2]: (int(part[3]), int(part[4])) for part in given if part is not None}
    if len(sizes) != len(given):
        raise RuntimeError(f"unexpected arguments of emx_{kind}: {head[1]}")
    states = {
        s["name"]: s for s in json.loads((folder / "predictor.json").read_text())["graphs"][kind].get("states", [])
    }
    buffers, starts = [f"void {head[0].removeprefix('void ')};".replace("restrict ", "")], []
    for name, state in states.items():
        rows, columns = sizes[name]
        buffers.append(f"static float {name}_now[{rows}][{columns}], {name}_then[{rows}][{columns}];")
        values = np.broadcast_to(np.float32(state["start"]), (rows, columns)).ravel()
        starts += [f"    (&{name}_now[0][0])[{at}] = {value!r}f;" for at, value in enumerate(values.tolist()) if value]
    window = sizes["inputs"][0]
    wanted = "golden_outputs[run][n]" if kind == "step" else f"golden_outputs[{window - 1}][n]"

    def call(run: str, now: str, then: str) -> str:
        fed = f"&golden_inputs[{run}]" if kind == "step" else "golden_inputs"
        named = {"inputs": fed, "prediction": f"(float (*)[{sizes['prediction'][1]}])found[{run}]"}
        named |= {name: f"{name}_{now}" for name in states} | {f"{name}_next": f"{name}_{then}" for name in states}
        return f"emx_{kind}({', '.join(named[name] for name in sizes)});"

    parts = {"runs": runs, "wanted": wanted, "buffers": "\n".join(buffers), "starts": "\n".join(starts)}
    calls = {"first": call("run", "now", "then"), "second": call("run + 1", "then", "now")}
    (folder / f"count_{kind}.c").write_text("#include <stdint.h>\n" + COUNT % (parts | calls))
    return f"emx_{kind}.c", f"count_{kind}.c"


def runtime_us(bundle: Bundle, folder: Path, calls: int) -> tuple[float, float]:
    """Processor microseconds of a prediction by ONNX Runtime, best of three: of the window and of the step."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    graphs = json.loads((folder / "predictor.json").read_text())["graphs"]
    made = [
        onnxruntime.InferenceSession(str(folder / graphs[kind]["file"]), options, providers=["CPUExecutionProvider"])
        for kind in ("window", "step")
    ]
    rows = random_inputs(bundle.predictor, calls + graphs["window"]["shape"][0], 1)
    states = [(s["name"], np.broadcast_to(np.float32(s["start"]), s["shape"]).copy()) for s in graphs["step"]["states"]]
    best = [float("inf"), float("inf")]
    for _ in range(3):
        start = time.process_time()
        for at in range(calls):
            made[0].run(None, {"inputs": rows[at : at + graphs["window"]["shape"][0]]})
        best[0] = min(best[0], time.process_time() - start)
        held = dict(states)
        names = list(held)
        start = time.process_time()
        for at in range(calls):
            found = made[1].run(None, {"inputs": rows[at : at + 1], **held})
            held = dict(zip(names, found[1:]))  # in the order in which they went in
        best[1] = min(best[1], time.process_time() - start)
    return 1e6 * best[0] / calls, 1e6 * best[1] / calls
