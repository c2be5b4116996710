"""`edp inspect` and the inspection of `edp screen` by a pool or a cluster: a unit is some logs, or the coverage."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

from edp.data.coverage import Coverage
from edp.errors import DataError, EdpError
from edp.jobs import Workforce
from edp.jobs.packing import packed, unpacked
from edp.jobs.units import UnitResult, WorkUnit, run_units
from edp.logs import DataQuality, QualityReport, Sketch, compare, inspect, look_into, sketch, unique_names
from edp.logs.quality.inspection import unreadable
from edp.logs.quality.sketches import Sketches
from edp.logs.repair import Repair
from edp.logs.source import DataSource
from edp.logs.store import read_index
from edp.progress import SILENT, Progress
from edp.recording import Recording
from edp.settings.tree import build, plain_tree
from edp.signals import SignalMap
from edp.storage.ledger import TrainingIdentity, WithState
from edp.storage.paths import full_path, is_file_at, is_there, status_of
from edp.workflows.covering import coverage
from edp.workflows.fleet.storing import keys_of, stored_logs

STORED_UNITS = 64
"""Units that the recordings of a store are divided into, about: opening a store takes longer the more it holds."""
UNIT_BYTES = 4 * 2**20
"""Of the logs of a unit, about a second of work: a unit takes hundredths of one to hand out and to take back."""


@dataclass(frozen=True)
class CoverageOrder:
    """Which coverage is asked for; see `edp.workflows.covering.coverage`."""

    inputs: tuple[str, ...] = ()
    split: str = ""


@dataclass(frozen=True)
class LookedAt:
    """What a unit found in the recordings that it looked at."""

    reports: tuple[QualityReport, ...]
    sketches: tuple[Sketch | None, ...]


@dataclass(frozen=True)
class Inspection:
    """What was found in a source.

    Attributes:
        quality: of its recordings.
        coverage: what they cover; None where that was not asked for, or cannot be told.
        why: why it cannot.
    """

    quality: DataQuality
    coverage: Coverage | None = None
    why: str = ""


def inspect_with(
    workforce: Workforce, source: DataSource, covers: CoverageOrder | None = None, progress: Progress = SILENT
) -> Inspection:
    """As `DataSource.inspect`, and `edp.workflows.covering.coverage`, by a workforce.

    Args:
        workforce: who looks; nodes see the logs under the same paths.
        source: where the recordings are.
        covers: the coverage that is wanted, too.
        progress: receiver of the progress; its units are parts of the logs.

    Raises:
        DataError: no log can be read at all.
    """
    recordings = source.read() if source.stored or source.at_most_h is not None else []
    units = _units_of_store(source, recordings) if source.stored else _units_of_logs(source)
    looks = len(units)
    if covers is not None:
        # First: it takes longest.
        units.insert(0, _coverage_unit(source, covers))

    looking = progress.stage("part", len(units))

    def note(unit: WorkUnit, result: UnitResult, done: int) -> None:
        looking.note(Path(unit.label).name)
        looking.step(done)

    results = run_units(units, workforce, on_done=note)
    covered, why = None, ""
    if covers is not None:
        first, results = results[0], results[1:]
        why = str(first.values["why"])
        covered = None if first.content is None else unpacked(first.content, Coverage)
    looked = [unpacked(result.content or b"", LookedAt) for result in results[:looks]]
    broken = [str(why) for result in results[:looks] for why in result.values.get("broken", ("",))]
    if broken and all(broken):  # as one process says it
        raise DataError(broken[0])
    reports = [report for one in looked for report in one.reports]
    sketches = [entry for one in looked for entry in one.sketches]
    if not source.stored:
        # As `DataSource.inspect` does: a finding on two recordings must tell which is which.
        names = unique_names([report.name for report in reports], [log.path for log in source.logs()])
        reports = [replace(report, name=name) for report, name in zip(reports, names, strict=True)]
        sketches = [None if s is None else replace(s, name=name) for s, name in zip(sketches, names, strict=True)]
    bounded = Sketches()
    for entry in sketches:
        if entry is not None:
            bounded.add(entry)
    return Inspection(compare(reports, bounded, source.drawn_findings(recordings)), covered, why)


def _units_of_logs(source: DataSource) -> list[WorkUnit]:
    units, logs, keys, places, size = [], list[dict[str, Any]](), list[str](), list[dict[str, str]](), 0
    listed = list(zip(source.logs(), stored_logs(source), strict=True))
    for number, (log, stored) in enumerate(listed):
        logs.append(
            {
                "map": None if log.signal_map is None else plain_tree(log.signal_map),
                "name": log.name,
                "rows": None if log.rows is None else list(log.rows),
                "repair": None if log.repair is None else plain_tree(log.repair),
            }
        )
        keys.append(stored.key)
        places.append({"path": str(full_path(log.path)), "shown": str(log.path)})
        size += status_of(log.path).st_size if is_file_at(log.path) else 0
        if size >= UNIT_BYTES or number == len(listed) - 1:
            label, where = places[0]["shown"], {"logs": places}
            units.append(WorkUnit(f"{__name__}:look_at_logs", label, {"logs": logs}, " ".join(keys), where))
            logs, keys, places, size = [], [], [], 0
    return units


def look_at_logs(identity: TrainingIdentity, where: Mapping[str, Any]) -> WithState:
    """Look into some logs."""
    looked = [_look(log, at) for log, at in zip(identity.config["logs"], where["logs"], strict=True)]
    reports, sketches, broken = zip(*looked, strict=True)
    return WithState({"broken": list(broken)}, packed(LookedAt(reports, sketches)))


def _look(log: Mapping[str, Any], at: Mapping[str, str]) -> tuple[QualityReport, Sketch | None, str]:
    """Report and sketch of a log, and why it cannot be read."""
    signal_map = None if log["map"] is None else build(SignalMap, log["map"], f"map of '{at['shown']}'")
    # The path as it was given stands in messages; where it leads nowhere on this node, the resolved one is read.
    shown = Path(at["shown"])
    path = shown if is_there(shown) else Path(at["path"])
    span = None if log["rows"] is None else (log["rows"][0], log["rows"][1])
    repair = None if log["repair"] is None else build(Repair, log["repair"], f"repairs of '{at['shown']}'")
    try:
        return (*look_into(path, signal_map, log["name"], span, repair), "")
    except DataError as error:
        return unreadable(shown, error), None, str(error)


def _units_of_store(source: DataSource, recordings: Sequence[Recording]) -> list[WorkUnit]:
    # What decides all of them: a stretch is drawn by how many recordings there are, and how long.
    digest = _digest([entry.digest for entry in read_index(source.store_folder()).recordings])
    each = max(1, -(-len(recordings) // STORED_UNITS))
    units = []
    for first in range(0, len(recordings), each):
        part = recordings[first : first + each]
        arguments = {"first": first, "count": len(part), "at_most_h": source.at_most_h}
        where = {"store": str(full_path(source.store_folder()))}
        label = str(source.path / part[0].name)
        units.append(WorkUnit(f"{__name__}:look_at_stored", label, arguments, digest, where))
    return units


def _digest(parts: Sequence[str]) -> str:
    return hashlib.blake2b("\n".join(parts).encode(), digest_size=16).hexdigest()


def look_at_stored(identity: TrainingIdentity, where: Mapping[str, Any]) -> WithState:
    """Look at some recordings of a store."""
    config = identity.config
    opened = _opened(where["store"], identity.data, config["at_most_h"])
    recordings = opened[config["first"] :][: config["count"]]
    looked = LookedAt(tuple(map(inspect, recordings)), tuple(map(sketch, recordings)))
    return WithState({"recordings": len(recordings)}, packed(looked))


@lru_cache(maxsize=1)
def _opened(store: str, digest: str, at_most_h: float | None) -> list[Recording]:
    return DataSource(Path(store), at_most_h=at_most_h).read()


def _coverage_unit(source: DataSource, covers: CoverageOrder) -> WorkUnit:
    arguments = {"inputs": list(covers.inputs), "split": covers.split}
    where = {"source": source.to_plain()}
    return WorkUnit(f"{__name__}:cover_all", "coverage", arguments, keys_of(source), where)


def cover_all(identity: TrainingIdentity, where: Mapping[str, Any]) -> WithState | dict[str, Any]:
    """What all recordings cover together, or why that cannot be told."""
    try:
        covered = coverage(
            DataSource.from_plain(where["source"]), tuple(identity.config["inputs"]), identity.config["split"]
        )
    except EdpError as error:
        return {"why": str(error)}
    return WithState({"why": ""}, packed(covered))
