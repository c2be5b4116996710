"""Content of ``transfer.json``: errors of methods that carry a network to another machine, in report units."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from edp.errors import ConfigError
from edp.evaluation.scores_file import MEAN, ByHorizon, Metrics, ScoredTarget
from edp.settings.bounds import above, check_bounds
from edp.settings.results import ResultFile

TARGET, SOURCE = "target", "source"
"""Domains: the other machine, and the machine that the network was trained for."""


@dataclass(frozen=True, kw_only=True)
class TransferTask:
    """Horizons in samples, samples per second, and first samples of each segment that are not evaluated."""

    horizons: tuple[int, ...]
    rate_hz: float
    skip: int = 0

    def __post_init__(self) -> None:
        check_bounds("task", self, rate_hz=above(0.0, 1e12))


@dataclass(frozen=True, kw_only=True)
class PartMinutes:
    """Minutes of each part of the recordings."""

    train: float
    validation: float
    test: float


@dataclass(frozen=True, kw_only=True)
class TransferData:
    """Recordings of the other machine."""

    recordings: int
    minutes: PartMinutes


@dataclass(frozen=True, kw_only=True)
class MethodScores:
    """Scores of one method.

    Attributes:
        label: name in tables.
        learned: number of parameters that were trained.
        weights: content address of the network; None for a method without a network of its own.
        domains: metrics by domain, horizon and target.
        recordings: mean absolute error by recording and horizon; empty in files of earlier versions.
    """

    label: str
    learned: int
    weights: str | None
    domains: Mapping[str, ByHorizon]
    recordings: Mapping[str, Mapping[str, float | None]] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class ErrorDistribution:
    """Histogram of errors: edges of the bins, and the fraction of samples in each bin by method."""

    edges: tuple[float, ...]
    shares: Mapping[str, tuple[float, ...]]


@dataclass(frozen=True, kw_only=True)
class TransferFile(ResultFile):
    """Content of ``transfer.json``.

    Attributes:
        edp: version of EDP.
        method: name of the method that is kept.
        before: name of the method that stands for the network as it was.
        network: description of the network.
        settings: settings of the training.
        source: weights and recordings of the network as it was.
        methods: scores by method.
        distributions: error distributions by horizon and target.
        logs: the recordings in words.
        notes: remarks for the reader of the page.
        files: hashes of files in the same folder.
    """

    NAME = "transfer.json"
    SCHEMA = 2
    WHAT = "transfer"
    ADVICE = "run edp train finetune again"

    edp: str | None = None
    method: str
    before: str
    network: str
    settings: Mapping[str, object] = field(default_factory=dict)
    source: Mapping[str, object] = field(default_factory=dict)
    task: TransferTask
    targets: tuple[ScoredTarget, ...]
    data: TransferData
    methods: Mapping[str, MethodScores]
    distributions: Mapping[str, Mapping[str, ErrorDistribution]]
    logs: str | None = None
    notes: tuple[str, ...]
    files: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        names = [MEAN, *(target.name for target in self.targets)]
        for method in (self.method, self.before):
            if method not in self.methods:
                raise ConfigError(f"methods.{method[:40]}: missing, expected the scores of the method")
        for name, one in self.methods.items():
            for domain in (TARGET, *self.methods[self.method].domains):
                for horizon in map(str, self.task.horizons):
                    scores = one.domains.get(domain, {}).get(horizon, {})
                    if not all(target in scores for target in names):
                        raise ConfigError(f"methods.{name[:40]}.domains.{domain[:40]}: lacks scores of k = {horizon}")

    def score(self, method: str, horizon: str, target: str = MEAN, domain: str = TARGET) -> Metrics:
        """Return the metrics of a method."""
        return self.methods[method].domains[domain][horizon][target]
