"""Unpacking that stops at the size that a file announces, whatever its packed bytes lead to."""

from __future__ import annotations

import bz2
import zlib
from collections.abc import Iterator
from typing import Any

_STEP = 1 << 20
"""Most bytes that are unpacked before they are counted."""
_FEED = 1 << 16
"""Packed bytes given to the engine at a time."""


def unpacked_size(packing: str, data: bytes | memoryview, limit: int) -> int:
    """Bytes that packed data hold, counted without keeping them; beyond `limit`, counting ends.

    Args:
        packing: ``zlib``, ``bz2``, ``lz4`` or ``zstd``.
        data: one packed stream (or several one after the other, for lz4 and zstd).
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
    """Packed data unpacked to at most ``limit + 1`` bytes; see `unpacked_size`."""
    unpacked = bytearray()
    for part in _parts(packing, data):
        unpacked += part
        if len(unpacked) > limit:
            break
    return bytes(unpacked[: limit + 1])


def _parts(packing: str, data: bytes | memoryview) -> Iterator[bytes]:
    if packing == "zlib":
        yield from _inflate(data)
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


def _inflate(data: bytes | memoryview) -> Iterator[bytes]:
    engine = zlib.decompressobj()
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
