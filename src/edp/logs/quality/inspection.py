"""Looking at a log file without refusing it: every defect becomes a finding."""

from __future__ import annotations

from dataclasses import replace
from difflib import get_close_matches
from itertools import islice
from pathlib import Path

import numpy as np

from edp.errors import DataError, EdpError, closest
from edp.logs.assemble import assemble
from edp.logs.detect import open_log
from edp.logs.formats.base import BEHIND_TABLE, NAMES_AGAIN, TORN_LINE, RawLog
from edp.logs.formats.names import name_of_file
from edp.logs.proposal.columns import look_at_log
from edp.logs.proposal.propose import plain_map
from edp.logs.quality.checks import Finding
from edp.logs.quality.quality import ClockFacts, QualityReport, inspect
from edp.logs.quality.sketches import Sketch, sketch
from edp.logs.repair import Repair
from edp.logs.resolve import ChannelSource, resolve
from edp.logs.timebase import Clock, judge
from edp.recording import Recording
from edp.signals import VOCABULARY, Kind, SignalMap
from edp.wording import typed

# Everything is read, so that every defect can be found and counted.
_LEFT_OUT = {
    TORN_LINE: "the last line was never finished; it is left out",
    NAMES_AGAIN: "the names stand again within the table: the logger was restarted; such lines are left out",
    BEHIND_TABLE: "lines behind the table are left out",
}
"""Descriptions of lines in a text file that are not rows, by type."""
_LENIENT = Repair(nan="keep", gaps="keep", duplicates="last", falling="sort")
_MAX_NAMES = 2000
"""Maximum number of column names compared with the vocabulary. A comparison takes half a millisecond."""
_MISSPELT = 0.85
"""Minimum similarity (`difflib`) of a name to the vocabulary for a spelling error: one letter in eight."""
_LONGEST_MISS = 64
"""Maximum number of characters of a compared name. The time grows with the product of both lengths."""


def inspect_log(path: str | Path, signal_map: SignalMap | None = None) -> QualityReport:
    """Inspect a log: its columns, units, time stamps and values.

    Args:
        path: a log of any known format.
        signal_map: see `read_recording`.

    Raises:
        DataError: only where the file itself cannot be read (missing, damaged, of another format).
    """
    return look_into(path, signal_map)[0]


def look_into(
    path: str | Path,
    signal_map: SignalMap | None = None,
    name: str | None = None,
    rows: tuple[int, int | None] | None = None,
    repair: Repair | None = None,
) -> tuple[QualityReport, Sketch | None]:
    """Inspect a log and return a sketch for comparing recordings, None if no sample could be read.

    Args:
        path: a log file of a known format.
        signal_map: see `read_recording`.
        name: see `read_recording`.
        rows: see `read_recording`.
        repair: repairs that will be applied when the log is read. Defects of time that they repair are warnings. This
            function repairs nothing.

    Raises:
        DataError: see `inspect_log`.
    """
    original_map = signal_map or SignalMap()
    raw, signal_map, sources, problems = _open_with_map(Path(path), original_map)
    proposed = signal_map != original_map
    findings = [Finding("error", None, str(problem)) for problem in problems]
    if proposed:
        what = (
            "no map was given and no column has a name of the vocabulary: columns are taken for what edp init proposes"
        )
        findings.append(Finding("note", None, what, 1, "", "edp init writes a map to check"))
    findings += [
        Finding("note", None, what, 1, f"line {raw.meta[fact]}") for fact, what in _LEFT_OUT.items() if fact in raw.meta
    ]
    if not signal_map.channels and not signal_map.others:
        findings += _find_near_misses(raw)
    findings += _unit_clashes(raw, signal_map)
    # Columns that cannot be read are findings here; the others are still looked at.
    usable, more = _readable(sources)
    findings += more
    try:
        clocks = _clocks(raw, usable, signal_map)
        lenient = _LENIENT if repair is None or repair.falling != "cut" else replace(_LENIENT, falling="cut")
        recording, _ = assemble(raw, usable, signal_map, lenient, name, rows)
    except DataError as error:
        findings.append(Finding("error", None, str(error)))
        empty = Recording(name or name_of_file(raw.path), (), np.empty((0, 0), dtype=np.float32), 1.0, str(raw.path))
        return replace(inspect(empty, tuple(findings)), proposed=proposed), None
    findings += _check_digest(raw, recording, signal_map, rows)
    for signal, clock in clocks:
        findings += _time_findings(signal, clock, repair or Repair())
    facts = tuple(_clock_facts(signal, clock) for signal, clock in clocks)
    return replace(inspect(recording, tuple(findings), facts), proposed=proposed), sketch(recording)


def unreadable(path: Path, why: DataError) -> QualityReport:
    """Return the report on an unreadable file: one error."""
    empty = Recording(name_of_file(path), (), np.empty((0, 0), dtype=np.float32), 1.0, str(path))
    return inspect(empty, (Finding("error", None, str(why)),))


def _open_with_map(path: Path, signal_map: SignalMap) -> tuple[RawLog, SignalMap, list[ChannelSource], list[EdpError]]:
    """Open a log with its channels by the map, or by a proposed map by default and no column is known.

    Raises:
        DataError: the file cannot be read.
    """
    try:
        raw = open_log(path, signal_map)
        sources, problems = resolve(raw, signal_map)
        if sources or signal_map != SignalMap():
            return raw, signal_map, sources, problems
    except DataError:
        # A file without names of columns is one that nobody described; all others stay unreadable.
        if signal_map != SignalMap():
            raise
        plain = plain_map(look_at_log(path))
    else:
        # Misspelt names of the vocabulary are answered with the right ones.
        misspelt = any(_is_misspelt(name) for name in islice(raw.signals, _MAX_NAMES))
        plain = signal_map if misspelt else plain_map(look_at_log(path))
    raw = open_log(path, plain)
    return raw, plain, *resolve(raw, plain)


def _is_misspelt(name: str) -> bool:
    """Return whether a name is a probable misspelling of a vocabulary name.

    Short names are excluded, since they resemble many.
    """
    return len(name) <= _LONGEST_MISS and bool(get_close_matches(name, VOCABULARY, n=1, cutoff=_MISSPELT))


def _check_digest(
    raw: RawLog, recording: Recording, signal_map: SignalMap, rows: tuple[int, int | None] | None
) -> list[Finding]:
    """Return whether reading would refuse the values, as not those that EDP wrote."""
    mapped = signal_map.channels or signal_map.rate_hz is not None or signal_map.sample_time_s is not None
    if raw.digest is None or mapped or rows is not None or recording.digest == raw.digest:
        return []
    what = "the values are not the ones that EDP wrote"
    advice = "copy the file again, or where the change is wanted, remove EDP's facts from it (edp_info)"
    return [Finding("error", None, what, 1, "", advice)]


def _clocks(raw: RawLog, sources: list[ChannelSource], signal_map: SignalMap) -> list[tuple[str, Clock]]:
    """Return each distinct time column of the file with the name of its first channel."""
    if signal_map.sample_time_s is not None or raw.rate_hz is not None:
        return []
    seen: dict[int, tuple[str, Clock]] = {}
    for entry in sources:
        signal = entry.signal
        if signal is not None and signal.time_s is not None and id(signal.time_s) not in seen:
            seen[id(signal.time_s)] = (signal.name, judge(signal.time_s, f"'{raw.path}', time of '{signal.name}'"))
    return list(seen.values())


def _clock_facts(name: str, clock: Clock) -> ClockFacts:
    at = clock.stamps
    longest = float((at[clock.gaps + 1] - at[clock.gaps]).max()) if len(clock.gaps) else 0.0
    counts = len(clock.duplicates), len(clock.falling)
    return ClockFacts(name, clock.rate_hz, clock.jitter, len(clock.gaps), longest, *counts)


def _readable(sources: list[ChannelSource]) -> tuple[list[ChannelSource], list[Finding]]:
    """Return the channels whose columns are numeric, and a finding for each other channel."""
    usable, findings = [], []
    for entry in sources:
        try:
            if entry.signal is not None:
                entry.signal.load()
            usable.append(entry)
        except DataError as error:
            findings.append(Finding("error", entry.channel.name, str(error)))
    return usable, findings


def _find_near_misses(raw: RawLog) -> list[Finding]:
    """Return the columns that are not taken although their names nearly are in the vocabulary."""
    findings = []
    for name in islice(raw.signals, _MAX_NAMES):
        if len(name) <= _LONGEST_MISS and name not in VOCABULARY and raw.signals[name].kind is None:
            hint = closest(name, VOCABULARY)
            if hint.startswith("; did you mean"):
                what = f"column '{name}' is not taken{hint}"
                findings.append(Finding("warning", None, what, 1, "", "map it or rename it"))
    return findings


def _unit_clashes(raw: RawLog, signal_map: SignalMap) -> list[Finding]:
    """Return the units of the map that differ from the file's."""
    findings = []
    for entry in signal_map.channels:
        stated = raw.signal(entry.column).unit if entry.column in raw else None
        # Numbers that are taken as they are have no unit to be wrong.
        if stated and entry.unit and stated != entry.unit and entry.kind is not Kind.GENERIC:
            what = f"the map says {entry.unit}, the file says {stated}; the map's unit is used"
            findings.append(Finding("warning", entry.name, what, 1, "", "check which is right"))
    return findings


def _time_findings(name: str, clock: Clock, repair: Repair) -> list[Finding]:
    at, findings = clock.stamps, []
    longest = float((at[clock.gaps + 1] - at[clock.gaps]).max()) if len(clock.gaps) else 0.0
    back = '"sort", or "cut" for a clock that begins anew (--repair falling=sort, falling=cut)'
    defects = (
        ("falling", clock.falling, f"time goes back ('{name}')", back),
        ("duplicates", clock.duplicates, f"duplicate time stamps ('{name}')", '"last" (--repair duplicates=last)'),
        (
            "gaps",
            clock.gaps,
            f"gaps in time ('{name}'), longest {typed(longest)} s",
            '"hold" or "cut" (--repair gaps=hold)',
        ),
    )
    for defect, rows, what, how in defects:
        if not len(rows):
            continue
        where = f"{'after ' if defect == 'gaps' else ''}row {int(rows[0])} (t = {typed(at[rows[0]])} s)"
        allowed = getattr(repair, defect)
        severity, advice = "error", f"repair {defect} = {how}"
        if allowed != "refuse":
            severity, advice = "warning", f"repaired when it is read: {defect} = {allowed}"
        findings.append(Finding(severity, None, what, len(rows), where, advice))
    if not clock.uniform:
        what = (
            f"time steps are not uniform ('{name}'): rms {typed(clock.jitter, 3)} of a step, median "
            f"{typed(clock.step_s)} s"
        )
        advice = f"rows are resampled causally to {typed(clock.rate_hz)} Hz; set rate_hz for another rate"
        findings.append(Finding("note", None, what, len(at), "", advice))
    return findings
