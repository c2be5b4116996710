"""ONNX graphs in ONNX Runtime, in this Python and in Pythons with other versions of ONNX Runtime."""

from __future__ import annotations

import importlib.util
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from edp.errors import ExportError
from edp.export.onnx import OnnxTarget
from edp.storage import write_bytes
from edp.workflows.parity.base import FORMS, NAME, ROUNDS, Missing, ParityCase, Ran, called

# Forty windows: PyTorch computes each from reset, fifty times the work of a stream.
WINDOWS = 40
PROGRAM = '''
"""Runs a graph of EDP: argv has the description, the kind of graph, inputs, outputs and the number of rounds."""
import json, sys, time
import numpy as np
import onnxruntime

about, kind, source, target, rounds = json.load(open(sys.argv[1])), *sys.argv[2:5], int(sys.argv[5])
graph = about["graphs"][kind]
options = onnxruntime.SessionOptions()
options.intra_op_num_threads, options.log_severity_level = 1, 3
run = onnxruntime.InferenceSession(graph["file"], options, providers=["CPUExecutionProvider"]).run
inputs, results, least = np.load(source), list(about["results"]), float("inf")
states = graph.get("states", [])
starts = {s["name"]: np.full(s["shape"], s["start"], np.float32) for s in states}
names = results + [s["next"] for s in states]
for _ in range(rounds):
    found, held = [], dict(starts)
    began = time.perf_counter()
    for row in inputs:
        made = dict(zip(names, run(names, {graph["input"]: row if kind == "window" else row[None], **held})))
        held = {s["name"]: made[s["next"]] for s in states}
        found.append(np.concatenate([made[name].ravel() for name in results]))
    least = min(least, time.perf_counter() - began)
np.save(target, np.array(found, np.float32))
print(json.dumps({"version": onnxruntime.__version__, "seconds": least / len(inputs)}))
'''


def _runs(case: ParityCase, folder: Path, kind: str, inputs: np.ndarray, rest: dict[str, Any]) -> list[tuple[str, Ran]]:
    """Run the graph in every interpreter."""
    for package in ("onnx", "onnxruntime"):
        if importlib.util.find_spec(package) is None:
            raise Missing(f"needs the Python package {package}")
    OnnxTarget().write(case.bundle, NAME, folder)
    write_bytes(folder / "run.py", PROGRAM.encode())
    np.save(folder / "inputs.npy", inputs)
    runs = []
    for python in (sys.executable, *case.interpreters):
        command = [python, "run.py", f"{NAME}.json", kind, "inputs.npy", "found.npy", ROUNDS]
        output = json.loads(called(command, folder))
        runs.append((output["version"], Ran(np.load(folder / "found.npy"), output["seconds"], **rest)))
    return runs


@FORMS.register("onnx_step")
class OnnxStep:
    """``edp export --format onnx``: the graph of a tick."""

    title: ClassVar[str] = "ONNX step, ONNX Runtime"

    def run(self, case: ParityCase, folder: Path) -> Sequence[tuple[str, Ran]]:
        """See `edp.workflows.parity.base.Form`."""
        return _runs(case, folder, "step", case.inputs, {})


@FORMS.register("onnx_window")
class OnnxWindow:
    """Parity form of ``edp export --format onnx``: run the exported graph of a window in ONNX Runtime."""

    title: ClassVar[str] = "ONNX window, ONNX Runtime"

    def run(self, case: ParityCase, folder: Path) -> Sequence[tuple[str, Ran]]:
        """See `edp.workflows.parity.base.Form`."""
        if case.bundle.predictor.graph().fed_back:
            raise ExportError("a plant is fed back: it has the graph of a tick alone")
        windows, expected, allowed = case.last_windows(WINDOWS)
        note = f"the last {len(windows)} windows, against PyTorch from reset"
        return _runs(
            case, folder, "window", np.stack(windows), {"expected": expected, "allowed": allowed, "note": note}
        )
