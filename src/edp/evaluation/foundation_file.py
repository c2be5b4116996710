"""Content of ``foundation.json``: a network over many machines, and its errors on machines that it has never seen."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from edp.settings.results import ResultFile


@dataclass(frozen=True, kw_only=True)
class PartSize:
    """Number of machines and recordings of a part of the data, and their length in minutes."""

    machines: int
    recordings: int
    minutes: float


@dataclass(frozen=True, kw_only=True)
class ContextError:
    """Error at a time since the state was reset.

    Attributes:
        seconds: time from the reset to the first scored tick of a block, s.
        mae: mean absolute error at the first horizon, mean over machines and targets, report units.
        change: relative change from the shortest time.
        change_error: standard error of the change over machines; None for a single machine.
    """

    seconds: float
    mae: float
    change: float
    change_error: float | None


@dataclass(frozen=True, kw_only=True)
class UnseenErrors:
    """Errors on machines that the network has never seen, at the first horizon.

    Attributes:
        contexts: errors by the time since the state was reset.
        machines: mean absolute error by machine at the longest time, report units.
        ticks: number of scored ticks.
        dropped: times since the reset that are longer than all recordings, s.
    """

    contexts: tuple[ContextError, ...]
    machines: Mapping[str, float]
    ticks: int
    dropped: tuple[float, ...]


@dataclass(frozen=True, kw_only=True)
class FoundationFile(ResultFile):
    """Content of ``foundation.json``.

    Attributes:
        edp: version of EDP that wrote the file.
        method: method of the pretraining.
        label: name of the method for readers.
        meta: settings of the method; None for a method without episodes.
        horizon: first horizon, in samples.
        rate_hz: sample rate.
        carried: number of chunks over which states are carried.
        data: size of each part of the data.
        unseen: errors on the machines of the test part.
    """

    NAME = "foundation.json"
    SCHEMA = 1
    WHAT = "pretraining"
    ADVICE = "remove the run folder and run edp train pretrain"

    edp: str
    method: str
    label: str
    meta: Mapping[str, object] | None
    horizon: int
    rate_hz: float
    carried: int
    data: Mapping[str, PartSize]
    unseen: UnseenErrors
