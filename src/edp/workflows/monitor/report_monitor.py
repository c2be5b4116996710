"""The page of a monitor's run, from the folder that `edp monitor run --out` wrote."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path

from edp.errors import StorageError
from edp.monitor.run_file import MonitorRunFile
from edp.monitor.traces import read_traces
from edp.report.common.provenance import provenance_rows
from edp.report.monitor.facts import AlarmFacts, MonitorFacts
from edp.report.monitor.page import build_monitor_page
from edp.settings.provenance import Provenance
from edp.settings.results import read_part
from edp.storage import JSON_BYTES, object_with, parse_json, read_object, read_text
from edp.storage.headers import check_files
from edp.storage.paths import full_path, is_there
from edp.storage.provenance import PROVENANCE
from edp.storage.runs import IDENTITY, missing_text
from edp.workflows.monitor.run_monitor import ALARM_LOG

PAGE = "report.html"
MAX_ALARMS = 100_000


def report_monitor(
    run: str | Path, out: str | Path | None = None, title: str | None = None
) -> tuple[Path, MonitorFacts]:
    """Write the page of a run of a monitor.

    Args:
        run: folder that `edp monitor run --out` wrote.
        out: the page; ``report.html`` in the folder by default.
        title: title of the page; the folder name by default.

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
    file = folder / (MonitorRunFile.NAME if is_there(folder / MonitorRunFile.NAME) else IDENTITY)
    if not is_there(folder / ALARM_LOG):
        raise StorageError(missing_text(folder, "monitor run"))
    content = read_object(file)
    names = {entry.name for entry in fields(MonitorRunFile)}
    table = {name: value for name, value in content.items() if name in names}
    result = MonitorRunFile.from_table(table, f"'{file}'")
    check_files(result.files, folder, "run the monitor again")
    return MonitorFacts(
        title or full_path(folder).name,
        read_traces(folder),
        read_alarms(folder / ALARM_LOG),
        result.promise,
        result.confusions,
        result.classes,
        provenance_rows(_provenance(folder, content)),
        result.remarks,
        result.unseen,
    )


def _provenance(folder: Path, content: Mapping[str, object]) -> Provenance:
    file = folder / PROVENANCE
    return Provenance.from_table({**content, **(read_object(file) if is_there(file) else {})}, f"'{file}'")


def read_alarms(file: Path) -> list[AlarmFacts]:
    """Return alarms of a log of JSON lines.

    Raises:
        StorageError: it is missing, too large or damaged; the message names the line.
    """
    lines = [line for line in read_text(file, JSON_BYTES).splitlines() if line.strip()]
    if len(lines) > MAX_ALARMS:
        raise StorageError(f"'{file}' has {len(lines):,} alarms; at most {MAX_ALARMS:,} must hold")
    return [_alarm(parse_json(line, f"'{file}', line {n}"), f"'{file}', line {n}") for n, line in enumerate(lines, 1)]


def _alarm(value: object, where: str) -> AlarmFacts:
    return read_part(AlarmFacts, object_with(value, (), where), where, "alarm", MonitorRunFile.ADVICE)
