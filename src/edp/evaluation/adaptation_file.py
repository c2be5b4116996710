"""Content of ``adaptation.json``: errors of a network with and without its adaptation, on replayed recordings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from edp.settings.results import ResultFile


@dataclass(frozen=True, kw_only=True)
class ReplayTarget:
    """Name of a target and unit of its errors."""

    name: str
    unit: str


@dataclass(frozen=True, kw_only=True)
class ReplayErrors:
    """Mean absolute errors per target within an interval of the time in motion, in report units.

    Attributes:
        horizon: prediction horizon, samples.
        from_s: start of the interval, s.
        to_s: end of the interval, s, or None for the end of the recordings.
        base: errors of the network without adaptation.
        adapted: errors of the network with adaptation.
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
        targets: targets of the network.
        mae: errors by horizon and time in motion.
        change: relative change of the error through adaptation, geometric mean over horizons and targets.
        change_by_recording: relative change of the error for each recording.
        fallback: fraction of samples at which the adaptation was switched off.
        taught: number of samples used by the adaptation.
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
