"""The page of a monitor's run: one offline HTML file without scripts."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from markupsafe import Markup

from edp.errors import count_of
from edp.monitor.alarms import episodes
from edp.monitor.diagnosis.sentences import clock
from edp.report.common.page import Page, Paragraph, Part, Section, Subsection
from edp.report.common.templates import template
from edp.report.monitor import facts as words
from edp.report.monitor.drawing import LEVEL_TEXTS, MARKS, SHADES_OF_LEVELS, evidence, overview, timeline
from edp.report.monitor.facts import MAX_ALARMS, MonitorFacts
from edp.wording import unbroken

MAX_TIMELINES = 16


def build_monitor_page(facts: MonitorFacts) -> Page:
    """Return the page of a run."""
    changes = episodes(facts.alarms)
    alarms: list[Part] = [_alarm(facts, first, again) for first, *again in changes[:MAX_ALARMS]]
    if len(changes) > MAX_ALARMS:
        alarms.append(f"{len(changes) - MAX_ALARMS} more changes are in the log of the run.")
    return Page(
        title=facts.title,
        kind="monitor",
        about=["monitor"],
        headline=words.headline(facts),
        verdict=words.verdict(facts),
        tiles=words.tiles(facts),
        sections=[
            Section(
                "alarms",
                "Alarms",
                [
                    "What changed, since when by the estimate of its onset, and what it could be instead. Bars show "
                    "the evidence: how far the means of residuals are off since then, in standard deviations of single "
                    "healthy blocks.",
                    *alarms,
                ],
            ),
            Section("time", "Time line", _time_lines(facts)),
            Section("log", "Log", [words.alarm_table(facts)]),
            Section("apart", "What cannot be told apart", _confusions(facts), "Not told apart"),
        ],
        provenance=facts.provenance,
        styles=("page.css", "monitor.css"),
    )


def _time_lines(facts: MonitorFacts) -> list[Part]:
    """Return the time lines of recordings with alarms and the overview of all recordings."""
    with_alarms = {alarm.recording for alarm in facts.alarms}
    traces = [trace for trace in facts.traces.recordings if trace.name in with_alarms]
    # A page without alarms still shows one time line: how far below the limits all stayed.
    shown = traces[:MAX_TIMELINES] or facts.traces.recordings[:1]
    left_out = len(traces) - len(shown)
    return [
        "Each detector's statistic over its limit, alarms from their estimated onset to the moment they were raised, "
        "and below them the level of each group of residuals.",
        *(Subsection([_html("draw", timeline(trace, facts))], trace.name) for trace in shown),
        *([f"In the overview only: {count_of(left_out, 'more recording')} with alarms."] if left_out > 0 else []),
        _html("legend", list(zip(LEVEL_TEXTS, SHADES_OF_LEVELS, strict=True))),
        Subsection(
            [
                "A row a recording; darker where a statistic comes near its limit, marks where an alarm was raised.",
                _html("draw", overview(facts)),
            ],
            "All recordings",
        ),
    ]


def _confusions(facts: MonitorFacts) -> list[Part]:
    """Return the faults that the monitor confuses; empty without a dictionary of faults."""
    if not facts.classes:
        return []
    if not facts.confusions:
        return [
            Paragraph(
                f"Of {facts.classes} faults of the dictionary no two are confused in more than a quarter of the "
                "left-out simulated sessions.",
                "quiet",
            )
        ]
    return [
        f"Of {facts.classes} faults of the dictionary, pairs that a test on left-out simulated sessions confuses in "
        "more than a quarter of the cases with the present sensors, all sizes together; and the further channel that "
        "would separate them.",
        words.confusion_table(facts),
    ]


def _alarm(facts: MonitorFacts, alarm: words.AlarmFacts, again: Sequence[words.AlarmFacts]) -> Markup:
    """Return an alarm with its evidence and causes, and how often it was raised again."""
    start = facts.start_of(alarm.recording)
    since, raised = clock(alarm.since_s, start), clock(alarm.raised_s, start)
    repeats = words.again_text(facts, again)
    when = f"{alarm.recording}: since {since}, raised {raised} by {alarm.detector}{repeats and '; ' + repeats}"
    return _html(
        "alarm",
        alarm,
        MARKS[alarm.severity],
        unbroken(alarm.sentence),
        when,
        evidence(alarm) if alarm.evidence else None,
        words.cause_table(alarm),
        words.confusions_of(facts, alarm),
    )


def _html(macro: str, *values: Any) -> Markup:
    """Return the text of a macro of ``monitor.jinja``."""
    return Markup(getattr(template("monitor.jinja").module, macro)(*values))
