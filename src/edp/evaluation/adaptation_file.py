"""Content of ``adaptation.json``: errors of a network with and without its adaptation, on replayed recordings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from edp.settings.results import ResultFile


@dataclass(frozen=True, kw_only=True)
class ReplayTarget:
    """Name of a target, and the unit of its errors."""

    name: str
    unit: str


@dataclass(frozen=True, kw_only=True)
class ReplayErrors:
    """Mean absolute errors within a span of the time in motion, one per target, report units.

    Attributes:
        horizon: in samples.
        from_s: begin of the span, s.
        to_s: end of the span, s; None for the end of the recordings.
        base: of the network alone.
        adapted: of the network with its adaptation.
    """

    horizon: int
    from_s: float
    to_s: float | None
    base: tuple[float, ...]
    adapted: tuple[float, ...]


@dataclass(frozen=True, kw_only=True)
class AdaptationFile(ResultFile):
    """Content of ``adaptation.json``.

    Attributes:
        recordings: names of the recordings.
        targets: of the network.
        mae: errors by horizon and time in motion.
        change: relative change of the error by the adaptation, geometric mean over horizons and targets.
        change_by_recording: the same for each recording.
        fallback: fraction of samples at which the adaptation was taken back.
        taught: number of samples from which the adaptation learned.
    """

    NAME = "adaptation.json"
    SCHEMA = 1
    WHAT = "adaptation"
    ADVICE = "remove the run folder and run edp adapt"

    recordings: tuple[str, ...]
    targets: tuple[ReplayTarget, ...]
    mae: tuple[ReplayErrors, ...]
    change: float
    change_by_recording: Mapping[str, float]
    fallback: float
    taught: int
