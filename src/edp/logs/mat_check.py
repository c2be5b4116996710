"""What a MAT file announces, weighed before it is unpacked: a small file may hold more than a machine has.

Layout of v5: a header of 128 bytes, then elements of type (4 bytes), length (4) and content; a packed element (15)
holds one array (14), whose length stands in its first 8 bytes. v7.3 is HDF5.
"""

from __future__ import annotations

import os
import signal
import struct
import time
import warnings
import zlib
from pathlib import Path

import h5py

from edp.errors import DataError
from edp.logs.limits import check_memory

_HEADER = 128
_PACKED, _MATRIX = 15, 14
_COPIES = 2
"""An array is in memory as it was unpacked and as a column."""
_PROBE_S = 8.0
_PROBE_BYTES_PER_S = 1e8
_ADVICE = "it may be damaged, or was made to exhaust memory; else save fewer variables, or Parquet or MDF, in a file"


def check_size(path: Path) -> None:
    """Add up what the variables of a file take.

    Raises:
        DataError: the file is cut off or damaged, or its variables do not fit into memory.
    """
    # The text of the header does not tell: some writers leave that of v5 before HDF5.
    total = _announced_v73(path) if h5py.is_hdf5(path) else _announced_v5(path)
    check_memory(path, _COPIES * total, "the variables of this MAT file", _ADVICE)


def _announced_v5(path: Path) -> int:
    size, total = path.stat().st_size, 0
    with path.open("rb") as stream:
        head = stream.read(_HEADER)
        order = ">" if head[126:128] == b"MI" else "<"
        at = _HEADER
        while at + 8 <= size:
            stream.seek(at)
            kind, length = struct.unpack(f"{order}II", stream.read(8))
            if at + 8 + length > size:
                raise DataError(
                    f"'{path}' is a MAT file that is cut off: a variable at byte {at} has {length} bytes, the file "
                    f"ends after {size}; copy or export it again"
                )
            total += _unpacked(stream.read(min(length, 256)), order) if kind == _PACKED else length
            at += 8 + length
    return total


def _unpacked(start: bytes, order: str) -> int:
    """Bytes that a packed element announces; 0 where it is damaged, which its reader finds."""
    try:
        head = zlib.decompressobj().decompress(start, 8)
    except zlib.error:
        return 0
    if len(head) < 8:
        return 0
    kind, length = struct.unpack(f"{order}II", head)
    return int(length) if kind == _MATRIX else 0


def _probe(path: Path) -> None:
    """Walk a file's structure in a process of its own: HDF5 itself may loop for ever, or crash, on damaged bytes."""
    if not hasattr(os, "fork"):
        return
    deadline = time.monotonic() + _PROBE_S + path.stat().st_size / _PROBE_BYTES_PER_S
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        child = os.fork()
    if child == 0:
        try:
            with h5py.File(path, "r") as file:
                file.visititems(_attributes)
        finally:
            # Other errors are met again, and told, by the process that reads.
            os._exit(0)
    pause = 1e-4
    while True:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            break
        if time.monotonic() > deadline:
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)
            status = signal.SIGKILL
            break
        time.sleep(pause)
        pause = min(2 * pause, 0.01)
    if status:
        raise DataError(f"'{path}' is a damaged MAT file: HDF5 finds no end in its structure; copy or export it again")


def _attributes(_: str, part: h5py.HLObject) -> None:
    for name in part.attrs:
        part.attrs[name]


def _announced_v73(path: Path) -> int:
    _probe(path)
    total = 0

    def add(_: str, part: h5py.HLObject) -> None:
        nonlocal total
        if isinstance(part, h5py.Dataset):
            total += part.size * part.dtype.itemsize

    try:
        with h5py.File(path, "r") as file:
            file.visititems(add)
    except Exception as error:
        # h5py meets damaged bytes with exceptions of many kinds; every one means the same to the user.
        raise DataError(
            f"'{path}' cannot be read as a MAT file ({type(error).__name__}: {error}); it may be truncated or damaged: "
            "copy or export it again"
        ) from error
    return total
