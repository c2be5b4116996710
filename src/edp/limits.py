"""What a file may ask of this machine's memory: announced sizes are weighed before anything is unpacked."""

from __future__ import annotations

import os
from pathlib import Path

from edp.errors import ConfigError, DataError

SHARE = 0.8
"""Of the memory that is free now, what a log may take."""


def free_bytes() -> int:
    """Memory that can be had now; a large number where the system does not tell."""
    try:
        for line in Path("/proc/meminfo").read_text(encoding="ascii").splitlines():
            if line.startswith("MemAvailable:"):
                return int(line.split()[1]) * 1024
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (OSError, ValueError, AttributeError, IndexError):
        return 1 << 62


def check_memory(path: Path, needed: int, what: str, advice: str) -> None:
    """Refuse what does not fit.

    Args:
        path: the file.
        needed: bytes that reading takes.
        what: what takes them.
        advice: what to do instead.

    Raises:
        DataError: `needed` is more than this machine can give.
    """
    free = free_bytes()
    if needed > SHARE * free:
        raise DataError(
            f"'{path}': {what} would take {_gigabytes(needed)} of memory, {_gigabytes(free)} are free; {advice}"
        )


def _gigabytes(count: int) -> str:
    return f"{count / 1e9:,.3g} GB"


def check_setting(needed: float, what: str, advice: str) -> None:
    """Refuse settings that ask for more memory than this machine can give, before any of it is taken.

    Args:
        needed: bytes.
        what: which settings take them.
        advice: what to do instead.

    Raises:
        ConfigError: says what it would take and what is free.
    """
    free = free_bytes()
    if needed > SHARE * free:
        raise ConfigError(f"{what} would take {readable(needed)} of memory, {readable(free)} are free; {advice}")


def readable(count: float) -> str:
    """A number of bytes in MB, GB or TB."""
    unit, size = ("TB", 1e12) if count >= 1e12 else ("GB", 1e9) if count >= 1e9 else ("MB", 1e6)
    return f"{count / size:,.3g} {unit}" if count < 1e15 else f"{count / size:,.0f} {unit}"
