"""Content of ``results.json``: closed loops of one controller on one task, with their scores."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from edp.control.base import MAX_EVENTS, ControlEvent
from edp.control.score import LoopScore
from edp.settings.bounds import check_count
from edp.settings.results import ResultFile

MAX_LOOPS = 100_000


@dataclass(frozen=True, kw_only=True)
class ControlSummary:
    """Mean scores over all loops, and the worst position and path error of the tip.

    Attributes:
        energy_kj: pump energy, or None if the plant does not report the power of its pumps.
        violations: number of samples with a violated limit.
        missed: number of samples without a solution of the controller.
        solve_us_median: median computing time per controller step, µs.
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
    """Computing times per controller step, µs."""

    median: float
    p99: float
    max: float


@dataclass(frozen=True, kw_only=True)
class LoopEntry:
    """One closed loop.

    Attributes:
        name: name of the recording.
        seed: seed of the task and the plant.
        seconds: duration of the reference, s.
        score: score over the evaluated samples.
        solve_us: computing times per controller step.
        events: events logged by the controller.
        warnings: events logged by the guard.
    """

    name: str
    seed: int
    seconds: float
    score: LoopScore
    solve_us: StepTimes
    events: tuple[ControlEvent, ...]
    warnings: tuple[ControlEvent, ...]

    def __post_init__(self) -> None:
        check_count("loop", "events", self.events, MAX_EVENTS)
        check_count("loop", "warnings", self.warnings, MAX_EVENTS)


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
    ADVICE = "remove the run folder and run edp loop run"

    edp: str
    sentence: str
    task: Mapping[str, object]
    controller: Mapping[str, object]
    machine: str
    plant: str
    summary: ControlSummary
    loops: tuple[LoopEntry, ...]

    def __post_init__(self) -> None:
        check_count("results of closed loops", "loops", self.loops, MAX_LOOPS)
