"""Whether the records of an MCAP file fit into it, looked at before a library takes their sizes as they are.

Layout: magic, then records of an operation code (1 byte), a length (8) and content, then magic again.
"""

from __future__ import annotations

import mmap
import struct
from pathlib import Path

from edp.errors import DataError
from edp.limits import check_memory

_MAGIC = b"\x89MCAP0\r\n"
_CHUNK, _FOOTER = 0x06, 0x02
_PREFIX = 9


def check_records(path: Path) -> None:
    """Walk the records of an MCAP file.

    Raises:
        DataError: the file is cut off, a record does not fit, or a chunk is larger than memory.
    """
    size = path.stat().st_size
    if size < 2 * len(_MAGIC) + _PREFIX:
        raise _broken(path, "ends inside its header (truncated)")
    with path.open("rb") as stream, mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as view:
        if view[-len(_MAGIC) :] != _MAGIC:
            raise _broken(path, "has no end (truncated, half downloaded, or its recorder was killed)")
        at, last = len(_MAGIC), 0
        while at < size - len(_MAGIC):
            if at + _PREFIX > size - len(_MAGIC):
                raise _broken(path, f"has at byte {at} a record that is cut off")
            last, length = struct.unpack_from("<BQ", view, at)
            if not last or at + _PREFIX + length > size - len(_MAGIC):
                raise _broken(path, f"has at byte {at} a record of {length} bytes, more than the file holds")
            if last == _CHUNK:
                _check_chunk(path, view, at + _PREFIX, length)
            at += _PREFIX + length
        if last != _FOOTER:
            raise _broken(path, "has no footer (truncated)")


def _check_chunk(path: Path, view: mmap.mmap, at: int, length: int) -> None:
    """Times (16 bytes), size unpacked (8), checksum (4), name of the packing, size packed (8), content."""
    if length < 40:
        raise _broken(path, f"has at byte {at} a chunk of {length} bytes")
    unpacked, _, named = struct.unpack_from("<QII", view, at + 16)
    if 40 + named > length:
        raise _broken(path, f"has at byte {at} a chunk whose packing has a name of {named} bytes")
    (packed,) = struct.unpack_from("<Q", view, at + 32 + named)
    if packed != length - 40 - named:
        raise _broken(path, f"has at byte {at} a chunk of {length} bytes that announces {packed}")
    check_memory(path, unpacked, "a chunk of messages", "it may be damaged; record smaller chunks")


def _broken(path: Path, what: str) -> DataError:
    return DataError(f"'{path}' is a damaged MCAP file: it {what}; copy or record it again")
