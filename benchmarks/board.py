"""Exported C on emulated controllers and on this computer: how it is built, run and counted."""

from __future__ import annotations

import re
import subprocess
from collections.abc import Sequence
from pathlib import Path

BOARD = Path(__file__).resolve().parents[1] / "tests/export/board"
M4 = ("-mthumb", "-mcpu=cortex-m4", "-mfloat-abi=hard", "-mfpu=fpv4-sp-d16", "--specs=rdimon.specs", "-nostartfiles")
M7 = ("-mthumb", "-mcpu=cortex-m7", "-mfloat-abi=hard", "-mfpu=fpv5-d16", "--specs=rdimon.specs", "-nostartfiles")
SEMIHOSTING = ("-nographic", "-semihosting-config", "enable=on,target=native")
QEMU_M4 = ("qemu-system-arm", "-M", "mps2-an386", *SEMIHOSTING)
QEMU_M7 = ("qemu-system-arm", "-M", "mps2-an500", *SEMIHOSTING)
COUNTING = ("-icount", "shift=0")
"""Options of QEMU under which its clock counts instructions."""
PLAIN = ("-O2", "-ffp-contract=off", "-I.")


def run(command: Sequence[object], folder: Path) -> str:
    """Run a program in a folder and return what it prints.

    Raises:
        RuntimeError: the program fails; the text has the end of what it printed.
    """
    done = subprocess.run([str(word) for word in command], cwd=folder, capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(f"{command[0]} ended with {done.returncode}: {(done.stdout + done.stderr)[-1000:]}")
    return done.stdout + done.stderr


def sources_of(folder: Path) -> tuple[str, ...]:
    """Return the C files of an exported model and its runtime."""
    return ("predictor.c", *sorted(path.name for path in folder.glob("edp_*.c")))


def listed_sources(folder: Path) -> list[str]:
    """Return the C files that the CMake file of an export lists."""
    listed = re.search(r"STATIC (.*)\)", (folder / "CMakeLists.txt").read_text())
    if listed is None:
        raise RuntimeError("the CMake file of the export has another form")
    return listed[1].split()


def build_image(folder: Path, core: Sequence[str], sources: Sequence[object], *flags: str) -> None:
    """Link ``image.elf`` for an emulated core."""
    rest = [*sources, BOARD / "startup.c", "-lm", "-lrdimon", "-o", "image.elf"]
    given = ["-std=gnu11", *PLAIN, *core, "-DCLOCK_HZ=25000000u", *flags, "-T", BOARD / "mps2.ld"]
    run(["arm-none-eabi-gcc", *given, *rest], folder)


def run_image(folder: Path, emulator: Sequence[str]) -> list[str]:
    """Return the words that ``image.elf`` prints while instructions are counted."""
    return run([*emulator, *COUNTING, "-kernel", "image.elf"], folder).split()


def on_board(folder: Path, sources: Sequence[object], *flags: str) -> list[str]:
    """Return the words that a program prints on the M4."""
    build_image(folder, M4, sources, *flags)
    return run_image(folder, QEMU_M4)


def instructions(folder: Path, *flags: str) -> int:
    """Return the executed instructions per sample on the M4, the mean over 200."""
    return int(on_board(folder, (*sources_of(folder), BOARD / "count.c"), *flags)[0])


def sizes_on_m7(folder: Path, sources: Sequence[str], header: str, state: str) -> tuple[int, int]:
    """Return the bytes of code and constants on a Cortex-M7, and of a state type that a header declares."""
    build = ["arm-none-eabi-gcc", "-std=gnu99", *PLAIN, *M7, "-c"]
    (folder / "state.c").write_text(f'#include "{header}"\nchar state[sizeof({state})];\n')
    objects = [f"{Path(name).stem}_m7.o" for name in (*sources, "state.c")]
    for source, made in zip((*sources, "state.c"), objects, strict=True):
        run([*build, source, "-o", made], folder)
    *code, last = (line.split() for line in run(["arm-none-eabi-size", *objects], folder).splitlines()[1:])
    return sum(int(line[0]) + int(line[1]) for line in code), int(last[2])


def callgrind(folder: Path, *arguments: str) -> int:
    """Return the instructions of a whole run of ``program`` on this computer."""
    command = ["valgrind", "--tool=callgrind", "--callgrind-out-file=counted", "./program", *arguments]
    counted = re.search(r"Collected : (\d+)", told := run(command, folder))
    if counted is None:
        raise RuntimeError(f"Callgrind counted nothing: {told[-500:]}")
    return int(counted[1])
