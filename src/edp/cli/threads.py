"""Threads of NumPy's linear algebra in commands and in all processes that they start."""

from __future__ import annotations

import os

from threadpoolctl import threadpool_limits

VARIABLE = "OPENBLAS_NUM_THREADS"


def use_one_blas_thread() -> None:
    """One thread for this process and its children, unless the environment says how many (`training.blas` says why)."""
    if VARIABLE in os.environ:
        return
    # Children and libraries that are not loaded yet read the variable; NumPy has read it already.
    os.environ[VARIABLE] = "1"
    threadpool_limits(limits=1, user_api="blas")
