"""Terminal output of recording quality, shared by `edp data check` and `edp data screen`."""

from __future__ import annotations

import math
import re
from typing import TYPE_CHECKING, Annotated

import typer

from edp.cli.console import out, table
from edp.cli.options import MAX_HOURS, within
from edp.errors import count_of
from edp.settings.bounds import above
from edp.wording import figure, number, percent

if TYPE_CHECKING:
    from edp.logs import DataQuality, Finding, QualityReport

MaxHoursOption = Annotated[
    float | None,
    typer.Option(
        "--max-hours",
        callback=within(above(0.0, MAX_HOURS)),
        help="Of a store, look at evenly spread stretches of at most so many hours, about; default: all.",
    ),
]
_NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")
_MAX_KINDS = 12
"""Kinds of findings of one severity that are shown without --details."""
_MAX_NAMED = 4
"""Logs that are named beside one."""
VERDICT_TEXTS = {
    "good": "good: use them as they are",
    "check": "check: read the warnings before training",
    "unusable": "unusable as they are: training would refuse them",
}


def show_report(report: QualityReport) -> None:
    """Print one recording's data, one row per channel, and all findings."""
    out.print(report.name, style="bold", end="")
    out.print(
        f": {number(report.duration_s, 1)} s, {figure(report.rate_hz)} Hz, {report.samples:,} samples, verdict: "
        f"{report.verdict}"
    )
    for clock in report.clocks:
        gaps = f"{count_of(clock.gaps, 'gap')}, longest {figure(clock.longest_gap_s)} s" if clock.gaps else "no gaps"
        out.print(
            f"  time of '{clock.name}': {figure(clock.rate_hz)} Hz, jitter {figure(clock.jitter, 2)} of a step, {gaps}"
        )
    if report.channels:
        rows = [(c.name, c.unit, *map(_short, (c.min, c.max, c.mean, c.std)), c.missing) for c in report.channels]
        table("", ["channel", "unit", "min", "max", "mean", "std", "missing"], rows)
        out.print()
        table(
            "", ["channel", "unit", "step", "noise", "SNR, dB", "new, Hz", "stuck, s", "at ends", "verdict"],
            [
                (c.name, c.unit, _short(c.step), _short(c.noise, 3), _short(c.snr_db, 3), f"{figure(c.new_hz)}",
                 f"{figure(c.stuck_s, 3)}", percent(c.at_ends), c.verdict)
                for c in report.channels
            ],
        )  # fmt: skip
    for finding in report.findings:
        show_finding(finding)
    out.print()


def show_lines(quality: DataQuality) -> None:
    """Print one line per log, then each type of finding once with the logs affected."""
    rows = []
    for report in quality.reports:
        counts = [sum(f.severity == severity for f in report.findings) for severity in ("error", "warning", "note")]
        figures = [
            number(report.duration_s, 1),
            figure(report.rate_hz),
            len(report.channels),
            *counts,
            report.verdict,
        ]
        rows.append([report.name, *figures])
    table("", ["log", "s", "Hz", "channels", "errors", "warnings", "notes", "verdict"], rows)
    out.print()
    kinds: dict[tuple[str, str | None, str, str], list[tuple[str, Finding]]] = {}
    for report in quality.reports:
        for finding in report.findings:
            # The same finding has other numbers in each log.
            what = _NUMBER.sub("#", finding.what.replace(report.source, ""))
            advice = _NUMBER.sub("#", finding.advice)
            kinds.setdefault((finding.severity, finding.channel, what, advice), []).append((report.name, finding))
    for severity in ("error", "warning", "note"):
        chosen = [each for (of, *_), each in kinds.items() if of == severity]
        if severity == "note" and chosen:
            out.print(f"  {count_of(len(chosen), 'kind')} of notes; --details shows all")
            break
        for each in sorted(chosen, key=len, reverse=True)[:_MAX_KINDS]:
            show_finding(each[0][1])
            if len(quality.reports) > 1:
                names = ", ".join(name for name, _ in each[:_MAX_NAMED]) + (", ..." if len(each) > _MAX_NAMED else "")
                out.print(f"    in {len(each)} of {count_of(len(quality.reports), 'log')}: {names}")
        if len(chosen) > _MAX_KINDS:
            out.print(f"  and {len(chosen) - _MAX_KINDS} more kinds of {severity}s; --details shows them")
    out.print()


def show_finding(finding: Finding) -> None:
    """Print one finding with its advice."""
    where = f" {finding.channel}:" if finding.channel else ""
    location = f" ({finding.where})" if finding.where else ""
    advice = f". {finding.advice}" if finding.advice else ""
    out.print(f"  {finding.severity}:{where} {finding.what}{location}{advice}")


def show_between(quality: DataQuality) -> None:
    """Print what shows between recordings."""
    for finding in quality.findings:
        show_finding(finding)
    if quality.findings:
        out.print()


def verdict_text(quality: DataQuality) -> str:
    """Return the last line: number of recordings, errors and repeats, and the remedy."""
    count, errors = len(quality.reports), quality.errors
    parts = [
        f"{count_of(count, 'recording')}",
        f"{count_of(errors, 'error')} that training would refuse" if errors else "no errors",
    ]
    if quality.repeats:
        parts.append(f"{count_of(len(quality.repeats), 'repeat')} of a session")
    return f"{', '.join(parts)}; {VERDICT_TEXTS[quality.verdict]}"


def _short(value: float | None, digits: int = 4) -> str:
    return "-" if value is None or not math.isfinite(value) else figure(value, digits)
