"""Checks between recordings: repeated sessions, a channel in two units."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np

from edp.logs.quality.checks import Finding
from edp.logs.quality.quality import QualityReport, verdict_of
from edp.logs.quality.repeats import Repeat, find_repeats
from edp.logs.quality.sketches import Sketches
from edp.settings.results import json_value
from edp.signals import UNITS, Kind
from edp.wording import typed

_MIN_RATIO = 9.0
"""Minimum ratio of two units. Smaller ratios may be caused by a difference in motion."""
_NEAR_DECADES = 0.35
"""Tolerance of size and noise relative to the ratio of two units, in decades: a factor of 2.2."""


@dataclass(frozen=True)
class DataQuality:
    """The quality of a data set.

    Attributes:
        reports: one for each log.
        repeats: pairs of recordings that hold the same session.
        findings: other differences between recordings.
    """

    reports: tuple[QualityReport, ...]
    repeats: tuple[Repeat, ...]
    findings: tuple[Finding, ...]

    @property
    def errors(self) -> int:
        """Number of findings that make a log unusable without repair."""
        return sum(len(report.errors) for report in self.reports)

    @property
    def proposed(self) -> bool:
        """Whether a log was read by a proposed map, for want of another one."""
        return any(report.proposed for report in self.reports)

    @property
    def verdict(self) -> str:
        """Verdict from the worst finding: ``unusable``, ``check`` or ``good``."""
        every = [finding for report in self.reports for finding in report.findings]
        return verdict_of([*every, *self.findings])

    def to_json(self) -> dict[str, object]:
        """Return the plain values."""
        return {
            "verdict": self.verdict,
            "errors": self.errors,
            "recordings": [report.to_json() for report in self.reports],
            "repeats": [repeat.to_json() for repeat in self.repeats],
            "cross_recording": [json_value(finding) for finding in self.findings],
        }


def compare(reports: Sequence[QualityReport], sketches: Sketches, more: Sequence[Finding] = ()) -> DataQuality:
    """Compare the recordings of a data set.

    Args:
        reports: reports of the single recordings.
        sketches: sketches of the readable recordings.
        more: additional findings on the whole data set.
    """
    repeats = find_repeats(sketches.all)
    advice = (
        "keep one of them, or put both on one side of the split: a test that repeats training says nothing of new data"
    )
    findings = [*more, *(Finding("warning", None, repeat.what, 1, "", advice) for repeat in repeats)]
    if sketches.by_hash:
        first = len(sketches.all) - sketches.by_hash
        what = (
            f"sessions that repeat in part were looked for among the first {first:,} recordings; the other "
            f"{sketches.by_hash:,} were compared by the hash of their samples alone"
        )
        findings.append(
            Finding("note", None, what, sketches.by_hash, "", "inspect other parts of the data by themselves")
        )
    return DataQuality(tuple(reports), repeats, (*findings, *_two_units(reports)))


def _two_units(reports: Sequence[QualityReport]) -> list[Finding]:
    """Find channels whose size and noise in one recording both differ from the others by the ratio of two units.

    A machine in steady state makes a channel small, but not its noise; a weaker sensor makes noise large, but not the
    size.
    """
    sizes: dict[tuple[str, str], list[tuple[str, float, float]]] = {}
    for report in reports:
        for channel in report.channels:
            largest = max(abs(channel.min), abs(channel.max))
            if channel.noise > 0 and math.isfinite(largest) and largest > 0:
                sizes.setdefault((channel.name, channel.kind), []).append((report.name, largest, channel.noise))
    findings = []
    for (name, kind), entries in sizes.items():
        if len(entries) < 2:
            continue
        usual = [float(np.median([entry[i] for entry in entries])) for i in (1, 2)]
        for recording, largest, noise in entries:
            ratios = largest / usual[0], noise / usual[1]
            unit = _unit_ratio(Kind(kind), ratios)
            if unit:
                what = (
                    f"in '{recording}' {typed(ratios[0], 2)} times its usual size, its noise {typed(ratios[1], 2)} "
                    f"times: {unit}"
                )
                advice = "give that log a map of its own with the right unit"
                findings.append(Finding("warning", name, what, 1, recording, advice))
    return findings


def _unit_ratio(kind: Kind, ratios: tuple[float, float]) -> str:
    """Return the two units that explain both ratios; empty if no pair of units does."""
    decades = [math.log10(ratio) for ratio in ratios]
    if min(map(abs, decades)) < math.log10(_MIN_RATIO) - _NEAR_DECADES:  # Most channels: no two units explain it.
        return ""
    for text, between in _unit_pairs(kind):
        if all(abs(one - between) < _NEAR_DECADES for one in decades):
            return text
    return ""


@cache
def _unit_pairs(kind: Kind) -> tuple[tuple[str, float], ...]:
    """Return the distinguishable pairs of units of a kind: their description, and their ratio in decades."""
    unit_factors = [(name, unit.factor) for name, unit in UNITS.items() if kind in unit.kinds and not unit.offset]
    return tuple(
        (f"{name} read as {other}?", math.log10(base / factor))
        for name, factor in unit_factors
        for other, base in unit_factors
        if max(base / factor, factor / base) >= _MIN_RATIO
    )
