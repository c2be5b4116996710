"""Are the bytes that `edp compress estimate` states those of the program that `edp export` writes?

Networks are exported, compiled for a Cortex-M4F (``-O2``) and linked without a C library's start-up code, unused
functions left out. Constants: the read-only data of the model's object, each constant up to the next word, must be
equal to the byte. Program: code and read-only data of the image, less these constants and the program that calls the
model; the estimate must be within 2 %. The C library's own writable data (``errno``) is not counted. Networks are
those of ``controller_cycles.py`` and all of the contract tests (``tests/conftest.py``), in both formats.

With ``--fit`` the sizes of the runtime's functions are measured anew and written to ``src/edp/export/c/kernels.toml``,
and the bytes of the model's own code (`edp.export.c.program`) are fitted and printed.
"""

from __future__ import annotations

import importlib.util
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import replace
from importlib import resources
from pathlib import Path
from types import ModuleType

import numpy as np
from scipy.optimize import linprog

from common import ROOT, Bench, benchmark, option, table
from controller_cycles import networks
from edp.errors import ExportError
from edp.export.c.integer_calls import tables_header
from edp.export.c.model import computed, make_model, remembered
from edp.export.c.program import features
from edp.export.c.sizes import sizes_of
from edp.export.c.target import core_files
from edp.ir.w8a16 import calibrate
from edp.networks.integer import IntegerPredictor
from edp.signals import Channel, Kind
from edp.training.bundle import Bundle
from embedded_step import whole

PROGRAMS = ("arm-none-eabi-gcc", "arm-none-eabi-nm", "arm-none-eabi-readelf")

PLUGINS = ROOT / "tests" / "plugins"
KERNELS = ROOT / "src/edp/export/c/kernels.toml"
COMPILER = "arm-none-eabi-gcc"
FLAGS = ("-std=c99", "-O2", "-ffp-contract=off", "-mthumb", "-mcpu=cortex-m4", "-mfloat-abi=hard", "-mfpu=fpv4-sp-d16",
         "-ffunction-sections", "-fdata-sections")  # fmt: skip
LINK = ("-nostartfiles", "--specs=nosys.specs", "-Wl,--gc-sections")
MAIN = """
#include "predictor.h"
static predictor_state state;
static predictor_output out;
static float in[PREDICTOR_INPUTS];
int main(void) {
    predictor_reset(&state);
    (void)predictor_step(&state, in, &out);
    (void)predictor_missed(&state, 2u, &out);
    return predictor_check() ? 0 : 1;
}
"""
HEAD = """# Bytes of the runtime's functions on a Cortex-M4F, and which symbols each of them needs, itself included.
# Measured with {version} {flags}
# by: python benchmarks/program_bytes.py --fit
"""
SECTION = re.compile(r"^\s*\[\s*\d+\]\s+(\S+)\s+PROGBITS\s+\S+\s+\S+\s+([0-9a-f]+)", re.M)


def run(folder: Path, *command: object) -> str:
    return subprocess.run(
        [str(part) for part in command], cwd=folder, check=True, capture_output=True, text=True
    ).stdout


def contracts() -> ModuleType:
    """Import the networks of the contract tests."""
    spec = importlib.util.spec_from_file_location("contract_networks", ROOT / "tests/conftest.py")
    if spec is None or spec.loader is None:
        raise RuntimeError("tests/conftest.py cannot be loaded")
    made = importlib.util.module_from_spec(spec)
    sys.path.insert(0, str(PLUGINS))  # as pytest does, by its setting `pythonpath`
    try:
        spec.loader.exec_module(made)
    finally:
        sys.path.remove(str(PLUGINS))
    return made


def bundles(quick: bool, seed: int) -> Iterator[tuple[str, Bundle]]:
    """Networks in both formats."""
    for name, bundle in networks(quick, seed).items():
        yield f"{name}, float32", bundle
        yield f"{name}, w8a16", whole(bundle, seed)
    known = contracts()
    for structure in known.COVERING[:2] if quick else known.STRUCTURES:
        agreed = known.forms_of(structure)
        form = agreed[list(known.STRUCTURES).index(structure) % len(agreed)]
        predictor = known._build(structure, form, 0.2).eval()
        inputs = tuple(Channel(name, Kind.GENERIC, "an input") for name in predictor.task.inputs)
        targets = predictor.task.targets
        bundle = Bundle(predictor, inputs, (Kind.GENERIC,) * len(targets), targets)
        yield f"{structure}, float32", bundle
        try:
            formats = calibrate(predictor.graph(), [known.smooth_rows(predictor)])
        except ExportError:
            continue
        yield f"{structure}, w8a16", replace(bundle, predictor=IntegerPredictor(predictor, formats))


def words(size: int) -> int:
    """Up to the next word."""
    return -(-size // 4) * 4


def sections(folder: Path, name: str, kinds: str) -> int:
    """Bytes of a file's sections of these kinds, each up to the next word."""
    held = SECTION.findall(run(folder, "arm-none-eabi-readelf", "-SW", name))
    return sum(words(int(size, 16)) for section, size in held if re.fullmatch(kinds, section))


def measured(bundle: Bundle) -> tuple[int, int, int]:
    """Constants, program, and the code of the model alone, of an exported and linked network."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        model = make_model("predictor", bundle)
        for name, text in core_files(model).items():
            (folder / name).write_text(text)
        (folder / "main.c").write_text(MAIN)
        run(folder, COMPILER, *FLAGS, "-c", "main.c", *model.sources)
        objects = [name.replace(".c", ".o") for name in ("main.c", *model.sources)]
        run(folder, COMPILER, *FLAGS, *LINK, "-Wl,-e,main", *objects, "-lm", "-o", "image.elf")
        constants = sections(folder, "predictor.o", r"\.(rodata|data).*")
        image = sections(folder, "image.elf", r"\.(text|rodata)") - sections(folder, "main.o", r"\.text.*")
        return constants, image - constants, sections(folder, "predictor.o", r"\.text.*")


def kernels() -> tuple[dict[str, int], dict[str, list[str]]]:
    """Bytes by symbol, and the symbols that each function of the runtime needs."""
    runtime = resources.files("edp.export.c").joinpath("runtime")
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        for file in runtime.iterdir():
            (folder / file.name).write_text(file.read_text())
        (folder / "edp_tables.h").write_text(tables_header())
        sources = sorted(path.name for path in folder.glob("*.c") if "tangent" not in path.name)
        run(folder, COMPILER, *FLAGS, "-c", *sources)
        objects = [name.replace(".c", ".o") for name in sources]
        found = re.findall(r" T (edp_\w+)", run(folder, "arm-none-eabi-nm", *objects))
        sizes: dict[str, int] = {}
        needs = {}
        for function in [*found, "memcpy"]:
            chosen = (f"-Wl,-e,{function}", f"-Wl,-u,{function}")
            run(folder, COMPILER, *FLAGS, *LINK, *chosen, *objects, "-lm", "-o", "image.elf")
            lines = run(folder, "arm-none-eabi-nm", "-S", "image.elf").splitlines()
            symbols = distinct([line.split() for line in lines if re.search(r" [tTrR] \S+$", line)])
            needs[function] = sorted(symbols)
            sizes |= symbols
    return sizes, needs


def distinct(symbols: Sequence[Sequence[str]]) -> dict[str, int]:
    """Bytes by name of symbols ``(address, size, kind, name)`` that do not lie within another one, as aliases do."""
    sized = [(int(row[0], 16), int(row[1], 16), row[3]) for row in symbols if len(row) == 4]
    sizes, end = {}, 0
    # Double precision of the compiler's library: subtraction goes on into addition, each under two names.
    for start, size, name in sorted(sized, key=lambda one: (one[0], -one[1], one[2])):
        if start + size > end:
            sizes[name] = words(size)
            end = start + size
    return sizes


def write_kernels() -> None:
    """Measure the functions of the runtime and write them down."""
    sizes, needs = kernels()
    version = run(ROOT, COMPILER, "--version").splitlines()[0]
    lines = [HEAD.format(version=version, flags=" ".join(FLAGS)), "[bytes]"]
    # The compiler's copies of a function have a dot in their names, which TOML would read as a table's.
    keys = {name: f'"{name}"' if "." in name else name for name in sizes}
    lines += [f"{keys[name]} = {size}" for name, size in sorted(sizes.items())]
    lines += ["", "[needs]", *(f"{name} = {symbols}".replace("'", '"') for name, symbols in sorted(needs.items()))]
    KERNELS.write_text("\n".join(lines) + "\n")


@benchmark(
    option("--fit", action="store_true", help="measure the runtime anew, and fit the model's own code"),
    programs=PROGRAMS,
)
def main(bench: Bench) -> object:
    if bench.options.fit:
        write_kernels()
    rows, given, code = [], [], []
    for name, bundle in bundles(bench.quick, bench.seed):
        model = make_model("predictor", bundle)
        ticks, ends = computed(model.graph, model.plan)
        constants, program, own = measured(bundle)
        said = sizes_of(model.graph)
        given.append([1, *features([*ticks, *ends, *remembered(model.graph)[1]])])
        code.append(own)
        rows.append([name, constants, said.constants, program, said.program, said.program / program])
    table(["network", "constants", "stated", "program", "estimate", "over linked"], rows)
    if bench.options.fit:
        # The least largest error: no network is to be missed by much.
        share = 1.0 / np.array([row[3] for row in rows], float)
        columns, wanted = np.array(given, float) * share[:, None], np.array(code, float) * share
        worst = -np.ones((len(rows), 1))
        both = np.vstack([np.hstack([columns, worst]), np.hstack([-columns, worst])])
        size = columns.shape[1]
        goal, free = [0.0] * size + [1.0], [(None, None)] * (size + 1)
        each = linprog(goal, A_ub=both, b_ub=np.hstack([wanted, -wanted]), bounds=free).x
        print("bytes of every model, a call, an argument on the stack, a wide number; and the largest error left:")
        print(", ".join(f"{value:.3f}" for value in each))
    different = sum(row[1] != row[2] for row in rows)
    worst = max(max(row[5], 1 / row[5]) for row in rows)
    bench.check("networks with a wrong size of constants", different, 1.0, "<= 0.0", "networks")
    bench.check("largest ratio between estimated and linked program size", worst, 1.0, "<= 1.02", "1")
    heads = ("network", "constants", "stated", "program", "estimate", "ratio")
    return [dict(zip(heads, row, strict=True)) for row in rows]


if __name__ == "__main__":
    main()
