"""Fit a predictor to prepared data: the one training loop, resumable after any epoch."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from edp.data.chunks import Batch, ChunkSampler, ChunkSpec
from edp.data.prepared import Prepared
from edp.data.series import Series
from edp.errors import ConfigError, DataError, EdpError
from edp.losses import Huber, LossSpec, masked_loss, output_weights
from edp.models.predictor import ModelSpec, Predictor, build_model, trainable
from edp.models.running import stream_answers
from edp.runs import RunFolder
from edp.signals import KINDS
from edp.streaming import State, detach_state, reset_where
from edp.training.checkpoint import Progress, Weights, load_checkpoint, save_checkpoint
from edp.training.optimizers import AdamW, OptimizerSpec
from edp.training.ridge_start import start_bypass
from edp.training.schedules import Cosine, ScheduleSpec


class TrainingError(EdpError):
    """Training cannot go on."""


@dataclass(frozen=True, kw_only=True)
class TrainingSpec:
    """How to train.

    Attributes:
        chunks: chunk or window regime, lengths, batch.
        loss: a registered loss.
        weight_power: p of the per-output weights (eq. 3.31); 0 for standardised targets.
        optimizer: a registered optimiser.
        schedule: a registered learning-rate schedule.
        epochs: the longest training.
        updates: updates per epoch; 0 for one pass over the data.
        patience: epochs without a better validation score before an early stop; 0 never stops early.
        clip_norm: largest global gradient norm.
        ema: decay of the weight average that is validated and kept; 0 keeps the weights themselves.
        seed: root of every random choice.
        threads: CPU threads, 0 for all cores; more than one pays for wide networks on an idle machine only, and
            another count gives other bits.
        device: ``auto``, ``cpu`` or ``cuda``.

    Raises:
        ConfigError: a value out of range.
    """

    chunks: ChunkSpec = field(default_factory=ChunkSpec)
    loss: LossSpec = field(default_factory=Huber)
    weight_power: float = 0.0
    optimizer: OptimizerSpec = field(default_factory=AdamW)
    schedule: ScheduleSpec = field(default_factory=Cosine)
    epochs: int = 20
    updates: int = 0
    patience: int = 8
    clip_norm: float = 1.0
    ema: float = 0.995
    seed: int = 0
    threads: int = 1
    device: str = "auto"

    def __post_init__(self) -> None:
        if self.epochs < 1 or self.updates < 0 or self.patience < 0 or self.threads < 0:
            raise ConfigError(
                f"training: epochs = {self.epochs} (at least 1), updates = {self.updates}, patience = "
                f"{self.patience}, threads = {self.threads} (all at least 0) must hold"
            )
        if not self.clip_norm > 0 or not 0 <= self.ema < 1:
            raise ConfigError(f"training: clip_norm = {self.clip_norm} > 0 and 0 <= ema = {self.ema} < 1 must hold")
        if self.device not in ("auto", "cpu", "cuda"):
            raise ConfigError(f"training: device = '{self.device}'; 'auto', 'cpu' or 'cuda' must hold")


@dataclass(frozen=True)
class Event:
    """Progress of a training, for displays: after every few updates and after each epoch."""

    epoch: int
    epochs: int
    update: int
    updates: int
    targets_per_s: float
    seconds_left: float
    row: dict[str, Any] | None = None


@dataclass(frozen=True, eq=False)
class Fitted:
    """A trained predictor with its history.

    Attributes:
        predictor: with the best weights, in evaluation mode.
        history: a row per epoch.
        seconds: training time over all sittings.
        targets_per_s: ticks with a loss per second of the update loop in this sitting.
        resumed_at: epoch at which this sitting began.
    """

    predictor: Predictor
    history: list[dict[str, Any]]
    seconds: float
    targets_per_s: float
    resumed_at: int


def fit(
    data: Prepared,
    model: ModelSpec,
    spec: TrainingSpec,
    run: tuple[RunFolder, str] | None = None,
    on_event: Callable[[Event], None] | None = None,
) -> Fitted:
    """Train on ``data.train``, choose by ``data.validation``; ``data.test`` is not touched.

    Args:
        data: prepared series.
        model: the network.
        spec: how to train.
        run: folder and key of the run; where given, a checkpoint after each epoch makes it resumable.
        on_event: called with progress.

    Raises:
        DataError: a recording is shorter than the burn-in.
        TrainingError: the loss is not finite.
    """
    torch.set_num_threads(thread_count(spec))
    return _Loop(data, model, spec, run).fit(on_event or (lambda event: None))


def thread_count(spec: TrainingSpec) -> int:
    """CPU threads that a training uses."""
    return spec.threads or os.cpu_count() or 1


class _Loop:
    """One training: the net, its average, the optimiser, and where it stands."""

    def __init__(self, data: Prepared, model: ModelSpec, spec: TrainingSpec, run: tuple[RunFolder, str] | None) -> None:
        self.data, self.spec, self.run = data, spec, run
        self.device = _device(spec.device)
        self.sampler = ChunkSampler(data.train, data.task.horizons, spec.chunks, spec.seed)
        for part in data.validation:
            if part.samples <= spec.chunks.burn_in + data.task.reach:
                raise DataError(
                    f"validation recording '{part.name}' has {part.samples} samples, no more than the burn-in of "
                    f"{spec.chunks.burn_in} plus the horizon of {data.task.reach}; give a longer one"
                )
        scaler = data.scaler()
        self.net = build_model(data.task, model, scaler, spec.seed)
        started = start_bypass(self.net, data.train, data.validation)
        self.net.to(self.device)
        named = [(name, parameter) for name, parameter in self.net.named_parameters() if parameter.requires_grad]
        self.optimizer = spec.optimizer.build(named)
        self.rates = [group["lr"] for group in self.optimizer.param_groups]
        self.average = {name: tensor.detach().clone() for name, tensor in self.net.named_parameters()}
        self.best = {name: tensor.clone() for name, tensor in self.average.items()}
        self.progress = Progress()
        sigma = torch.tensor(scaler.target_scale, dtype=torch.float32, device=self.device)
        self.weights = output_weights(sigma, spec.weight_power)
        self.updates = spec.updates or max(1, self.sampler.updates())
        if started:  # The regression is a candidate itself: training must improve on it to be kept.
            self.progress.best_score = self._validate()[0]

    def fit(self, on_event: Callable[[Event], None]) -> Fitted:
        self._resume()
        resumed_at, seen, busy = self.progress.epoch, 0, 0.0
        while self.progress.epoch < self.spec.epochs and not self._stalled():
            began = time.perf_counter()
            loss, targets = self._epoch(on_event)
            busy += time.perf_counter() - began
            seen += targets
            row = self._close_epoch(loss, time.perf_counter() - began)
            on_event(self._event(self.progress.epoch, self.updates, seen / busy, time.perf_counter() - began, row))
        with torch.no_grad():
            for name, parameter in self.net.named_parameters():
                parameter.copy_(self.best[name])
        rate = seen / busy if busy else 0.0
        return Fitted(self.net.eval(), self.progress.history, self.progress.seconds, rate, resumed_at)

    def _resume(self) -> None:
        held = load_checkpoint(self.run[0].path, self.run[1]) if self.run else None
        if held is None:
            return
        self.progress, weights, optimizer = held
        with torch.no_grad():
            for name, parameter in self.net.named_parameters():
                parameter.copy_(weights.current[name])
                self.average[name].copy_(weights.average[name])
                self.best[name].copy_(weights.best[name])
        self.optimizer.load_state_dict(optimizer)

    def _stalled(self) -> bool:
        waited = self.progress.epoch - self.progress.best_epoch
        return 0 < self.spec.patience <= waited

    def _batches(self) -> Iterator[Batch]:
        """Exactly `updates` batches; the order depends on the seed and the epoch alone."""
        passes, given = 0, 0
        while given < self.updates:
            for batch in self.sampler.epoch(self.progress.epoch * 1000 + passes):
                yield batch
                given += 1
                if given == self.updates:
                    return
            passes += 1

    def _epoch(self, on_event: Callable[[Event], None]) -> tuple[float, int]:
        # Dropout must not depend on how often the run was stopped: each epoch has its own seed.
        torch.manual_seed(self.spec.seed * 100_003 + self.progress.epoch)
        self.net.train()
        state: State | None = None
        total, seen, began, shown = 0.0, 0, time.perf_counter(), time.perf_counter()
        for number, batch in enumerate(self._batches(), start=1):
            loss, state = self._update(batch, state)
            total += loss
            seen += batch.targets_seen
            now = time.perf_counter()
            if now - shown > 0.5:
                shown = now
                on_event(self._event(self.progress.epoch + 1, number, seen / (now - began), now - began, None))
        return total / self.updates, seen

    def _update(self, batch: Batch, state: State | None) -> tuple[float, State]:
        x = torch.from_numpy(batch.inputs).to(self.device)
        reset = torch.from_numpy(batch.reset).to(self.device)
        initial = self.net.initial_state(len(x), x)
        if state is None or len(x) != self.spec.chunks.batch or self.spec.chunks.regime == "window":
            state = initial
        else:
            state = reset_where(reset, initial, state)
        share = self.progress.updates / (self.updates * self.spec.epochs)
        factor = self.spec.schedule.factor(share, self.progress.schedule)
        for group, rate in zip(self.optimizer.param_groups, self.rates, strict=True):
            group["lr"] = rate * factor
        answer, features, state = self.net.run(x, state)
        target = self.net.code.encode(torch.from_numpy(batch.future).to(self.device), features)
        valid = torch.from_numpy(batch.valid).to(self.device)
        loss = masked_loss(self.spec.loss, answer, target, valid, self.weights)
        value = float(loss.detach())
        if not math.isfinite(value):
            raise TrainingError(
                f"the training loss is {value} at update {self.progress.updates + 1}: the training diverged; lower "
                "the learning rate or clip_norm, or look for outliers with edp inspect"
            )
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(trainable(self.net), self.spec.clip_norm)
        self.optimizer.step()
        self.progress.updates += 1
        self._follow()
        return value, detach_state(state)

    def _follow(self) -> None:
        """Move the average towards the weights; young averages move faster."""
        count = self.progress.updates
        decay = min(self.spec.ema, (1 + count) / (10 + count)) if self.spec.ema else 0.0
        targets = list(self.average.values())
        with torch.no_grad():
            current = [parameter.detach() for parameter in self.net.parameters()]
            torch._foreach_lerp_(targets, current, 1.0 - decay)

    def _close_epoch(self, loss: float, seconds: float) -> dict[str, Any]:
        progress = self.progress
        score, report, validation_loss = self._validate()
        progress.epoch += 1
        progress.seconds += seconds
        better = score < progress.best_score
        if better:
            progress.best_score, progress.best_epoch = score, progress.epoch
            self.best = {name: tensor.clone() for name, tensor in self.average.items()}
        self.spec.schedule.observe(score, progress.schedule)
        row = {
            "epoch": progress.epoch,
            "updates": progress.updates,
            "train_loss": loss,
            "validation_loss": validation_loss,
            "validation_score": score,
            "validation_mae": report,
            "learning_rate": self.optimizer.param_groups[0]["lr"],
            "seconds": round(progress.seconds, 3),
            "best": better,
        }
        progress.history.append(row)
        if self.run:
            weights = Weights(dict(self.net.named_parameters()), self.average, self.best)
            save_checkpoint(self.run[0].path, self.run[1], progress, weights, self.optimizer)
            self.run[0].write_history(progress.history)
        return row

    def _validate(self) -> tuple[float, float, float]:
        """Standardised and reported mean absolute error of the averaged weights, and their loss."""
        held = {name: parameter.detach().clone() for name, parameter in self.net.named_parameters()}
        with torch.no_grad():
            for name, parameter in self.net.named_parameters():
                parameter.copy_(self.average[name])
        try:
            return validation_scores(self.net, self.data.validation, self.spec, self.data)
        finally:
            with torch.no_grad():
                for name, parameter in self.net.named_parameters():
                    parameter.copy_(held[name])

    def _event(self, epoch: int, update: int, rate: float, seconds: float, row: dict[str, Any] | None) -> Event:
        done = (epoch - 1) * self.updates + update
        left = max(0, self.spec.epochs * self.updates - done)
        return Event(epoch, self.spec.epochs, update, self.updates, rate, left * seconds / max(1, update), row)


def validation_scores(
    net: Predictor, series: list[Series], spec: TrainingSpec, data: Prepared
) -> tuple[float, float, float]:
    """Mean absolute error in standard deviations, in report units, and the loss, streamed over `series`."""
    scale = net.code.width.detach().cpu().double()
    factors = torch.tensor([KINDS[kind].report_factor for kind in data.target_kinds], dtype=torch.float64)
    skip = spec.chunks.burn_in if spec.chunks.regime == "chunk" else net.spec.window - 1
    absolute, count, loss = torch.zeros_like(scale), 0, 0.0
    for part, said in zip(series, stream_answers(net, series), strict=True):
        target = standard_targets(net, part)[:, skip:]
        ticks = slice(skip, skip + target.shape[1])
        answer = replace(said, center=said.center[:, ticks], spread=said.spread[:, ticks])
        absolute += (answer.center - target).abs().sum(dim=(0, 1)) * scale
        count += target.shape[1]
        loss += float(spec.loss.evaluate(answer, target).mean(dim=(-1, -2)).sum())
    mean = absolute / max(1, count)
    return float((mean / scale).mean()), float((mean * factors).mean()), loss / max(1, count)


def standard_targets(net: Predictor, part: Series) -> Tensor:
    """Targets of a whole series as the network is trained on them, ``(1, tick, horizon, output)``, double precision.

    Ticks whose targets lie beyond the end are left out.
    """
    ticks = part.samples - net.task.reach
    future = np.stack([part.targets[k : k + ticks] for k in net.task.horizons], axis=1)
    like = next(net.parameters())
    x = torch.from_numpy(part.inputs[:ticks]).unsqueeze(0).to(like)
    with torch.inference_mode():
        features, _ = net.front(x, net.front.initial_state(1, x))
        return net.code.encode(torch.from_numpy(future).unsqueeze(0).to(like), features).cpu().double()


def _device(name: str) -> torch.device:
    if name == "cuda" and not torch.cuda.is_available():
        raise ConfigError("training: device = 'cuda' but no CUDA device is present; use device = 'auto' or 'cpu'")
    return torch.device("cuda" if name != "cpu" and torch.cuda.is_available() else "cpu")


__all__ = ["Event", "Fitted", "TrainingError", "TrainingSpec", "fit", "thread_count", "validation_scores"]
