"""Content of ``free_run.json`` and ``step_response.json``: errors of a twin in free-run simulation, in report units."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from edp.errors import ConfigError
from edp.settings.bounds import MAX_ROWS, above, check_bounds, integer
from edp.settings.results import ResultFile, read_part

TWIN = "twin"
"""Name of the twin in the lists of models."""
PARTS = ("velocities", "strokes", "pressures")
"""Kinds of output channels, in the order of a twin's outputs."""
RUNS = "free_runs.safetensors"
MAX_TEXT = 2_000
"""Maximum number of characters of a candidate's label or reason."""
POSITIVE, COUNT = above(0.0, 1e12), integer(0, MAX_ROWS)
ByChannel = Mapping[str, float | None]


@dataclass(frozen=True, kw_only=True)
class ChannelErrors:
    """Mean errors of channels.

    Attributes:
        unit: common unit of all channels; None if they differ.
        by_channel: mean of each channel; None without samples.
        units: unit by channel if they differ.
        mean: over channels; None where they have no common unit.
    """

    unit: str | None
    by_channel: ByChannel
    units: Mapping[str, str] = field(default_factory=dict)
    mean: float | None

    def unit_of(self, channel: str) -> str:
        """Return the unit of a channel; empty where unknown."""
        return self.units.get(channel) or self.unit or ""


@dataclass(frozen=True, kw_only=True)
class StrokeErrors(ChannelErrors):
    """Errors of strokes `at_s` seconds after the start, with the median over runs and channels."""

    at_s: float
    median: float | None

    def __post_init__(self) -> None:
        check_bounds("stroke_error", self, at_s=POSITIVE)


@dataclass(frozen=True, kw_only=True)
class PressureErrors:
    """Root-mean-square errors of pressures in standard deviations (NRMSE); None for a constant pressure."""

    mean: float | None
    by_channel: ByChannel


@dataclass(frozen=True, kw_only=True)
class FreeRunErrors:
    """Errors of free runs.

    Attributes:
        velocity_mae: mean absolute error of velocities.
        stroke_error: absolute errors of strokes by time.
        pressure_nrmse: errors of pressures.
        diverged: fraction of the runs that left the machine.
    """

    velocity_mae: ChannelErrors
    stroke_error: tuple[StrokeErrors, ...]
    pressure_nrmse: PressureErrors
    diverged: float


@dataclass(frozen=True, kw_only=True)
class RunSummary(FreeRunErrors):
    """Mean errors over `runs` free-run simulations."""

    runs: int

    def __post_init__(self) -> None:
        check_bounds("errors", self, runs=COUNT)


@dataclass(frozen=True, kw_only=True)
class ErrorLine:
    """Errors over the horizon; the mean and each channel have one value per horizon."""

    unit: str | None
    mean: tuple[float | None, ...] = ()
    by_channel: Mapping[str, tuple[float | None, ...]]


@dataclass(frozen=True, kw_only=True)
class HorizonErrors:
    """Errors at horizons that grow geometrically, by kind of channel."""

    seconds: tuple[float, ...]
    velocities: ErrorLine
    strokes: ErrorLine
    pressures: ErrorLine

    def __post_init__(self) -> None:
        check_bounds("by_horizon", self, seconds=POSITIVE)

    def part(self, name: str) -> ErrorLine:
        """Return the errors of a part named in `PARTS`."""
        line: ErrorLine = getattr(self, name)
        return line


@dataclass(frozen=True, kw_only=True)
class MotionErrors:
    """Errors in one motion state of the actuators: at an end stop, standing still, or moving.

    Attributes:
        share: fraction of the time over all actuators.
        machine_share: fraction of the time in which the machine counts as doing so.
        stroke_error: None for a twin without strokes.
    """

    share: float
    machine_share: float = 0.0
    velocity_mae: ChannelErrors
    stroke_error: ChannelErrors | None = None
    pressure_nrmse: PressureErrors


@dataclass(frozen=True, kw_only=True)
class PartCoverage:
    """Fraction of free runs inside the interval, and half widths of the interval."""

    share: float
    by_channel: Mapping[str, float] = field(default_factory=dict)
    half_width: ChannelErrors


@dataclass(frozen=True, kw_only=True)
class CoverageAt:
    """Coverage `at_s` seconds after the start, by kind of channel; `calibrated` is False later than the calibration."""

    at_s: float
    calibrated: bool = True
    velocities: PartCoverage | None = None
    strokes: PartCoverage | None = None
    pressures: PartCoverage | None = None

    def __post_init__(self) -> None:
        check_bounds("intervals.at", self, at_s=POSITIVE)

    def parts(self) -> dict[str, PartCoverage]:
        """Return the coverage of the kinds of channels that the twin has."""
        each = {name: getattr(self, name) for name in PARTS}
        return {name: part for name, part in each.items() if part is not None}


@dataclass(frozen=True, kw_only=True)
class IntervalCoverage:
    """Coverage of a twin's intervals: nominal, number of runs that calibrated them, and counted by time."""

    coverage: float
    calibrated_by: int = 0
    at: tuple[CoverageAt, ...]


@dataclass(frozen=True, kw_only=True)
class AheadErrors:
    """Errors of a twin a few samples ahead of measured channels."""

    ticks: int = 0
    seconds: float
    moments: int
    velocity_mae: ChannelErrors
    stroke_error: ChannelErrors
    pressure_nrmse: PressureErrors

    def __post_init__(self) -> None:
        check_bounds("ahead", self, seconds=POSITIVE, moments=COUNT)


@dataclass(frozen=True, kw_only=True)
class ErrorPair:
    """Errors of a look-ahead predictor and of a twin at the same samples."""

    predictor: ChannelErrors
    twin: ChannelErrors


@dataclass(frozen=True, kw_only=True)
class PredictorComparison:
    """Comparison with a look-ahead predictor at the same samples.

    Attributes:
        run: folder of the predictor.
        label: name of the model in tables.
        ticks: samples ahead.
        trained_on: recordings that the predictor was trained on.
        seconds: time ahead.
        moments: number of samples.
        errors: errors by kind of channel.
    """

    run: str = ""
    label: str
    ticks: int = 0
    trained_on: tuple[str, ...]
    seconds: float
    moments: int
    errors: Mapping[str, ErrorPair]

    def __post_init__(self) -> None:
        check_bounds("beside", self, seconds=POSITIVE, moments=COUNT)


@dataclass(frozen=True, kw_only=True)
class CommandExcess:
    """A command that leaves its range in training, SI units.

    Attributes:
        share: fraction of the samples.
        low, high: the range.
        least, largest: values that occur.
    """

    share: float
    low: float
    high: float
    least: float
    largest: float


@dataclass(frozen=True, kw_only=True)
class FreeRunScores(FreeRunErrors):
    """Scores of one model.

    Attributes:
        runs: number of free runs.
        recordings: number of their recordings.
        seconds: length of a run.
        by_driving: errors by driving task; empty if recordings do not state it.
        situations: errors by situation of the actuators; situations that do not occur are omitted.
        intervals: None without intervals.
        ahead: None where no recording is long enough.
        beyond: commands that leave their range in training.
        beside: None without a predictor.
    """

    runs: int
    recordings: int
    seconds: float
    by_horizon: HorizonErrors
    by_recording: Mapping[str, RunSummary]
    by_driving: Mapping[str, RunSummary]
    situations: Mapping[str, MotionErrors]
    intervals: IntervalCoverage | None = None
    ahead: AheadErrors | None = None
    beyond: Mapping[str, CommandExcess] = field(default_factory=dict)
    beside: PredictorComparison | None = None

    def __post_init__(self) -> None:
        check_bounds("errors", self, runs=COUNT, recordings=COUNT, seconds=POSITIVE)


@dataclass(frozen=True, kw_only=True)
class ReportedChannel:
    """A channel with its unit of reports, which is the SI unit times `factor`."""

    name: str
    description: str
    unit: str
    factor: float

    def __post_init__(self) -> None:
        check_bounds("channel", self, factor=POSITIVE)


@dataclass(frozen=True, kw_only=True)
class AnswerChannels:
    """Output channels of a twin, by kind."""

    velocities: tuple[ReportedChannel, ...]
    strokes: tuple[ReportedChannel, ...]
    pressures: tuple[ReportedChannel, ...]


@dataclass(frozen=True, kw_only=True)
class FreeRunFile(ResultFile):
    """Content of ``free_run.json``: scores of the twin (`TWIN`) and its baselines, with hashes of related files."""

    NAME = "free_run.json"
    SCHEMA = 2
    WHAT = "scores"
    ADVICE = "run edp evaluate with the run folder of the twin"

    channels: AnswerChannels
    models: Mapping[str, FreeRunScores]
    files: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if TWIN not in self.models:
            raise ConfigError(f"'models.{TWIN}' is missing; it must be given")


def read_models(table: Mapping[str, object], where: str) -> Mapping[str, FreeRunScores]:
    """Build scores by name of a model from the header of a twin, which messages call `where`; empty without scores.

    Raises:
        StorageError: a value has another form.
    """
    return {name: read_part(FreeRunScores, one, f"{where}, scores.{name}") for name, one in table.items()}


@dataclass(frozen=True, kw_only=True)
class StepAnswer:
    """Response of a channel to a step: median, and ends of the middle 80 %, by time."""

    name: str
    unit: str
    median: tuple[float, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]


@dataclass(frozen=True, kw_only=True)
class CommandStep:
    """A step of a command and the responses of all channels."""

    command: str
    size: float
    unit: str
    answers: tuple[StepAnswer, ...]

    def __post_init__(self) -> None:
        check_bounds("step", self, size=POSITIVE)


@dataclass(frozen=True, kw_only=True)
class StepResponses(ResultFile):
    """Content of ``step_response.json``: times since the step, number of moments, and the steps."""

    NAME = "step_response.json"
    SCHEMA = 1
    WHAT = "step responses"
    ADVICE = "run edp evaluate with the run folder of the twin"

    seconds: tuple[float, ...]
    moments: int
    steps: tuple[CommandStep, ...]

    def __post_init__(self) -> None:
        check_bounds("response", self, seconds=POSITIVE, moments=COUNT)
        answers = [answer for step in self.steps for answer in step.answers]
        if any(len(line) != len(self.seconds) for one in answers for line in (one.median, one.low, one.high)):
            raise ConfigError("lines have other lengths than the times")
        if len({len(step.answers) for step in self.steps}) > 1:
            raise ConfigError("steps have different numbers of answers")


@dataclass(frozen=True, kw_only=True)
class CandidateRow:
    """A formulation that a choice tried.

    Attributes:
        label: its name.
        error: free-run error on data not used by its fits, relative to the static map; None if the fit failed.
        seconds: processor time.
        chosen: whether it is the one that is kept.
        why: the reason why it was left out; empty for none.
    """

    label: str
    error: float | None
    seconds: float
    chosen: bool
    why: str

    def __post_init__(self) -> None:
        if max(len(self.label), len(self.why)) > MAX_TEXT:
            raise ConfigError(f"a label or reason is longer than {MAX_TEXT:,} characters")


@dataclass(frozen=True, kw_only=True)
class CandidatesFile(ResultFile):
    """Content of ``candidates.json``: formulations that a twin was chosen among, the simplest first."""

    NAME = "candidates.json"
    SCHEMA = 1
    WHAT = "candidates"
    ADVICE = "train the twin again"

    candidates: tuple[CandidateRow, ...]
