"""Decompression bounded by the announced size of the data.

All packed data of strangers go through this module or, where a library of a log's format unpacks by itself, through the
sandbox with its bound on memory; `tests/security/test_archives.py` holds the rest of EDP to that.
"""

from __future__ import annotations

import bz2
import zlib
from collections.abc import Iterator
from typing import IO, Any

from edp.errors import DataError

_STEP = 1 << 20
"""Maximum number of bytes that are unpacked before they are counted."""
_FEED = 1 << 16
"""Number of packed bytes passed to the decompressor at a time."""
DEFLATE_RATIO = 1100
"""Maximum ratio of unpacked to packed bytes. The Deflate format reaches at most 1,032."""


def measure_unpacked(packing: str, data: bytes | memoryview, limit: int) -> int:
    """Count the bytes that packed data hold, without keeping them; beyond `limit`, counting ends.

    Args:
        packing: ``zlib``, ``bz2``, ``lz4`` or ``zstd``.
        data: one packed stream (or several one after the other, for bz2, lz4 and zstd).
        limit: bytes announced.

    Raises:
        EOFError: the data are cut off.
        Exception: the packing's own error where they are damaged, or its package is not installed.
    """
    total = 0
    for part in _parts(packing, data):
        total += len(part)
        if total > limit:
            break
    return total


def unpack_to(packing: str, data: bytes | memoryview, limit: int) -> bytes:
    """Return packed data unpacked to at most ``limit + 1`` bytes; see `measure_unpacked`."""
    unpacked = bytearray()
    for part in _parts(packing, data):
        unpacked += part
        if len(unpacked) > limit:
            break
    return bytes(unpacked[: limit + 1])


def unpack_start(data: bytes, count: int) -> bytes:
    """Return the first `count` decompressed bytes of a zlib stream; fewer if the stream is truncated or damaged."""
    try:
        return zlib.decompressobj().decompress(data, count)
    except zlib.error:
        return b""


class DamagedError(Exception):
    """Packed data that are damaged or incomplete."""


def unpack_raw(data: bytes, limit: int) -> bytes:
    """Return a deflated entry of an archive, unpacked to at most ``limit + 1`` bytes.

    Raises:
        DamagedError: the data are damaged or cut off.
    """
    unpacked = bytearray()
    try:
        for part in _inflate(data, -zlib.MAX_WBITS):
            unpacked += part
            if len(unpacked) > limit:
                break
    except (zlib.error, EOFError) as error:
        raise DamagedError(str(error)) from error
    return bytes(unpacked[: limit + 1])


def _parts(packing: str, data: bytes | memoryview) -> Iterator[bytes]:
    if packing == "zlib":
        yield from _inflate(data, zlib.MAX_WBITS)
        return
    view = memoryview(data)
    at = 0
    while at < len(view):
        # A stream of its own may follow another one.
        engine = _engine(packing)
        begun = at
        while not engine.eof and at <= len(view):
            if engine.needs_input:
                if at == len(view):
                    raise EOFError("packed data that are cut off")
                feed = bytes(view[at : at + _FEED])
                at += len(feed)
            else:
                feed = b""
            yield engine.decompress(feed, _STEP)
        at -= len(engine.unused_data or b"")
        # An engine that takes nothing would loop for ever.
        if at <= begun:
            return


def _inflate(data: bytes | memoryview, window: int) -> Iterator[bytes]:
    engine = zlib.decompressobj(window)
    view = memoryview(data)
    for at in range(0, len(view), _FEED):
        # Fed in small pieces: what is left over of one is copied in each step.
        rest = bytes(view[at : at + _FEED])
        while rest and not engine.eof:
            yield engine.decompress(rest, _STEP)
            rest = engine.unconsumed_tail
        if engine.eof:
            return
    while part := engine.decompress(b"", _STEP):
        yield part
    if not engine.eof:
        raise EOFError("packed data that are cut off")


def _engine(packing: str) -> Any:
    if packing == "bz2":
        return bz2.BZ2Decompressor()
    if packing == "lz4":
        import lz4.frame  # type: ignore[import-untyped]

        return lz4.frame.LZ4FrameDecompressor()
    if packing == "zstd":
        from backports import zstd

        return zstd.ZstdDecompressor()
    raise ValueError(f"a packing '{packing}'")


def open_zstd(stream: IO[bytes], mode: str, limit: int) -> Any:
    """Open a file packed by zstd; reading it beyond `limit` unpacked bytes raises DataError."""
    from backports import zstd

    class Bounded(zstd.ZstdFile):
        def read(self, size: int | None = -1) -> bytes:
            part = super().read(size)
            if self.tell() > limit:
                raise DataError(f"a packed file that unpacks to more than {limit} bytes")
            return part

    return Bounded(stream, mode)  # type: ignore[call-overload]
