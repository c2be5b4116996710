"""A monitor's run as a reader sees it: sentences, key figures and tables."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime

from edp.monitor.alarms import Severity, episodes
from edp.monitor.diagnosis.causes import NONE_OF_THESE, Cause
from edp.monitor.diagnosis.sentences import clock
from edp.monitor.diagnosis.structure import Confusion
from edp.monitor.run_file import MAX_TEXT
from edp.monitor.traces import RecordingTrace, RunTraces
from edp.settings.bounds import check_count, check_texts
from edp.table import Column, Table, Value, figures
from edp.wording import MISSING, count_text, label_by_name, listed, number, short_labels

MAX_ALARMS = 40
"""Maximum number of alarms with evidence on a page. Equal alarms count as one; the log lists all alarms."""
MAX_CAUSES = 5
MAX_ENTRIES = 64
"""Maximum number of causes, and of segments of evidence, per alarm."""
MAX_SILENT = 6
MAX_REMARKS = 6
OUTSIDE = "no alarm, but "
"""Beginning of a remark on residuals outside their healthy range."""


@dataclass(frozen=True)
class AlarmFacts:
    """One alarm.

    Attributes:
        recording: name of the recording.
        raised_s: time of the alarm; `since_s` is the estimated start of the change, s from the start.
        detector: detector of the alarm.
        statistic: statistic that exceeded `limit`.
        evidence: summaries of residuals and how far they are off since then, in standard deviations of healthy
            blocks, the largest first.
        causes: the most likely first; empty without a dictionary.
        sentence: all of it in one.
        severity: ``note``, ``warning`` or ``stop``.
    """

    recording: str
    raised_s: float
    since_s: float
    detector: str
    statistic: float
    limit: float
    evidence: tuple[tuple[str, float], ...]
    causes: tuple[Cause, ...]
    sentence: str
    severity: Severity

    def __post_init__(self) -> None:
        for name, entries in (("evidence", self.evidence), ("causes", self.causes)):
            check_count("alarm", name, entries, MAX_ENTRIES)
        words = (cause.words for cause in self.causes)
        check_texts("alarm", (self.recording, self.detector, self.sentence, *words), MAX_TEXT)


@dataclass(frozen=True, eq=False)
class MonitorFacts:
    """A run of a monitor over logs.

    Attributes:
        title: title of the page.
        traces: statistics and levels of all recordings.
        alarms: alarms in order of time.
        promise: the sentence of the calibration.
        confusions: faults of the dictionary that cannot be told apart; empty without one.
        classes: number of faults in the dictionary; 0 without one.
        provenance: name and text of where it comes from.
        remarks: names of recordings by remark, in addition to their alarms.
        unseen: changes that the absence of alarms does not exclude.
    """

    title: str
    traces: RunTraces
    alarms: Sequence[AlarmFacts]
    promise: str
    confusions: Sequence[Confusion] = ()
    classes: int = 0
    provenance: Sequence[tuple[str, str]] = ()
    remarks: Mapping[str, Sequence[str]] = field(default_factory=dict)
    unseen: str = ""

    def trace_of(self, alarm: AlarmFacts) -> RecordingTrace | None:
        """Return the trace of an alarm's recording."""
        return next((trace for trace in self.traces.recordings if trace.name == alarm.recording), None)

    def start_of(self, recording: str) -> datetime | None:
        """Return the start time of a recording if it is known."""
        trace = next((trace for trace in self.traces.recordings if trace.name == recording), None)
        return start_time(trace.start) if trace is not None else None


def start_time(text: str) -> datetime | None:
    """Return the time of an ISO 8601 text; None for any other text."""
    try:
        return datetime.fromisoformat(text) if text else None
    except ValueError:
        return None


def headline(facts: MonitorFacts) -> str:
    """State the number of alarms, the time, and the causes in one sentence."""
    hours = hours_text(facts.traces.hours)
    if not facts.alarms:
        outside = any(remark.startswith(OUTSIDE) for remark in facts.remarks)
        return f"No alarm in {hours}{', but residuals lie outside of their healthy range' if outside else ''}"
    count = f"{len(facts.alarms)} alarm{'s' * (len(facts.alarms) > 1)} in {hours}"
    # A fault that stays alarms again and again: it is named once.
    subjects: Counter[str] = Counter()
    for first, *again in episodes(facts.alarms):
        subjects[_subject(first)] += 1 + len(again)
    parts = [text if times == 1 else f"{text} ({times} times)" for text, times in subjects.most_common(2)]
    more = f"; {len(subjects) - 2} more" if len(subjects) > 2 else ""
    return f"{count}: {'; '.join(parts)}{more}"


def _subject(alarm: AlarmFacts) -> str:
    """Return the subject of an alarm without its time."""
    if not alarm.causes:
        return "unnamed changes"
    first = alarm.causes[0]
    if first.kind == NONE_OF_THESE:
        return "changes that no fault of the dictionary explains"
    return first.words if first.probability >= 0.5 else f"perhaps {first.words}"


def again_text(facts: MonitorFacts, again: Sequence[AlarmFacts]) -> str:
    """Return how often a change was raised again, and when for the last time; empty where it was not."""
    if not again:
        return ""
    last = clock(again[-1].raised_s, facts.start_of(again[-1].recording))
    return f"raised again at {last}" if len(again) == 1 else f"raised again {len(again)} times, the last at {last}"


def hours_text(hours: float) -> str:
    """Return a time of operation as text."""
    return f"{hours:.1f} h" if hours >= 1.0 else f"{hours * 60.0:.3g} min"


def verdict(facts: MonitorFacts) -> list[str]:
    """Return the sentences behind the headline."""
    lines = [f"Limits: {facts.promise}." if facts.promise else ""]
    if facts.unseen and not facts.alarms:
        lines.append(f"What silence does not exclude: {facts.unseen}.")
    silent = sorted({name for trace in facts.traces.recordings for name in trace.silent})
    if silent:
        shown = listed(silent[:MAX_SILENT]) + (f" and {len(silent) - MAX_SILENT} more" * (len(silent) > MAX_SILENT))
        lines.append(f"Silent for want of channels in some recordings: {shown}; faults that only they show go unseen.")
    for remark, names in list(facts.remarks.items())[:MAX_REMARKS]:
        others = f" and {len(names) - 1} more" * (len(names) > 1)
        lines.append(f"Of {short_labels(names)[0]}{others}: {remark}.")
    if facts.classes == 0 and facts.alarms:
        lines.append("The monitor has no dictionary of faults: alarms say which residuals changed, not why.")
    return [line for line in lines if line]


def tiles(facts: MonitorFacts) -> list[tuple[str, str, str]]:
    """Return key figures: value, unit, description."""
    grades = Counter(alarm.severity for alarm in facts.alarms)
    with_alarms = {alarm.recording for alarm in facts.alarms}
    quiet = sum(trace.name not in with_alarms for trace in facts.traces.recordings)
    delays = [alarm.raised_s - alarm.since_s for alarm in facts.alarms]
    rows = [
        (count_text(len(facts.alarms)), "", "alarms"),
        *((count_text(grades[name]), "", text) for name, text in SEVERITIES if grades[name]),
        (f"{quiet} of {len(facts.traces.recordings)}", "", "recordings without an alarm"),
    ]
    if delays:
        middle = sorted(delays)[len(delays) // 2]
        rows.append((number(middle, 0), "s", "from the estimated onset to the alarm (median)"))
    return rows


SEVERITIES: tuple[tuple[Severity, str], ...] = (
    ("stop", "reasons to stop"),
    ("warning", "warnings"),
    ("note", "notes"),
)


def alarm_table(facts: MonitorFacts) -> Table:
    """Return one row per alarm."""
    rows: list[tuple[Value, ...]] = []
    labels = label_by_name(alarm.recording for alarm in facts.alarms)
    for alarm in facts.alarms[: 10 * MAX_ALARMS]:
        start = facts.start_of(alarm.recording)
        first = alarm.causes[0] if alarm.causes else None
        rows.append((
            labels[alarm.recording], clock(alarm.since_s, start), clock(alarm.raised_s, start), alarm.severity,
            first.words if first else MISSING, first.probability if first else None,
            alarm.statistic / alarm.limit if alarm.limit > 0.0 else None,
        ))  # fmt: skip
    share = figures([], decimals=2)
    heads = (
        Column("Recording"),
        Column("Since"),
        Column("Raised"),
        Column("Severity", is_text=True),
        Column("Most likely", is_text=True),
        Column("Probability", "", share),
        Column("Over limit", "", share),
    )
    return Table("Alarms in the order in which they were raised", heads, tuple(rows), name="alarms")


def cause_table(alarm: AlarmFacts) -> Table | None:
    """Return the possible causes of an alarm, the most likely first; None without a dictionary."""
    rows: list[tuple[Value, ...]] = [
        (
            cause.words,
            cause.component or MISSING,
            cause.at_fault if cause.at_fault != "none" else MISSING,
            cause.probability,
        )
        for cause in alarm.causes[:MAX_CAUSES]
    ]
    if not rows:
        return None
    heads = (
        Column("What it could be"),
        Column("Part", is_text=True),
        Column("Where", is_text=True),
        Column("Probability", "", figures([], False, 2)),
    )
    return Table("Causes", heads, tuple(rows), frozenset({0}), name="causes")


def confusions_of(facts: MonitorFacts, alarm: AlarmFacts) -> list[str]:
    """State which faults the present sensors cannot separate from the most likely cause of an alarm."""
    if not alarm.causes:
        return []
    first = alarm.causes[0]
    mine = ":".join(filter(None, (first.kind, first.site)))
    pairs = [pair for pair in facts.confusions if mine in (pair.first, pair.second)]
    lines = []
    for pair in pairs[:3]:
        other = pair.second if pair.first == mine else pair.first
        helps = f"; {pair.sensor} would separate them" if pair.sensor else ""
        lines.append(f"With the present sensors {mine} is hard to tell from {other}{helps}.")
    return lines


def confusion_table(facts: MonitorFacts) -> Table:
    """Return faults that the sensors cannot separate, the worst pairs first."""
    rows: list[tuple[Value, ...]] = [
        (pair.first, pair.second, pair.error, pair.sensor or MISSING, pair.sensor_error) for pair in facts.confusions
    ]
    share = figures([], decimals=2)
    heads = (
        Column("Fault"),
        Column("Not told apart from", is_text=True),
        Column("Error between the two", "", share),
        Column("Further sensor that separates them", is_text=True),
        Column("Error with it", "", share),
    )
    return Table("Faults that cannot be told apart with the present sensors", heads, tuple(rows), name="confusions")
