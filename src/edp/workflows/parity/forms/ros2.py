"""ROS-free part of the ROS 2 package: the C code through ctypes, one tick per call."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar

import numpy as np

from edp.export.escape import python_literal
from edp.export.ros2 import Ros2Target
from edp.storage import write_bytes
from edp.workflows.parity.base import FORMS, NAME, ROUNDS, ParityCase, Ran, called, need

PROGRAM = '''
"""Streams rows of JSON through the package's core: argv has the rounds."""
import json, sys, time
from predictor_ros.core import Core

rows, core, least = json.load(sys.stdin), Core(), float("inf")
for _ in range(int(sys.argv[1])):
    core.reset()
    found = []
    began = time.perf_counter()
    for row in rows:
        core.step(row)
        found.append([core.result(meaning) for meaning in core.results])
    least = min(least, time.perf_counter() - began)
print(json.dumps([found, least / len(rows)]))
'''


@FORMS.register("ros2")
class Ros2Core:
    """``edp export --format ros2``: the core of the node, without ROS."""

    title: ClassVar[str] = "ROS 2 package, core"

    def run(self, case: ParityCase, folder: Path) -> Sequence[tuple[str, Ran]]:
        """See `edp.workflows.parity.base.Form`."""
        compiler = need("cc", "gcc libc6-dev")
        Ros2Target().write(case.bundle, NAME, folder)
        write_bytes(folder / "run.py", PROGRAM.encode())
        called([sys.executable, "-c", f"from {NAME}_ros.core import build; build({python_literal(compiler)})"], folder)
        output = json.loads(
            called([sys.executable, "run.py", ROUNDS], folder, json.dumps(case.inputs.tolist()).encode())
        )
        predictions = [np.concatenate([np.ravel(part) for part in tick]) for tick in output[0]]
        return [("", Ran(np.array(predictions, np.float32), output[1]))]
