"""Description of an exported monitor: names, units, order, rate, limit; as JSON."""

from __future__ import annotations

from edp import __version__
from edp.export.description import entry_of
from edp.export.monitor.parts import MonitorParts
from edp.export.si_names import si_channels
from edp.monitor.summaries import SUMMARIES
from edp.storage.reading import Table

SCHEMA = 1


def description(parts: MonitorParts, name: str) -> Table:
    """Return the plain values that JSON can hold."""
    chain, summaries = parts.chain, parts.chain.summaries
    return {
        "schema": SCHEMA,
        "edp": __version__,
        "name": name,
        "monitor": parts.title,
        "monitor_hash": parts.digest,
        "promise": parts.promise,
        "rate_hz": parts.rate_hz,
        "block_s": summaries.block / parts.rate_hz,
        "settle_blocks": chain.settle,
        "inputs": [
            entry_of(c.name, own.name, c.kind, c.description)
            for c, own in zip(parts.inputs, si_channels(parts.inputs), strict=True)
        ],
        "residuals": list(parts.residuals),
        "summaries": [*SUMMARIES, *(f"drive{number + 1}" for number in range(len(summaries.drivers)))],
        "watches": [{"detector": w.detector, "option": w.option, "directions": w.directions} for w in parts.watches],
        "limit": chain.limit,
    }
