"""Are the flash and the memory that `edp footprint` estimates those of the code that `edp export` writes?

The exported model is linked for a Cortex-M4F (``-O2``, unused functions left out), and so is the same program without
it. The difference of program, constants and initialised data is the flash that it takes, mathematics library
included. Its state is what ``sizeof`` says. Its stack is what a tick overwrites of a filled stack on the emulated
core, behind a whole window, where every layer has run. The estimates must be within 15 % of flash, and not below the
memory that was used. With ``--fit`` the numbers of `edp.evaluation.controller` are fitted to what was linked.
"""

from __future__ import annotations

import collections
import subprocess
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from common import finish, parser, table, verdict
from controller_cycles import networks
from edp.evaluation.controller import FORMATS
from edp.evaluation.footprint import footprint
from edp.export.c.target import CTarget
from edp.training.bundle import Bundle
from embedded_step import on_board, sources_of, whole

PROGRAM = """
#include <stdint.h>
#include <stdio.h>
#define DEEP 16384
#ifdef MODEL
#include "predictor.h"
#include "predictor_golden.h"
static predictor_state state;
static predictor_output out;
static void ticks(void) {
    for (unsigned tick = 0; tick < TICKS; tick++) {
        (void)predictor_step(&state, golden_inputs[tick % 32u], &out);
    }
}
#else
static void ticks(void) {}
#endif
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
#ifdef MODEL
    predictor_reset(&state);
    (void)printf("%u %u", (unsigned)sizeof(state), used(ticks));
#else
    (void)printf("%u %u", 0u, used(ticks));
#endif
    return 0;
}
"""


def linked(folder: Path, sources: tuple[str, ...], *flags: str) -> tuple[int, int, int]:
    """Bytes of flash (program, constants, initialised data), of the state, and of stack of a tick."""
    (folder / "memory.c").write_text(PROGRAM)
    lean = ("-ffunction-sections", "-fdata-sections", "-Wl,--gc-sections")
    state, stack = (int(word) for word in on_board(folder, ("memory.c", *sources), *lean, *flags))
    sizes = subprocess.run(
        ["arm-none-eabi-size", "image.elf"], cwd=folder, check=True, capture_output=True, text=True
    ).stdout.splitlines()[1]
    text, data = map(int, sizes.split()[:2])
    return text + data, state, stack


def measured(bundle: Bundle) -> tuple[int, int, int]:
    """Flash, state and stack of an exported model, bytes."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        bare = linked(folder, ())
        CTarget().write(bundle, "predictor", folder)
        sources = sources_of(folder)
        flags = ("-DMODEL", f"-DTICKS={bundle.predictor.spec.window}u")
        with_it = linked(folder, sources, *flags)
        golden = golden_bytes(folder)
    return with_it[0] - bare[0] - golden, *with_it[1:]


def stored(bundle: Bundle, number_format: str) -> tuple[int, int]:
    """Bytes of folded weights, and features written, as the estimate takes them."""
    costs = bundle.predictor.costs()
    weights = FORMATS[number_format].weight_bytes * sum(cost.parameters - cost.foldable for cost in costs)
    return weights, sum(cost.width_out for cost in costs)


def golden_bytes(folder: Path) -> int:
    """Bytes of the inputs that the program is fed with, which are no part of the model."""
    said = subprocess.run(
        ["arm-none-eabi-nm", "-S", "image.elf"], cwd=folder, check=True, capture_output=True, text=True
    ).stdout
    return sum(int(line.split()[1], 16) for line in said.splitlines() if line.split()[-1].startswith("golden_"))


def main() -> None:
    made = parser(__doc__ or "")
    made.add_argument("--fit", action="store_true", help="print the bytes of the program and of an output, fitted")
    arguments = made.parse_args()
    rows, fits = [], collections.defaultdict(list)
    for name, bundle in networks(arguments.quick, arguments.seed).items():
        estimates = {entry.number_format: entry for entry in footprint(bundle.predictor).estimates}
        for number_format in FORMATS:
            running = whole(bundle, arguments.seed) if number_format == "w8a16" else replace(bundle)
            flash, state, stack = measured(running)
            said = estimates[number_format]
            weights, outputs = stored(bundle, number_format)
            fits[number_format].append((outputs, flash - weights))
            over = (said.flash_bytes / flash, said.ram_bytes / (state + stack))
            rows.append([name, number_format, flash, said.flash_bytes, over[0], said.parameter_bytes, state, stack,
                         said.ram_bytes, over[1]])  # fmt: skip
    heads = ["network", "numbers", "flash", "flash estimate", "over linked", "parameters", "state", "stack",
             "memory estimate", "over used"]  # fmt: skip
    table(heads, rows)
    verdicts = []
    for number_format in FORMATS:
        own = [row for row in rows if row[1] == number_format]
        worst = max(max(row[4], 1 / row[4]) for row in own)
        least = min(row[9] for row in own)
        verdicts += [
            verdict(f"{number_format}: {question}", value, 1.0, goal, "1", arguments.quick)
            for question, value, goal in (
                ("largest ratio of estimated and linked flash, either way", worst, "<= 1.15"),
                ("least ratio of estimated and used memory", least, ">= 1.0"),
            )
        ]
        if arguments.fit:
            outputs, rest = np.array(fits[number_format], float).T
            per, program = np.polyfit(outputs, rest, 1)
            print(f"{number_format}: {program:.0f} bytes of program, {per:.1f} an output")
    kept = [dict(zip([head.replace(" ", "_") for head in heads], row, strict=True)) for row in rows]
    finish("controller_memory", verdicts, arguments.seed, kept)


if __name__ == "__main__":
    main()
