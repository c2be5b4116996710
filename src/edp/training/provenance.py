"""Provenance of a trained model: recordings, command, versions and time."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from edp.data.prepared import Prepared
from edp.logs.source import DataSource
from edp.storage.provenance import new_provenance

PARTS = ("train", "validation", "test")


def training_provenance(
    source: DataSource,
    data: Prepared,
    seed: int,
    threads: int,
    seconds: float,
    frozen: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Return the provenance of a training.

    Args:
        source: where the recordings are.
        data: the recordings, divided.
        seed: of the training.
        threads: with which it ran.
        seconds: that it took.
        frozen: digests and names of recordings that no later training may see.
    """

    def part(name: str) -> dict[str, Any]:
        series = getattr(data, name)
        hours = sum(entry.samples for entry in series) / data.task.rate_hz / 3600
        return {"recordings": len(series), "hours": round(hours, 4), "names": [entry.name for entry in series]}

    origin = {
        "source": source.label,
        "reader": source.to_plain(),
        "rate_hz": data.task.rate_hz,
        **{name: part(name) for name in PARTS},
        "digest": data.digest,
        **({"frozen": dict(frozen)} if frozen else {}),
    }
    return new_provenance(origin, threads) | {"seed": seed, "seconds": round(seconds, 2)}
