"""What does a tick of an exported network cost: executed instructions on a Cortex-M4F, time on this computer?

Networks as in the thesis's setting (30 features, 3 targets, window of 50, four residual blocks of kernel 3, LSTM) with
weights as drawn: costs do not depend on them. Instructions are counted by QEMU, the same at every run; times are of the
processor, one thread. W8A16 is the same network in whole numbers, with the core's DSP instructions and plain loops.
Rivals, with the same weights: C that emx-onnx-cgen makes of our ONNX graphs of a tick and of a window, built with the
same flags; ONNX Runtime on both graphs; PyTorch, a tick at a time, as `Stream.step` runs it.
"""

from __future__ import annotations

import re
import resource
import subprocess
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

import onnx_rivals
from board import M4, instructions, on_board, run, sources_of
from common import Bench, benchmark, table
from edp.data.features import FG2
from edp.data.scaling import Scaler
from edp.data.task import TargetMode, Task
from edp.export.c.target import CTarget
from edp.export.golden import random_inputs
from edp.ir.w8a16 import calibrate
from edp.networks import ModelSpec, Stream, build_model
from edp.networks.backbones import HybridSpec
from edp.networks.integer import IntegerPredictor
from edp.signals import TABLE_A1, Kind
from edp.storage import make_folder
from edp.training.bundle import Bundle

PROGRAMS = ("gcc", "arm-none-eabi-gcc", "arm-none-eabi-size", "qemu-system-arm")

SIZES = ((32, 32), (32, 64), (64, 64), (64, 128))
RUNS = {"step": 20, "window": 2}


HEADS = ["channels/units", "constants", "MACs", "M4 instructions", "per MAC", "code bytes", "emx step", "emx window",
         "C us", "ORT window us", "ORT step us", "PyTorch us"]  # fmt: skip
WHOLE_HEADS = ["channels/units", "constant bytes", "W8A16 instructions", "per MAC", "plain loops", "code bytes", "C us"]


def whole(bundle: Bundle, seed: int) -> Bundle:
    """Return the network in integer arithmetic; its weights are arbitrary, since they do not change the cost."""
    graph = bundle.predictor.graph()
    chosen = calibrate(graph, [random_inputs(bundle.predictor, 500, seed)])
    return replace(bundle, predictor=IntegerPredictor(bundle.predictor, chosen))


def make(channels: int, units: int, seed: int) -> Bundle:
    task = Task(FG2, ("CylVels_1", "CylVels_2", "CylVels_3"), (10,), TargetMode.DELTA, 100.0)
    backbone = HybridSpec(channels=(channels,) * 4, kernel=3, units=units)
    features = len(FG2.features)
    scaler = Scaler(np.zeros(features), np.ones(features), np.zeros((1, 3)), np.ones((1, 3)))
    predictor = build_model(task, ModelSpec(backbone=backbone), scaler, seed).eval()
    inputs = tuple(TABLE_A1[name] for name in task.inputs)
    return Bundle(predictor, inputs, (Kind.VELOCITY,) * 3, task.targets)


def rival_instructions(folder: Path, kind: str) -> int:
    """Count the instructions of one prediction by the reference's C code, after comparing its outputs with ours."""
    counted, permille = on_board(folder, onnx_rivals.counting(folder, kind, RUNS[kind]), "-I..")
    if int(permille) > 1000:
        raise RuntimeError(f"emx-onnx-cgen's {kind} is {int(permille) / 1000} times the tolerance away from PyTorch")
    return int(counted)


def code_bytes(folder: Path) -> int:
    """Program code of model and runtime on the M4, without constants."""
    sources = sources_of(folder)
    run(["arm-none-eabi-gcc", "-std=c99", "-O2", "-ffp-contract=off", *M4[:4], "-c", *sources], folder)
    objects = [name.replace(".c", ".o") for name in sources]
    lines = run(["arm-none-eabi-size", "-A", *objects], folder).splitlines()
    return sum(int(line.split()[1]) for line in lines if line.startswith(".text"))


def host_us(folder: Path, bundle: Bundle, ticks: int) -> float:
    """Microseconds a tick on this computer, the best of three runs, reading and writing included."""
    run(
        ["gcc", "-std=c99", "-O2", "-ffp-contract=off", *sources_of(folder), "host_test.c", "-lm", "-o", "program"],
        folder,
    )
    feed, best = random_inputs(bundle.predictor, ticks, 1).tobytes(), float("inf")
    for _ in range(3):
        start = children_s()
        subprocess.run([str(folder / "program"), "stream"], input=feed, check=True, stdout=subprocess.DEVNULL)
        best = min(best, children_s() - start)
    return 1e6 * best / ticks


def children_s() -> float:
    """Processor seconds of the programs that this one has run."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def torch_us(bundle: Bundle, ticks: int) -> float:
    stream, rows = Stream(bundle.predictor), random_inputs(bundle.predictor, ticks, 1)
    best = float("inf")
    for _ in range(3):
        stream.reset()
        start = time.process_time()
        for row in rows:
            stream.step(row)
        best = min(best, time.process_time() - start)
    return 1e6 * best / ticks


@benchmark(programs=PROGRAMS)
def main(bench: Bench) -> object:
    sizes = SIZES[:1] if bench.quick else SIZES
    rows, whole_rows = [], []
    versions: dict[str, object] = {}
    for channels, units in sizes:
        bundle = make(channels, units, bench.seed)
        with tempfile.TemporaryDirectory() as temporary:
            folder = Path(temporary)
            CTarget().write(bundle, "predictor", folder)
            graphs = make_folder(folder / "onnx")
            versions = onnx_rivals.write(bundle, graphs)
            counted, code = instructions(folder), code_bytes(folder)
            step, window = (rival_instructions(graphs, kind) for kind in ("step", "window"))
            host, torch = host_us(folder, bundle, 5_000 if bench.quick else 20_000), torch_us(bundle, 300)
            onnx_window, onnx_step = onnx_rivals.runtime_us(bundle, graphs, 300 if bench.quick else 2_000)
        with tempfile.TemporaryDirectory() as temporary:
            folder = Path(temporary)
            CTarget().write(whole(bundle, bench.seed), "predictor", folder)
            constants = int(re.findall(r"Constants (\d+) bytes", (folder / "predictor.h").read_text())[0])
            eight, plain = instructions(folder), instructions(folder, "-DEDP_PORTABLE")
            whole_us = host_us(folder, bundle, 5_000 if bench.quick else 20_000)
            whole_code = code_bytes(folder)
        graph, size = bundle.predictor.graph(), f"{channels}/{units}"
        whole_rows.append((size, constants, eight, eight / graph.macs, plain, whole_code, whole_us))
        made = (size, graph.parameters, graph.macs, counted, counted / graph.macs, code)
        rows.append((*made, step, window, host, onnx_window, onnx_step, torch))
        for name, ours, rival, goal, unit in (
            ("instructions per sample, C against emx-onnx-cgen's step", counted, step, "<= 0.5", "instructions"),
            ("instructions per sample, C against emx-onnx-cgen's window", counted, window, "<= 0.0333", "instructions"),
            ("instructions per sample, W8A16 against emx-onnx-cgen's step", eight, step, "<= 0.5", "instructions"),
            ("time per sample, C against ONNX Runtime on the window", host, onnx_window, "<= 0.05", "us"),
            ("time per sample, C against PyTorch", host, torch, "<= 0.05", "us"),
        ):
            bench.check(f"{size}: {name}", ours, rival, goal, unit)
    table(HEADS, rows)
    table(WHOLE_HEADS, whole_rows)
    of_whole = (dict(zip(WHOLE_HEADS, row)) for row in whole_rows)
    return [{"rivals": versions}, *(dict(zip(HEADS, row)) for row in rows), *of_whole]


if __name__ == "__main__":
    main()
