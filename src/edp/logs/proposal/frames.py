"""Traces of a bus, which hold frames and no signals."""

from __future__ import annotations

from edp.errors import DataError
from edp.logs.proposal.columns import LogLook

_IDENTIFIERS = frozenset(("id", "can_id", "canid", "arbitration_id", "identifier", "pgn", "spn"))
_BYTES = frozenset(("data", "payload", "bytes", "data bytes", "databytes", "data_bytes"))


def holds_frames(look: LogLook) -> bool:
    """Return whether the columns form a bus trace: an identifier and bytes."""
    names = {name.lower() for name in (*look.names, *look.texts)}
    return not _IDENTIFIERS.isdisjoint(names) and bool(names & {*_BYTES, "d0", "d1", "data0"})


def refuse_frames(look: LogLook) -> None:
    """Refuse a bus trace whose bytes are text next to their identifiers.

    Raises:
        DataError: it is one; its numbers are no signals.
    """
    texts = {name.lower() for name in look.texts}
    if holds_frames(look) and not _BYTES.isdisjoint(texts):
        raise DataError(
            f"'{look.path}' holds raw frames of a bus ({', '.join(look.texts[:3])}), no signals: decode them with "
            "their DBC file, as MDF 4 or CSV (in Python: asammdf or cantools)"
        )
