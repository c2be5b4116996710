"""Whether a simple baseline does better than a network or a twin after all, by the scores of held-out recordings."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

NETWORK = "network"
TWIN = "twin"
TWIN_ADVICE = "take that floor by twin.kind, another formulation, or more recordings with more motion"
MACHINE, GREY = "identified machine", "grey box"
"""What an identification is judged as, and what it was made of."""
MACHINE_ADVICE = "more rounds or starts of the fit (twin.fit), a nearer --machine, or more recordings with more motion"
MEASURE = "rmse"
"""By which models are compared: here, in headlines and in tables. Trainings minimise squares, the preset auto chooses
and promises by them, published floors state them; and of a machine that mostly rests the mean absolute error is decided
by ticks at rest, of which persistence is exactly right."""
MEASURE_NAME = "RMSE"
ADVICE = "train with the preset auto, or on more recordings"
LEAST = 1e-3
"""Share of error below which two models count as equal: rounding and threads make as much."""


@dataclass(frozen=True)
class Beaten:
    """A baseline with less error than the network, or a floor with less than the twin.

    Attributes:
        label: how tables call it.
        less: by which share its error is less, over all outputs and horizons.
        outputs: targets on which it has less error, over all horizons.
        judged: what it beats.
        advice: what to do instead.
    """

    label: str
    less: float
    outputs: tuple[str, ...]
    judged: str = "network"
    advice: str = ADVICE

    def sentence(self) -> str:
        """For the first line of what a person reads."""
        where = f" (on {', '.join(self.outputs)})" if self.outputs else ""
        return (
            f"On the held-out recordings {self.label} has {100 * self.less:.1f} % less error than the "
            f"{self.judged}{where}: do not use this {self.judged}; {self.advice}."
        )


def beaten_by(scores: Mapping[str, Any], minutes: float | None = None) -> Beaten | None:
    """The baseline that beats the network by most; None where none does.

    Errors are compared by the geometric mean of the ratio of root-mean-square errors over horizons and targets, so
    that no unit counts for more than another.

    Args:
        scores: the content of ``scores.json``.
        minutes: that the preset auto was given; None for any other training.
    """
    models = scores["models"]
    if NETWORK not in models:
        return None
    unit = "minute" if minutes == 1 else "minutes"
    advice = ADVICE if minutes is None else f"give it more than {minutes:g} {unit} (--minutes), or more recordings"
    better = []
    for name, model in models.items():
        if name == NETWORK:
            continue
        by_target = {
            target["name"]: _logarithm(models[NETWORK], model, target["name"], scores["task"]["horizons"])
            for target in scores["targets"]
        }
        finite = [value for value in by_target.values() if math.isfinite(value)]
        if finite:
            mean = sum(finite) / len(finite)
            lost = tuple(target for target, value in by_target.items() if value > LEAST)
            better.append((mean, Beaten(str(model["label"]), 1.0 - math.exp(-mean), lost, advice=advice)))
    # Logarithms: halving one target's error and doubling another's cancel out.
    mean, worst = max(better, key=lambda entry: entry[0], default=(0.0, None))
    return worst if mean > LEAST else None


@dataclass(frozen=True)
class LostOutput:
    """An output on which a baseline has less error than the network at some horizon.

    Attributes:
        target: name of the output.
        label: how tables call the best baseline on it.
        less: by which share its error is less.
        horizon: where it is less by most, in samples.
    """

    target: str
    label: str
    less: float
    horizon: int


def lost_outputs(scores: Mapping[str, Any]) -> list[LostOutput]:
    """The outputs on which some baseline has less root-mean-square error at some horizon, the worst first.

    Args:
        scores: the content of ``scores.json``.
    """
    models, horizons = scores["models"], scores["task"]["horizons"]
    lost = []
    for target in scores["targets"] if NETWORK in models else ():
        # Each horizon by itself: a network that leads at one may be of no use at another.
        gains = {
            (str(model["label"]), horizon): _logarithm(models[NETWORK], model, target["name"], [horizon])
            for name, model in models.items()
            for horizon in horizons
            if name != NETWORK
        }
        best = max((where for where in gains if gains[where] > LEAST), key=lambda where: gains[where], default=None)
        if best is not None:
            lost.append(LostOutput(str(target["name"]), best[0], 1.0 - math.exp(-gains[best]), int(best[1])))
    return sorted(lost, key=lambda output: -output.less)


def twin_beaten_by(models: Mapping[str, Any]) -> Beaten | None:
    """The floor that beats the twin by most on free runs; None where none does.

    Compared is the geometric mean, over actuators, of the ratios of the velocities' errors and of the strokes' at each
    time: a network that only follows for a second, or drifts for a minute, is seen by both.

    Args:
        models: scores by name, as ``free_run.json`` has them; the twin's is ``twin``.
    """
    return _beaten_on_free_runs(models, TWIN, TWIN, TWIN_ADVICE)


def machine_beaten_by(models: Mapping[str, Any]) -> Beaten | None:
    """The guess, or the static map, that beats an identified machine by most on free runs; None where none does.

    Args:
        models: scores by name, as `edp.workflows.identify.identify` gives them. The grey box is what the machine was
            made of, not what stands in its place.
    """
    rivals = {name: scores for name, scores in models.items() if name != GREY}
    return _beaten_on_free_runs(rivals, MACHINE, "machine file", MACHINE_ADVICE)


def _beaten_on_free_runs(models: Mapping[str, Any], judged: str, what: str, advice: str) -> Beaten | None:
    own, better = _free_run_errors(models[judged]), []
    for name, scores in models.items():
        theirs = _free_run_errors(scores)
        by_actuator = {
            actuator: [math.log(a / b) for a, b in zip(errors, theirs[actuator], strict=True) if a > 0 and b > 0]
            for actuator, errors in own.items()
            if name != judged
        }
        ratios = [ratio for actuator in by_actuator.values() for ratio in actuator]
        if ratios:
            lost = tuple(name for name, logs in by_actuator.items() if sum(logs) > LEAST * len(logs))
            mean = sum(ratios) / len(ratios)
            better.append((mean, Beaten(name, 1.0 - math.exp(-mean), lost, what, advice)))
    mean, worst = max(better, key=lambda entry: entry[0], default=(0.0, None))
    return worst if mean > LEAST else None


def free_run_error(scores: Mapping[str, Any], reference: Mapping[str, Any]) -> float:
    """Error of free runs over that of a reference on the same runs: what `twin_beaten_by` compares, as one number.

    Args:
        scores: see `edp.evaluation.free_run.free_run_scores`.
        reference: of another twin.

    Returns:
        The geometric mean, over actuators, of the ratios of velocity errors and of stroke errors at each time.
    """
    pairs = zip(_free_run_errors(scores).values(), _free_run_errors(reference).values(), strict=True)
    ratios = [math.log(a / b) for ours, theirs in pairs for a, b in zip(ours, theirs, strict=True) if a > 0 and b > 0]
    return math.exp(sum(ratios) / len(ratios)) if ratios else 1.0


def _free_run_errors(scores: Mapping[str, Any]) -> dict[str, list[float]]:
    """Of each actuator the error of its velocity, then of its stroke at each time."""
    rows = [scores["velocity_mae"], *scores["stroke_error"]]
    columns = zip(*(row["by_channel"].values() for row in rows), strict=True)
    return dict(zip(scores["velocity_mae"]["by_channel"], map(list, columns), strict=True))


def _logarithm(network: Mapping[str, Any], model: Mapping[str, Any], target: str, horizons: list[int]) -> float:
    """Mean over horizons of the logarithm of the network's error over a model's; NaN where one of them is zero."""
    values = []
    for horizon in horizons:
        ours, theirs = (
            entry["overall"].get(str(horizon), {}).get(target, {}).get(MEASURE) for entry in (network, model)
        )
        # A perfect prediction has no logarithm; such a target decides nothing.
        if ours and theirs:
            values.append(math.log(ours / theirs))
    return sum(values) / len(values) if values else math.nan
