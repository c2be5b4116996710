"""Execution of a job from its claim to its record; every outcome becomes a record."""

from __future__ import annotations

import contextlib
import importlib
import platform
import sys
import time
import traceback
from collections.abc import Callable, Mapping
from typing import Any

from edp.errors import BusyError, ConfigError, EdpError, NotFiniteError, StorageError
from edp.storage.ledger import (
    Record,
    TrainingIdentity,
    TrainingStatus,
    WithState,
    canonical,
    claim,
    known,
    leave_arrival,
    leave_state,
)

CLAIM_WAIT_S = 10.0
"""Maximum waiting time for the claim of another worker, s, for example of a pool that was killed a moment ago."""
SHOWN_TRACE = 4000
BEGUN = b"begun"
"""Message that a worker sends before it calls the function of a job."""


def perform(
    identity: TrainingIdentity, where: Mapping[str, Any], folder: str | None, begun: Callable[[], None]
) -> Record:
    """Run a training; every outcome becomes a record.

    Args:
        identity: settings that determine the result.
        where: see `edp.jobs.base.Job`.
        folder: folder of the ledger, to claim the training and write its state and record.
        begun: called before the function of the training.
    """
    with contextlib.ExitStack() as stack:
        if folder is not None:
            try:
                stack.enter_context(_claim_training(folder, identity.key))
            except (BusyError, StorageError) as error:
                return Record(identity, TrainingStatus.LOST, None, str(error))
            # Asked again under the claim: another worker may have finished it meanwhile.
            before = known(folder, identity.key)
            if before is not None:
                return before
        record, state = call(identity, where, begun)
        if folder is not None:
            try:
                if state is not None:  # first: a record without it would have its successor begin anew
                    leave_state(folder, identity.key, state)
            except StorageError as error:
                return Record(identity, TrainingStatus.LOST, None, str(error))
            with contextlib.suppress(StorageError):  # a full disk: the coordinator meets it, too, and says so
                leave_arrival(folder, record)
        return record


def _claim_training(folder: str, key: str) -> Any:
    patience = time.monotonic() + CLAIM_WAIT_S
    while True:
        try:
            return claim(folder, key)
        except BusyError:
            if time.monotonic() > patience:
                # Patience has an end: a claim that is held for long belongs to a living worker.
                raise
            time.sleep(0.05)


def call(
    identity: TrainingIdentity, where: Mapping[str, Any], begun: Callable[[], None], is_raising: bool = False
) -> tuple[Record, bytes | None]:
    """Call the function of a job.

    Args:
        identity: see `perform`.
        where: see `perform`.
        begun: see `perform`.
        is_raising: raise what the function raises, in place of a record of it.

    Returns:
        The record, and the state that the function returned.
    """
    started = time.monotonic()
    status, result, state = TrainingStatus.DONE, None, None
    message = trace = error_type = ""
    try:
        function = resolve(identity.job)
        begun()
        # The clock starts at the call: imports of a busy machine are no part of the training.
        started = time.monotonic()
        returned = function(identity, where)
        result = returned.result if isinstance(returned, WithState) else returned
        if not isinstance(result, Mapping):
            raise ConfigError(f"'{identity.job}' returned {type(result).__name__}; a training returns a table")
        # A result that is no plain JSON fails here, by name, and not in the ledger.
        canonical(result)
        state = returned.state if isinstance(returned, WithState) else None
    # `SystemExit` too: a library that ends the process would look like a lost training.
    except (Exception, SystemExit) as error:
        if is_raising:
            raise
        result, message, error_type = None, str(error), f"{type(error).__module__}:{type(error).__qualname__}"
        if isinstance(error, NotFiniteError):
            status = TrainingStatus.DIVERGED
        elif isinstance(error, EdpError):
            status = TrainingStatus.FAILED
        else:
            status = TrainingStatus.OOM if _out_of_memory(error) else TrainingStatus.FAILED
            message, trace = f"{type(error).__name__}: {error}", traceback.format_exc()[-SHOWN_TRACE:]
    measured: dict[str, Any] = {
        "seconds": time.monotonic() - started,
        "peak_mb": peak_mb(),
        "host": platform.node(),
        "finished": time.strftime("%Y-%m-%dT%H:%M:%S%z"),
    }
    measured |= {name: text for name, text in (("trace", trace), ("error", error_type)) if text}
    record = Record(identity, status, result, message, measured)
    return record, state


def resolve(name: str) -> Callable[[TrainingIdentity, Mapping[str, Any]], Any]:
    """Return the function named ``package.module:name``.

    Raises:
        ConfigError: there is none.
    """
    module, _, function = name.partition(":")
    try:
        job_function = getattr(importlib.import_module(module), function)
    except (ImportError, AttributeError, ValueError) as error:
        raise ConfigError(f"there is no job '{name}' ({error}); give it as package.module:function") from error
    return job_function  # type: ignore[no-any-return]


def peak_mb() -> float:
    """Return the peak memory of this process in MiB; 0 if the system does not report it."""
    try:
        import resource
    except ImportError:  # not POSIX
        return 0.0
    # macOS gives bytes, Linux kilobytes.
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (2**20 if sys.platform == "darwin" else 2**10)


def _out_of_memory(error: BaseException) -> bool:
    """Return whether an error of Python, NumPy or PyTorch means exhausted memory."""
    # By name: PyTorch's class is not there without torch.
    named = any("OutOfMemoryError" in kind.__name__ for kind in type(error).__mro__)
    return named or isinstance(error, MemoryError) or "can't allocate memory" in str(error)
