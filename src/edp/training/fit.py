"""Fit a predictor to prepared data: the one training loop, resumable after any epoch."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path

import torch

from edp.data.chunks import Batch, ChunkSampler, Sampler
from edp.data.prepared import Prepared
from edp.data.series import Series
from edp.errors import ConfigError, DataError
from edp.networks.predictor import ModelSpec, build_model, trainable
from edp.networks.streaming import State, detach_state, reset_where
from edp.storage.reading import Table
from edp.storage.runs import KeyedRun
from edp.training.bagging.fit import fit_in_folds
from edp.training.checkpoint import (
    FILE,
    REFIT,
    TrainingPosition,
    Weights,
    Within,
    damaged,
    load_checkpoint,
    save_checkpoint,
)
from edp.training.memory import check_training_memory
from edp.training.objective import Objective
from edp.training.outcome import Diverged, Fitted, TrainingError, TrainingProgress
from edp.training.ridge_start import start_bypass
from edp.training.spec import TrainingSpec, check_training, thread_count, to_gradient_training
from edp.training.strategy import BatchContext, DirectFit, EpisodicStrategy, StreamStrategy, TrainingStrategy
from edp.training.validation import calibrate, validation_scores
from edp.wording import typed


def fit(
    data: Prepared,
    model: ModelSpec,
    spec: TrainingSpec,
    run: KeyedRun | None = None,
    on_event: Callable[[TrainingProgress], None] | None = None,
    strategy: TrainingStrategy | DirectFit | None = None,
) -> Fitted:
    """Train on ``data.train``, choose by ``data.validation``; ``data.test`` is not touched.

    Args:
        data: prepared series.
        model: the network.
        spec: settings of the training.
        run: run folder; with it, a checkpoint after each epoch makes the training resumable.
        on_event: called with progress.
        strategy: weights to begin with, a teacher, or what fits the network by itself; it is part of what the key of
            `run` must tell apart. A strategy has no folds: with it a committee trains by gradient (see
            `to_gradient_training`).

    Raises:
        ConfigError: settings that contradict one another.
        DataError: a recording is shorter than the burn-in.
        Diverged: the loss is not finite any more; it carries the best weights before that.
    """
    torch.set_num_threads(thread_count(spec))
    tell = on_event or (lambda event: None)
    if spec.ensemble is not None and strategy is None:
        return fit_in_folds(data, model, spec, run.folder if run else None, tell)
    if isinstance(strategy, DirectFit):
        direct = strategy.fit_network(data, model, spec, tell)
        if run is not None:
            run.folder.write_history(direct.history)
        return direct
    spec = to_gradient_training(spec)
    fitted = Loop(data, model, spec, run, strategy).fit(tell)
    best = max((row["epoch"] for row in fitted.history if row["best"]), default=0)
    if spec.refit == "none" or not best:
        return fitted
    try:
        again = Loop(data, model, spec, run, strategy, _rows_of_refit(fitted.history, best, spec)).fit(tell)
    except Diverged as end:
        raise Diverged(str(end), fitted, end.facts) from end
    again.predictor.output.load_state_dict(fitted.predictor.output.state_dict())
    return replace(again, history=fitted.history, seconds=fitted.seconds + again.seconds)


def _rows_of_refit(history: list[dict[str, object]], best: int, spec: TrainingSpec) -> list[dict[str, object]]:
    """Return a history row of the first training for each epoch of the refit; the last one covers additional epochs."""
    if spec.refit == "best":
        return history[:best]
    return history + history[-1:] * (spec.epochs - len(history))


class Loop:
    """One training: network, average, optimiser, and position.

    Where `refitted` holds the rows of an earlier training, all segments train, for as many epochs as there are rows;
    what the earlier one validated stands for what cannot be validated any more. With `windowed` what validates is
    predicted from reset over each window, and not as a stream.
    """

    def __init__(
        self,
        data: Prepared,
        model: ModelSpec,
        spec: TrainingSpec,
        run: KeyedRun | None,
        strategy: TrainingStrategy | None = None,
        refitted: list[Table] | None = None,
        windowed: bool = False,
    ) -> None:
        self.data, self.spec, self.run, self.strategy, self.refitted = data, spec, run, strategy, refitted
        self.epochs = spec.epochs if refitted is None else len(refitted)
        self.file = run.folder.path / (FILE if refitted is None else REFIT) if run else None
        self.device = _device(spec.device)
        check_training(data.task, model, spec)
        self.net = build_model(data.task, model, data.scaler(), spec.seed)
        check_training_memory(self.net, data, spec, getattr(strategy, "passes", 1))
        own_series = data.train if refitted is None else [*data.train, *data.validation]
        taught_series = own_series if strategy is None else strategy.series(data.task, own_series)
        self.sampler = self._sampler(taught_series)
        for part in data.validation:
            if part.samples <= spec.chunks.burn_in + data.task.max_horizon:
                raise DataError(
                    f"validation recording '{part.name}' has {part.samples} samples, no more than the burn-in of "
                    f"{spec.chunks.burn_in} plus the horizon of {data.task.max_horizon}; give a longer one"
                )
        if self.net.physics is not None:
            self.net.physics.settle(torch.from_numpy(part.inputs[:]) for part in data.train)
        started = start_bypass(self.net, data.train, data.validation)
        if strategy is not None:
            started = strategy.begin(self.net, spec) or started
        self.net.to(self.device)
        named = [(name, parameter) for name, parameter in self.net.named_parameters() if parameter.requires_grad]
        self.optimizer = spec.optimizer.build(named)
        # Walking the tree of modules at every update would cost as much as a layer.
        self.learned = trainable(self.net)
        self.all: list[torch.Tensor] = list(self.net.parameters())
        self.rates = [group["lr"] for group in self.optimizer.param_groups]
        self.average = {name: tensor.detach().clone() for name, tensor in self.net.named_parameters()}
        self.best = {name: tensor.clone() for name, tensor in self.average.items()}
        self.progress, self.within = TrainingPosition(), Within()
        self.windowed = windowed
        self.objective = Objective(spec, self.net.code)
        self.updates = spec.updates or max(1, self.sampler.updates())
        if started and refitted is None:  # the regression is a candidate itself: training must improve on it
            self.progress.best_score = self._validate()[0]

    def _sampler(self, series: Sequence[Series]) -> Sampler:
        """Create the source of batches: carried chunks or windows, or the strategy's own batches."""
        task, spec = self.data.task, self.spec
        if isinstance(self.strategy, EpisodicStrategy):
            return self.strategy.sampler(series, task, spec)
        return ChunkSampler(series, task.horizons, spec.chunks, spec.seed, spec.augmentations)

    def fit(self, on_event: Callable[[TrainingProgress], None]) -> Fitted:
        self._resume()
        self.go_on(on_event)
        return self.finish()

    def go_on(self, on_event: Callable[[TrainingProgress], None]) -> None:
        """Train to the last epoch, or until the early stop."""
        self.resumed_at, self.rate = self.progress.epoch, 0.0
        seen, busy = 0, 0.0
        while self.progress.epoch < self.epochs and not self._is_stalled():
            began = time.perf_counter()
            seen += self.advance(self.updates, on_event)
            busy += time.perf_counter() - began
            row = self._close_epoch(self.within.loss, time.perf_counter() - began)
            self.rate = seen / busy
            on_event(self._event(self.progress.epoch, self.updates, self.rate, time.perf_counter() - began, row))

    def finish(self) -> Fitted:
        """Return the fitted model after the last epoch; the training cannot continue."""
        return self._make_result()

    def _make_result(self) -> Fitted:
        """Return the network with the best weights until now."""
        with torch.no_grad():
            for name, parameter in self.net.named_parameters():
                parameter.copy_(self.best[name])
        if self.net.spec.output.calibrated and self.refitted is None:
            calibrate(self.net, self.data.validation, self.spec)
        if self.strategy is not None:
            self.strategy.end(self.net)
        return Fitted(self.net.eval(), self.progress.history, self.progress.seconds, self.rate, self.resumed_at)

    def _divergence_error(self, what: str, value: float) -> Diverged:
        progress = self.progress
        best_rows = [row for row in progress.history if row["epoch"] == progress.best_epoch]
        if self.refitted is not None:
            saved = "this was the refit; the weights of the first training are kept"
        elif best_rows:
            error = f"validation MAE {typed(best_rows[0]['validation_mae'])}"
            saved = f"the weights of epoch {progress.best_epoch} ({error}) are kept"
        elif math.isfinite(progress.best_score):
            saved = "the weights of the start are kept"
        else:
            saved = "no epoch was finished before, so nothing is kept"
        facts = {
            "epoch": progress.epoch + 1,
            "update": progress.updates,
            "kept_epoch": progress.best_epoch if math.isfinite(progress.best_score) else None,
        }
        return Diverged(
            f"{what} is {value} at update {progress.updates} (epoch {facts['epoch']}): the training diverged; {saved}. "
            "Lower the learning rate or clip_norm, or look for outliers with edp data check",
            self._make_result() if math.isfinite(progress.best_score) else None,
            facts,
        )

    def _resume(self) -> None:
        checkpoint = load_checkpoint(self.file, self.run.key) if self.run and self.file else None
        if checkpoint is None:
            return
        self.progress, weights, optimizer = checkpoint
        try:
            self.objective.running.copy_(weights.running)
            with torch.no_grad():
                for name, parameter in self.net.named_parameters():
                    parameter.copy_(weights.current[name])
                    self.average[name].copy_(weights.average[name])
                    self.best[name].copy_(weights.best[name])
            self.optimizer.load_state_dict(optimizer)
        except (KeyError, TypeError, ValueError, RuntimeError) as error:
            raise damaged(self.file or Path(FILE), error) from error

    def _is_stalled(self) -> bool:
        waited = self.progress.epoch - self.progress.best_epoch
        return self.refitted is None and 0 < self.spec.patience <= waited and self.spec.average.may_stop()

    def _batches(self) -> Iterator[Batch]:
        """Yield exactly `updates` batches; the order depends only on the seed and the epoch."""
        passes, batches = 0, 0
        while batches < self.updates:
            for batch in self.sampler.epoch(self.progress.epoch * 1000 + passes):  # orders of epochs do not meet
                yield batch
                batches += 1
                if batches == self.updates:
                    return
            passes += 1

    def advance(self, until: int, on_event: Callable[[TrainingProgress], None]) -> int:
        """Go on to an update of this epoch; ticks with a loss that were seen on the way."""
        within = self.within
        if not within.updates:
            # Dropout must not depend on how often the run was stopped: each epoch has its own seed.
            torch.manual_seed(self.spec.seed * 100_003 + self.progress.epoch)  # prime: seeds do not meet
        self.net.train()
        seen, began, shown = 0, time.perf_counter(), time.perf_counter()
        for batch in islice(self._batches(), within.updates, until):
            loss, within.stream = self._update(batch, within.stream)
            within.total += loss
            within.updates += 1
            seen += batch.targets_seen
            now = time.perf_counter()
            if now - shown > 0.5:  # seconds
                shown = now
                on_event(self._event(self.progress.epoch + 1, within.updates, seen / (now - began), now - began, None))
        return seen

    def pause(self) -> Fitted:
        """End training before the current epoch is complete and return the model with the best weights until now."""
        self.resumed_at, self.rate = self.progress.epoch, 0.0
        self.progress.history.append(self._judge_epoch(self.within.loss))
        return self._make_result()

    def _update(self, batch: Batch, state: State | None) -> tuple[float, State]:
        x, reset = (torch.from_numpy(part).to(self.device) for part in (batch.inputs, batch.reset))
        initial = self.net.initial_state(len(x), x)
        goes_on = len(x) == self.spec.chunks.batch and self.spec.chunks.regime != "window"
        state = reset_where(reset, initial, state) if state is not None and goes_on else initial
        for group, rate in zip(self.optimizer.param_groups, self.rates, strict=True):
            group["lr"] = rate * self._factor()
        future, valid = (torch.from_numpy(part).to(self.device) for part in (batch.future, batch.valid))
        if isinstance(self.strategy, EpisodicStrategy):
            loss = self.strategy.episode(self.net, self.objective, (x, future, valid))
        else:
            columns = batch.strategy_columns
            taught = None if columns is None else torch.from_numpy(columns).to(self.device)
            if taught is not None and isinstance(self.strategy, StreamStrategy):
                self.strategy.tell(self.net, taught, reset)
            answer, features, hidden, state = self.net.forward_features(x, state)
            if self.strategy is None or taught is None:
                loss = self.objective.evaluate(answer, future, features, valid)
            else:
                done = self.progress.updates / (self.updates * self.spec.epochs)
                parts = BatchContext(answer, future, features, hidden, valid, taught, done)
                loss = self.strategy.loss(self.objective, parts)
        self.progress.updates += 1
        value = float(loss.detach())
        if not math.isfinite(value):
            raise self._divergence_error("the training loss", value)
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.learned, self.spec.clip_norm)
        self.optimizer.step()
        self._follow()
        return value, detach_state(state)

    def _factor(self) -> float:
        """Share of the base learning rate at the coming update."""
        done, total = self.progress.updates, self.updates * self.spec.epochs
        factor = self.spec.schedule.rate_factor(done / total, self.progress.schedule)
        return self.spec.average.rate_factor(factor, done + 1, total)

    def _follow(self) -> None:
        """Move the average towards the weights."""
        step = self.spec.average.step(self.progress.updates, self.updates * self.spec.epochs)
        targets = list(self.average.values())
        with torch.no_grad():
            torch._foreach_lerp_(targets, self.all, step)

    def _close_epoch(self, loss: float, seconds: float) -> dict[str, object] | None:
        """Validate and select after an epoch, and store the training position; return the history row."""
        progress = self.progress
        row = None
        if self.refitted is None:
            row = self._judge_epoch(loss)
        else:
            score = self.refitted[progress.epoch]["validation_score"]
            progress.best_score, progress.best_epoch = score, progress.epoch + 1
            self.best = {name: tensor.clone() for name, tensor in self.average.items()}
            self.spec.schedule.observe(score, progress.schedule)
        progress.epoch += 1
        progress.seconds += seconds
        self.within = Within()
        if row is not None:
            row["seconds"] = round(progress.seconds, 3)
            progress.history.append(row)
        if self.run and self.file:
            weights = Weights(dict(self.net.named_parameters()), self.average, self.best, self.objective.running)
            save_checkpoint(self.file, self.run.key, progress, weights, self.optimizer)
            if row is not None:
                self.run.folder.write_history(progress.history)
        return row

    def _judge_epoch(self, loss: float) -> dict[str, object]:
        """Validate the averaged weights and keep them if they are the best until now."""
        progress = self.progress
        score, report, validation_loss = self._validate()
        for what, value in (("score", score), ("loss", validation_loss)):
            if not math.isfinite(value):
                raise self._divergence_error(f"the validation {what}", value)
        better = score < progress.best_score
        if better:
            progress.best_score, progress.best_epoch = score, progress.epoch + 1
            self.best = {name: tensor.clone() for name, tensor in self.average.items()}
        self.spec.schedule.observe(score, progress.schedule)
        return {
            "epoch": progress.epoch + 1,
            "updates": progress.updates,
            "train_loss": loss,
            "validation_loss": validation_loss,
            "validation_score": score,
            "validation_mae": report,
            "learning_rate": self.optimizer.param_groups[0]["lr"],
            "seconds": 0.0,
            "best": better,
        }

    def _validate(self) -> tuple[float, float, float]:
        """Return the standardised and reported mean absolute error of the averaged weights, and their loss."""
        current_weights = {name: parameter.detach().clone() for name, parameter in self.net.named_parameters()}
        with torch.no_grad():
            for name, parameter in self.net.named_parameters():
                parameter.copy_(self.average[name])
        try:
            if isinstance(self.strategy, EpisodicStrategy):
                return self.strategy.judge(self.net, self.objective, self.data)
            return validation_scores(self.net, self.data.validation, self.spec, self.data, self.windowed)
        finally:
            with torch.no_grad():
                for name, parameter in self.net.named_parameters():
                    parameter.copy_(current_weights[name])

    def _event(
        self, epoch: int, update: int, rate: float, seconds: float, row: dict[str, object] | None
    ) -> TrainingProgress:
        done = (epoch - 1) * self.updates + update
        left = max(0, self.epochs * self.updates - done)
        return TrainingProgress(
            epoch,
            self.epochs,
            update,
            self.updates,
            rate,
            left * seconds / max(1, update),
            row,
            self.refitted is not None,
        )


def _device(name: str) -> torch.device:
    if name == "cuda" and not torch.cuda.is_available():
        raise ConfigError("training: device = 'cuda' but no CUDA device is present; use device = 'auto' or 'cpu'")
    return torch.device("cuda" if name != "cpu" and torch.cuda.is_available() else "cpu")


__all__ = [
    "Diverged",
    "Fitted",
    "TrainingError",
    "TrainingProgress",
    "TrainingSpec",
    "fit",
    "validation_scores",
]
