"""The page of a monitor's run, from the folder that `edp monitor run --out` wrote."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

from edp.errors import DataError, StorageError
from edp.monitor.alarms import SEVERITIES
from edp.monitor.diagnosis.causes import Cause
from edp.monitor.diagnosis.structure import MOST_PAIRS, confusion_of
from edp.monitor.traces import read_traces
from edp.report.common.provenance import provenance_rows
from edp.report.monitor.facts import AlarmFacts, MonitorFacts
from edp.report.monitor.page import build_monitor_page
from edp.settings.provenance import Provenance
from edp.storage import JSON_BYTES, object_with, parse_json, read_object, read_text
from edp.storage.headers import FILES, check_files
from edp.storage.paths import full_path, is_there
from edp.storage.provenance import PROVENANCE
from edp.storage.runs import IDENTITY, missing_text
from edp.workflows.monitor.run_monitor import ALARM_LOG, RESULT

PAGE = "report.html"
LONGEST = 4096
MOST_ALARMS, MOST_EVIDENCE, MOST_CAUSES, MOST_REMARKED = 100_000, 64, 64, 100_000


def report_monitor(
    run: str | Path, out: str | Path | None = None, title: str | None = None
) -> tuple[Path, MonitorFacts]:
    """Write the page of a run of a monitor.

    Args:
        run: folder that `edp monitor run --out` wrote.
        out: the page; ``report.html`` in the folder by default.
        title: of the page; the folder's name by default.

    Returns:
        The page, and what it says.

    Raises:
        StorageError: the folder is no run of a monitor, is damaged, or the page cannot be written.
    """
    folder = Path(run)
    facts = read_run(folder, title)
    return build_monitor_page(facts).write(Path(out) if out is not None else folder / PAGE), facts


def read_run(folder: Path, title: str | None = None) -> MonitorFacts:
    """Read the monitor run of a folder.

    Raises:
        StorageError: it is no run of a monitor, or is damaged.
    """
    # Earlier versions wrote the result into the file that states the identity of a run.
    file = folder / (RESULT if is_there(folder / RESULT) else IDENTITY)
    if not is_there(folder / ALARM_LOG):
        raise StorageError(missing_text(folder, "monitor run"))
    content = read_object(file, ("promise", "monitor", "classes", "confusions"))
    check_files(content.get(FILES, {}), folder, "run the monitor again")
    where = f"'{file}'"
    pairs, classes = content["confusions"], content["classes"]
    if not isinstance(pairs, list) or len(pairs) > MOST_PAIRS or type(classes) is not int or classes < 0:
        raise StorageError(f"{where} is damaged: confusions or classes; run the monitor again")
    try:
        confusions = tuple(confusion_of(entry, where) for entry in pairs)
    except DataError as error:
        raise StorageError(f"{error}; run the monitor again") from error
    return MonitorFacts(
        title or full_path(folder).name,
        read_traces(folder),
        read_alarms(folder / ALARM_LOG),
        _text(content["promise"], where),
        confusions,
        classes,
        provenance_rows(_provenance(folder, content)),
        _remarks(content, where),
        _text(content.get("unseen", ""), where),
    )


def _provenance(folder: Path, content: Mapping[str, object]) -> Provenance:
    file = folder / PROVENANCE
    return Provenance.from_table({**content, **(read_object(file) if is_there(file) else {})}, f"'{file}'")


def _remarks(content: Mapping[str, object], where: str) -> dict[str, list[str]]:
    """Return remarks by recording; runs of earlier versions have fewer of them.

    Raises:
        StorageError: it is damaged.
    """
    remarks: dict[str, list[str]] = {}
    for key in ("outside", "unlike", "unlearned"):
        entries = content.get(key, {})
        if not isinstance(entries, dict) or len(entries) > MOST_REMARKED:
            raise StorageError(f"{where}: {key} must be an object of at most {MOST_REMARKED}; run the monitor again")
        for name, texts in entries.items():
            for remark in texts if isinstance(texts, list) else [texts]:
                remarks.setdefault(_text(remark, where), []).append(_text(name, where))
    return remarks


def read_alarms(file: Path) -> list[AlarmFacts]:
    """Alarms of a log of JSON lines.

    Raises:
        StorageError: it is missing, too large or damaged; the message names the line.
    """
    lines = [line for line in read_text(file, JSON_BYTES).splitlines() if line.strip()]
    if len(lines) > MOST_ALARMS:
        raise StorageError(f"'{file}' has {len(lines):,} alarms; at most {MOST_ALARMS:,} must hold")
    return [_alarm(parse_json(line, f"'{file}', line {n}"), f"'{file}', line {n}") for n, line in enumerate(lines, 1)]


def _alarm(value: Any, where: str) -> AlarmFacts:
    entry = object_with(value, [field.name for field in fields(AlarmFacts)], where)
    evidence, causes = entry["evidence"], entry["causes"]
    if entry["severity"] not in SEVERITIES:
        raise StorageError(f"{where}: severity must be one of {', '.join(SEVERITIES)}; run the monitor again")
    for name, part, most in (("evidence", evidence, MOST_EVIDENCE), ("causes", causes, MOST_CAUSES)):
        if not isinstance(part, list) or len(part) > most:
            raise StorageError(f"{where}: {name} must be a list of at most {most}; run the monitor again")
    if any(not isinstance(pair, list) or len(pair) != 2 for pair in evidence):
        raise StorageError(f"{where}: evidence must be names with numbers; run the monitor again")
    recording, detector, sentence = (_text(entry[name], where) for name in ("recording", "detector", "sentence"))
    raised, since, statistic, limit = (
        _number(entry[name], where) for name in ("raised_s", "since_s", "statistic", "limit")
    )
    shown = tuple((_text(name, where), _number(number, where)) for name, number in evidence)
    named = tuple(_cause(cause, where) for cause in causes)
    return AlarmFacts(recording, raised, since, detector, statistic, limit, shown, named, sentence, entry["severity"])


def _cause(value: Any, where: str) -> Cause:
    names = [entry.name for entry in fields(Cause)]
    entry: Mapping[str, object] = object_with(value, names, where)
    if entry["at_fault"] not in ("sensor", "machine", "none") or not isinstance(entry["grave"], bool):
        raise StorageError(f"{where}: a cause is damaged; run the monitor again")
    kind, site, component, unit, words = (
        _text(entry[name], where) for name in ("kind", "site", "component", "unit", "words")
    )
    size, grade = (None if entry[name] is None else _number(entry[name], where) for name in ("size", "grade"))
    probability = _number(entry["probability"], where)
    return Cause(kind, site, component, entry["at_fault"], size, unit, probability, words, grade, entry["grave"])


def _text(value: Any, where: str) -> str:
    if not isinstance(value, str) or len(value) > LONGEST:
        raise StorageError(f"{where}: a text of at most {LONGEST} characters must be there; run the monitor again")
    return value


def _number(value: Any, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise StorageError(f"{where}: a finite number must be there; run the monitor again")
    return float(value)
