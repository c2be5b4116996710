"""Content of ``results.json``: closed loops of one controller on one task, with their scores."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from edp.control.base import MOST_EVENTS, ControlEvent
from edp.control.score import LoopScore
from edp.settings.bounds import check_count
from edp.settings.results import ResultFile

MOST_LOOPS = 100_000


@dataclass(frozen=True, kw_only=True)
class ControlSummary:
    """Scores over all loops: means, and the worst of the two errors of the tip.

    Attributes:
        energy_kj: None if the plant does not report the power of its pumps.
        violations: number of samples at which a limit was violated.
        missed: number of samples at which the controller had no answer.
        solve_us_median: median time of a step of the controller, µs.
    """

    position_rms_mm: float
    position_worst_mm: float
    path_rms_mm: float
    path_worst_mm: float
    attitude_rms_deg: float
    lever_travel: float
    energy_kj: float | None
    violations: int
    missed: int
    solve_us_median: float


@dataclass(frozen=True, kw_only=True)
class StepTimes:
    """Times of a step of the controller, µs."""

    median: float
    p99: float
    max: float


@dataclass(frozen=True, kw_only=True)
class LoopEntry:
    """One closed loop.

    Attributes:
        name: of its recording.
        seed: of the task and the plant.
        seconds: duration of the reference.
        score: over the judged samples.
        solve_us: times of a step of the controller.
        events: events that the controller logged.
        warnings: events that the guard logged.
    """

    name: str
    seed: int
    seconds: float
    score: LoopScore
    solve_us: StepTimes
    events: tuple[ControlEvent, ...]
    warnings: tuple[ControlEvent, ...]

    def __post_init__(self) -> None:
        check_count("loop", "events", self.events, MOST_EVENTS)
        check_count("loop", "warnings", self.warnings, MOST_EVENTS)


@dataclass(frozen=True, kw_only=True)
class ControlFile(ResultFile):
    """Content of ``results.json``.

    Attributes:
        edp: version that ran the loops.
        sentence: the score in one sentence.
        task: settings of the task, with its ``kind``.
        controller: settings of the controller, with its ``kind``.
        machine: name of the machine.
        plant: description of the plant.
        summary: scores over all loops.
        loops: loops in the order of their seeds.
    """

    NAME = "results.json"
    SCHEMA = 1
    WHAT = "results of closed loops"
    ADVICE = "remove the run folder and run edp control"

    edp: str
    sentence: str
    task: Mapping[str, object]
    controller: Mapping[str, object]
    machine: str
    plant: str
    summary: ControlSummary
    loops: tuple[LoopEntry, ...]

    def __post_init__(self) -> None:
        check_count("results of closed loops", "loops", self.loops, MOST_LOOPS)
