"""Is the memory that `edp compress estimate` estimates that of the code that `edp export` writes?

The exported model is linked for a Cortex-M4F (``-O2``, unused functions left out) and run on an emulated one. Its state
is what ``sizeof`` says. Its stack is what a tick overwrites of a filled stack, behind a whole window, where every layer
has run. The estimate must not be below what was used. Bytes of flash are the matter of ``program_bytes.py``.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

from board import on_board, sources_of
from common import Bench, benchmark, table
from controller_cycles import networks
from edp.evaluation.controller import FORMATS
from edp.evaluation.footprint import footprint
from edp.export.c.target import CTarget
from edp.training.bundle import Bundle
from embedded_step import whole

PROGRAMS = ("arm-none-eabi-gcc", "qemu-system-arm")

PROGRAM = """
#include <stdint.h>
#include <stdio.h>
#define DEEP 16384
#include "predictor.h"
#include "predictor_golden.h"
static predictor_state state;
static predictor_output out;
static void ticks(void) {
    for (unsigned tick = 0; tick < TICKS; tick++) {
        (void)predictor_step(&state, golden_inputs[tick % 32u], &out);
    }
}
static __attribute__((noinline)) unsigned used(void (*volatile run)(void)) {
    volatile uint8_t *const top = __builtin_frame_address(0);
    for (unsigned place = 64u; place < DEEP; place++) {
        *(top - place) = 0xA5u;
    }
    run();
    unsigned place = DEEP - 1u;
    while (place > 64u && *(top - place) == 0xA5u) {
        place--;
    }
    return place;
}
int main(void) {
    predictor_reset(&state);
    (void)printf("%u %u", (unsigned)sizeof(state), used(ticks));
    return 0;
}
"""


def measured(bundle: Bundle) -> tuple[int, int]:
    """State and stack of an exported model, bytes."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        CTarget().write(bundle, "predictor", folder)
        (folder / "memory.c").write_text(PROGRAM)
        lean = ("-ffunction-sections", "-fdata-sections", "-Wl,--gc-sections")
        flags = (*lean, f"-DTICKS={bundle.predictor.spec.window}u")
        state, stack = (int(word) for word in on_board(folder, ("memory.c", *sources_of(folder)), *flags))
        return state, stack


@benchmark(programs=PROGRAMS)
def main(bench: Bench) -> object:
    rows = []
    for name, bundle in networks(bench.quick, bench.seed).items():
        counts = footprint(bundle.predictor)
        for number_format in FORMATS:
            running = whole(bundle, bench.seed) if number_format == "w8a16" else bundle
            state, stack = measured(running)
            said = counts.estimate(number_format).ram_bytes
            rows.append([name, number_format, state, stack, said, said / (state + stack)])
    heads = ["network", "numbers", "state", "stack", "memory estimate", "over used"]
    table(heads, rows)
    for number_format in FORMATS:
        least = min(row[5] for row in rows if row[1] == number_format)
        question = f"{number_format}: least ratio of estimated and used memory"
        bench.check(question, least, 1.0, ">= 1.0", "1")
    kept = [dict(zip([head.replace(" ", "_") for head in heads], row, strict=True)) for row in rows]
    return kept


if __name__ == "__main__":
    main()
