"""One training of a search: a plain order in, a plain record out, so that any process on any machine can do it."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import lru_cache
from itertools import pairwise
from typing import Any

import numpy as np

from edp.config.experiment import Experiment, build, plain_tree
from edp.data.prepared import Prepared, prepare
from edp.data.splits import ByRecording, Split, Stretch
from edp.errors import ConfigError, DataError
from edp.evaluation.footprint import parameters_and_macs
from edp.evaluation.judge import JudgeSpec, judge, score_predictions
from edp.evaluation.mac_check import check_counted
from edp.evaluation.scores_file import MEAN, ByHorizon, metric
from edp.logs.source import DataSource
from edp.networks.predictor import build_model
from edp.networks.running import window_predictions
from edp.recording import Recording
from edp.settings.bounds import MAX_EPOCHS, MAX_UPDATES, SEED, check_bounds, integer
from edp.storage.ledger import Record
from edp.training.bundle import blank_scaler
from edp.training.parts import fit_part
from edp.workflows.search.arms import Arm

SCORES = ("mae", "rmse", "p95", "p99", "composite")
SessionScores = dict[str, dict[str, dict[str, float]]]
"""Scores by session and horizon, report units, means over outputs."""


@dataclass(frozen=True)
class TrainingRequest:
    """Training to perform and evaluate; equal requests give equal records.

    Attributes:
        settings: the whole experiment as plain tables (`edp.workflows.search.arms.Arm`); its split is not used.
        source: result of `DataSource.to_dict`.
        train: names of the sessions that train.
        judged: names of the sessions that evaluate; none of them trains, and with one epoch none chooses anything.
        seed: root of every random choice of the training.
        updates: training steps over all epochs; 0 with several epochs makes each of them one pass over the data.
        until: the step after which this part of the training ends and is evaluated, or with several epochs the epoch;
            None for the end. A part goes on to the same bits as a training without a stop.
        stops: possible ends of earlier parts; they affect no result and are not part of a key.
        epochs: one for a training without an early stop, so that no session that evaluates has a say.
        patience: epochs without a better validation score before an early stop; 0 never.
        validation: names of the sessions that validate after each of several epochs; they may be those that evaluate,
            as in the thesis, and do not train.
        recipe: what is made of the network in phase 6 (`edp.workflows.search.smaller.Recipe`), plain; None in the other
            phases.
    """

    settings: Mapping[str, object]
    source: Mapping[str, object]
    train: tuple[str, ...]
    judged: tuple[str, ...]
    seed: int
    updates: int
    until: int | None = None
    stops: tuple[int, ...] = ()
    epochs: int = 1
    patience: int = 0
    validation: tuple[str, ...] = ()
    recipe: Mapping[str, object] | None = None

    def __post_init__(self) -> None:
        both = sorted(set(self.train) & {*self.judged, *self.validation})
        if both:
            raise ConfigError(f"order: {', '.join(both)} would train and judge or validate; each session must do one")
        if not self.train or not self.judged:
            raise ConfigError(
                f"order: {len(self.train)} sessions train, {len(self.judged)} judge; at least one of each must hold"
            )
        self._check_length()
        length, what = (self.updates, "updates") if self.epochs == 1 else (self.epochs, "epochs")
        steps = [*self.stops, length if self.until is None else self.until]
        if steps[0] < 1 or any(a >= b for a, b in pairwise(steps)) or (self.until or 0) >= length:
            raise ConfigError(
                f"order: stops {list(self.stops)} and an end at {self.until} of {length} {what}; steps from 1 "
                "on, each after the one before and all before the last, must hold"
            )

    def _check_length(self) -> None:
        check_bounds("order", self, seed=SEED, epochs=integer(1, MAX_EPOCHS), patience=integer(0, MAX_EPOCHS))
        check_bounds("order", self, updates=integer(1 if self.epochs == 1 else 0, MAX_UPDATES))
        if self.updates % self.epochs:
            raise ConfigError(
                f"order: updates = {self.updates} in {self.epochs} epochs; a multiple of them, or 0 for passes over "
                "the data, must hold"
            )
        if (self.epochs > 1) != bool(self.validation):
            raise ConfigError(
                f"order: {self.epochs} epochs and {len(self.validation)} sessions that validate; several epochs need "
                "some, and one has none"
            )

    @property
    def whole(self) -> TrainingRequest:
        """Return the training of which this is a part."""
        return replace(self, until=None, stops=())

    def to_json(self) -> dict[str, object]:
        """Return the request in JSON types; `from_json` is the inverse."""
        return dict(plain_tree(self))

    @staticmethod
    def from_json(plain: Mapping[str, object]) -> TrainingRequest:
        """Return the request from the result of `to_json`; other keys are ignored.

        Raises:
            ConfigError: a value that is missing or of another kind.
        """
        names = [part.name for part in fields(TrainingRequest) if part.name in plain]
        return build(TrainingRequest, {name: plain[name] for name in names}, "of an order")


@dataclass(frozen=True)
class Outcome:
    """Outcome of a request.

    Attributes:
        order: request of the training.
        status: ``done``, or how it ended.
        result: result of `TrainedPart`, if it is complete.
        message: error message.
    """

    order: TrainingRequest
    status: str
    result: Mapping[str, Any] | None = None
    message: str = ""

    @staticmethod
    def from_record(order: TrainingRequest, record: Record) -> Outcome:
        """Return the outcome of a request from the ledger's record."""
        return Outcome(order, str(record.status), record.result, record.message)

    def score(self, session: str, horizon: int, name: str = "composite") -> float:
        """Return a score on one session; NaN for a failed training, which counts as the worst."""
        if self.result is None:
            return float("nan")
        return float(self.result["sessions"][session][str(horizon)][name])

    def mean(self, horizon: int, name: str = "composite") -> float:
        """Return a score, mean over the evaluation sessions; NaN for a failed training."""
        return float(np.mean([self.score(session, horizon, name) for session in self.order.judged]))


@dataclass(frozen=True)
class TrainedPart:
    """Finished training, or a part of a training.

    Attributes:
        result: for JSON. ``sessions``: for each evaluation session its scores at each horizon, report units, mean over
            targets; ``scores``: their means over sessions; ``parameters``, ``macs_tick``, and more where it applies.
        state: state from which the next part continues; None at the end.
    """

    result: dict[str, object]
    state: bytes | None = None


def train_part(order: TrainingRequest, start: bytes | None = None) -> TrainedPart:
    """Train and evaluate a request, which may be a part of a training.

    Args:
        order: training to run.
        start: state of an earlier part; it saves the time to come there, and changes nothing else.

    Raises:
        ConfigError: settings that contradict one another or the data.
        DataError: a session is missing or cannot be read.
        Diverged: the loss was not finite any more.
    """
    experiment = experiment_of(order)
    data = prepared(order, experiment)
    windowed = order.epochs > 1 and experiment.training.chunks.regime == "window"
    fitted, state = fit_part(data, experiment.model, experiment.training, order.until, start, windowed)
    spec = JudgeSpec(baselines=(), warmup_samples=experiment.evaluation.warmup_samples)
    if windowed:
        # Windows have no start-up of their own; the first whole one ends at the window's last tick.
        skip = max(spec.warmup_samples or 0, experiment.model.window, data.task.features.init_samples)
        by_recording = score_predictions(window_predictions(fitted.predictor, data.test), data, skip).recordings
    else:
        by_recording = judge(fitted.predictor, data, spec, "").scores.models["network"].recordings
    sessions = session_scores(by_recording)
    parameters, macs_tick = parameters_and_macs(fitted.predictor.costs())
    result: dict[str, object] = {
        "sessions": sessions,
        "scores": mean_scores(sessions),
        "parameters": parameters,
        "macs_tick": macs_tick,
        "train_loss": fitted.history[-1]["train_loss"],
    }
    if order.epochs > 1:
        rows = fitted.history
        result |= {"epochs": len(rows), "best_epoch": max((row["epoch"] for row in rows if row["best"]), default=0)}
    return TrainedPart(result, state)


def experiment_of(order: TrainingRequest) -> Experiment:
    """Return the experiment that a request trains.

    With one long epoch schedules run to their end and nothing is chosen; with several, each is validated.
    """
    experiment = Arm(order.settings).experiment()
    training = replace(
        experiment.training,
        epochs=order.epochs,
        updates=order.updates // order.epochs,
        patience=order.patience,
        # A refit would train on the sessions that judge.
        refit="none",
        seed=order.seed,
    )
    return replace(experiment, training=training)


def session_scores(recordings: Mapping[str, ByHorizon]) -> SessionScores:
    """Return the means over outputs of the scores by recording and horizon that `score_predictions` gives."""
    return {
        name: {
            horizon: {score: metric(scores[MEAN], score) for score in SCORES} for horizon, scores in horizons.items()
        }
        for name, horizons in recordings.items()
    }


def mean_scores(sessions: Mapping[str, Mapping[str, Mapping[str, float]]]) -> dict[str, float]:
    """Return the mean of each score over sessions and horizons."""
    rows = [scores for horizons in sessions.values() for scores in horizons.values()]
    return {name: sum(row[name] for row in rows) / len(rows) for name in SCORES}


def prepared(order: TrainingRequest, experiment: Experiment) -> Prepared:
    """Return the series of a request: training, validation and evaluation sessions.

    Raises:
        ConfigError: settings that contradict the data.
        DataError: a session is missing or cannot be read.
    """
    recordings = {recording.name: recording for recording in _recordings(json.dumps(order.source, sort_keys=True))}
    needed = dict.fromkeys((*order.train, *order.validation, *order.judged))
    missing = [name for name in needed if name not in recordings]
    if missing:
        raise DataError(
            f"'{order.source['path']}' has no session {', '.join(missing)}; the data changed since the search began: "
            "restore them, or begin another search"
        )
    chosen = [recordings[name] for name in needed]
    first = chosen[0]
    task = experiment.task.resolve(first.rate_hz, first.channel_names, experiment.model.physics)
    if len(order.train) == 1:
        raise DataError("a search needs two training sessions or more; give more recordings or fewer folds")
    if order.validation:
        data = prepare(chosen, task, _Named(order.train, order.validation, order.judged), experiment.model.window)
        return data
    # A training needs a part that validates; with one epoch it decides nothing, so it is one of those that train.
    # The first training session stands in as validation part, since every training has one.
    split = ByRecording(validation=order.train[:1], test=order.judged)
    data = prepare(chosen, task, split, experiment.model.window)
    return replace(data, train=[*data.validation, *data.train])


@dataclass(frozen=True)
class _Named:
    """Split of whole sessions by name; validation and evaluation sessions may coincide, which `ByRecording` refuses."""

    train: tuple[str, ...]
    validation: tuple[str, ...]
    judged: tuple[str, ...]

    def split(self, recordings: Sequence[Recording], gap: int) -> Split:
        """Return every session whole."""
        whole = {recording.name: Stretch(i, 0, recording.samples) for i, recording in enumerate(recordings)}
        parts = (self.train, self.validation, self.judged)
        return Split(*(tuple(whole[name] for name in part) for part in parts))


# Text as a key: `lru_cache` needs something that can be hashed.
# One source: a worker serves one search, and two data sets might not fit in memory.
@lru_cache(maxsize=1)
def _recordings(source: str) -> Sequence[Recording]:
    """Return the recordings of a source, cached for repeated trainings in this process."""
    return DataSource.from_dict(json.loads(source)).read()


def costs_of(arm: Arm, channels: Sequence[str] = ()) -> dict[str, float]:
    """Return analytic costs of the network of an arm, before anything is trained: parameters, MACs of a tick.

    Raises:
        ConfigError: settings that cannot be, or a part that counts other work than it does.
    """
    return dict(_costs(json.dumps(arm.tables, sort_keys=True), tuple(channels)))


# A study that goes on asks for the costs of all its networks again, and phases ask for those of the same network.
@lru_cache(maxsize=1024)
def _costs(settings: str, channels: tuple[str, ...]) -> Mapping[str, float]:
    experiment = Arm(json.loads(settings)).experiment()
    task = experiment.task.resolve(100.0, channels, experiment.model.physics)
    # Weights do not matter to counts; building takes milliseconds, training minutes.
    network = build_model(task, experiment.model, blank_scaler(task), seed=0)
    check_counted(network)
    parameters, macs_tick = parameters_and_macs(network.costs())
    return {"parameters": float(parameters), "macs_tick": float(macs_tick)}
