"""The CasADi step as a symbolic function, and the C code behind CasADi's external function."""

from __future__ import annotations

import importlib.util
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar

import numpy as np

from edp.errors import ExportError
from edp.export.casadi import CasadiTarget
from edp.export.description import has_equations
from edp.storage import write_bytes
from edp.workflows.parity.base import FORMS, NAME, Missing, ParityCase, Ran, called, need

PROGRAM = '''
"""Streams rows through the exported step: argv has the folder, how, inputs, outputs, compiler."""
import json, sys, time
import numpy as np

sys.path.insert(0, sys.argv[1])
from edp_casadi import Network

network = Network(sys.argv[1] + "/predictor.json")
step = network.step if sys.argv[2] == "symbolic" else network.external(network.compile(sys.argv[5]))
x, found = network.start, []
inputs = np.load(sys.argv[3])
began = time.perf_counter()
for row in inputs:
    x, *results = step(x, row)
    found.append(np.concatenate([np.array(part).ravel() for part in results]))
spent = time.perf_counter() - began
np.save(sys.argv[4], np.array(found, np.float32))
print(json.dumps(spent / len(inputs)))
'''


def _run(case: ParityCase, folder: Path, how: str, compiler: str = "") -> Sequence[tuple[str, Ran]]:
    if importlib.util.find_spec("casadi") is None:
        raise Missing("needs the Python package casadi")
    CasadiTarget().write(case.bundle, NAME, folder)
    write_bytes(folder / "run.py", PROGRAM.encode())
    np.save(folder / "inputs.npy", case.inputs)
    # Isolated (`-I`): the exported files must run without EDP on the path.
    output = called([sys.executable, "-I", "run.py", folder, how, "inputs.npy", "found.npy", compiler], folder)
    return [("", Ran(np.load(folder / "found.npy"), json.loads(output)))]


@FORMS.register("casadi")
class CasadiStep:
    """``edp export --format casadi``: the symbolic step, without EDP and PyTorch."""

    title: ClassVar[str] = "CasADi, symbolic step"

    def run(self, case: ParityCase, folder: Path) -> Sequence[tuple[str, Ran]]:
        """See `edp.workflows.parity.base.Form`."""
        return _run(case, folder, "symbolic")


@FORMS.register("casadi_external")
class CasadiExternal:
    """``edp export --format casadi``: the C code behind the external function."""

    title: ClassVar[str] = "CasADi, external C"

    def run(self, case: ParityCase, folder: Path) -> Sequence[tuple[str, Ran]]:
        """See `edp.workflows.parity.base.Form`."""
        if has_equations(case.bundle.predictor.graph()):
            raise ExportError("the C code of a grey box's equations has no tangents, so none stands behind CasADi")
        return _run(case, folder, "external", need("cc", "gcc libc6-dev"))
