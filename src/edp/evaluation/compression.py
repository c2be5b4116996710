"""Result of a compression: networks in number formats, evaluated against a budget; the file ``compression.json``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

from edp.errors import ConfigError, StorageError
from edp.evaluation.controller import Budget, ResourceUsage
from edp.settings.results import ResultFile
from edp.storage.ledger import Opening
from edp.storage.paths import is_file_at

Scores = Mapping[str, Mapping[str, float]]
"""``mae`` and ``composite`` by horizon: mean over outputs, report units."""


@dataclass(frozen=True, kw_only=True)
class CompressedRow:
    """A network in one number format.

    Attributes:
        name: network and format.
        recipe: description of the training and compression.
        number_format: a name of `edp.workflows.compression.FORMATS`; `label`: as tables show it.
        resource_usage: estimated resources on the controller.
        over: limits that it exceeds: what it takes, and what is granted; `fits`: whether there are none.
        scores: scores in this format on the comparison recordings.
        before: scores in float32 on the same recordings.
        error: MAE divided by that of the teacher in float32, the mean over horizons.
        run: folder of the network's run; empty for one of a search.
    """

    name: str
    recipe: str
    number_format: str
    label: str
    resource_usage: ResourceUsage
    over: Mapping[str, tuple[int, int]]
    fits: bool
    scores: Scores
    before: Scores
    error: float
    run: str = ""

    @property
    def costs(self) -> tuple[float, int, int]:
        """Error, cycles (high estimate) and bytes of parameters, the criteria of a choice in this order."""
        return self.error, self.resource_usage.cycles[2], self.resource_usage.parameter_bytes


@dataclass(frozen=True, kw_only=True)
class HeldOutTest:
    """Evaluation on recordings that took part in no choice.

    Attributes:
        seen_before: whether networks were evaluated on them before these.
        name: name of the sealed test set; None if it was not opened.
        opened: time of opening, ISO 8601.
        openings: all openings of the test set, oldest first.
        scores: scores of ``teacher`` and ``chosen``.
        error: MAE of the chosen network divided by the teacher's, mean over horizons.
    """

    seen_before: bool = False
    name: str | None = None
    opened: str | None = None
    openings: tuple[Opening, ...] = ()
    scores: Mapping[str, Scores] = field(default_factory=dict)
    error: float | None = None


@dataclass(frozen=True)
class ComparedTask:
    """Horizons in samples, and the rate in Hz."""

    horizons: tuple[int, ...]
    rate_hz: float


@dataclass(frozen=True)
class RecordingCounts:
    """Number of recordings of each part; `test` is the sealed test set."""

    train: int
    validation: int
    test: int


@dataclass(frozen=True, kw_only=True, eq=False)
class CompressionResult(ResultFile):
    """Content of ``compression.json``.

    Attributes:
        unit: unit of the scores.
        teacher: the teacher in float32; `rows`: all networks in all formats.
        front: indices of the rows that no other one surpasses in error, cycles and bytes of parameters.
        chosen: index of the row that fits with the smallest error; None if none fits.
        notes: omitted parts, each with the reason.
    """

    NAME: ClassVar[str] = "compression.json"
    SCHEMA: ClassVar[int] = 2
    ADVICE: ClassVar[str] = "run edp compress search again: it reads the finished networks"

    budget: Budget
    task: ComparedTask
    unit: str
    recordings: RecordingCounts
    teacher: CompressedRow
    rows: tuple[CompressedRow, ...]
    front: tuple[int, ...]
    chosen: int | None
    held_out_test: HeldOutTest = field(default_factory=HeldOutTest)
    notes: tuple[str, ...]

    def __post_init__(self) -> None:
        indices = (*self.front, *([] if self.chosen is None else [self.chosen]))
        if not all(0 <= index < len(self.rows) for index in indices):
            raise ConfigError(f"front or chosen: got indices {list(indices)} of {len(self.rows)} rows")
        horizons = {str(horizon) for horizon in self.task.horizons}
        scores = [part for row in (self.teacher, *self.rows) for part in (row.scores, row.before)]
        for part in (*scores, *self.held_out_test.scores.values()):
            if set(part) != horizons or any(not {"mae", "composite"} <= set(row) for row in part.values()):
                raise ConfigError(f"scores: got those of {', '.join(part)}, expected horizons {', '.join(horizons)}")

    @property
    def horizons(self) -> list[str]:
        """Look-aheads in samples, as keys of scores."""
        return [str(horizon) for horizon in self.task.horizons]

    def ahead(self, horizon: str) -> str:
        """Return a horizon in words."""
        return f"{1e3 * int(horizon) / self.task.rate_hz:.0f} ms ahead (k = {horizon})"

    @property
    def best(self) -> CompressedRow | None:
        """The chosen row."""
        return None if self.chosen is None else self.rows[self.chosen]


def read_compression(folder: str | Path) -> CompressionResult:
    """Return the checked content of the ``compression.json`` in a folder.

    Raises:
        StorageError: the folder has no such file, or the file is damaged or of another version.
    """
    file = Path(folder) / CompressionResult.NAME
    if not is_file_at(file):
        raise StorageError(f"'{folder}' holds no {file.name}; give the folder of edp compress search")
    return CompressionResult.from_file(file)
