"""Inspection of a recording: problems are reported, never repaired here."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from edp.logs.quality.checks import (
    CHECKS,
    SEVERITIES,
    Finding,
    Looked,
    copies,
    look_at,
)
from edp.logs.quality.columns import columns
from edp.recording import Recording
from edp.settings.results import json_value
from edp.signals import KINDS

VERDICTS = {"error": "unusable", "warning": "check", "note": "good"}
"""Verdict on a channel or recording by its worst finding. Without a finding the verdict is good."""


@dataclass(frozen=True)
class ChannelFacts:
    """Facts of one channel in its report unit (``mm/s``, ``bar`` and so on); missing samples are left out.

    Attributes:
        name: name of the channel.
        kind: physical quantity.
        unit: the report unit.
        min: smallest value.
        max: largest value.
        mean: mean value.
        std: standard deviation.
        missing: samples that are NaN or infinite.
        constant: one value throughout.
        step: distance between neighbouring values of a quantised channel, None where there is none.
        levels: distinct values, of at most 500,000 samples.
        noise: deviation of its white noise in steady state.
        snr_db: deviation over noise in decibels, None without noise.
        new_hz: rate of new values, Hz.
        stuck_s: longest time at exactly one value between the ends of the range.
        at_ends: fraction of the samples at the minimum or maximum.
        verdict: ``good``, ``check`` or ``unusable``.
    """

    name: str
    kind: str
    unit: str
    min: float
    max: float
    mean: float
    std: float
    missing: int
    constant: bool
    step: float | None
    levels: int
    noise: float
    snr_db: float | None
    new_hz: float
    stuck_s: float
    at_ends: float
    verdict: str


@dataclass(frozen=True)
class ClockFacts:
    """Facts of one time column: rate, jitter (rms distance from a straight line, in steps), gaps and bad stamps."""

    name: str
    rate_hz: float
    jitter: float
    gaps: int
    longest_gap_s: float
    duplicates: int
    falling: int


@dataclass(frozen=True)
class QualityReport:
    """All findings of one log, worst first, with data on its time and channels.

    Where it is `proposed`, no map was given and no column is of the vocabulary: channels are what `edp init` would take
    the columns for.
    """

    name: str
    source: str
    samples: int
    rate_hz: float
    duration_s: float
    jitter: float
    clocks: tuple[ClockFacts, ...]
    channels: tuple[ChannelFacts, ...]
    findings: tuple[Finding, ...]
    proposed: bool = False

    @property
    def errors(self) -> tuple[Finding, ...]:
        """Findings that make the log unusable without repair."""
        return tuple(finding for finding in self.findings if finding.severity == "error")

    @property
    def verdict(self) -> str:
        """Verdict: ``unusable``, ``check`` or ``good``."""
        return verdict_of(self.findings)

    def to_json(self) -> dict[str, object]:
        """Return the plain JSON values; a number that is not finite becomes None."""
        return {**json_value(self), "verdict": self.verdict}


def verdict_of(findings: Sequence[Finding]) -> str:
    """Return the verdict for the worst of the findings."""
    worst = min((SEVERITIES.index(finding.severity) for finding in findings), default=len(SEVERITIES) - 1)
    return VERDICTS[SEVERITIES[worst]]


def inspect(
    recording: Recording, extra: tuple[Finding, ...] = (), clocks: tuple[ClockFacts, ...] = ()
) -> QualityReport:
    """Check every channel of a recording.

    Args:
        recording: values float32, shape ``(time, channel)``, SI units; NaN marks missing values.
        extra: findings about the file made before (time stamps, columns).
        clocks: data of the file's time columns.
    """
    findings = list(extra)
    facts = []
    gaps = any(clock.gaps for clock in clocks)
    in_gaps = int(np.count_nonzero(np.isnan(recording.values).all(axis=1))) if gaps else 0
    for channel, values in zip(recording.channels, columns(recording), strict=True):
        looked = look_at(channel, values, recording.rate_hz, in_gaps)
        of_channel = [finding for check in CHECKS for finding in check(looked)]
        of_file = [finding for finding in extra if finding.channel == channel.name]
        facts.append(_facts(looked, verdict_of([*of_channel, *of_file])))
        findings += of_channel
    findings += copies(recording)
    return QualityReport(
        recording.name,
        recording.source,
        recording.samples,
        recording.rate_hz,
        recording.duration_s,
        max((clock.jitter for clock in clocks), default=0.0),
        clocks,
        tuple(facts),
        tuple(sorted(findings, key=lambda finding: SEVERITIES.index(finding.severity))),
    )


def _facts(looked: Looked, verdict: str) -> ChannelFacts:
    channel, good, measures = looked.channel, looked.good, looked.measures
    kind = KINDS[channel.kind]
    unit = kind.report_unit
    nan = float("nan")
    low, high, mean, std = nan, nan, nan, nan
    if len(good):
        sums = good.astype(np.float64)
        low, high, mean = (kind.to_report(float(x)) for x in (good.min(), good.max(), sums.mean()))
        # The sum of a constant leaves rounding, which would pass for a deviation.
        std = 0.0 if looked.constant else kind.report_factor * float(sums.std())
    noise = kind.report_factor * measures.noise
    return ChannelFacts(
        channel.name,
        str(channel.kind),
        unit,
        low,
        high,
        mean,
        std,
        looked.samples - len(good),
        looked.constant,
        None if measures.quantum is None else kind.report_factor * measures.quantum,
        measures.levels,
        noise,
        20.0 * math.log10(std / noise) if noise > 0 and std > 0 else None,
        looked.rate_hz / measures.every,
        looked.stuck_samples / looked.rate_hz,
        measures.at_low + measures.at_high,
        verdict,
    )
