"""The folder for MATLAB and Simulink: MATLAB code and S-function in GNU Octave, the C Caller's function in C."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path
from string import Template
from typing import ClassVar

import numpy as np
import scipy.io

from edp.export.c.model import make_model
from edp.export.description import float_graph
from edp.export.escape import matlab_string
from edp.export.golden import Rows
from edp.export.simulink import SimulinkTarget
from edp.storage import write_bytes
from edp.storage.paths import entries_of
from edp.workflows.parity.base import FORMS, NAME, ROUNDS, ParityCase, Ran, called, need
from edp.workflows.parity.forms.c_code import FLAGS

REPEATS = 25
"""Times that the recording is fed to the S-function for its speed: the block's start is no tick."""
NATIVE = f"net = {NAME}_load(); found = {NAME}_stream(net, rows);"
NATIVE_TIMED = f"{NAME}_stream(net, rows);"
BLOCK = f"found = {NAME}_octave(rows);"
BLOCK_TIMED = f"{NAME}_octave(repmat(rows, {REPEATS}, 1));"
PROGRAM = Template("""addpath(${folder}); load('rows.mat');
${run}
seconds = Inf;
for round = 1:${rounds}
    tic(); ${timed} seconds = min(seconds, toc());
end
save('-v6', 'found.mat', 'found', 'seconds');
""")
DRIVER = Template("""/* Streams rows through the C Caller's function some times, its state as a Unit Delay joins it. */
#define _POSIX_C_SOURCE 199309L
#include "${name}_call.h"
#include <stdio.h>
#include <string.h>
#include <time.h>

int main(void) {
    static float in[${ticks}][${inputs}], out[${ticks}][${numbers}];
    static uint32_t state[2][${NAME}_STATE_WORDS];
    double least = 1e30;
    int32_t status;
    if (fread(in, sizeof in, 1u, stdin) != 1u) {
        return 2;
    }
    for (int round = 0; round < ${rounds}; round++) {
        struct timespec from, to;
        memset(state, 0, sizeof state);
        (void)clock_gettime(CLOCK_MONOTONIC, &from);
        for (long tick = 0; tick < ${ticks}; tick++) {
            ${name}_call(in[tick], false, 0u, state[tick % 2], state[(tick + 1) % 2], ${results}, &status);
        }
        (void)clock_gettime(CLOCK_MONOTONIC, &to);
        const double spent = (double)(to.tv_sec - from.tv_sec) + 1e-9 * (double)(to.tv_nsec - from.tv_nsec);
        least = (spent < least) ? spent : least;
    }
    return (fwrite(out, sizeof out, 1u, stdout) == 1u && fwrite(&least, sizeof least, 1u, stdout) == 1u) ? 0 : 3;
}
""")


def _octave(case: ParityCase, folder: Path, run: str, timed: str) -> tuple[Rows, float]:
    """Return the results of a program in Octave, and its least seconds."""
    program = need("octave-cli", "octave")
    # The ONNX window is a form of its own and would need the package onnx here.
    SimulinkTarget(window=False).write(case.bundle, NAME, folder)
    scipy.io.savemat(folder / "rows.mat", {"rows": case.inputs})
    text = PROGRAM.substitute(folder=matlab_string(folder), run=run, timed=timed, rounds=ROUNDS)
    write_bytes(folder / "parity_program.m", text.encode())
    # Without the user's start-up file, which may change paths and number formats.
    called([program, "--norc", "--quiet", "parity_program.m"], folder)
    octave_file = scipy.io.loadmat(folder / "found.mat")
    return np.asarray(octave_file["found"], dtype=np.float32), float(octave_file["seconds"].item())


@FORMS.register("matlab")
class MatlabCode:
    """``edp export --format simulink``: the plain MATLAB code."""

    title: ClassVar[str] = "MATLAB code, GNU Octave"

    def run(self, case: ParityCase, folder: Path) -> Sequence[tuple[str, Ran]]:
        """See `edp.workflows.parity.base.Form`."""
        float_graph(case.bundle.predictor, "plain MATLAB code")
        predictions, seconds = _octave(case, folder, NATIVE, NATIVE_TIMED)
        return [("", Ran(predictions, seconds / len(predictions)))]


@FORMS.register("s_function")
class SFunction:
    """``edp export --format simulink``: the S-function as a MEX with substitutes for Simulink's headers."""

    title: ClassVar[str] = "S-function, MEX in GNU Octave"

    def run(self, case: ParityCase, folder: Path) -> Sequence[tuple[str, Ran]]:
        """See `edp.workflows.parity.base.Form`."""
        need("mkoctfile", "octave-dev")
        predictions, seconds = _octave(case, folder, BLOCK, BLOCK_TIMED)
        note = "stand-ins take the place of Simulink's headers"
        return [("", Ran(predictions, seconds / REPEATS / len(predictions), note=note))]


@FORMS.register("c_caller")
class CCaller:
    """``edp export --format simulink``: the function of a C Caller block."""

    title: ClassVar[str] = "C Caller's function"

    def run(self, case: ParityCase, folder: Path) -> Sequence[tuple[str, Ran]]:
        """See `edp.workflows.parity.base.Form`."""
        compiler = need("cc", "gcc libc6-dev")
        SimulinkTarget(window=False).write(case.bundle, NAME, folder)
        graph = make_model(NAME, case.bundle).graph
        sizes = [graph.width_of(value) for value in graph.results.values()]
        places = np.cumsum([0, *sizes])
        sizes_of = {"ticks": len(case.inputs), "inputs": graph.inputs, "numbers": sum(sizes), "rounds": ROUNDS}
        results = ", ".join(f"&out[tick][{offset}]" for offset in places[:-1])
        text = DRIVER.substitute(sizes_of, name=NAME, NAME=NAME.upper(), results=results)
        write_bytes(folder / "driver.c", text.encode())
        sources = ["driver.c", f"{NAME}_call.c", *entries_of(folder / "core", "*.c")]
        called([compiler, *FLAGS, "-I", "core", *sources, "-lm", "-o", "driver"], folder)
        output = called([folder / "driver"], folder, np.ascontiguousarray(case.inputs, dtype=np.float32).tobytes())
        (seconds,) = struct.unpack("<d", output[-8:])
        predictions = np.frombuffer(output[:-8], dtype=np.float32).reshape(len(case.inputs), -1)
        return [("", Ran(predictions, seconds / len(predictions), note="the state goes in and comes out as a vector"))]
