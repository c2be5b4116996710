"""Measures predictions of test recordings in report units, one recording after the other."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edp.data.prepared import Prepared
from edp.errors import DataError
from edp.evaluation.by_situation import Situations, SituationTally
from edp.evaluation.measured import SPEED_BINS, Measured, MeasuredIntervals
from edp.evaluation.scores_file import (
    MEAN,
    ByTarget,
    IntervalScores,
    ModelScores,
    ScoredInput,
    ScoredTarget,
    ScoredTask,
    ScoresFile,
)
from edp.evaluation.situation import situation_of
from edp.evaluation.tally import Values, name_scores
from edp.signals import KINDS
from edp.stats.metrics import interval_score, interval_scores, score, spread
from edp.stats.sketch import QuantileSketch

Numbered = Iterable[tuple[int, NDArray[np.float32]]]
"""Numbers of test series, in any order, each with an array that has one entry per sample."""


class Ruler:
    """Measures predictions in report units; the same ticks for every model that reaches them.

    Args:
        data: ``data.test`` has the truth.
        skip: first ticks of each segment that are not scored.

    Raises:
        DataError: no tick can be scored.
    """

    def __init__(self, data: Prepared, skip: int) -> None:
        self.data, self.skip = data, skip
        self.task = data.task
        facts = [KINDS[kind] for kind in data.target_kinds]
        self.units = [fact.report_unit for fact in facts]
        self.factors = np.array([fact.report_factor for fact in facts])
        ticks = [max(0, series.samples - self.task.max_horizon) for series in data.test]
        if max(ticks) <= skip:
            raise DataError(
                f"no tick of the test recordings can be scored: the longest has {max(ticks)} ticks "
                f"before the horizon, the first {skip} are start-up; give longer recordings"
            )
        self.situations = Situations(data)
        speeds, first = QuantileSketch(), self.task.horizons[0]
        for series, count in zip(data.test, ticks, strict=True):
            if count > skip:
                ahead = series.targets[first + skip : first + count].astype(np.float64) * self.factors
                speeds.update(np.abs(ahead))
        # The last half per cent of speeds are single events; they would stretch the bins and leave them empty.
        self.edges = np.linspace(0.0, speeds.quantiles([0.995])[0] or 1.0, SPEED_BINS + 1)

    def truth(self, number: int) -> Values:
        """Return the measured targets of a test series, shape ``(tick, horizon, target)``.

        Samples whose target is beyond the end are omitted.
        """
        series = self.data.test[number]
        ticks = max(0, series.samples - self.task.max_horizon)
        future = np.stack([series.targets[k : k + ticks] for k in self.task.horizons], axis=1)
        return np.asarray(future.astype(np.float64) * self.factors)

    def file(self, models: Mapping[str, ModelScores], left_out: Sequence[str]) -> ScoresFile:
        """Return the scores of all models with the task, its targets and inputs."""
        targets = zip(self.task.targets, self.data.descriptions, self.units, self.factors, strict=True)
        return ScoresFile(
            task=ScoredTask(
                name=self.task.features.name,
                horizons=self.task.horizons,
                rate_hz=self.task.rate_hz,
                mode=str(self.task.mode),
                skip=self.skip,
            ),
            targets=tuple(
                ScoredTarget(name=name, description=text, unit=unit, factor=float(factor))
                for name, text, unit, factor in targets
            ),
            inputs=tuple(
                ScoredInput(name=c.name, unit=KINDS[c.kind].report_unit, factor=float(KINDS[c.kind].report_factor))
                for c in self.data.inputs
            ),
            models=dict(models),
            situation=situation_of(self.data),
            left_out=tuple(left_out),
        )

    def measure(self, predictions: Numbered) -> ModelScores:
        """Return the scores of one model: overall, by recording with spread, by speed and situation.

        And of running integrals.
        """
        return self.scores(self.gathered(predictions))

    def unmeasured(self) -> Measured:
        """Return empty accumulators."""
        return Measured(self.task.targets, len(self.task.horizons), self.edges, self.task.integrate)

    def gathered(self, predictions: Numbered) -> Measured:
        """Return the metrics of predictions of all recordings, or of a part."""
        measured = self.unmeasured()
        for number, values in predictions:
            truth = self.truth(number)
            predicted = values[: len(truth)] * self.factors
            for h, horizon in enumerate(self.task.horizons):
                p, t = self._ticks(predicted[:, h], truth[:, h])
                measured.tallies[h].update(p, t)
                measured.speeds[h].update(p, t)
                self._add_situations(measured.by_situation[h], number, horizon, predicted[:, h], truth[:, h])
                if len(t):
                    measured.recordings.setdefault(number, {})[str(horizon)] = self._score_recording(p, t)
            for target, sums in measured.integrals.items():
                sums += self._integrate_errors(target, predicted, truth)
        return measured

    def scores(self, measured: Measured) -> ModelScores:
        """Return the scores of what all recordings measure together, as `measure` gives them."""
        names = [str(horizon) for horizon in self.task.horizons]
        recordings: dict[str, dict[str, ByTarget]] = {}
        for number in sorted(measured.recordings):
            recordings.setdefault(self.data.test[number].name, {}).update(measured.recordings[number])
        # Of each horizon by recording: `recordings` holds what was scored at all.
        errors = {name: [r[name][MEAN]["mae"] for r in recordings.values() if name in r] for name in names}
        by_situation = zip(names, measured.by_situation, strict=True) if self.situations.axes else ()
        return ModelScores(
            overall={name: tally.scores() for name, tally in zip(names, measured.tallies, strict=True)},
            recordings=recordings,
            spread={name: asdict(spread([x for x in values if x is not None])) for name, values in errors.items()},
            by_speed={name: speed.rows() for name, speed in zip(names, measured.speeds, strict=True)},
            by_situation={name: tally.rows() for name, tally in by_situation},
            integrated={
                target: {"rmse": float(np.sqrt(sums[1] / sums[0]))} for target, sums in measured.integrals.items()
            },
        )

    def new_interval_metrics(self, coverages: Sequence[float]) -> MeasuredIntervals:
        """Return empty accumulators of interval metrics."""
        return MeasuredIntervals((len(self.task.horizons), len(coverages), len(self.task.targets)))

    def gather_intervals(self, bounds: Numbered, coverages: Sequence[float]) -> MeasuredIntervals:
        """Return the metrics of intervals of all recordings, or of a part."""
        measured = self.new_interval_metrics(coverages)
        for number, pairs in bounds:
            truth = self.truth(number)[self.skip :]
            if not len(truth):
                continue
            within = pairs[self.skip : self.skip + len(truth)].astype(np.float64) * self.factors
            measured.ticks += len(truth)
            for h, which, i in np.ndindex(*measured.covered.shape):
                bounds_of = within[:, which, 0, h, i], within[:, which, 1, h, i], truth[:, h, i]
                share, width = interval_scores(*bounds_of)
                measured.scored[h, which, i] += interval_score(*bounds_of, coverages[which]) * len(truth)
                measured.covered[h, which, i] += share * len(truth)
                measured.wide[h, which, i] += width * len(truth)
        return measured

    def intervals(
        self, measured: MeasuredIntervals, coverages: Sequence[float]
    ) -> dict[str, tuple[IntervalScores, ...]]:
        """Share of the truth that each interval holds, its mean width and score, by horizon, coverage and target."""
        ticks = measured.ticks
        return {
            str(horizon): tuple(
                IntervalScores(
                    coverage=coverage,
                    covered=self._name_values(measured.covered[h, which] / ticks),
                    width=self._name_values(measured.wide[h, which] / ticks),
                    score=self._name_values(measured.scored[h, which] / ticks),
                )
                for which, coverage in enumerate(coverages)
            )
            for h, horizon in enumerate(self.task.horizons)
        }

    def _name_values(self, values: Values) -> dict[str, float]:
        return {MEAN: float(np.mean(values)), **dict(zip(self.task.targets, map(float, values), strict=True))}

    def _add_situations(
        self, tally: SituationTally, number: int, horizon: int, predicted: NDArray[Any], truth: NDArray[Any]
    ) -> None:
        """Add one recording's errors at one horizon."""
        if self.situations.axes:
            ticks_of = self.situations.find_masks(self.data.test[number], horizon, len(truth))
            tally.update(np.abs(predicted - truth), self._mask_scored(predicted), ticks_of)

    def _mask_scored(self, predicted: NDArray[Any]) -> NDArray[np.bool_]:
        """Return the ticks after start-up at which the model has its history."""
        # A baseline without its history says NaN; a tick counts only where all targets are predicted.
        scored: NDArray[np.bool_] = np.isfinite(predicted).all(axis=1)
        scored[: self.skip] = False
        return scored

    def _ticks(self, predicted: NDArray[Any], truth: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
        """Return the evaluated samples of both."""
        scored = self._mask_scored(predicted)
        return predicted[scored], truth[scored]

    def _score_recording(self, predicted: NDArray[Any], truth: NDArray[Any]) -> ByTarget:
        """Return all scores of the mean over outputs; of each output errors alone, since runs have many recordings."""
        scores = name_scores(
            self.task.targets, [score(predicted[:, i], truth[:, i]) for i in range(len(self.task.targets))]
        )
        measures = ("mae", "rmse")
        return {
            name: values if name == MEAN else {key: values[key] for key in measures} for name, values in scores.items()
        }

    def _integrate_errors(self, target: str, predicted: NDArray[Any], truth: NDArray[Any]) -> Values:
        """Return the ticks, and sum of the squared error of the running integral, in report unit times seconds."""
        h, column = self.task.horizons.index(0), self.task.targets.index(target)
        difference = (predicted[:, h, column] - truth[:, h, column])[self.skip :]
        # Ticks without a prediction add nothing to the integral; NaN would end it.
        errors = np.nancumsum(difference) / self.task.rate_hz
        return np.array([len(errors), float(np.square(errors).sum())])
