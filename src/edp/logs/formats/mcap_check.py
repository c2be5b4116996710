"""Check that the records of an MCAP file fit into it, before a library relies on their sizes.

Layout: magic, then records of an operation code (1 byte), a length (8) and content, then magic again.
"""

from __future__ import annotations

import mmap
import struct
from pathlib import Path

from edp.errors import DataError
from edp.logs.formats.bag_memory import MemoryFile
from edp.storage.memory import check_memory

_MAGIC = b"\x89MCAP0\r\n"
_FOOTER, _SCHEMA, _CHANNEL, _CHUNK, _CHUNK_INDEX, _STATISTICS = 0x02, 0x03, 0x04, 0x06, 0x08, 0x0B
RATIO = 1100
"""Maximum ratio of unpacked to packed size. Deflate reaches 1,032; machine messages reach about 10."""
SPARE = 1 << 20
"""Additional unpacked size in bytes that is always allowed."""
_LONGEST = {_SCHEMA: 1 << 20, _CHANNEL: 1 << 16}
"""Maximum size in bytes of a message definition, and of a topic with its settings."""
_SMALLEST_MESSAGE = 31
"""Minimum size of a message record in bytes: prefix 9, channel 2, sequence 4, both times 16."""
_PREFIX = 9
"""Number of bytes before the content of a record."""


def check_records(path: Path | MemoryFile) -> None:
    """Walk the records of an MCAP file, on disk or in memory.

    Raises:
        DataError: the file is cut off, a record does not fit, or a chunk is larger than memory.
    """
    size = path.stat().st_size
    if size < 2 * len(_MAGIC) + _PREFIX:
        raise _damage_error(Path(str(path)), "ends inside its header (truncated)")
    if isinstance(path, MemoryFile):
        _walk(Path(path.name), memoryview(path.data), size)
        return
    with path.open("rb") as stream, mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as view:
        _walk(path, view, size)


def _walk(path: Path, view: mmap.mmap | memoryview, size: int) -> None:
    # Looked at first: without its end a file has no index, and the library would search for one.
    if view[-len(_MAGIC) :] != _MAGIC:
        raise _damage_error(path, "has no end (truncated, half downloaded, or its recorder was killed)")
    walk = _Walk(path, view)
    at, last = len(_MAGIC), 0
    while at < size - len(_MAGIC):
        if at + _PREFIX > size - len(_MAGIC):
            raise _damage_error(path, f"has at byte {at} a record that is cut off")
        last, length = struct.unpack_from("<BQ", view, at)
        # Operation code 0 is none of MCAP's: zeros of a lost block would be walked as empty records.
        if not last or at + _PREFIX + length > size - len(_MAGIC):
            raise _damage_error(path, f"has at byte {at} a record of {length} bytes, more than the file holds")
        try:
            walk.record(last, at + _PREFIX, length)
        except struct.error as error:
            raise _damage_error(path, f"has at byte {at} a record that is cut off ({error})") from error
        at += _PREFIX + length
    if last != _FOOTER:
        raise _damage_error(path, "has no footer (truncated)")
    walk.end()


class _Walk:
    """Traversal of the records, which adds up the announced sizes."""

    def __init__(self, path: Path, view: mmap.mmap | memoryview) -> None:
        self.path = path
        self.view = view
        self.unpacked = len(view)
        self.spans: list[tuple[int, int, int]] = []
        self.indexed: set[int] = set()
        self.announced = 0

    def record(self, kind: int, at: int, length: int) -> None:
        if length > _LONGEST.get(kind, length):
            raise _damage_error(self.path, f"has at byte {at} a definition of {length} bytes")
        if kind == _CHUNK:
            self.chunk(at, length)
        elif kind == _CHUNK_INDEX:
            self.index(at, length)
        elif kind == _STATISTICS:
            (self.announced,) = struct.unpack_from("<Q", self.view, at)
            (count,) = struct.unpack_from("<I", self.view, at + 42)
            for entry in range(min(count, length) // 10):
                # Pairs of a channel's number (2 bytes) and its count of messages (8).
                (messages,) = struct.unpack_from("<Q", self.view, at + 46 + 10 * entry + 2)
                self.announced = max(self.announced, messages)

    def chunk(self, at: int, length: int) -> None:
        """Check a chunk: times (16 bytes), unpacked size (8), checksum (4), compression, packed size (8), content."""
        if length < 40:
            raise _damage_error(self.path, f"has at byte {at} a chunk of {length} bytes")
        start, stop, unpacked, _, named = struct.unpack_from("<QQQII", self.view, at)
        if 40 + named > length:
            raise _damage_error(self.path, f"has at byte {at} a chunk whose packing has a name of {named} bytes")
        (packed,) = struct.unpack_from("<Q", self.view, at + 32 + named)
        if packed != length - 40 - named:
            raise _damage_error(self.path, f"has at byte {at} a chunk of {length} bytes that announces {packed}")
        self.weigh(at, start, stop, packed, unpacked)

    def index(self, at: int, length: int) -> None:
        """Check a chunk index: times (16 bytes), position and length of the chunk (16), lists, and both sizes (16)."""
        if length < 64:
            raise _damage_error(self.path, f"has at byte {at} an index of {length} bytes")
        start, stop, chunk_offset, _ = struct.unpack_from("<QQQQ", self.view, at)
        packed, unpacked = struct.unpack_from("<QQ", self.view, at + length - 16)
        if chunk_offset in self.indexed:
            raise _damage_error(self.path, f"has at byte {at} a second index of the chunk at byte {chunk_offset}")
        self.indexed.add(chunk_offset)
        if packed > len(self.view):
            raise _damage_error(
                self.path, f"has at byte {at} an index of {packed} packed bytes, more than the file holds"
            )
        self.weigh(at, start, stop, packed, unpacked)

    def weigh(self, at: int, start: int, stop: int, packed: int, unpacked: int) -> None:
        if unpacked > RATIO * packed + SPARE:
            raise _damage_error(self.path, f"has at byte {at} a chunk of {packed} bytes that claims to hold {unpacked}")
        check_memory(self.path, unpacked, "a chunk of messages", "it may be damaged; record smaller chunks")
        self.unpacked += unpacked
        # Starts (1) sort before ends (2) of the same moment, so that touching chunks count together.
        self.spans += [(start, 1, unpacked), (max(start, stop), 2, -unpacked)]

    def end(self) -> None:
        """Check that overlapping chunks fit into memory, and that message counts are possible for the file size."""
        together = most = 0
        for _, _, size in sorted(self.spans):
            together += size
            most = max(most, together)
        # Each chunk stands here twice, by itself and by its index.
        check_memory(self.path, most // 2, "the chunks of one moment", "it may be damaged; record it again")
        if self.announced * _SMALLEST_MESSAGE > self.unpacked:
            raise _damage_error(self.path, f"announces {self.announced} messages in {self.unpacked} bytes")


def _damage_error(path: Path, what: str) -> DataError:
    return DataError(f"'{path}' is a damaged MCAP file: it {what}; copy or record it again")
