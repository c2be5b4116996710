"""The page of a monitor's run: one offline HTML file without scripts."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from markupsafe import Markup

from edp.monitor.alarms import episodes
from edp.monitor.diagnosis.sentences import clock
from edp.report.common.templates import stylesheet, template
from edp.report.monitor import facts as words
from edp.report.monitor.drawing import LEVEL_TEXTS, MARKS, SHADES_OF_LEVELS, evidence, overview, timeline
from edp.report.monitor.facts import MOST_ALARMS, MonitorFacts
from edp.storage import write_bytes
from edp.wording import unbroken

MOST_TIMELINES = 16


def write_monitor_page(facts: MonitorFacts, target: str | Path) -> Path:
    """Write the page of a run.

    Raises:
        StorageError: the page cannot be written.
    """
    write_bytes(Path(target), render(facts).encode("utf-8", "replace"))
    return Path(target)


def render(facts: MonitorFacts) -> str:
    """The page's text."""
    with_alarms = {alarm.recording for alarm in facts.alarms}
    traces = [trace for trace in facts.traces.recordings if trace.name in with_alarms]
    # A page without alarms still shows one time line: how far below the limits all stayed.
    shown = traces[:MOST_TIMELINES] or list(facts.traces.recordings[:1])
    changes = episodes(facts.alarms)
    context: dict[str, Any] = {
        "title": facts.title,
        "headline": unbroken(words.headline(facts)),
        "verdict": words.verdict(facts),
        "tiles": words.tiles(facts),
        "alarms": [_alarm(facts, first, again) for first, *again in changes[:MOST_ALARMS]],
        "left_out": max(0, len(changes) - MOST_ALARMS),
        "log": words.alarm_sheet(facts) if facts.alarms else None,
        "overview": overview(facts),
        "timelines": [(trace.name, timeline(trace, facts)) for trace in shown],
        "timelines_left_out": max(0, len(traces) - MOST_TIMELINES),
        "shades": list(zip(SHADES_OF_LEVELS, LEVEL_TEXTS, strict=True)),
        "marks": MARKS,
        "classes": facts.classes,
        "confusions": words.confusion_sheet(facts) if facts.confusions else None,
        "provenance": facts.provenance,
        "style": Markup(stylesheet("page.css")),
    }
    return template("monitor.html.jinja").render(**context)


def _alarm(facts: MonitorFacts, alarm: words.AlarmFacts, again: Sequence[words.AlarmFacts]) -> dict[str, Any]:
    """What the page says of one alarm and of those after it that say the same."""
    sheet = words.cause_sheet(alarm)
    return {
        "sentence": unbroken(alarm.sentence),
        "severity": alarm.severity,
        "recording": alarm.recording,
        "raised": clock(alarm.raised_s, facts.start_of(alarm.recording)),
        "since": clock(alarm.since_s, facts.start_of(alarm.recording)),
        "detector": alarm.detector,
        "again": words.again_text(facts, again),
        "evidence": evidence(alarm) if alarm.evidence else None,
        "causes": sheet if sheet is not None else None,
        "confusions": words.confusions_of(facts, alarm),
    }
