"""Command ``edp doctor``: installed and missing parts of EDP, and their purpose."""

from __future__ import annotations

import importlib.util
import os
import platform
import re
import shutil
import sys
import tempfile
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from importlib import metadata
from pathlib import Path
from typing import Annotated

import typer

from edp import __version__
from edp.cli.console import JsonFlag, emit, listing, out
from edp.cli.progress import show_progress
from edp.errors import EdpError, count_of
from edp.storage.paths import is_folder_at
from edp.wording import figure, number

BROKEN = 3
"""Exit code where something is missing or broken that edp cannot do without."""
_PACKAGE = "excavator-dynamics-predictor"
_MIN_DISK = 2e9
"""Bytes: a demo takes half of that, a search several."""
_MIN_MEMORY = 2e9
"""Bytes: 10 h of 45 channels train in 1.5 GB."""
_EXTRAS: Mapping[str, tuple[str, str]] = {
    "mdf": ("asammdf", "MDF 4 logs"),
    "ros": ("rosbags", "ROS bags and MCAP"),
    "onnx": ("onnx", "edp export --format onnx"),
    "fmu": ("ziglang", "edp export --format fmu, edp verify of FMUs"),
    "casadi": ("casadi", "edp export --format casadi"),
    "live": ("foxglove", "edp live --record"),
    "rerun": ("rerun", "edp live --rerun"),
    "control": ("gymnasium", "edp loop run, edp loop tune, the simulator as an environment"),
    "rl": ("stable_baselines3", "controllers learned by reinforcement"),
    "cluster": ("ray", "edp search --cluster"),
}
"""Optional parts: module by which each is known, and what it is needed for."""
_PROGRAMS: Mapping[str, str] = {
    "cc": "edp verify of exported C code",
    "gcc": "edp verify of exported C code",
    "clang": "checks of exported C code",
    "octave": "edp verify of MATLAB code",
    "ffmpeg": "edp data animate as a film",
    "chromium": "tests of pages",
    "arm-none-eabi-gcc": "code size and cycles on a controller",
    "qemu-system-arm": "exported code under emulation",
    "x86_64-w64-mingw32-gcc": "exported code for Windows",
    "wine": "exported code for Windows, run here",
}
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")


@dataclass(frozen=True)
class InstallationCheck:
    """Result of one installation check.

    Attributes:
        what: its name.
        state: ``ok``, ``missing`` (optional) or ``broken`` (edp needs it).
        value: version, size or path.
        needed_for: consequence of its absence, and how to install it.
    """

    what: str
    state: str
    value: str
    needed_for: str


def doctor(
    folder: Annotated[Path, typer.Argument(help="Where runs are to be written; its disk is looked at.")] = Path(),
    ahead: Annotated[
        bool,
        typer.Option("--compile", help="First compile simulator, twins and controllers, so that no first call has to."),
    ] = False,
    as_json: JsonFlag = False,
) -> None:
    """Check the installation: versions, optional packages, sandbox, compilers, disk, memory and threads.

    Runs none of the programs it looks for. Ends with exit code 3 where something is broken that edp cannot do without.

    Example: `edp doctor`
    """
    if ahead:
        from edp.workflows.compile_ahead import compile_ahead

        with show_progress("doctor", as_json) as progress:
            compile_ahead(progress)
    checks = [*packages(), *machine(folder), reading(), *sandbox_layers(), *extras(), *programs()]
    broken = [check for check in checks if check.state == "broken"]

    def show() -> None:
        rows = [(check.what, check.state, check.value, check.needed_for) for check in checks]
        listing("", ["what", "state", "value", "needed for"], rows)
        missing = sum(check.state == "missing" for check in checks)
        out.print()
        out.print(f"{len(broken)} broken, {count_of(missing, 'optional part')} missing")

    emit(as_json, {"checks": [asdict(check) for check in checks], "broken": len(broken)}, show)
    if broken:
        raise typer.Exit(BROKEN)


def packages() -> list[InstallationCheck]:
    """EDP, Python and the packages that EDP cannot do without."""
    good = (3, 11) <= sys.version_info < (3, 15)
    python = InstallationCheck(
        "Python", "ok" if good else "broken", platform.python_version(), "3.11 to 3.14 is tested"
    )
    checks = [InstallationCheck("edp", "ok", __version__, str(Path(sys.executable))), python]
    try:
        required = metadata.requires(_PACKAGE) or []
    except metadata.PackageNotFoundError:
        text = "versions of packages are unknown: install edp (pip install, make setup)"
        return [*checks, InstallationCheck("installation", "missing", "runs from source", text)]
    names = [re.split(r"[^\w.-]", line, maxsplit=1)[0] for line in required if "extra ==" not in line]
    absent = [name for name in names if _version(name) is None]
    checks += [InstallationCheck(name, "broken", "-", f"pip install {name}") for name in absent]
    checks += [
        InstallationCheck(name, "ok", _version(name) or "", "training")
        for name in ("torch", "numpy")
        if name not in absent
    ]
    return checks


def _version(name: str) -> str | None:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def machine(folder: Path) -> list[InstallationCheck]:
    """System, threads, memory and disk."""
    from edp.storage.memory import free_bytes

    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    limits = ", ".join(f"{name}={os.environ[name][:8]}" for name in _THREADS if name in os.environ)
    system = "ok" if sys.platform == "linux" else "missing"
    checks = [
        InstallationCheck(
            "system", system, f"{platform.system()} {platform.machine()}", "only Linux is tested; on Windows take WSL"
        ),
        InstallationCheck(
            "threads", "ok", f"{cores} cores{'; ' if limits else ''}{limits}", "training.threads, --workers"
        ),
        _size("memory", free_bytes(), _MIN_MEMORY, "training; free now"),
    ]
    there = next((path for path in (folder.absolute(), *folder.absolute().parents) if is_folder_at(path)), Path("/"))
    try:
        checks.append(_size("disk", shutil.disk_usage(there).free, _MIN_DISK, f"runs below {there}"))
    except OSError as error:
        checks.append(InstallationCheck("disk", "broken", error.strerror or "unreadable", f"runs below {there}"))
    if not os.access(there, os.W_OK):
        checks.append(
            InstallationCheck("folder", "broken", "read-only", f"runs below {there}: choose another folder (--out)")
        )
    return checks


def _size(what: str, size: float, least: float, needed_for: str) -> InstallationCheck:
    state = "ok" if size >= least else "missing"
    advice = "" if size >= least else f"; less than {figure(least / 1e9)} GB is little"
    return InstallationCheck(what, state, f"{number(size / 1e9, 1)} GB", needed_for + advice)


def reading() -> InstallationCheck:
    """Whether a log can be read: readers run in processes that the system must be able to lock down."""
    try:
        from edp.logs import read_recording

        with tempfile.TemporaryDirectory(prefix="edp_") as folder:
            log = Path(folder) / "log.csv"
            log.write_text("time_s,CylVels_1\n0,1\n1,2\n2,3\n", encoding="utf-8")
            samples = read_recording(log).samples
    except (EdpError, OSError, ImportError) as error:
        return InstallationCheck(
            "reading of logs", "broken", " ".join(str(error).split())[:120], "everything that reads logs"
        )
    state = "ok" if samples == 3 else "broken"
    return InstallationCheck("reading of logs", state, "a log was read apart", "everything that reads logs")


def sandbox_layers() -> list[InstallationCheck]:
    """State each layer of the sandbox that the reader of the last log found: in force, or why it is missing.

    Looks at nothing by itself: `reading` reads a log.
    """
    from edp.sandbox.layers import LAYERS, get_seen_layers

    seen = get_seen_layers()
    checks = []
    for layer in LAYERS:
        reason = "not tried: no log was read" if seen is None else seen[layer.name]
        needed_for = f"stops {layer.stops}" + (f"; {layer.needs}: {layer.advice}" if reason else "")
        state = "missing" if reason else "ok"
        checks.append(InstallationCheck(f"sandbox: {layer.name}", state, reason or "in force", needed_for))
    return checks


def extras() -> list[InstallationCheck]:
    """Check the optional parts of EDP."""
    checks = []
    for extra, (module, needed_for) in _EXTRAS.items():
        there = importlib.util.find_spec(module) is not None
        value = "installed" if there else f"pip install '{_PACKAGE}[{extra}]'"
        checks.append(InstallationCheck(f"[{extra}]", "ok" if there else "missing", value, needed_for))
    return checks


def programs() -> list[InstallationCheck]:
    """Programs of the system that some commands call."""
    checks = []
    for name, needed_for in _PROGRAMS.items():
        path = shutil.which(name)
        checks.append(InstallationCheck(name, "missing" if path is None else "ok", path or "-", needed_for))
    return checks
