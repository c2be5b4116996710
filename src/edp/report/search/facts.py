"""A model search as its `study.json` holds it (`edp.storage.study_file`): what the pages, pictures and tables read."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import wraps
from pathlib import Path
from typing import Any, TypeVar

from edp.data.frozen import SECOND_TEST_SET
from edp.errors import StorageError
from edp.storage.study_file import check_study

TITLES = {
    "isolation": "isolation and variance",
    "calibration": "calibration",
    "screening": "screening",
    "planning": "power",
    "confirmation": "confirmation",
    "synthesis": "synthesis",
    "exploration": "exploration",
    "compression": "compression",
}
"""Phases in their order, as those are called that have not begun."""
NUMBERS = dict(zip(TITLES, ("0", "1", "2", "2.5", "3", "4", "5", "6"), strict=True))
"""Phases in the thesis's count."""

Made = TypeVar("Made")
Absent = TypeVar("Absent")


@dataclass(frozen=True)
class PhaseFacts:
    """How far a phase is and what it took.

    Attributes:
        name, title: of the phase.
        trainings: that it asked for, and that no earlier phase had.
        trained: of these, those that have ended.
        failed: of these, those that did not end well.
        pruned: of these, those that were ended at a rung.
        seconds: of training, summed over workers.
        wall_s: by the clock.
        began, ended: moments in ISO 8601; empty where it has not.
    """

    name: str
    title: str
    trainings: int = 0
    trained: int = 0
    failed: int = 0
    pruned: int = 0
    seconds: float = 0.0
    wall_s: float = 0.0
    began: str = ""
    ended: str = ""

    @property
    def heading(self) -> str:
        """As ``Phase 2.5: power``."""
        number = NUMBERS.get(self.name)
        return f"Phase {number}: {self.title}" if number else self.title.capitalize()


@dataclass(frozen=True)
class Training:
    """One training of the history.

    Attributes:
        phase: that asked for it.
        test: whether it was judged on the sessions set apart.
        status: ``done``, ``pruned``, or how it failed.
        score: None where it was pruned or failed.
        seconds: that it took.
        parameters, macs_tick: None where they were not counted.
        label: what it was.
    """

    phase: str
    test: bool
    status: str
    score: float | None
    seconds: float
    parameters: float | None
    macs_tick: float | None
    label: str


@dataclass(frozen=True)
class StudyFacts:
    """A study.

    Attributes:
        state: one of `edp.storage.study_file.STATES`.
        mode: ``sound`` or ``thesis``.
        preset: name of its settings.
        unit: of the scores.
        data: path, number of sessions, hours and hash of the recordings.
        spec: settings of the search.
        development, test, second: names of sessions; `second` are those of the second test set.
        modules: title of each module by name.
        phases: in their order, those that have not begun among them.
        facts: what each decided phase found, by name.
        sentences: what it decided and why.
        history: every training that has ended, in the order in which they were asked for.
        openings: judged_counts at the test sessions.
    """

    state: str
    mode: str
    preset: str
    unit: str
    data: Mapping[str, Any]
    spec: Mapping[str, Any]
    development: tuple[str, ...]
    test: tuple[str, ...]
    modules: Mapping[str, str]
    phases: tuple[PhaseFacts, ...]
    facts: Mapping[str, Mapping[str, Any]]
    sentences: Mapping[str, tuple[str, ...]]
    history: tuple[Training, ...]
    openings: tuple[Mapping[str, Any], ...]
    second: tuple[str, ...] = ()

    @property
    def title(self) -> str:
        """Name of the data."""
        return Path(str(self.data["path"])).name or str(self.data["path"])

    def module(self, name: str) -> str:
        """Title of a module."""
        return self.modules.get(name, name)

    def phase(self, name: str) -> PhaseFacts | None:
        """A phase; None where the study has none of this name."""
        return next((phase for phase in self.phases if phase.name == name), None)


def facts_of(study: Mapping[str, Any]) -> StudyFacts:
    """A study, checked.

    Raises:
        StorageError: of another schema, or with parts missing or of a wrong kind; the message names the part.
    """
    check_study(study)
    return reading("study.json", lambda: _facts_of(study))


def _facts_of(study: Mapping[str, Any]) -> StudyFacts:
    decisions = [dict(decision) for decision in study["decisions"]]
    data, sessions = dict(study["data"]), dict(study["sessions"])
    return StudyFacts(
        state=study["state"],
        mode=study["mode"],
        preset=str(study["preset"]),
        unit=str(study["unit"]),
        data=data | {"path": str(data["path"]), "sessions": int(data["sessions"]), "hours": real(data["hours"])},
        spec={str(key): value for key, value in study["spec"].items()} | {"horizon": int(study["spec"]["horizon"])},
        development=tuple(map(str, sessions["development"])),
        test=tuple(map(str, sessions["test"])),
        modules={str(name): str(title) for name, title in study["modules"].items()},
        phases=_phases(study["phases"]),
        facts={str(decision["phase"]): dict(decision["facts"]) for decision in decisions},
        sentences={str(decision["phase"]): tuple(map(str, decision["sentences"])) for decision in decisions},
        history=_history(study["history"], study["openings"]),
        openings=tuple(dict(decision) for decision in study["openings"]),
        second=tuple(map(str, sessions.get("second", ()))),
    )


def _phases(begun: Sequence[Mapping[str, Any]]) -> tuple[PhaseFacts, ...]:
    begun_phases = {phase.name: phase for phase in map(_phase, begun)}
    ahead = {name: PhaseFacts(name, title) for name, title in TITLES.items() if name not in begun_phases}
    both = begun_phases | ahead
    order = [name for name in TITLES if name in both] + [name for name in both if name not in TITLES]
    return tuple(both[name] for name in order)


def _phase(phase_row: Mapping[str, Any]) -> PhaseFacts:
    return PhaseFacts(
        name=str(phase_row["name"]),
        title=str(phase_row["title"]),
        trainings=int(phase_row["trainings"] or 0),
        trained=int(phase_row["trained"] or 0),
        failed=int(phase_row["failed"] or 0),
        pruned=int(phase_row.get("pruned") or 0),
        seconds=known(phase_row["seconds"]) or 0.0,
        wall_s=known(phase_row["wall_s"]) or 0.0,
        began=str(phase_row["began"] or ""),
        ended=str(phase_row["ended"] or ""),
    )


def _history(rows: Sequence[Mapping[str, Any]], openings: Sequence[Mapping[str, Any]]) -> tuple[Training, ...]:
    """What has ended. The last trainings of phases 4 and 6 are those that a sealed test set was opened for."""
    test: set[int] = set()
    for phase, second in (("synthesis", False), ("compression", True)):
        places = [index for index, row in enumerate(rows) if row["phase"] == phase]
        judged_counts = [len(row["judged"]) for row in openings if (str(row["test_set"]) == SECOND_TEST_SET) == second]
        sealed = (
            (judged_counts[-1] if second else sum(judged_counts)) if judged_counts else 0
        )  # judged_counts of edp compress trained nothing here
        test |= set(places[len(places) - sealed :] if sealed and places else ())
    return tuple(_training(row, index in test) for index, row in enumerate(rows) if row["status"] != "waiting")


def _training(row: Mapping[str, Any], test: bool) -> Training:
    return Training(
        phase=str(row["phase"]),
        test=test,
        status=str(row["status"]),
        score=known(row["score"]),
        seconds=known(row["seconds"]) or 0.0,
        parameters=known(row.get("parameters")),
        macs_tick=known(row.get("macs_tick")),
        label=str(row["label"] or ""),
    )


def real(value: Any) -> float:
    """A finite number.

    Raises:
        ValueError: none, or no number.
    """
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ValueError(f"{str(value)[:40]!r} is no finite number")
    return float(value)


def known(value: Any) -> float | None:
    """A finite number, or none.

    Raises:
        ValueError: something else.
    """
    return None if value is None else real(value)


def pair(value: Any) -> tuple[float, float] | None:
    """Bounds of an interval, or none."""
    if value is None:
        return None
    low, high = value
    return real(low), real(high)


def of_phase(
    name: str, absent: Absent
) -> Callable[[Callable[[StudyFacts, Mapping[str, Any]], Made]], Callable[[StudyFacts], Made | Absent]]:
    """Make a function of a study and a phase's facts one of the study: `absent` where the phase has not decided yet.

    Facts that cannot be read become one `StorageError` that names the phase.
    """

    def wrap(function: Callable[[StudyFacts, Mapping[str, Any]], Made]) -> Callable[[StudyFacts], Made | Absent]:
        @wraps(function)
        def call(study: StudyFacts) -> Made | Absent:
            facts = study.facts.get(name)
            if facts is None:
                return absent
            return reading(f"study.json: phase '{name}'", lambda: function(study, facts))

        return call

    return wrap


def reading(where: str, read: Callable[[], Made]) -> Made:
    """What `read` gives.

    Raises:
        StorageError: it met something missing or of a wrong kind.
    """
    try:
        return read()
    except (KeyError, TypeError, ValueError, AttributeError, IndexError) as error:
        what = f"it lacks {error}" if isinstance(error, KeyError) else f"it cannot be read: {error}"
        raise StorageError(
            f"{where}: {what}; another version of EDP wrote it, or it was edited. Call `edp search` on the study "
            "again: it writes the file anew from its ledger"
        ) from error
