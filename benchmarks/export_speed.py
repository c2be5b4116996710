"""What does a tick cost in an engineer's tool: the FMUs through FMPy against ONNX Runtime on the window, and real time?

Networks as in the thesis's setting (30 features, 3 targets, window of 50, four residual blocks of kernel 3, LSTM) with
weights as drawn: costs do not depend on them. Times are of the processor, one thread, the best of three. A tick of an
FMU is what an importer written in Python does with FMPy: inputs set, a step, outputs read. The rival is what a block
that evaluates the window at every tick cannot do without: ONNX Runtime on our graph of the window, and none of the
costs of the block. Then every form that `edp verify` can run here, by the clock, with its difference from PyTorch.
"""

from __future__ import annotations

import ctypes
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import onnx_rivals
from common import Bench, benchmark, table
from edp.export.fmu import FmuTarget
from edp.export.golden import random_inputs
from edp.export.onnx import OnnxTarget
from edp.storage import make_folder
from edp.training.bundle import Bundle
from edp.workflows.parity import compare, golden_case
from edp.workflows.parity.forms.fmu import Slave
from embedded_step import make, whole

SIZES = ((32, 64), (64, 128))
RUNS = 3
HEADS = ["form", "channels/units", "us a tick", "times real time"]
PARITY_HEADS = ["form", "verdict", "of what is allowed", "us a tick, by the clock", "note"]


def best_us(run: Callable[[], object], ticks: int) -> float:
    """Processor microseconds of a tick, the best of some runs."""
    best = float("inf")
    for _ in range(RUNS):
        start = time.process_time()
        run()
        best = min(best, time.process_time() - start)
    return 1e6 * best / ticks


def fmus_us(bundle: Bundle, ticks: int, seed: int, derivatives: bool = True) -> dict[str, float]:
    """Return the time of one sample through FMPy in FMI 2.0 and 3.0, and of the FMI 2.0 step alone."""
    rows, found = random_inputs(bundle.predictor, ticks, seed), {}
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        target = FmuTarget(binaries="linux64", derivatives=derivatives)
        for version, file in zip((2, 3), target.write(bundle, "predictor", folder), strict=True):
            slave = Slave(file, folder / str(version), version)
            found[f"FMI {version}.0"] = best_us(partial(slave.stream, rows), ticks)
            if version == 2:
                found["step alone"] = best_us(partial(steps, slave, ticks), ticks)
            slave.close()
    return found


def steps(slave: Slave, ticks: int) -> None:
    """Run FMI 2.0 steps with constant inputs, without FMPy."""
    instance, size = slave.fmu.component, slave.step_s
    signature = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p, ctypes.c_double, ctypes.c_double, ctypes.c_int)
    call = signature(("fmi2DoStep", slave.fmu.dll))
    begin = slave.fmu.getRealStatus(2)
    for tick in range(ticks):
        call(instance, begin + tick * size, size, 1)


@benchmark()
def main(bench: Bench) -> object:
    ticks, windows = (500, 100) if bench.quick else (3_000, 500)
    rows: list[tuple[object, ...]] = []
    for channels, units in SIZES[:1] if bench.quick else SIZES:
        bundle, size = make(channels, units, bench.seed), f"{channels}/{units}"
        tick_us = 1e6 / bundle.task.rate_hz
        folder = make_folder(bench.folder / size.replace("/", "_"))
        OnnxTarget().write(bundle, "predictor", folder)
        window_us, step_us = onnx_rivals.runtime_us(bundle, folder, windows)
        ours = fmus_us(bundle, ticks, bench.seed)
        plain = fmus_us(bundle, ticks, bench.seed, derivatives=False)
        eight = fmus_us(whole(bundle, bench.seed), ticks, bench.seed)
        found = {f"FMU float32, {name}": us for name, us in ours.items()}
        found |= {f"FMU float32 without derivatives, {name}": us for name, us in plain.items()}
        found |= {f"FMU w8a16, {name}": us for name, us in eight.items()}
        found |= {"ONNX Runtime, step": step_us, "ONNX Runtime, window": window_us}
        rows += [(name, size, us, tick_us / us) for name, us in found.items()]
        text = f"{size}: FMU step against ONNX Runtime on the window, without importers"
        bench.check(text, ours["step alone"], window_us, "<= 0.1", "us")
        for name in ("FMI 2.0", "FMI 3.0"):
            text = f"{size}: FMU step, {name} through FMPy, against ONNX Runtime on the window"
            bench.check(text, ours[name], window_us, "<= 0.1", "us")
            text = f"{size}: FMU step against its sample time, {name} through FMPy"
            bench.check(text, ours[name], tick_us, "<= 0.005", "us")
    table(HEADS, rows)
    print()
    case = golden_case(make(*SIZES[0], bench.seed), 200 if bench.quick else 400)
    forms = ("c", "fmu", "onnx_step", "onnx_window") if bench.quick else ()
    said = [
        (r.title, r.verdict, _number(r.largest), _number(r.microseconds), r.note or r.why) for r in compare(case, forms)
    ]
    table(PARITY_HEADS, said)
    return [dict(zip(HEADS, row)) for row in rows] + [dict(zip(PARITY_HEADS, row)) for row in said]


def _number(value: float | None) -> float | str:
    return "" if value is None else value


if __name__ == "__main__":
    main()
