"""Shared libraries of an FMU for Linux and Windows, built by Zig's C compiler."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from edp.errors import ExportError
from edp.storage import write_bytes

# Products and sums stay apart (`-ffp-contract=off`): equal bits on every processor. No debug paths in the library.
FLAGS = ("-std=c99", "-O2", "-ffp-contract=off", "-fvisibility=hidden", "-g0", "-fno-sanitize=all")


@dataclass(frozen=True)
class Platform:
    """Platform of a shared library.

    Attributes:
        target: name of the platform for the compiler; the number is the oldest glibc.
        ending: ending of the library's name.
        folders: folder of the library in an FMU, by version of FMI.
        flags: compiler flags in addition to `FLAGS`.
        last: libraries.
    """

    target: str
    ending: str
    folders: Mapping[int, str]
    flags: tuple[str, ...]
    last: tuple[str, ...]


PLATFORMS = {
    # glibc 2.17 is that of RHEL 7: the library loads on every Linux since.
    "linux64": Platform("x86_64-linux-gnu.2.17", ".so", {2: "linux64", 3: "x86_64-linux"}, ("-fPIC",), ("-lm",)),
    "win64": Platform("x86_64-windows-gnu", ".dll", {2: "win64", 3: "x86_64-windows"}, (), ()),
}


@dataclass(frozen=True)
class Sources:
    """Source files to compile.

    Attributes:
        name: name of the libraries.
        files: sources and headers, file name to text.
        common: C files of all versions of FMI.
        own: C files that only one version has, by version.
    """

    name: str
    files: Mapping[str, str]
    common: Sequence[str]
    own: Mapping[int, Sequence[str]]


def libraries(sources: Sources, platforms: Sequence[str]) -> dict[int, dict[str, bytes]]:
    """Return the path in the FMU and content of each library, by version of FMI.

    Where Zig builds for Windows for the first time, it builds the C library too, which takes minutes.

    Raises:
        ExportError: Zig is not installed, or the compiler refuses the code.
    """
    if platforms and importlib.util.find_spec("ziglang") is None:
        raise ExportError(
            "the libraries of an FMU need the package ziglang: pip install 'excavator-dynamics-predictor[fmu]', or "
            "write one with sources only: --set binaries=none"
        )
    binaries: dict[int, dict[str, bytes]] = {version: {} for version in sources.own}
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        for file, text in sources.files.items():
            # Line ends of C sources are those of Unix, whatever the exporting system writes.
            write_bytes(folder / file, text.encode())
        for platform in map(PLATFORMS.__getitem__, platforms):
            flags = ("-target", platform.target, *FLAGS, *platform.flags, "-shared", "-s")
            library = f"{sources.name}{platform.ending}"
            for version, listed in sources.own.items():
                _zig(folder, *flags, *sources.common, *listed, *platform.last, "-o", library)
                binaries[version][f"binaries/{platform.folders[version]}/{library}"] = (folder / library).read_bytes()
    return binaries


def _zig(folder: Path, *arguments: str) -> None:
    # Objects of this export are of no use to the next one: they are not kept with what Zig builds of the C library.
    surroundings = os.environ | {"ZIG_LOCAL_CACHE_DIR": str(folder / "cache")}
    command = [sys.executable, "-m", "ziglang", "cc", *arguments]
    done = subprocess.run(command, cwd=folder, env=surroundings, capture_output=True)
    if done.returncode:
        raise ExportError(f"Zig's compiler refuses the code of the FMU: {done.stderr.decode(errors='replace')[-2000:]}")
