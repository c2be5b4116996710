"""The verdict on a model by its scores on held-out recordings: headline, first line and exit code come from it.

The burden of proof is on the model. Its error is compared with that of the best reference (a baseline, a floor, what it
was made from):

* *worse*: the reference has less error; the exit code is `BEATEN`;
* *better*: the model has less error, and the 95 % interval over recordings excludes zero;
* *not distinguishable*: the model has less error, but the interval holds zero, or the recordings are too few for one.

Recordings are the independent units of every comparison; segments of one recording count as one. The gains of a
controller are compared on references, each with a seed of its own, which take the place of recordings.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from edp.errors import count_of
from edp.evaluation.adaptation_file import AdaptationFile
from edp.evaluation.free_run_file import FreeRunErrors, FreeRunScores
from edp.evaluation.scores_file import ByHorizon, ModelScores, ScoresFile, error_at
from edp.evaluation.tuning_file import TipErrors
from edp.stats.resampled import paired_t
from edp.wording import figure, percent, percent_interval

NETWORK = "network"
TWIN = "twin"
TWIN_ADVICE = "take that floor by twin.kind, another formulation, or more recordings with more motion"
MACHINE, GREY = "identified machine", "grey box"
"""Names of the result and of the reference in the comparison of an identification."""
MACHINE_ADVICE = "more rounds or starts of the fit (twin.fit), a nearer --machine, or more recordings with more motion"
MEASURE = "rmse"
"""Metric for comparing models, also in headlines and tables. Trainings minimise squared errors, the preset auto selects
models and states expected errors by it, and published references state it. If a machine mostly rests, the mean absolute
error depends on steady-state samples, which persistence predicts exactly.
"""
MEASURE_NAME = "RMSE"
ADVICE = "train with the preset auto, or on more recordings"
LEAST = 1e-3
"""Relative difference of errors below which two models count as equal. Rounding and threads cause as much."""


BEATEN = 6
"""Exit code of the outcome *worse*."""
FEWEST = 3
"""Minimum number of recordings (or references) for an interval."""


class ErrorOutcome(StrEnum):
    """Outcome of a comparison with a reference."""

    BETTER = "better"
    OPEN = "not distinguishable"
    WORSE = "worse"


def outcome_of(change: float, high: float | None) -> ErrorOutcome:
    """Return the outcome for a relative change of the error and its interval.

    Args:
        change: error over that of the reference, less one.
        high: upper end of the 95 % interval of the change; None where there are too few recordings for one.
    """
    if change > LEAST:
        return ErrorOutcome.WORSE
    better = change < -LEAST and high is not None and high < 0.0
    return ErrorOutcome.BETTER if better else ErrorOutcome.OPEN


@dataclass(frozen=True)
class ErrorVerdict:
    """A model against its best reference.

    Attributes:
        label: name of the reference in tables.
        less: share by which the error of the reference is less, over all outputs and horizons; negative where the
            model has less.
        outputs: targets on which the reference has less error, over all horizons.
        judged: name of the evaluated model.
        advice: advice if the model is worse.
        interval: 95 % interval, over recordings, of the relative change of the model's error; None for too few.
        recordings: number of recordings, or other units, that were compared.
        ground: data of the comparison, in the plural.
        unit: unit of resampling for the interval, in the singular.
    """

    label: str
    less: float
    outputs: tuple[str, ...]
    judged: str = "network"
    advice: str = ADVICE
    interval: tuple[float, float] | None = None
    recordings: int = 0
    ground: str = "held-out recordings"
    unit: str = "recording"

    @property
    def change(self) -> float:
        """Relative change of the error against the reference."""
        return 1.0 / (1.0 - self.less) - 1.0 if self.less < 1.0 else math.inf

    @property
    def outcome(self) -> ErrorOutcome:
        """Outcome of this comparison."""
        return outcome_of(self.change, None if self.interval is None else self.interval[1])

    @property
    def exit_code(self) -> int:
        """Exit code of a command with this verdict."""
        return BEATEN if self.outcome is ErrorOutcome.WORSE else 0

    def sentence(self) -> str:
        """Return the sentence that opens the terminal output and the page."""
        if self.outcome is ErrorOutcome.WORSE:
            where = f" (on {', '.join(self.outputs)})" if self.outputs else ""
            return (
                f"On the {self.ground} {self.label} has {percent(self.less)} less error than the "
                f"{self.judged}{where}: do not use this {self.judged}; {self.advice}."
            )
        gain = f"{percent(max(0.0, -self.change))} less error"
        who, other = f"On the {self.ground} the {self.judged}", f"{self.label}, the best of the others"
        if self.interval is None:
            count = self.recordings
            few = f"{count_of(count, self.unit)} {'are' if count > 1 else 'is'} too few for an interval"
            why = few if count else "no interval"
            return f"{who} has {gain} than {other} ({why}: chance is not excluded)."
        units = count_of(self.recordings, self.unit)
        reach = f"95 % interval of the change over {units}: {percent_interval(*self.interval)}"
        if self.outcome is ErrorOutcome.BETTER:
            return f"{who} has {gain} than {other} ({reach})."
        return f"{who} is not distinguishable from {other}: {gain} ({reach})."

    def headline(self, figures: str) -> str:
        """Return the headline of a page: the first line of the terminal, then figures of a model that may be used."""
        return self.sentence() if self.outcome is ErrorOutcome.WORSE else f"{self.sentence()} {figures}"


UNADAPTED = ErrorVerdict(
    "the network without adaptation",
    0.0,
    (),
    "adaptation",
    "run the network without it, or choose other adapt settings",
)
BEFORE_TUNING = ErrorVerdict(
    "the controller before",
    0.0,
    (),
    "tuned controller",
    "keep the gains as they were, or give more --trials and --loops",
    ground="references that tuned nothing",
    unit="reference",
)


@dataclass(frozen=True)
class ErrorRatios:
    """Logarithms of error ratios between the evaluated model and one reference.

    Attributes:
        label: name of the reference in tables.
        by_output: values over all recordings, one per horizon or time that both models have, for each output.
        by_recording: mean over outputs and times of each recording; see `by_recording`.
    """

    label: str
    by_output: Mapping[str, Sequence[float]]
    by_recording: Mapping[str, float]


def by_recording(logs: Mapping[str, Sequence[float]]) -> dict[str, float]:
    """Return the mean logarithm of the error ratio of each recording.

    Args:
        logs: errors by recording, or by segment of a recording such as ``name[100:200]``. Segments of one recording are
            one unit, because they share day, driver and oil temperature.
    """
    pooled: dict[str, list[float]] = {}
    for name, values in logs.items():
        finite = [value for value in values if math.isfinite(value)]
        if finite:
            pooled.setdefault(name.partition("[")[0], []).append(sum(finite) / len(finite))
    return {name: sum(values) / len(values) for name, values in pooled.items()}


def best_verdict(ratios: Iterable[ErrorRatios], template: ErrorVerdict) -> ErrorVerdict | None:
    """Return the verdict against the reference with the least error; None without a reference.

    Args:
        ratios: error ratios by reference.
        template: verdict with the name of the model, advice and ground.
    """
    worst: tuple[float, ErrorVerdict] | None = None
    for one in ratios:
        values = [value for logs in one.by_output.values() for value in logs]
        if values:
            # Logarithms: halving one output's error and doubling another's cancel out.
            mean, logs = sum(values) / len(values), list(one.by_recording.values())
            lost = tuple(name for name, of in one.by_output.items() if of and sum(of) > LEAST * len(of))
            if worst is None or mean > worst[0]:
                interval, less = _interval(logs, mean), 1.0 - math.exp(-mean)
                verdict = replace(template, label=one.label, less=less, outputs=lost, interval=interval)
                worst = mean, replace(verdict, recordings=len(logs))
    return None if worst is None else worst[1]


def network_verdict(scores: ScoresFile, minutes: float | None = None) -> ErrorVerdict | None:
    """Return the verdict on a network against the baseline with the least error; None without a baseline.

    Errors are compared by the geometric mean of the ratio of root-mean-square errors over horizons and targets, so
    that no unit counts for more than another.

    Args:
        scores: the content of ``scores.json``.
        minutes: time budget of the preset auto; None for any other training.
    """
    models = scores.models
    if NETWORK not in models:
        return None
    unit = "minute" if minutes == 1 else "minutes"
    advice = (
        ADVICE if minutes is None else f"give it more than {figure(minutes)} {unit} (--time-budget), or more recordings"
    )
    horizons, network, ratios = scores.task.horizons, models[NETWORK], []
    for name, model in models.items():
        if name != NETWORK:
            by_target = {t.name: _logarithm(network.overall, model.overall, t.name, horizons) for t in scores.targets}
            finite = {target: [value] for target, value in by_target.items() if math.isfinite(value)}
            ratios.append(ErrorRatios(model.label, finite, _compare_recordings(network, model, scores)))
    return best_verdict(ratios, ErrorVerdict("", 0.0, (), NETWORK, advice))


def beaten_by(scores: ScoresFile, minutes: float | None = None) -> ErrorVerdict | None:
    """Return the verdict of `network_verdict` where it is *worse*, else None."""
    return _if_worse(network_verdict(scores, minutes))


def _if_worse(verdict: ErrorVerdict | None) -> ErrorVerdict | None:
    return verdict if verdict is not None and verdict.outcome is ErrorOutcome.WORSE else None


def _compare_recordings(network: ModelScores, model: ModelScores, scores: ScoresFile) -> dict[str, float]:
    """Return the logarithms of the ratio of errors of the recordings that both have."""
    logs = {}
    for name, ours in network.recordings.items():
        theirs = model.recordings.get(name, {})
        logs[name] = [_logarithm(ours, theirs, target.name, scores.task.horizons) for target in scores.targets]
    return by_recording(logs)


def _interval(logs: list[float], mean: float) -> tuple[float, float] | None:
    """Return 95 % interval of the relative change over recordings, the pooled change included; None for too few."""
    if len(logs) < FEWEST:
        return None
    ends = paired_t(np.array(logs)).interval()
    # Long recordings count for more in the pooled error than in the mean over recordings: the wider statement holds.
    return math.expm1(min(float(ends[0]), mean)), math.expm1(max(float(ends[1]), mean))


@dataclass(frozen=True)
class LostOutput:
    """An output on which a baseline has less error than the network at some horizon.

    Attributes:
        target: name of the output.
        label: name of the best baseline in tables.
        less: relative difference of the errors.
        horizon: horizon with the largest difference, in samples.
    """

    target: str
    label: str
    less: float
    horizon: int


def find_lost_outputs(scores: ScoresFile) -> list[LostOutput]:
    """Return the outputs on which a baseline has a lower RMSE at some horizon, the worst first.

    Args:
        scores: the content of ``scores.json``.
    """
    models, horizons = scores.models, scores.task.horizons
    lost = []
    for target in scores.targets if NETWORK in models else ():
        # Each horizon by itself: a network that leads at one may be of no use at another.
        gains = {
            (model.label, horizon): _logarithm(models[NETWORK].overall, model.overall, target.name, [horizon])
            for name, model in models.items()
            for horizon in horizons
            if name != NETWORK
        }
        best = max((where for where in gains if gains[where] > LEAST), key=lambda where: gains[where], default=None)
        if best is not None:
            lost.append(LostOutput(target.name, best[0], 1.0 - math.exp(-gains[best]), best[1]))
    return sorted(lost, key=lambda output: -output.less)


def twin_beaten_by(models: Mapping[str, FreeRunScores]) -> ErrorVerdict | None:
    """Return the verdict of `twin_verdict` where it is *worse*, else None."""
    return _if_worse(twin_verdict(models))


def twin_verdict(models: Mapping[str, FreeRunScores]) -> ErrorVerdict | None:
    """Return the comparison of a twin with its best baseline in free-run simulation; None without a baseline.

    Compared is the geometric mean, over actuators, of the ratios of the velocities' errors and of the strokes' at each
    time: a network that only follows for a second, or drifts for a minute, is seen by both.

    Args:
        models: scores by name, as ``free_run.json`` has them; the twin's is ``twin``.
    """
    return _verdict_on_free_runs(models, TWIN, TWIN, TWIN_ADVICE)


def machine_verdict(models: Mapping[str, FreeRunScores]) -> ErrorVerdict | None:
    """Return the verdict on an identified machine against the guess and the static map on free runs.

    Args:
        models: scores by name, as `edp.workflows.identify.identify` gives them. The grey box is what the machine was
            made of, not what stands in its place.
    """
    rivals = {name: scores for name, scores in models.items() if name != GREY}
    return _verdict_on_free_runs(rivals, MACHINE, "machine file", MACHINE_ADVICE)


def _verdict_on_free_runs(
    models: Mapping[str, FreeRunScores], judged: str, what: str, advice: str
) -> ErrorVerdict | None:
    own = models[judged]
    ratios = [
        ErrorRatios(name, _free_run_logs(own, scores), by_recording(_free_run_logs_by_recording(own, scores)))
        for name, scores in models.items()
        if name != judged
    ]
    return best_verdict(ratios, ErrorVerdict("", 0.0, (), what, advice))


def _free_run_logs(own: FreeRunErrors, scores: FreeRunErrors) -> dict[str, list[float]]:
    """Return the logarithms of the ratio of errors of each actuator, at the times that both have.

    Without errors of zero.
    """
    ours, theirs = _free_run_errors(own), _free_run_errors(scores)
    return {
        actuator: [math.log(errors[at] / theirs[actuator][at]) for at in errors
                   if errors[at] > 0 < theirs[actuator].get(at, 0.0)]
        for actuator, errors in ours.items()
    }  # fmt: skip


def _free_run_logs_by_recording(own: FreeRunScores, scores: FreeRunScores) -> dict[str, list[float]]:
    """Return the error ratios of each recording, over all actuators."""
    theirs = scores.by_recording
    return {
        name: [value for logs in _free_run_logs(summary, theirs[name]).values() for value in logs]
        for name, summary in own.by_recording.items()
        if name in theirs
    }


def adaptation_verdict(content: AdaptationFile) -> ErrorVerdict:
    """Return the verdict on an adaptation against the same network without it."""
    return change_verdict(content.change, content.change_by_recording, UNADAPTED)


def tuning_verdict(errors: TipErrors) -> ErrorVerdict:
    """Return the verdict on tuned gains against the initial gains, on the plant of the evaluation."""
    by_reference = {name: change.relative for name, change in errors.by_reference.items()}
    return change_verdict(errors.relative, by_reference, BEFORE_TUNING)


def change_verdict(change: float, by_unit: Mapping[str, float], reference: ErrorVerdict) -> ErrorVerdict:
    """Return the verdict on something made from its reference, whose errors are known relative to that reference.

    Args:
        change: error over that of the reference, less one, over all recordings.
        by_unit: error ratios of each recording, or of each reference of a controller.
        reference: a verdict with the label of the reference, what is evaluated, the advice and the ground.
    """
    mean = math.log1p(change)
    logs = [math.log1p(one) for one in by_unit.values()]
    return replace(reference, less=1.0 - math.exp(-mean), interval=_interval(logs, mean), recordings=len(logs))


def free_run_error(scores: FreeRunErrors, reference: FreeRunErrors) -> float:
    """Return the free-run error relative to a reference on the same runs, as one number; see `twin_beaten_by`.

    Args:
        scores: see `edp.evaluation.free_run.free_run_scores`.
        reference: scores of another twin.

    Returns:
        The geometric mean, over actuators, of the ratios of velocity errors and of stroke errors at each time.
    """
    ratios = [value for logs in _free_run_logs(scores, reference).values() for value in logs]
    return math.exp(sum(ratios) / len(ratios)) if ratios else 1.0


def _free_run_errors(scores: FreeRunErrors) -> dict[str, dict[float, float]]:
    """Return errors by actuator and time (s): the velocity error at time 0, stroke errors at later times."""
    rows = [(0.0, scores.velocity_mae), *((row.at_s, row) for row in scores.stroke_error)]
    columns = zip(*([value or 0.0 for value in row.by_channel.values()] for _, row in rows), strict=True)
    times = [at for at, _ in rows]
    return {
        actuator: dict(zip(times, column, strict=True))
        for actuator, column in zip(scores.velocity_mae.by_channel, columns, strict=True)
    }


def _logarithm(network: ByHorizon, model: ByHorizon, target: str, horizons: Sequence[int]) -> float:
    """Return the mean over horizons of the log error ratio between network and model; NaN if an error is zero."""
    values = []
    for horizon in horizons:
        ours, theirs = (error_at(entry, horizon, target, MEASURE) for entry in (network, model))
        # A perfect prediction has no logarithm; such a target decides nothing.
        if ours and theirs:
            values.append(math.log(ours / theirs))
    return sum(values) / len(values) if values else math.nan
