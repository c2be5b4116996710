"""Compiling the simulator's inner loops, with an on-disk cache where one can be kept.

Numba's cache knows a function by its own file, not by the files of the functions it calls: after an edit to one file,
callers elsewhere would keep running the old code. The cache folder therefore carries a fingerprint of every source
file of this package that holds compiled code or the layout of its arrays; edits to other files keep the cache.
"""

from __future__ import annotations

import fcntl
import hashlib
import os
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import numba

from edp.signals import GROUND_POINTS

Function = TypeVar("Function", bound=Callable[..., Any])

# No "nnan"/"ninf": a diverging state must stay visible as NaN.
# No reference counts ("_nrt"): compiled functions read and write arrays of their callers and allocate none. Counting
# references to them, with atomic operations at every use, took 40 % of a step.
OPTIONS: dict[str, Any] = {
    "fastmath": {"nsz", "arcp", "contract", "afn", "reassoc"},
    "error_model": "numpy",
    "_nrt": False,
}


def fingerprinted() -> tuple[Path, ...]:
    """The source files that compiled code comes from: those that import this one, `layout`, and this one."""
    files = sorted(Path(__file__).parents[1].rglob("*.py"))
    own = (Path(__file__).name, "layout.py")
    return tuple(f for f in files if f.name in own or b"from edp.sim.physics.jit import" in f.read_bytes())


@cache
def cache_folder() -> Path | None:
    """Where compiled code is kept: below NUMBA_CACHE_DIR or the user's cache folder; None where neither is writable."""
    state = hashlib.blake2b(digest_size=8)
    state.update(str(GROUND_POINTS).encode())
    for source in fingerprinted():
        # The zero byte separates name and content, so that no other split of the same bytes has this hash.
        state.update(source.relative_to(Path(__file__).parents[1]).as_posix().encode() + b"\0" + source.read_bytes())
    chosen = os.environ.get("NUMBA_CACHE_DIR")
    try:
        base = Path(chosen) if chosen else Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "edp"
        folder = base / f"sim-{state.hexdigest()}"
        folder.mkdir(parents=True, exist_ok=True)
    except (OSError, RuntimeError):  # read-only, or a user without a home
        return None
    return folder if os.access(folder, os.W_OK) else None


def compiled(function: Function) -> Function:
    """Compile with Numba; cache the machine code on disk, or do without where no folder is writable."""
    return _compile(function, OPTIONS)


def inlined(function: Function) -> Function:
    """Like `compiled`, and part of every caller's own code, so that results which a caller drops cost nothing."""
    return _compile(function, {**OPTIONS, "forceinline": True})


def _compile(function: Function, options: dict[str, Any]) -> Function:
    folder = cache_folder()
    if folder is None:
        plain: Any = numba.njit(**options)(function)
        return plain  # type: ignore[no-any-return]
    config: Any = numba.config
    before = config.CACHE_DIR
    config.CACHE_DIR = str(folder)
    try:
        fast: Any = numba.njit(cache=True, **options)(function)
    finally:
        # Restored at once: other users of Numba in this process keep their own cache folder.
        config.CACHE_DIR = before
    return fast  # type: ignore[no-any-return]


class WarmUp:
    """Compiles everything once for each cache folder, in one process, in one order.

    What a caller's machine code looks like depends on whether the functions it calls were compiled in the same process
    or loaded. Processes that fill an empty cache side by side would each run their own variant, and the last bits of
    their results would differ.
    """

    def __init__(self) -> None:
        self._begun = False

    def once(self, play: Callable[[], None]) -> None:
        """Run `play`, which calls all compiled code, where this cache was not filled before; others wait for it."""
        if self._begun:
            return
        self._begun = True
        folder = cache_folder()
        if folder is None:
            play()
            return
        whole = folder / "whole"
        if whole.exists():
            return
        with (folder / "lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            # Asked again under the lock: another process may have filled the cache meanwhile.
            if not whole.exists():
                play()
                # Marked last: a rehearsal that was killed is repeated.
                whole.touch()


rehearsal = WarmUp()
