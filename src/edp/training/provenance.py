"""Provenance of a trained model: recordings, command, versions and time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from edp.data.prepared import Prepared
from edp.data.series import Series
from edp.logs.source import DataSource
from edp.settings.provenance import DataOrigin, DataPart, Provenance, new_provenance


def training_provenance(
    source: DataSource,
    data: Prepared,
    seed: int,
    threads: int,
    seconds: float,
    frozen: Mapping[str, str] | None = None,
) -> Provenance:
    """Return the provenance of a training.

    Args:
        source: source of the recordings.
        data: the recordings, divided.
        seed: seed of the training.
        threads: number of threads of the training.
        seconds: processor time of the training, s.
        frozen: digests and names of recordings that no later training may see.
    """

    def part(series: Sequence[Series]) -> DataPart:
        hours = sum(entry.samples for entry in series) / data.task.rate_hz / 3600
        return DataPart(recordings=len(series), hours=round(hours, 4), names=tuple(entry.name for entry in series))

    origin = DataOrigin(
        source=source.label,
        reader=source.to_dict(),
        rate_hz=data.task.rate_hz,
        train=part(data.train),
        validation=part(data.validation),
        test=part(data.test),
        digest=data.digest,
        frozen=dict(frozen or {}),
    )
    return replace(new_provenance(origin, threads), seed=seed, seconds=round(seconds, 2))
