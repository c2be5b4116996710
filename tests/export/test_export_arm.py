"""Exported networks on bare Cortex-M cores under QEMU: the same bits as on this machine, and counted instructions."""

from __future__ import annotations

from pathlib import Path

import pytest

from edp.export.c.target import CTarget

BOARD = Path(__file__).parent / "board"
CORES = {
    "m4": ("cortex-m4", "fpv4-sp-d16", "mps2-an386", 25_000_000),
    "m7": ("cortex-m7", "fpv5-sp-d16", "mps2-an500", 25_000_000),
    "m33": ("cortex-m33", "fpv5-sp-d16", "mps2-an505", 20_000_000),
}
# Instructions of a step on the M4 with GCC 12, -O2, in single precision and in integers.
STORED = {
    ("hybrid", False): 8_315,
    ("tcn", False): 5_133,
    ("lstm", False): 6_669,
    ("lstm+hybrid physics", False): 13_426,
    ("hybrid", True): 9_442,
    ("tcn", True): 5_164,
    ("lstm", True): 7_914,
}


@pytest.fixture(scope="module")
def on_core(c):
    """Builds an exported folder for a core and gives what its program prints."""

    def make(folder: Path, core: str, program: Path) -> list[str]:
        c.need("arm-none-eabi-gcc", "qemu-system-arm")
        cpu, fpu, machine, clock = CORES[core]
        script = (BOARD / "mps2.ld").read_text()
        if core == "m33":  # its secure memory lies elsewhere
            script = script.replace("0x00000000", "0x10000000").replace(
                "0x20000000, LENGTH = 4M", "0x38000000, LENGTH = 2M"
            )
        (folder / "board.ld").write_text(script)
        flags = [
            "-std=gnu99",
            "-O2",
            "-ffp-contract=off",
            "-mthumb",
            f"-mcpu={cpu}",
            "-mfloat-abi=hard",
            f"-mfpu={fpu}",
        ]
        flags += ["--specs=rdimon.specs", "-nostartfiles", "-I.", f"-DCLOCK_HZ={clock}u", "-T", "board.ld"]
        sources = [*c.sources(folder), program, BOARD / "startup.c"]
        c.run("arm-none-eabi-gcc", *flags, *sources, "-lm", "-lrdimon", "-o", "image.elf", folder=folder)
        emulator = ["qemu-system-arm", "-M", machine, "-nographic", "-icount", "shift=0"]
        emulator += ["-semihosting-config", "enable=on,target=native", "-kernel", "image.elf"]
        return c.run(*emulator, folder=folder).decode().splitlines()

    return make


RUNS = [(*case, tuple(CORES) if case[0] == "hybrid" else ("m4",)) for case in STORED]
OTHERS = [pytest.param(*case, ("m7", "m33"), marks=pytest.mark.slow) for case in STORED if case[0] != "hybrid"]


@pytest.mark.parametrize(("network", "whole", "cores"), [*RUNS, *OTHERS])
def test_every_core_gives_the_bits_of_this_machine(c, network, whole, cores, bundle_of, on_core, tmp_path):
    CTarget().write(bundle_of(network, whole), "predictor", tmp_path)
    c.need("gcc")
    flags = ("-std=c99", "-O2", "-ffp-contract=off", "-I.")
    c.run("gcc", *flags, *c.sources(tmp_path), BOARD / "count.c", "-lm", "-o", "here", folder=tmp_path)
    (wanted,) = c.run(tmp_path / "here").decode().split()
    for core in cores:
        count, found = on_core(tmp_path, core, BOARD / "count.c")
        assert found == wanted, core
        if core == "m4":
            assert 0.8 * STORED[network, whole] < int(count.split()[0]) < 1.05 * STORED[network, whole]


@pytest.mark.parametrize(("network", "whole"), [("hybrid+all", False), ("tcn+all", True)])
def test_the_whole_test_of_a_model_passes_on_a_core(network, whole, bundle_of, on_core, tmp_path):
    CTarget().write(bundle_of(network, whole), "predictor", tmp_path)
    assert on_core(tmp_path, "m4", tmp_path / "host_test.c")[-1] == "predictor: all tests passed"
