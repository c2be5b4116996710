"""What a MAT file announces, weighed before it is unpacked: a small file may hold more than a machine has.

Layout of v5: a header of 128 bytes, then elements of type (4 bytes), length (4) and content; a packed element (15)
holds one array (14), whose length stands in its first 8 bytes. v7.3 is HDF5.
"""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import h5py

from edp.errors import DataError
from edp.limits import check_memory

_HEADER = 128
_PACKED, _MATRIX = 15, 14
_COPIES = 2
"""An array is in memory as it was unpacked and as a column."""
_DEFLATE_RATIO = 1100
"""Deflate packs no better than 1,032 to 1."""
_UNSTORED_BYTES = 1 << 20
"""What an array may claim beyond that: HDF5 need not store what was never written."""
_ADVICE = "it may be damaged, or was made to exhaust memory; else save fewer variables, or Parquet or MDF, in a file"


def check_size(path: Path) -> tuple[int, int]:
    """Add up what the variables of a file take.

    Returns:
        bytes when unpacked, and the number of HDF5 objects (v7.3) or of variables (v5).

    Raises:
        DataError: the file is cut off or damaged, or its variables do not fit into memory.
    """
    # The text of the header does not tell: some writers leave that of v5 before HDF5.
    total, objects = _announced_v73(path) if h5py.is_hdf5(path) else _announced_v5(path)
    check_memory(path, _COPIES * total, "the variables of this MAT file", _ADVICE)
    return total, objects


def _announced_v5(path: Path) -> tuple[int, int]:
    size, total, objects = path.stat().st_size, 0, 0
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
            held = _unpacked(stream.read(min(length, 256)), order) if kind == _PACKED else length
            if held > _DEFLATE_RATIO * (length + 64):
                raise _impossible(path, f"the variable at byte {at}", held, length)
            total += held
            objects += 1
            at += 8 + length
    return total, objects


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


def _announced_v73(path: Path) -> tuple[int, int]:
    total = objects = 0

    def add(name: str, part: h5py.HLObject) -> None:
        nonlocal total, objects
        objects += 1
        if isinstance(part, h5py.Dataset):
            held, stored = part.size * part.dtype.itemsize, part.id.get_storage_size()
            if held > _DEFLATE_RATIO * stored + _UNSTORED_BYTES:
                raise _impossible(path, f"the array '{name}'", held, stored)
            total += held

    try:
        with h5py.File(path, "r") as file:
            file.visititems(add)
    except DataError:
        raise
    except Exception as error:
        # h5py meets damaged bytes with exceptions of many kinds; every one means the same to the user.
        raise DataError(
            f"'{path}' cannot be read as a MAT file ({type(error).__name__}: {error}); it may be truncated or damaged: "
            "copy or export it again"
        ) from error
    return total, objects


def _impossible(path: Path, what: str, held: int, stored: int) -> DataError:
    return DataError(
        f"'{path}': {what} claims {held} bytes, packed into {stored}; it may be damaged, or was made to exhaust "
        "memory: copy or export it again"
    )
