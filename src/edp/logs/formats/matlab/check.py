"""Size check of a MAT file before it is unpacked, since a small file may expand beyond the memory of the machine.

Layout of v5: a header of 128 bytes, then elements of type (4 bytes), length (4) and content; a packed element (15)
holds one array (14), whose length stands in its first 8 bytes. v7.3 is HDF5.
"""

from __future__ import annotations

import math
import struct
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from edp.errors import DataError, brief
from edp.storage.memory import check_memory
from edp.storage.unpacking import DEFLATE_RATIO, unpack_start

_HEADER = 128
_PACKED, _MATRIX = 15, 14
_COPIES = 2
"""Number of copies of an array in memory: unpacked, and as a column."""
_UNSTORED_BYTES = 1 << 20
"""Maximum size of an array beyond its stored bytes: HDF5 need not store values that were never written."""
_MAX_OBJECTS = 1_000_000
"""Maximum number of objects in a file. A Simulink log of 1,000 signals has about 30,000."""
_LINKS = {
    h5py.h5l.TYPE_SOFT: "a soft link",
    h5py.h5l.TYPE_EXTERNAL: "a link to another file",
}
_FILTERS = frozenset((h5py.h5z.FILTER_DEFLATE, h5py.h5z.FILTER_SHUFFLE, h5py.h5z.FILTER_FLETCHER32))
"""Compression filters of MATLAB. Other filters may be code that the library loads from a folder."""
_SHOWN = 80
_ADVICE = "it may be damaged, or was made to exhaust memory; else save fewer variables, or Parquet or MDF, in a file"


def check_size(path: Path) -> tuple[int, int]:
    """Add up the memory required by the variables of a file.

    Returns:
        bytes when unpacked, and the number of HDF5 objects (v7.3) or of variables (v5).

    Raises:
        DataError: the file is cut off or damaged, or its variables do not fit into memory.
    """
    # The text of the header does not tell: some writers leave that of v5 before HDF5.
    total, objects = _measure_v73(path) if h5py.is_hdf5(path) else _measure_v5(path)
    check_memory(path, _COPIES * total, "the variables of this MAT file", _ADVICE)
    return total, objects


def _measure_v5(path: Path) -> tuple[int, int]:
    size, total, objects = path.stat().st_size, 0, 0
    with path.open("rb") as stream:
        head = stream.read(_HEADER)
        # The two letters as the writer's processor laid them out.
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
            array_bytes = _measure_packed(stream.read(min(length, 256)), order) if kind == _PACKED else length
            if array_bytes > DEFLATE_RATIO * (length + 64):
                raise _impossible(path, f"the variable at byte {at}", array_bytes, length)
            total += array_bytes
            objects += 1
            at += 8 + length
    return total, objects


def _measure_packed(start: bytes, order: str) -> int:
    """Return the bytes that a packed element announces; 0 where it is damaged, which its reader finds."""
    # Eight bytes unpacked tell the length, whatever the rest would lead to.
    head = unpack_start(start, 8)
    if len(head) < 8:
        return 0
    kind, length = struct.unpack(f"{order}II", head)
    return int(length) if kind == _MATRIX else 0


def _measure_v73(path: Path) -> tuple[int, int]:
    try:
        with h5py.File(path, "r") as file:
            walk = _Walk(path)
            walk.run(file.id)
            return walk.total, len(walk.seen)
    except DataError:
        raise
    except Exception as error:
        # h5py meets damaged bytes with exceptions of many kinds; every one means the same to the user.
        raise DataError(
            f"'{path}' cannot be read as a MAT file ({type(error).__name__}: {brief(error)}); it may be truncated or "
            "damaged: copy or export it again"
        ) from error


class _Walk:
    """Every object of a v7.3 file, through links and references, before a value of an array is read.

    Only hard links are followed: MATLAB writes no others, and a file could name other files through them.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.total = 0
        self.seen: set[int] = set()
        self.todo: list[tuple[str, Any]] = []

    def run(self, root: Any) -> None:
        self.add("/", root)
        while self.todo:
            name, part = self.todo.pop()
            if isinstance(part, h5py.h5g.GroupID):
                self.links(name, part)
            elif isinstance(part, h5py.h5d.DatasetID):
                self.array(name, part)

    def add(self, name: str, part: Any) -> None:
        # By address: links may lead back, and one object may have many names.
        address = h5py.h5o.get_info(part).addr
        if address in self.seen:
            return
        self.seen.add(address)
        if len(self.seen) > _MAX_OBJECTS:
            raise DataError(f"'{self.path}' holds more than {_MAX_OBJECTS} objects; save fewer variables in a file")
        self.todo.append((name, part))

    def links(self, name: str, group: Any) -> None:
        for link in group:
            inner = f"{name.rstrip('/')}/{link.decode(errors='replace')}"
            kind = group.links.get_info(link).type
            if kind != h5py.h5l.TYPE_HARD:
                raise self.refused(inner, _LINKS.get(kind, "a link of an unknown kind"))
            self.add(inner, h5py.h5o.open(group, link))

    def array(self, name: str, data: Any) -> None:
        """Check a dataset and add its size to the total.

        Rejects virtual and external storage before the shape is read, since reading the shape of a virtual dataset
        opens other files.
        """
        plan = data.get_create_plist()
        if plan.get_layout() == h5py.h5d.VIRTUAL:
            raise self.refused(name, "a virtual data set, whose values lie in other files")
        if plan.get_external_count():
            raise self.refused(name, "an array in external storage, whose values lie in another file")
        for filter_index in range(plan.get_nfilters()):
            number = plan.get_filter(filter_index)[0]
            if number not in _FILTERS:
                raise self.refused(name, f"an array packed by the filter {number}")
        part = h5py.Dataset(data)
        size, stored = part.size or 0, data.get_storage_size()
        chunk = math.prod(part.chunks or (0,))
        # A chunk is unpacked whole, even where an array uses a corner of it.
        memory_bytes = max(size, chunk if stored else 0) * part.dtype.itemsize
        if memory_bytes > DEFLATE_RATIO * stored + _UNSTORED_BYTES:
            raise _impossible(self.path, f"the array {_format_name(name)}", memory_bytes, stored)
        self.total += memory_bytes
        if size and h5py.check_ref_dtype(part.dtype) is not None:
            check_memory(self.path, _COPIES * self.total, "the variables of this MAT file", _ADVICE)
            self.references(name, part)

    def references(self, name: str, part: h5py.Dataset) -> None:
        """Check the targets of references in cells and objects, which need not be linked from elsewhere."""
        for reference in np.asarray(part[()]).ravel():
            if isinstance(reference, h5py.RegionReference):
                raise self.refused(name, "a reference to a region of an array")
            if reference:
                self.add(f"{name} (reference)", h5py.h5r.dereference(reference, part.id))

    def refused(self, name: str, what: str) -> DataError:
        return DataError(
            f"'{self.path}': {_format_name(name)} is {what}; a MAT file of MATLAB holds all of its values itself. Load "
            "it in MATLAB and save it again"
        )


def _format_name(name: str) -> str:
    name = name.lstrip("/")
    return repr(name if len(name) <= _SHOWN else name[: _SHOWN - 3] + "...")


def _impossible(path: Path, what: str, memory_bytes: int, stored: int) -> DataError:
    return DataError(
        f"'{path}': {what} claims {memory_bytes} bytes, packed into {stored}; it may be damaged, or was made to "
        "exhaust "
        "memory: copy or export it again"
    )
