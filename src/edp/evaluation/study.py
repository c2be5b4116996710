"""The file in which a model search writes its progress and decisions, ``study.json``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

from edp.data.frozen import SECOND_TEST_SET
from edp.errors import ConfigError, StorageError
from edp.evaluation.study_facts import FACTS, OPTIONAL
from edp.settings.results import json_value
from edp.settings.tree import SettingsTree
from edp.storage.ledger import Opening
from edp.storage.paths import is_file_at, is_folder_at
from edp.storage.reading import read_json

FILE, SCHEMA = "study.json", 2
STATES = ("running", "stopped", "killed", "finished")
"""Of a study; ``killed`` is one whose file says that it runs, and which no process holds."""
MODES = ("sound", "thesis")
"""Whose tests and rules decide: those of docs/explanation/statistics.md, or those of the thesis."""
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
"""Titles of the phases in their order."""
NUMBERS = dict(zip(TITLES, ("0", "1", "2", "2.5", "3", "4", "5", "6"), strict=True))
"""Phases in the thesis's count."""
F = TypeVar("F")


@dataclass(frozen=True)
class Decision:
    """Result and decision of a phase.

    Attributes:
        phase: its name.
        facts: one of the classes of this module; a table for a phase that EDP does not have.
        sentences: what was decided and why.
    """

    phase: str
    facts: Any
    sentences: tuple[str, ...]

    def to_json(self) -> object:
        """Return plain values that JSON has: a number that is not finite becomes null."""
        return json_value(self)


@dataclass(frozen=True, kw_only=True)
class PhaseRow:
    """Progress of a phase: requested trainings and their outcomes, with ISO 8601 times.

    `seconds` of training are summed over workers, `wall_s` are by the clock.
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
    ended: str | None = None

    @property
    def heading(self) -> str:
        """Heading such as ``Phase 2.5: power``."""
        number = NUMBERS.get(self.name)
        return f"Phase {number}: {self.title}" if number else self.title.capitalize()


@dataclass(frozen=True, kw_only=True)
class TrainingRow:
    """A training, all of its parts together.

    Attributes:
        phase: that asked for it first.
        status: ``waiting``, ``done``, ``pruned``, or how it failed; `message`: what went wrong.
        score: None if it was pruned or failed.
        rung: the last one, if it ended there.
    """

    phase: str
    number: int
    label: str
    status: str = "waiting"
    seconds: float = 0.0
    score: float | None = None
    parameters: float | None = field(default=None, metadata=OPTIONAL)
    macs_tick: float | None = field(default=None, metadata=OPTIONAL)
    message: str | None = field(default=None, metadata=OPTIONAL)
    rung: int | None = field(default=None, metadata=OPTIONAL)


@dataclass(frozen=True)
class StudyData:
    """Recordings of a study."""

    path: str
    sessions: int
    hours: float
    hash: str


@dataclass(frozen=True)
class SessionSets:
    """Sessions for training and validation, test sessions, and sessions of the second test set."""

    development: tuple[str, ...]
    test: tuple[str, ...]
    second: tuple[str, ...] = ()


@dataclass(frozen=True)
class TrainingCounts:
    """Number of finished, requested and maximum trainings."""

    done: int = 0
    asked: int = 0
    total: int = 0


@dataclass(frozen=True, kw_only=True)
class StudyFile:
    """Content of ``study.json``.

    Attributes:
        state, mode: one of `STATES` and of `MODES`.
        unit: of the scores.
        spec: settings of the search, from the preset of this name.
        modules: titles by name.
        decisions: of the phases that have ended; `phases`: those that have begun.
        history: every training, in the order of asking.
    """

    state: str
    mode: str
    unit: str
    preset: str
    data: StudyData
    spec: Mapping[str, Any]
    sessions: SessionSets
    created: str = ""
    modules: Mapping[str, str]
    decisions: tuple[Decision, ...]
    phases: tuple[PhaseRow, ...]
    history: tuple[TrainingRow, ...]
    openings: tuple[Opening, ...]
    counts: TrainingCounts = field(default_factory=TrainingCounts)
    updated: str = ""

    @property
    def title(self) -> str:
        """Name of the data."""
        return Path(self.data.path).name or self.data.path

    @property
    def decided(self) -> tuple[str, ...]:
        """Names of the phases that have ended."""
        return tuple(decision.phase for decision in self.decisions)

    @property
    def ended(self) -> tuple[TrainingRow, ...]:
        """Trainings that have ended."""
        return tuple(row for row in self.history if row.status != "waiting")

    @property
    def all_phases(self) -> tuple[PhaseRow, ...]:
        """The phases that have begun and those that have not, in their order."""
        begun = {phase.name: phase for phase in self.phases}
        ahead = {name: PhaseRow(name=name, title=title) for name, title in TITLES.items()}
        return tuple((ahead | begun).values())

    def facts(self, kind: type[F]) -> F | None:
        """Return the results of a phase by their class; None if the phase has not ended."""
        return facts_of_kind(self.decisions, kind)

    def module(self, name: str) -> str:
        """Return the title of a module."""
        return self.modules.get(name, name)

    def tested(self) -> frozenset[int]:
        """Return the indices of the trainings that a sealed test set was opened for: the last of phases 4 and 6."""
        tested: set[int] = set()
        for phase, second in (("synthesis", False), ("compression", True)):
            indices = [index for index, row in enumerate(self.history) if row.phase == phase]
            counts = [len(one.judged) for one in self.openings if (one.test_set == SECOND_TEST_SET) == second]
            # Openings by edp compress search trained nothing here.
            sealed = counts[-1:] if second else counts
            tested |= set(indices[len(indices) - sum(sealed) :] if sum(sealed) else ())
        return frozenset(tested)

    def to_json(self) -> dict[str, object]:
        """Return plain values that JSON has: a number that is not finite becomes null."""
        return {"schema": SCHEMA, **json_value(self)}


def facts_of_kind(decisions: Sequence[Decision], kind: type[F]) -> F | None:
    """Return the results of a class among decisions; None without any."""
    return next((decision.facts for decision in decisions if isinstance(decision.facts, kind)), None)


STUDY_TREE = SettingsTree(what="study", null_is_nan=True)


def read_study(path: str | Path) -> StudyFile:
    """Return the checked content of a study's file.

    Args:
        path: path of ``study.json``, or of its folder.

    Raises:
        StorageError: missing, unreadable, of another schema, or no study.
    """
    file = Path(path)
    if is_folder_at(file) or file.suffix != ".json":
        file = file / FILE
        if not is_file_at(file):
            raise StorageError(f"'{path}' holds no study ({FILE} is missing); give the folder of edp search --out")
    return parse_study(read_json(file), str(file))


def parse_study(content: object, where: str = FILE) -> StudyFile:
    """Return a study from plain values.

    Raises:
        StorageError: no study, one of another schema, or one with parts that are missing or of another kind.
    """
    if not isinstance(content, Mapping) or "schema" not in content:
        raise StorageError(f"{where} is no study: it has no 'schema'; give the study.json that `edp search` wrote")
    if content["schema"] != SCHEMA:
        raise StorageError(
            f"{where} has schema {content['schema']!r}, this version of EDP reads {SCHEMA}; use the version that wrote "
            "it, or call `edp search` on the study again with this one"
        )
    for name, options in (("state", STATES), ("mode", MODES)):
        if content.get(name) not in options:
            raise StorageError(f"{where}: {name} = {content.get(name)!r}; {', '.join(options)} are known")
    try:
        study = STUDY_TREE.build(StudyFile, {key: content[key] for key in content if key != "schema"}, where)
        return replace(
            study, decisions=tuple(_parse_facts(decision, study.mode, where) for decision in study.decisions)
        )
    except ConfigError as error:
        raise StorageError(
            f"{error}\nanother version of EDP wrote it, or it was edited: call `edp search` on the study again, which "
            "writes it anew from its ledger"
        ) from error


def _parse_facts(decision: Decision, mode: str, where: str) -> Decision:
    kind = FACTS[mode].get(decision.phase)
    if kind is None or not isinstance(decision.facts, Mapping):
        return decision
    return replace(decision, facts=STUDY_TREE.build(kind, decision.facts, f"{where}: phase '{decision.phase}'"))
