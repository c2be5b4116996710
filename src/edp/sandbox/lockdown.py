"""Restrictions of a process that reads a log, and the layers that enforce them.

* **File rules** (`edp.sandbox.landlock`, Linux 5.13): opens nothing for writing and, for reading, only the log and the
  folders of Python and its libraries; from 6.7 no TCP, from 6.12 no signals to other processes. Where Landlock is
  missing, another process opens files by the same list (`edp.sandbox.broker`, Linux 5.9).
* **System calls** (`edp.sandbox.syscalls`, Linux on x86_64 and aarch64): the calls that reading needs, and no others.
* **Limits** (`edp.sandbox.allowance`, POSIX): memory, processor time, no file grows, no core file. The number of
  processes is not limited: that limit counts all processes and threads of the user.
* **Audit hook** (`edp.sandbox.audit`, everywhere): the same from Python code.

Each layer holds where the system has it; none needs rights.
"""

from __future__ import annotations

import os
import sys
import sysconfig
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

from edp.sandbox import audit, broker, landlock, syscalls
from edp.sandbox.layers import AUDIT_HOOK, FILE_RULES, LIMITS, SYSTEM_CALLS

try:
    import resource
except ImportError:  # not POSIX
    resource = None  # type: ignore[assignment]

_SYSTEM = (
    "/lib", "/lib64", "/usr/lib", "/usr/lib64", "/usr/local/lib", "/usr/share/zoneinfo", "/etc/localtime",
    "/etc/timezone", "/etc/ld.so.cache", "/dev/null", "/dev/zero", "/dev/random", "/dev/urandom", "/proc/self",
    "/proc/meminfo", "/proc/cpuinfo", "/proc/stat", "/proc/sys/vm/overcommit_memory", "/proc/sys/kernel/pid_max",
    "/sys/devices/system/cpu", "/sys/devices/system/node", "/sys/fs/cgroup",
    "/sys/kernel/mm/transparent_hugepage",
)  # fmt: skip
"""Files and folders of the system that Python and its libraries read: libraries, time zones and the number of
processors."""
_LIBRARIES = {"site-packages", "dist-packages"}


_folders: list[Path] = []


def note_libraries() -> None:
    """Find the folders of the standard library, of installed libraries and of the packages imported until now.

    A worker does so before it forks, whenever it has imported something.
    """
    places = {sysconfig.get_path(name) for name in ("stdlib", "platstdlib", "purelib", "platlib")}
    places |= {os.path.join(prefix, "lib") for prefix in (sys.prefix, sys.base_prefix)}
    places |= {entry for entry in sys.path if Path(entry).name in _LIBRARIES or entry.endswith(".zip")}
    for name, module in list(sys.modules.items()):
        file = getattr(module, "__file__", None)
        if "." not in name and isinstance(file, str):
            places.add(os.path.dirname(file) if os.path.basename(file).startswith("__init__.") else file)
    _folders.clear()
    for entry in sorted(os.path.realpath(entry) for entry in places if entry):
        if os.path.exists(entry) and not any(Path(entry).is_relative_to(folder) for folder in _folders):
            _folders.append(Path(entry))


def lock_down(readable: Iterable[Path]) -> dict[str, str]:
    """Give up for good all that reading a log does not need.

    Args:
        readable: the log, a file or a folder.

    Returns:
        for each layer, by its name in `edp.sandbox.layers`, why it is missing; empty where it holds. Each layer was
        tried after it was put in force.
    """
    if not _folders:
        note_libraries()
    # Listed before any layer holds: looking for folders needs what the layers forbid.
    allowed = [*readable, *_folders, *map(Path, _SYSTEM)]
    # Landlock before the filter, which refuses the calls that make Landlock's rules. The hook comes last: it cannot be
    # removed, and would decide about what the other layers open as well.
    return {
        FILE_RULES.name: _missing(lambda: _restrict_files(allowed)),
        SYSTEM_CALLS.name: _missing(syscalls.restrict),
        LIMITS.name: _missing(_check_limits),
        AUDIT_HOOK.name: _missing(lambda: audit.restrict(allowed)),
    }


def _restrict_files(readable: Sequence[Path]) -> None:
    try:
        landlock.restrict(readable)
    except OSError as error:
        try:
            broker.restrict(readable)
        except OSError as other:
            raise OSError(f"{error.strerror or error}, and {other.strerror or other}") from other


def _missing(put_in_force: Callable[[], None]) -> str:
    try:
        put_in_force()
    except OSError as error:
        return error.strerror or str(error)
    return ""


def _check_limits() -> None:
    """Raise OSError if files may grow or memory is unlimited (`edp.sandbox.allowance` sets both)."""
    if resource is None:
        raise OSError("the system has no limits of processes")
    unlimited = resource.RLIM_INFINITY
    if resource.getrlimit(resource.RLIMIT_FSIZE)[0] != 0 or resource.getrlimit(resource.RLIMIT_AS)[0] == unlimited:
        raise OSError("the system does not take limits of file size and memory")
