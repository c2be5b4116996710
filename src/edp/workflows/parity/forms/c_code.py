"""The exported C on this computer: in single precision, and in integers (W8A16) against their Python reference."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from string import Template
from typing import ClassVar

import numpy as np

from edp.export.c import CTarget
from edp.export.golden import Rows, stream
from edp.ir.w8a16 import calibrate
from edp.networks.integer import IntegerPredictor
from edp.networks.twin import IntegerTwinPlant, TwinPlant
from edp.storage import write_bytes
from edp.storage.paths import entries_of
from edp.training.bundle import Bundle
from edp.wording import typed
from edp.workflows.parity.base import FORMS, NAME, ROUNDS, ParityCase, Ran, called, need

# Without contraction of products and sums: the tolerance is that of single precision, W8A16 asks for equal bits.
FLAGS = ("-std=c99", "-O2", "-ffp-contract=off")
DRIVER = Template("""/* Streams rows of inputs some times; then rows of outputs, and the least seconds as a double. */
#define _POSIX_C_SOURCE 199309L
#include "${name}.h"
#include <stdio.h>
#include <time.h>

static ${name}_state state;

int main(void) {
    static float in[${ticks}][${NAME}_INPUTS];
    static ${name}_output out[${ticks}];
    double least = 1e30;
    if (fread(in, sizeof in, 1u, stdin) != 1u) {
        return 2;
    }
    for (int round = 0; round < ${rounds}; round++) {
        struct timespec from, to;
        ${name}_reset(&state);
        (void)clock_gettime(CLOCK_MONOTONIC, &from);
        for (long tick = 0; tick < ${ticks}; tick++) {
            (void)${name}_step(&state, in[tick], &out[tick]);
        }
        (void)clock_gettime(CLOCK_MONOTONIC, &to);
        const double spent = (double)(to.tv_sec - from.tv_sec) + 1e-9 * (double)(to.tv_nsec - from.tv_nsec);
        least = (spent < least) ? spent : least;
    }
    return (fwrite(out, sizeof out, 1u, stdout) == 1u && fwrite(&least, sizeof least, 1u, stdout) == 1u) ? 0 : 3;
}
""")


def streamed(bundle: Bundle, inputs: Rows, folder: Path) -> tuple[Rows, float]:
    """Export, compile and run; return the outputs of each sample and the seconds per sample.

    Raises:
        ExportError: the network has no such form.
        Missing: there is no compiler.
        Broken: it does not compile or run.
    """
    compiler = need("cc", "gcc libc6-dev")
    CTarget().write(bundle, NAME, folder)
    filled = DRIVER.substitute(name=NAME, NAME=NAME.upper(), ticks=len(inputs), rounds=ROUNDS)
    write_bytes(folder / "driver.c", filled.encode())
    runtime = sorted(path.name for path in entries_of(folder, "edp_*.c"))
    called([compiler, *FLAGS, "driver.c", f"{NAME}.c", *runtime, "-lm", "-o", "driver"], folder)
    output = called([folder / "driver"], folder, np.ascontiguousarray(inputs, dtype=np.float32).tobytes())
    # The driver writes the least time behind the numbers.
    (seconds,) = struct.unpack("<d", output[-8:])
    return np.frombuffer(output[:-8], dtype=np.float32).reshape(len(inputs), -1), seconds / len(inputs)


@FORMS.register("c")
class CCode:
    """``edp export --format c`` of the unchanged network."""

    title: ClassVar[str] = "C"

    def run(self, case: ParityCase, folder: Path) -> Sequence[tuple[str, Ran]]:
        """See `edp.workflows.parity.base.Form`."""
        predictions, seconds = streamed(case.bundle, case.inputs, folder)
        return [(case.bundle.predictor.number_format, Ran(predictions, seconds))]


@FORMS.register("c_w8a16")
class WholeNumbers:
    """``edp export --format c`` in integers (W8A16); a float network is quantised on the golden recording for this."""

    title: ClassVar[str] = "C in integers (W8A16)"

    def run(self, case: ParityCase, folder: Path) -> Sequence[tuple[str, Ran]]:
        """See `edp.workflows.parity.base.Form`."""
        predictor = case.bundle.predictor
        if isinstance(predictor, IntegerPredictor):
            return []  # the form `c` is that already
        chosen = calibrate(predictor.graph(), [case.inputs])
        if isinstance(predictor, TwinPlant):
            whole: IntegerPredictor = IntegerTwinPlant(predictor, chosen)
        else:
            whole = IntegerPredictor(predictor, chosen)
        predictions, seconds = streamed(replace(case.bundle, predictor=whole), case.inputs, folder)
        expected = stream(whole, case.inputs)
        deviations = np.abs(expected - case.expected).max() / float(predictor.code.width.max())
        note = (
            f"against the Python reference of the same; that is {typed(deviations, 2)} deviations from float32 at most"
        )
        return [("w8a16", Ran(predictions, seconds, expected, np.zeros_like(case.allowed), note))]
