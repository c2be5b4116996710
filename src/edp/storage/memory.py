"""Memory checks: announced sizes of a file are compared with the free memory before it is unpacked."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterator
from pathlib import Path

from edp.errors import ConfigError, DataError
from edp.wording import typed

SHARE = 0.8
"""Fraction of the free memory that a log may take."""
UNKNOWN_BYTES = 1 << 62
"""Value for the available memory if the operating system states no limit, bytes."""
Listener = Callable[[int, int, int], None]
_listener: Listener | None = None


def listen(listener: Listener | None) -> None:
    """Set the function that `announce` calls: a process that reads one log raises its limits accordingly."""
    global _listener
    _listener = listener


def announce(*, memory: int = 0, work: int = 0, parts: int = 0) -> None:
    """Report the sizes in the checked headers of a log, so that a sandbox allows them.

    Args:
        memory: bytes that reading takes at one time.
        work: bytes that are unpacked, one after the other.
        parts: objects, variables or messages that are gone through.
    """
    if _listener is not None:
        _listener(memory, work, parts)


def free_bytes() -> int:
    """Return the memory available to this process: the minimum for machine, control groups and own limits.

    A large number where the system does not tell.
    """
    return max(min([_machine(), *_groups(), *_own_limits()]), 0)


def _machine() -> int:
    with contextlib.suppress(OSError, ValueError, IndexError):
        for line in Path("/proc/meminfo").read_text(encoding="ascii").splitlines():
            if line.startswith("MemAvailable:"):
                return int(line.split()[1]) * 1024
    with contextlib.suppress(OSError, ValueError, AttributeError):
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    return UNKNOWN_BYTES


def _groups(processes: Path = Path("/proc/self/cgroup"), root: Path = Path("/sys/fs/cgroup")) -> Iterator[int]:
    """Yield the free memory of each memory control group, from the process's own to the outermost (v2 and v1)."""
    try:
        lines = processes.read_text(encoding="utf-8").splitlines()
    except (OSError, ValueError):
        return
    for line in lines:
        _, names, group_path = (*line.split(":", 2), "", "")[:3]
        if names and "memory" not in names.split(","):
            continue
        top = root if not names else root / "memory"
        group = top / group_path.lstrip("/")
        # In a container the path may be that of the host; its own group then lies at the top.
        for folder in (group, *group.parents):
            if folder == top or top in folder.parents:
                left = _group_left(folder, version_2=not names)
                if left is not None:
                    yield left


def _group_left(folder: Path, version_2: bool) -> int | None:
    limit, usage, cache = (
        ("memory.max", "memory.current", "inactive_file")
        if version_2
        else ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file")
    )
    try:
        most, used = int((folder / limit).read_text("ascii")), int((folder / usage).read_text("ascii"))
    except (OSError, ValueError):  # no such group, or "max"
        return None
    with contextlib.suppress(OSError, ValueError, IndexError):
        for line in (folder / "memory.stat").read_text("ascii").splitlines():
            if line.startswith(f"{cache} "):
                used -= int(line.split()[1])  # files kept in memory give way
    return most - used


def _own_limits() -> Iterator[int]:
    """Yield the free memory within the process's limits on address space and data; in a sandbox, its hard limits."""
    try:
        import resource

        pages = [int(part) for part in Path("/proc/self/statm").read_text("ascii").split()]
    except (ImportError, OSError, ValueError):
        return
    page = os.sysconf("SC_PAGE_SIZE")
    used = {resource.RLIMIT_AS: pages[0] * page, resource.RLIMIT_DATA: pages[5] * page}
    for limit, used_bytes in used.items():
        soft, hard = resource.getrlimit(limit)
        # In a sandbox the soft limit is this module's own, which announcements raise up to the hard one.
        most = soft if _listener is None else hard
        if most != resource.RLIM_INFINITY:
            yield most - used_bytes


def check_memory(path: Path, needed: int, what: str, advice: str) -> None:
    """Refuse what does not fit; what does is allowed to a reader in a sandbox.

    Args:
        path: the file.
        needed: bytes that reading takes.
        what: user of the memory, for the message.
        advice: advice for the message.

    Raises:
        DataError: `needed` is more than this machine can give.
    """
    free = free_bytes()
    # A share of what is free: other processes, and the results themselves, need some, too.
    if needed > SHARE * free:
        raise DataError(
            f"'{path}': {what} would take {gigabytes(needed)} of memory, {gigabytes(free)} are free; {advice}"
        )
    announce(memory=needed)


def gigabytes(count: float) -> str:
    """Format a number of bytes in GB."""
    return f"{typed(count / 1e9, 3)} GB"


def check_setting(needed: float, what: str, advice: str) -> None:
    """Raise an error for settings that need more memory than the machine can give, before it is allocated.

    Args:
        needed: bytes.
        what: settings that need the memory.
        advice: advice for the message.

    Raises:
        ConfigError: says what it would take and what is free.
    """
    free = free_bytes()
    if needed > SHARE * free:
        raise ConfigError(f"{what} would take {readable(needed)} of memory, {readable(free)} are free; {advice}")


def readable(count: float) -> str:
    """Format a number of bytes in MB, GB or TB."""
    unit, size = ("TB", 1e12) if count >= 1e12 else ("GB", 1e9) if count >= 1e9 else ("MB", 1e6)
    return f"{typed(count / size, 3)} {unit}" if count < 1e15 else f"{count / size:,.0f} {unit}"
