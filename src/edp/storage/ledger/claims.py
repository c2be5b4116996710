"""Claims of running trainings, and results left by workers."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import IO

from edp.errors import BusyError, StorageError
from edp.storage.ledger.record import FINAL, RECORD_BYTES, Record
from edp.storage.locks import hold, release
from edp.storage.paths import entries_of
from edp.storage.reading import read_bytes
from edp.storage.writing import make_folder, write_bytes


def claim(folder: str | Path, key: str) -> Claim:
    """Claim a training for this process until it ends or releases the claim.

    Raises:
        BusyError: another process trains it.
    """
    file = make_folder(Path(folder, "claims")) / f"{key}.lock"
    try:
        return Claim(file, hold(file))
    except BusyError as error:
        holder = str(error).rpartition("process ")[2]
        raise BusyError(f"training {key} is claimed by process {holder}; it is not done twice") from None


@dataclass(frozen=True)
class Claim:
    """A training that this process does; leaving the block frees it."""

    file: Path
    stream: IO[str]

    def __enter__(self) -> Claim:
        """Return the claim."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Release the claim."""
        release(self.file, self.stream)


def free_dead_claims(folder: str | Path) -> None:
    """Remove the claims of processes that were killed."""
    for file in entries_of(Path(folder, "claims"), "*.lock"):
        # A claim whose process is gone can be locked, and leaving it removes its file.
        with contextlib.suppress(BusyError), claim(folder, file.stem):
            pass


def leave_arrival(folder: str | Path, record: Record) -> None:
    """Store a worker's result in case the coordinator is killed before it enters the result into the ledger."""
    write_bytes(Path(folder, "arrived", f"{record.key}.json"), record.to_bytes())


def whole(file: Path) -> Record | None:
    """Return the final record in a file; None without one."""
    try:
        record = Record.from_bytes(read_bytes(file, RECORD_BYTES))
    except (OSError, ValueError, KeyError, TypeError, StorageError):
        return None
    return record if record.key == file.stem and record.status in FINAL else None


def known(folder: str | Path, key: str) -> Record | None:
    """Return the final record of a training, left by the coordinator or a worker; None without one."""
    # The ledger first: what arrived is entered there, and then removed.
    return whole(Path(folder, "records", f"{key}.json")) or whole(Path(folder, "arrived", f"{key}.json"))
