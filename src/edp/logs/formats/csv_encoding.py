"""The encoding of a text file, from its first bytes."""

from __future__ import annotations

_LACKING = frozenset(b"\x81\x8d\x8f\x90\x9d")
"""Byte values that cp1252 does not define."""


def encoding_of(head: bytes) -> str:
    """Return the encoding of a text that begins with `head`, as a name known to Python and pyarrow."""
    if head[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return "utf-16"
    try:
        # Whole lines only: the end of what was read may cut a character.
        head[: head.rfind(b"\n") + 1].decode("utf-8")
    except UnicodeDecodeError:
        # Texts of East Asia hold bytes that cp1252 lacks; which of their encodings it is no byte tells.
        return "latin-1" if not _LACKING.isdisjoint(head) else "cp1252"
    return "utf-8-sig" if head[:3] == b"\xef\xbb\xbf" else "utf-8"
