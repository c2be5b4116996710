"""Compiled loops that release the GIL, and the threads that call them."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TypeVar

from threadpoolctl import threadpool_limits

from edp.storage.machine_code import Compiler, files_with

Item = TypeVar("Item")
Result = TypeVar("Result")


def sources() -> tuple[Path, ...]:
    """Return the source files that determine the compiled code."""
    return (*files_with(Path(__file__).parent, "from edp.data.screening.compiled import compiled"), Path(__file__))


compiler = Compiler("screening", sources)
compiled = compiler.compiled


def threads() -> int:
    """Return the processors that this process may use."""
    # Containers and schedulers may give a process fewer processors than the machine has.
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def spread(
    work: Callable[[Item], Result], items: Iterable[Item], on_share: Callable[[float], None] | None = None
) -> list[Result]:
    """Apply `work` to every item on all processors and return the results in order.

    `on_share` receives the finished fraction.

    The linear algebra library uses one thread during the call, because its threads would wait for each other.
    """
    todo = list(items)
    results: list[Result] = []
    with threadpool_limits(limits=1, user_api="blas"), ThreadPoolExecutor(threads()) as pool:
        try:
            for done, result in enumerate(pool.map(work, todo), start=1):
                results.append(result)
                if on_share is not None:
                    on_share(done / len(todo))
        except BaseException:  # Ctrl-C too: do not wait for what has not begun
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    return results
