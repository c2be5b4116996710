"""What does a sample of an exported monitor cost, and does `edp compress estimate` predict its cycles?

Chains of several sizes with drawn numbers run on an emulated Cortex-M4F, which has no double precision in hardware: the
instructions of every tick of a block are counted, and those of some ticks traced and given their cycles as in
`controller_cycles.py`. With ``--fit`` the cycles of a residual, an input, a product and a root are fitted to what was
counted (`edp.evaluation.monitor_footprint`).

Then a network of the preset `quick` with weights as drawn, alone and within a monitor of its look-ahead errors: what
the monitor adds, on average and in the longest tick.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from board import M4, QEMU_M4, build_image, instructions, on_board
from common import Bench, benchmark, option, table
from controller_cycles import of_preset, traced_image
from edp.evaluation.monitor_footprint import chain_cycles, chain_work
from edp.export.c.target import CTarget
from edp.export.monitor import GoldenChain, GoldenResiduals, MonitorParts, NetworkPart, monitor_files
from edp.monitor.adaptation import SlowDrift
from edp.monitor.chain import MonitorChain
from edp.monitor.conditioning import Conditioning
from edp.monitor.detectors import CusumSpec, EwmaSpec
from edp.monitor.residuals.balances import Balances
from edp.monitor.summaries import BlockSummaries
from edp.monitor.watches import Watch
from edp.signals import Channel, Kind

PROGRAMS = ("arm-none-eabi-gcc", "arm-none-eabi-objdump", "qemu-system-arm")

BLOCK, SETTLE = 100, 1
FITTED = (
    *((6, 30, 25, 20, 0), (12, 30, 25, 40, 3), (24, 30, 25, 60, 0), (24, 12, 8, 120, 1), (40, 40, 12, 60, 0)),
    *((40, 20, 12, 60, 4), (4, 60, 40, 20, 0)),
)
"""Residuals, inputs, numbers of the operating point, directions of each of two watches, drivers: what is fitted to."""
HELD_OUT = ((9, 24, 16, 45, 0), (18, 30, 24, 90, 3), (30, 30, 10, 40, 2))
"""Sizes that they are judged by."""
PROGRAM = """
#include "watch.h"
#include <stdio.h>
#define SYST_CSR (*(volatile uint32_t *)0xE000E010u)
#define SYST_RVR (*(volatile uint32_t *)0xE000E014u)
#define SYST_CVR (*(volatile uint32_t *)0xE000E018u)
static watch_state state;
static float in[WATCH_INPUTS], residuals[WATCH_RESIDUALS];
static uint32_t lcg = 1u;
static float drawn(void) {
    lcg = (1664525u * lcg) + 1013904223u;
    return ((float)(lcg >> 8) * 1.1920929e-7f) - 1.0f;
}
int main(void) {
    watch_reset(&state);
    SYST_RVR = 0xFFFFFFu;
    for (unsigned tick = 0; tick < TICKS; tick++) {
        watch_output out;
        (void)out;
        for (unsigned i = 0; i < WATCH_INPUTS; i++) { in[i] = drawn(); }
        for (unsigned i = 0; i < WATCH_RESIDUALS; i++) { residuals[i] = drawn(); }
        SYST_CVR = 0u;
        SYST_CSR = 5u;
        const uint32_t start = SYST_CVR;
#ifdef WHOLE
        (void)watch_step(&state, in, &out);
#else
        watch_chain(&state, in, residuals);
#endif
        const uint32_t passed = (start - SYST_CVR) & 0xFFFFFFu;
#ifdef COUNTED
        (void)printf("%lu ", (unsigned long)(passed * (1000000000u / CLOCK_HZ)));
#else
        (void)passed;
#endif
    }
    return 0;
}
"""


@benchmark(option("--fit", action="store_true", help="print cycles fitted to what was counted"), programs=PROGRAMS)
def main(bench: Bench) -> object:
    quick, seed = bench.quick, bench.seed
    root = bench.folder
    sizes = HELD_OUT[:1] if quick else (FITTED if bench.options.fit else HELD_OUT)
    rows = [measured(size, root / str(i), seed) for i, size in enumerate(sizes)]
    beside = compare_with_predictor(root / "beside", seed)
    each = float(np.mean([row["cycles_each"] for row in rows]))
    for row in rows:
        row["ratio"] = row["estimate"] / (row["mean"] * each)
        row["longest_ratio"] = row["longest_estimate"] / (row["most"] * each)
    heads = ["residuals", "inputs", "point", "directions", "drivers", "instructions", "longest tick"]
    heads += ["estimate / counted", "longest"]
    names = ("mean", "most", "ratio", "longest_ratio")
    table(heads, [[*row["size"], *(row[name] for name in names)] for row in rows])
    if bench.options.fit:
        print(fitted(rows, each))
    print(f"{each:.3f} cycles an instruction; predictor {beside['alone']:,} instructions a tick, in a monitor of its "
          f"look-ahead errors {beside['mean']:,.0f}, longest {beside['most']:,}")  # fmt: skip
    worst = max(abs(row["ratio"] - 1.0) for row in rows)
    bench.check("estimated cycles of a chain against counted ones, largest error", worst, 0.15, "<= 1", "share")
    bench.check(
        "estimated cycles of the longest step against counted ones",
        max(abs(row["longest_ratio"] - 1.0) for row in rows),
        0.3,
        "<= 1",
        "share",
    )
    name = "monitor of prediction errors and predictor, mean step"
    bench.check(name, beside["mean"], 1.25 * beside["alone"], "<= 1", "instructions")
    bench.check("longest step of that monitor", beside["most"], 1.25 * beside["alone"], "<= 1", "instructions")
    return {"chains": rows, "cycles_an_instruction": each, "beside": beside}


def measured(size: tuple[int, ...], folder: Path, seed: int) -> dict[str, Any]:
    """Instructions of the ticks of a block, and cycles of one of them."""
    parts = drawn_parts(size, seed)
    counts = counted(parts, folder)
    few, many = (traced_ticks(folder, ticks) for ticks in (2, 4))
    each = (many[1] - few[1]) / (many[0] - few[0])
    return {
        "size": size, "mean": float(counts.mean()), "most": int(counts.max()), "cycles_each": each,
        "work": chain_work(parts), "estimate": chain_cycles(parts).mean,
        "longest_estimate": chain_cycles(parts).most,
    }  # fmt: skip


def counted(parts: MonitorParts, folder: Path, *flags: str) -> np.ndarray:
    """Instructions of each tick of a block that is judged."""
    ticks = (SETTLE + 3) * BLOCK
    folder.mkdir(exist_ok=True)
    files = monitor_files(parts, "watch")
    for name, text in files.texts().items():
        (folder / name).write_text(text)
    (folder / "ticks.c").write_text(PROGRAM)
    sources = ("ticks.c", *files.compiled)
    told = on_board(folder, sources, "-fno-tree-loop-vectorize", "-DCOUNTED", f"-DTICKS={ticks}u", *flags)
    return np.array(told, float)[-BLOCK:]


def traced_ticks(folder: Path, ticks: int) -> tuple[int, int]:
    build_image(folder, M4, sorted(path.name for path in folder.glob("*.c")), f"-DTICKS={ticks}u")
    return traced_image(folder, QEMU_M4)


def compare_with_predictor(folder: Path, seed: int) -> dict[str, Any]:
    """Instructions of a predictor alone, and of a monitor of its errors, a whole step each."""
    bundle = of_preset("quick", seed)
    with tempfile.TemporaryDirectory() as temporary:
        CTarget().write(bundle, "predictor", Path(temporary))
        alone = instructions(Path(temporary))
    inputs, targets = len(bundle.inputs), len(bundle.task.targets)
    names = [channel.name for channel in bundle.inputs]
    judged = tuple(names.index(target) for target in bundle.task.targets)
    network = NetworkPart(
        bundle, tuple(range(inputs)), np.zeros(inputs, np.float32), judged, tuple(range(targets)),
        tuple(k for k in bundle.task.horizons for _ in bundle.task.targets),
    )  # fmt: skip
    parts = drawn_parts((targets, inputs, inputs, 5 * targets, 0), seed, network, bundle.inputs)
    counts = counted(parts, folder, "-DWHOLE")
    return {"alone": alone, "mean": float(counts.mean()), "most": int(counts.max()), "work": chain_work(parts)}


def drawn_parts(
    size: tuple[int, ...], seed: int, network: NetworkPart | None = None, channels: tuple[Channel, ...] = ()
) -> MonitorParts:
    """Create a monitor with random parameters."""
    residuals, inputs, points, directions, drivers = size
    rng, summaries = np.random.default_rng(seed), (5 + drivers) * residuals
    channels = channels or tuple(Channel(f"c{i}", Kind.GENERIC) for i in range(inputs))

    def single(*shape: int) -> np.ndarray:
        return rng.normal(size=shape).astype(np.float32).astype(float)

    widths = np.concatenate([np.ones((summaries, 1)), 0.01 * np.abs(single(summaries, points))], axis=1)
    kinds = CusumSpec(0.5), EwmaSpec(0.5)
    watches = tuple(Watch(kind, single(summaries), single(summaries, directions)) for kind in kinds)
    sums = BlockSummaries(
        block=BLOCK, centre=np.full(inputs, 0.1), spread=np.ones(inputs), scale=np.ones(residuals),
        change=np.ones(residuals), channel=np.arange(residuals) % inputs, level=np.arange(points // 2),
        moving=np.arange(points - points // 2) % inputs,
        drivers=np.arange(drivers * residuals * 2).reshape(drivers, residuals, 2) % inputs,
    )  # fmt: skip
    conditioning = Conditioning(
        offset=single(points), width=np.ones(points), usual=single(summaries, points + 1),
        spread=widths.astype(np.float32).astype(float), floor=np.full(summaries, 0.25), clip=6.0,
    )  # fmt: skip
    chain = MonitorChain(sums, conditioning, SlowDrift(0.001, 0.5), watches, limit=1e9, quiet=0.0, settle=SETTLE)
    pairs = (np.arange(residuals)[:, None] + np.arange(2)) % inputs
    columns = {channel.name: i for i, channel in enumerate(channels)}
    source = network or Balances(
        tuple(columns), pairs, 100.0 * np.ones(residuals), np.ones(residuals), 100.0, np.zeros(inputs, np.float32),
        ("1",) * residuals,
    )  # fmt: skip
    golden = GoldenChain(np.zeros((1, 2)), (-1,), (0,), np.zeros(summaries))
    rows = GoldenResiduals(*(np.zeros(shape, np.float32) for shape in ((1, inputs), (1, residuals), residuals)))
    names, reads = tuple(f"r{i}" for i in range(residuals)), [tuple(range(inputs))] * residuals
    about = "drawn", "0" * 32, "drawn", channels, 100.0
    return MonitorParts(*about, names, reads, columns, (source,), chain, golden, rows)


def fitted(rows: list[dict[str, Any]], each: float) -> dict[str, float]:
    """Cycles of the parts of the work, by least squares of relative errors."""
    names = list(rows[0]["work"])
    work = np.array([[row["work"][name] for name in names] for row in rows])
    cycles = np.array([row["mean"] * each for row in rows])
    found, *_ = np.linalg.lstsq(work / cycles[:, None], np.ones(len(cycles)), rcond=None)
    return dict(zip(names, found.round(1).tolist(), strict=True))


if __name__ == "__main__":
    main()
