"""Are the cycles that `edp compress estimate` estimates those of the code that `edp export` writes?

Instructions of a tick, once a whole window was seen, are counted on an emulated Cortex-M4F. Some ticks are traced, and
each instruction is given its cycles by the Cortex-M4 Technical Reference Manual (ARM DDI 0439, table of instruction set
timing): a load or store 1 behind another one and 2 otherwise, one of several registers 1 and one for each, a taken
branch 1 and 2 for the pipeline (1 to 3 there), an integer division 12 (2 to 12), floating-point products and sums 1,
fused ones 3, divisions and roots 14. Memory has no wait states here; how much slower boards are is in
`edp.evaluation.controller`. The low estimate must be within 15 % of that.

With ``--fit`` the cycles of a multiply-accumulate and of a feature in that file are fitted to what was counted of the
networks without trees. A step of a tree is what 60 to 200 trees of depth 2 to 6 add to a network, over their steps.
"""

from __future__ import annotations

import collections
import re
import subprocess
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from board import M4, QEMU_M4, build_image, on_board, run, sources_of
from common import Bench, benchmark, option, table
from edp.config.experiment import load_experiment
from edp.data.scaling import Scaler
from edp.data.task import Task
from edp.evaluation.controller import FORMATS
from edp.evaluation.footprint import footprint
from edp.export.c.target import CTarget
from edp.networks import build_model
from edp.networks.predictor import ModelSpec
from edp.signals import TABLE_A1, Kind
from edp.training.bundle import Bundle
from embedded_step import make, whole

PROGRAMS = ("arm-none-eabi-gcc", "arm-none-eabi-objdump", "qemu-system-arm")

TRACE = ("-singlestep", "-d", "exec,nochain", "-D", "/dev/stderr")
PROGRAM = """
#include "predictor.h"
#include "predictor_golden.h"
#include <stdio.h>
#define SYST_CSR (*(volatile uint32_t *)0xE000E010u)
#define SYST_RVR (*(volatile uint32_t *)0xE000E014u)
#define SYST_CVR (*(volatile uint32_t *)0xE000E018u)
static predictor_state state;
static predictor_output out;
int main(void) {
    predictor_reset(&state);
    for (unsigned tick = 0; tick < TICKS; tick++) {
        (void)predictor_step(&state, golden_inputs[tick], &out);
    }
#ifdef COUNTED
    SYST_RVR = 0xFFFFFFu;
    SYST_CVR = 0u;
    SYST_CSR = 5u;
    const uint32_t start = SYST_CVR;
    for (unsigned tick = 0; tick < COUNTED; tick++) {
        (void)predictor_step(&state, golden_inputs[tick], &out);
    }
    (void)printf("%lu", (unsigned long)(((start - SYST_CVR) & 0xFFFFFFu) * (1000000000u / CLOCK_HZ) / COUNTED));
#endif
    return 0;
}
"""
REFILL, DIVISION, ROOT = 2, 12, 14
SINGLE = re.compile(r"^(ldr|str)(b|h|sb|sh)?$")
BRANCHES = re.compile(r"^(b|bl|bx|blx|cbz|cbnz|tbb|tbh|b(eq|ne|cs|cc|mi|pl|vs|vc|hi|ls|ge|lt|gt|le))$")
LINE = re.compile(r"^\s*([0-9a-f]+):\s+(?:[0-9a-f]{4} ?){1,2}\s+(\S+)\s*([^;@]*)", re.M)


def registers(operands: str) -> int:
    """How many registers a list in braces has."""
    inside = operands[operands.index("{") + 1 : operands.index("}")]
    count = 0
    for part in inside.replace(" ", "").split(","):
        first, dash, last = part.partition("-")
        count += int(last[1:]) - int(first[1:]) + 1 if dash else 1
    return count


def fixed_cycles(word: str, operands: str) -> tuple[int, bool]:
    """Cycles of an instruction wherever it stands, a branch not taken; and whether it is a single load or store."""
    plain = re.sub(r"\.(w|n|f32|s32|u32|f64|i32|32|s16|u16)", "", word)
    base = re.sub(r"(eq|ne|cs|cc|mi|pl|vs|vc|hi|ls|ge|lt|gt|le)$", "", plain) if plain not in TAKEN else plain
    if SINGLE.match(base) or base in ("vldr", "vstr"):
        return 2, True
    if base in ("ldrd", "strd"):
        return 3, False
    if base in ("push", "pop", "vpush", "vpop") or re.match(r"^v?(ldm|stm)", base):
        return 1 + registers(operands), False
    if base in ("sdiv", "udiv"):
        return DIVISION, False
    if base in ("vdiv", "vsqrt"):
        return ROOT, False
    if base in ("vmla", "vmls", "vnmla", "vnmls", "vfma", "vfms", "vfnma", "vfnms"):
        return 3, False
    return (2, False) if base in ("mla", "mls") else (1, False)


# Words that end like a condition and have none.
TAKEN = {
    "muls", "bics", "lsls", "movs", "adcs", "sbcs", "vmls", "vfms", "vnmls", "vfnms", "smmls", "mls", "teq", "umlal",
    "smlal", "vcvt", "svc", "bls", "bcs", "bcc", "bvs", "bvc", "blt", "ble", "bge", "bgt", "bhi", "bmi", "bpl", "beq",
    "bne",
}  # fmt: skip


def disassembled(folder: Path, double: tuple[int, int] = (0, 0)) -> dict[int, tuple[int, bool, bool, int]]:
    """Cycles, whether a single load or store, whether a branch, and length of the instruction at each address.

    Args:
        folder: with ``image.elf``.
        double: cycles that a product or sum, and a division or root, takes more in double precision.
    """
    said = run(["arm-none-eabi-objdump", "-d", "image.elf"], folder)
    found = {}
    for line in said.splitlines():
        match = LINE.match(line)
        if match is None:
            continue
        word, operands = match[2], match[3].strip()
        cycles, single = fixed_cycles(word, operands)
        if ".f64" in word and not word.startswith(("vldr", "vstr", "vmov")):
            cycles += double[1] if word.startswith(("vdiv", "vsqrt")) else double[0]
        plain = word.partition(".")[0]
        jumps = bool(BRANCHES.match(plain)) or "pc}" in operands or operands.startswith("pc,")
        codes = re.match(r"^\s*[0-9a-f]+:\s+([0-9a-f]{4})( [0-9a-f]{4})?", line)
        found[int(match[1], 16)] = (cycles, single, jumps, 4 if codes and codes[2] else 2)
    return found


def traced(folder: Path, ticks: int) -> tuple[int, int]:
    """Instructions and cycles of so many ticks from reset, start-up included."""
    build_image(folder, M4, ["ticks.c", *sources_of(folder)], f"-DTICKS={ticks}")
    return traced_image(folder, QEMU_M4)


def traced_image(folder: Path, emulator: tuple[str, ...], double: tuple[int, int] = (0, 0)) -> tuple[int, int]:
    """Instructions and cycles of a whole run of ``image.elf``, start-up included; `double` as in `disassembled`."""
    known = disassembled(folder, double)
    command = [*emulator, *TRACE, "-kernel", "image.elf"]
    instructions, cycles, before, behind = 0, 0, None, False
    with subprocess.Popen(command, cwd=folder, stderr=subprocess.PIPE, text=True) as running:
        for line in running.stderr or ():
            if not line.startswith("Trace"):
                continue
            at = int(line.split("/", 2)[1], 16)
            if at not in known:
                raise RuntimeError(f"address {at:#x} was executed, but is not in the listing")
            cost, single, _, _ = known[at]
            if before is not None and known[before][2] and at != before + known[before][3]:
                cycles += REFILL
            cycles += 1 if single and behind else cost
            instructions, before, behind = instructions + 1, at, single
    return instructions, cycles


def a_tick(bundle: Bundle) -> tuple[int, float]:
    """Instructions of a tick behind a whole window, and cycles of an instruction in the third and fourth tick."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        CTarget().write(bundle, "predictor", folder)
        (folder / "ticks.c").write_text(PROGRAM)
        flags = (f"-DTICKS={bundle.predictor.spec.window}u", "-DCOUNTED=20u")
        instructions = int(on_board(folder, ("ticks.c", *sources_of(folder)), *flags)[0])
        few, many = (traced(folder, ticks) for ticks in (2, 4))
    return instructions, (many[1] - few[1]) / (many[0] - few[0])


def of_preset(preset: str, seed: int, changes: tuple[str, ...] = ()) -> Bundle:
    """Create an untrained network of a preset."""
    experiment = load_experiment(None, preset, list(changes))
    return drawn(experiment.task.resolve(100.0), experiment.model, seed)


def drawn(task: Task, model: ModelSpec, seed: int) -> Bundle:
    features, horizons = len(task.features.features), len(task.horizons)
    blank = np.zeros((horizons, len(task.targets)))
    predictor = build_model(task, model, Scaler(np.zeros(features), np.ones(features), blank, blank + 1), seed).eval()
    inputs = tuple(TABLE_A1[name] for name in task.inputs)
    return Bundle(predictor, inputs, (Kind.VELOCITY,) * len(task.targets), task.targets)


def networks(quick: bool, seed: int) -> dict[str, Bundle]:
    """Networks of several kinds and sizes, by name."""
    small = {"thesis's kind 32/32": make(32, 32, seed)}
    if quick:
        return small
    made = small | {f"thesis's kind {c}/{u}": make(c, u, seed) for c, u in ((32, 64), (64, 64), (64, 128))}
    made |= {"preset quick": of_preset("quick", seed), "preset standard": of_preset("standard", seed)}
    narrow = ("model.backbone.channels=[72]", "model.backbone.units=72", "model.head.hidden=24")
    made["standard, 72 units"] = of_preset("standard", seed, narrow)
    made["LSTM 64"] = of_preset("quick", seed, ('model.backbone={kind="lstm",units=64}',))
    levels = ('model.backbone={kind="tcn",channels=[32,32,32,32]}', "model.blocks=[]")
    made["TCN 32, four levels"] = of_preset("quick", seed, levels)
    small_members = 'kind="committee",members=4,units=32'
    for trees, depth in ((0, 4), (60, 4), (200, 6)):
        backbone = f"model.backbone={{{small_members},trees={trees},tree_depth={depth}}}"
        made[f"committee, {trees} trees of depth {depth}"] = of_preset("committee", seed, (backbone,))
    return made


def parts_of(bundle: Bundle) -> tuple[int, int]:
    """Multiply-accumulates of a tick and features written, as the estimate takes them."""
    costs = bundle.predictor.costs()
    return sum(c.per_column + c.per_prediction + c.pooling for c in costs), sum(c.width_out for c in costs)


@benchmark(option("--fit", action="store_true", help="print two numbers of each format, fitted"), programs=PROGRAMS)
def main(bench: Bench) -> object:
    rows, ratios = [], collections.defaultdict(list)
    fits: dict[str, list[tuple[int, int, int]]] = collections.defaultdict(list)
    for name, bundle in networks(bench.quick, bench.seed).items():
        estimates = {entry.number_format: entry.cycles["cortex_m4f"] for entry in footprint(bundle.predictor).estimates}
        for number_format in FORMATS:
            running = whole(bundle, bench.seed) if number_format == "w8a16" else replace(bundle)
            instructions, each = a_tick(running)
            cycles = round(instructions * each)
            low, _, high = estimates[number_format]
            macs, outputs = parts_of(bundle)
            if not any(cost.tree_steps for cost in bundle.predictor.costs()):
                fits[number_format].append((macs, outputs, cycles))
            ratios[number_format].append(low / cycles)
            rows.append([name, number_format, macs, instructions, cycles, each, low, low / cycles, high])
    table(["network", "numbers", "MACs", "instructions", "cycles", "per instruction", "estimate", "over counted",
           "high estimate"], rows)  # fmt: skip
    for number_format, found in ratios.items():
        worst = max(found, key=lambda ratio: abs(np.log(ratio)))
        name = f"{number_format}: largest ratio between estimated and counted cycles"
        bench.check(name, max(worst, 1 / worst), 1.0, "<= 1.15", "1")
        if bench.options.fit:
            macs, outputs, cycles = (np.array(column, float) for column in zip(*fits[number_format], strict=True))
            per, *_ = np.linalg.lstsq(np.stack([macs, outputs], 1) / cycles[:, None], np.ones(len(cycles)), rcond=None)
            print(f"{number_format}: {per[0]:.3f} cycles a multiply-accumulate, {per[1]:.1f} a feature written")
    heads = ("network", "format", "macs", "instructions", "cycles", "per_instruction", "estimate", "ratio", "high")
    return [dict(zip(heads, row, strict=True)) for row in rows]


if __name__ == "__main__":
    main()
