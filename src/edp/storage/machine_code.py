"""Machine code compiled by Numba, cached on disk by its sources.

Numba's own cache lies beside the sources, where a user may not write. It knows a function by its own file, not by the
files of the functions it calls: after an edit to one file, callers elsewhere would keep running the old code. The
folder of a `Compiler` therefore carries a fingerprint of every source file that its code comes from; edits to other
files keep the cache.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

import numba

from edp.storage.portable import lock as lock_file

Function = TypeVar("Function", bound=Callable[..., Any])

PACKAGE = Path(__file__).parents[1]
# Operations in the order written, none fused (no "fastmath"): otherwise the last bits of a loop depend on which copy of
# a function it runs, and so on whether this process compiled the function or loaded it. Divisions follow NumPy's rules.
# Without the interpreter's lock, threads run loops side by side.
OPTIONS: Mapping[str, object] = {"nogil": True, "error_model": "numpy"}


class Compiler:
    """Compiles the functions of one part of EDP alike, and keeps their code in one folder.

    Args:
        part: name of the part, with which the folder's name begins.
        sources: gives the source files that compiled code comes from.
        facts: content of compiled code that comes from files other than the sources.
        options: options of ``numba.njit``, in addition to `OPTIONS`.
    """

    def __init__(
        self,
        part: str,
        sources: Callable[[], Sequence[Path]],
        facts: str = "",
        options: Mapping[str, object] | None = None,
    ) -> None:
        self.part, self.sources, self.facts, self.options = part, sources, facts, {**OPTIONS, **(options or {})}

    @cached_property
    def folder(self) -> Path | None:
        """Cache folder in NUMBA_CACHE_DIR or the user's cache folder; None if neither is writable."""
        state = hashlib.blake2b(digest_size=8)
        state.update(self.facts.encode())
        for source in (*self.sources(), Path(__file__)):
            # The zero byte separates name and content, so that no other split of the same bytes has this hash.
            state.update(source.relative_to(PACKAGE).as_posix().encode() + b"\0" + source.read_bytes())
        chosen = os.environ.get("NUMBA_CACHE_DIR")
        try:
            base = Path(chosen) if chosen else Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "edp"
            folder = base / f"{self.part}-{state.hexdigest()}"
            folder.mkdir(parents=True, exist_ok=True)
        except (OSError, RuntimeError):  # read-only, or a user without a home
            return None
        return folder if os.access(folder, os.W_OK) else None

    def compiled(self, function: Function) -> Function:
        """Compile with Numba; cache the machine code on disk, or do without where no folder is writable."""
        return self._compile(function, {**self.options})

    def inlined(self, function: Function) -> Function:
        """Compile like `compiled`, inlined into every caller, so that unused results have no cost."""
        return self._compile(function, {**self.options, "forceinline": True})

    def inner(self, function: Function) -> Function:
        """Compile what only compiled code calls, without the shells that Python needs, which cost time to compile.

        Its machine code is kept as part of its callers'.
        """
        # Numba's types do not know these two options.
        options: dict[str, Any] = {**self.options, "no_cpython_wrapper": True, "no_cfunc_wrapper": True}
        plain: Any = numba.njit(**options)(function)
        return plain  # type: ignore[no-any-return]

    def _compile(self, function: Function, options: dict[str, Any]) -> Function:
        if self.folder is None:
            plain: Any = numba.njit(**options)(function)
            return plain  # type: ignore[no-any-return]
        config: Any = numba.config
        before = config.CACHE_DIR
        config.CACHE_DIR = str(self.folder)
        try:
            fast: Any = numba.njit(cache=True, **options)(function)
        finally:
            # Restored at once: other users of Numba in this process keep their own cache folder.
            config.CACHE_DIR = before
        _keep_if_possible(fast, self.folder)
        return fast  # type: ignore[no-any-return]


def _keep_if_possible(fast: Any, folder: Path) -> None:
    """Run a Numba function without the cache if its machine code cannot be stored, such as on a full disk."""
    cache = getattr(fast, "_cache", None)  # absent where NUMBA_DISABLE_JIT leaves the function as it is
    if cache is None:
        return
    save = cache.save_overload

    def save_if_possible(signature: Any, data: Any) -> None:
        # RuntimeError: Numba has no machine code yet to store, where another thread compiles the same function.
        with contextlib.suppress(OSError, RuntimeError), (folder / "lock").open("w") as stream:
            # Numba numbers the files of a function by its index: two processes would give two signatures one file.
            with contextlib.suppress(OSError):  # a file system without locks
                lock_file(stream, wait=True)
            save(signature, data)

    cache.save_overload = save_if_possible


def files_with(folder: Path, line: str) -> tuple[Path, ...]:
    """Return the Python files in a folder tree that contain a line of code, sorted."""
    return tuple(file for file in sorted(folder.rglob("*.py")) if line.encode() in file.read_bytes())
