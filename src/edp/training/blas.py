"""Threads of NumPy's linear algebra while models are fitted."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from threadpoolctl import threadpool_limits


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Limit NumPy's linear algebra to one thread inside the block, also as a decorator; torch threads stay.

    Matrices here are small. Threads of OpenBLAS wait for one another by spinning, which costs processor time wherever
    another process has a core: docs/journal has what it cost trainings.
    """
    with threadpool_limits(limits=1, user_api="blas"):
        yield
