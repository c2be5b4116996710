"""The quality of recordings as tables of a page."""

from __future__ import annotations

import math

from edp.errors import count_of
from edp.logs import DataQuality, Finding
from edp.report.common.page import Fold, Section
from edp.table import Column, Table
from edp.wording import MISSING, count_text, figure, number, percent

SHOWN_CHANNELS = 400
"""Maximum number of rows of the channel table. The JSON file lists all channels."""


def quality_section(quality: DataQuality) -> Section:
    """Return the section on the quality of recordings: recordings, channels that are not good, and findings."""
    return Section(
        "quality",
        "Quality of the recordings",
        [
            "What the sensors and the logger did to the signals: steps of the numbers, noise at rest, how often a new "
            "value comes, how long one value stands, and the share of the time at an end of the range.",
            recordings_table(quality),
            Fold("Channel by channel", [channels_table(quality)]),
            findings_table(quality),
        ],
        "Quality",
    )


def recordings_table(quality: DataQuality) -> Table:
    """Return one row per recording."""
    rows = tuple(
        (
            report.name,
            number(report.duration_s, 1),
            figure(report.rate_hz),
            number(report.jitter, 3),
            count_text(sum(clock.gaps for clock in report.clocks)),
            count_text(sum(channel.missing for channel in report.channels)),
            count_text(sum(finding.severity == "warning" for finding in report.findings)),
            report.verdict,
        )
        for report in quality.reports
    )
    columns = (
        Column("Recording"),
        Column("Length", "s"),
        Column("Rate", "Hz"),
        Column("Jitter", "steps"),
        Column("Gaps"),
        Column("Missing", "values"),
        Column("Warnings"),
        Column("Verdict"),
    )
    return Table("Recordings", columns, rows)


def channels_table(quality: DataQuality) -> Table:
    """Return the sensor data of each channel, the worst over all recordings."""
    columns = (
        Column("Channel"),
        Column("Unit"),
        Column("Min"),
        Column("Max"),
        Column("Step"),
        Column("Noise"),
        Column("SNR", "dB"),
        Column("New", "Hz"),
        Column("Stuck", "s"),
        Column("At ends"),
        Column("Verdict", "worst"),
    )
    names = list(dict.fromkeys(channel.name for report in quality.reports for channel in report.channels))
    rows = []
    for name in names[:SHOWN_CHANNELS]:
        facts = [channel for report in quality.reports for channel in report.channels if channel.name == name]
        snr = [channel.snr_db for channel in facts if channel.snr_db is not None]
        # The worst verdict of any recording counts for the channel.
        worst = next(v for v in ("unusable", "check", "good") if any(channel.verdict == v for channel in facts))
        rows.append(
            (
                name,
                facts[0].unit,
                _figure(min(channel.min for channel in facts)),
                _figure(max(channel.max for channel in facts)),
                _figure(max((channel.step for channel in facts if channel.step is not None), default=None)),
                _figure(max(channel.noise for channel in facts) or None),
                number(min(snr), 0) if snr else MISSING,
                f"{min(channel.new_hz for channel in facts):.3g}",
                number(max(channel.stuck_s for channel in facts), 1),
                percent(max(channel.at_ends for channel in facts)),
                worst,
            )
        )
    return Table("Channels over all recordings", columns, tuple(rows))


def findings_table(quality: DataQuality) -> Table:
    """Return the errors and warnings, equal ones of several recordings together, worst first; notes are in the JSON."""
    grouped: dict[tuple[str, str, str, str], list[str]] = {_key(finding): [] for finding in quality.findings}
    for report in quality.reports:
        for finding in report.findings:
            if finding.severity != "note":
                grouped.setdefault(_key(finding), []).append(report.name)
    rows = tuple(
        (channel or ("Whole log" if names else "Data set"), severity, what, _where(names), advice)
        for (severity, channel, what, advice), names in sorted(grouped.items(), key=lambda item: item[0][0])
    )
    columns = tuple(Column(head, is_text=True) for head in ("Channel", "", "Finding", "Where", "What to do"))
    return Table("Findings", columns, rows)


def _key(finding: Finding) -> tuple[str, str, str, str]:
    return finding.severity, finding.channel or "", finding.what, finding.advice


def _where(names: list[str]) -> str:
    return "several recordings" if not names else names[0] if len(names) == 1 else count_of(len(names), "recording")


def _figure(value: float | None) -> str:
    if value is None or not math.isfinite(value):
        return MISSING
    return number(value, 0) if abs(value) >= 1000 else f"{value:.3g}".replace("-", "−").replace("e−0", "e−")
