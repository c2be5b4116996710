"""Training of a twin on free runs from measured starts everywhere in the recordings.

One-step networks drift when they are fed back. Here the loss is taken on the run itself, first short and then longer,
through the compiled loop and its adjoint; ports stay measured by chance, so that one set of weights serves all modes.
"""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from edp.data.series import Series
from edp.errors import ConfigError, DataError, NotFiniteError
from edp.networks.losses.huber import huber
from edp.networks.twin import Twin, even_starts
from edp.networks.twin.recurrent import RecurrentTwin
from edp.networks.twin.recurrent_cell import CellWeights
from edp.networks.twin.residual import ResidualTwin
from edp.networks.twin.windows import MeasuredWindows, random_windows
from edp.settings.bounds import (
    MAX_BATCH,
    MAX_NAMES,
    MAX_UPDATES,
    MOST_TICKS,
    SEED,
    SHARE,
    WEIGHT,
    above,
    check_bounds,
    check_count,
    integer,
)
from edp.storage.runs import KeyedRun
from edp.training.blas import one_blas_thread
from edp.training.checkpoint import FILE, TrainingPosition, Weights, damaged, load_checkpoint, save_checkpoint
from edp.training.fitted_twin import FittedTwin, FreeRunProgress
from edp.training.optimizers import OptimizerSpec, Soap
from edp.wording import setting_text, typed

Array = NDArray[np.float32]
MAX_LENGTH_S = 600.0
"""Of a free run that is trained on; gradients over longer ones say nothing more."""


EXACT = 1e-12
"""Error in deviations below which an output is exact; a logarithm needs some number."""


class FreeRunDiverged(NotFiniteError):
    """Loss or gradients of a free run are not finite any more."""

    exit_code = 4


@dataclass(frozen=True, kw_only=True)
class FreeRunSpec:
    """Training settings of a twin.

    Attributes:
        seed: seed of the weights, the starts and the measured ports.
        batch: free runs side by side in an update.
        lengths_s: lengths of the free runs, stage after stage.
        updates: updates of each stage.
        measured_fraction: share of the batch that are measured throughout, as a filter is.
        mixed_fraction: share of the batch in which each port is measured or free by chance, as with missing sensors.
        stroke_weight: weight of a standardised stroke error relative to a velocity error; small errors accumulate.
        pressure_weight: weight of a standardised pressure error.
        delta: weighted error above which the Huber loss is linear, in standard deviations.
        clip_norm: bound on the norm of a gradient.
        optimizer: optimiser; its learning rate rises over `warmup` and falls to zero by a cosine.
        warmup: share of all updates.
        validate_every: updates from one validation to the next.
        validation_s: length of a free run of the validation, and of those that choose a formulation.
        patience: validations without an improvement after which the last stage ends; 0 never ends early.

    Raises:
        ConfigError: a value out of range, or stages that do not fit one another.
    """

    seed: int = 0
    batch: int = 64
    lengths_s: tuple[float, ...] = (0.1, 0.3, 1.0, 3.0)
    updates: tuple[int, ...] = (1500, 2000, 3000, 500)
    # More of them cost accuracy in free runs, and gave none where ports are measured (docs/journal).
    measured_fraction: float = 0.05
    mixed_fraction: float = 0.1
    stroke_weight: float = 10.0
    pressure_weight: float = 0.3
    delta: float = 0.1
    clip_norm: float = 1.0
    # On M22 its free runs were off by 5.95 mm/s after 160 processor s, those of AdamW (4e-3) by 6.44 after 202.
    optimizer: OptimizerSpec = field(default_factory=lambda: Soap(learning_rate=3e-3))
    warmup: float = 0.02
    validate_every: int = 250
    validation_s: float = 10.0
    patience: int = 8

    def __post_init__(self) -> None:
        bounds = {"seed": SEED, "batch": integer(1, MAX_BATCH), "updates": integer(1, MAX_UPDATES)}
        bounds |= {"lengths_s": above(0.0, MAX_LENGTH_S), "validation_s": above(0.0, MAX_LENGTH_S)}
        bounds |= {
            "measured_fraction": SHARE,
            "mixed_fraction": SHARE,
            "warmup": SHARE,
            "clip_norm": WEIGHT,
            "delta": WEIGHT,
        }
        bounds |= {"stroke_weight": WEIGHT, "pressure_weight": WEIGHT}
        bounds |= {"validate_every": integer(1, MAX_UPDATES), "patience": integer(0, MAX_UPDATES)}
        check_bounds("free runs", self, **bounds)
        check_count("free runs", "lengths_s", self.lengths_s, MAX_NAMES, least=1)
        if len(self.lengths_s) != len(self.updates):
            raise ConfigError(
                f"free runs: {len(self.lengths_s)} lengths_s and {len(self.updates)} updates; one number of updates "
                "for each length must hold"
            )
        if self.measured_fraction + self.mixed_fraction >= 1.0:
            raise ConfigError(
                f"free runs: measured_fraction = {setting_text(self.measured_fraction)} and mixed_fraction = "
                f"{setting_text(self.mixed_fraction)} leave no "
                "lane that runs free; a sum below 1 must hold"
            )


def draw_measured_ports(spec: FreeRunSpec, shape: tuple[int, int, int], prefix: int, rng: np.random.Generator) -> Array:
    """Return the measured ports ``(tick, run, output)``: 1 in the prefix, later by the fractions in the settings."""
    _, lanes, answers = shape
    kind = rng.random(lanes)
    ports = np.zeros(shape, np.float32)
    ports[:prefix] = 1.0
    ports[:, kind < spec.measured_fraction] = 1.0
    mixed = (kind >= spec.measured_fraction) & (kind < spec.measured_fraction + spec.mixed_fraction)
    # A sensor that is missing is missing in the prefix, too, but for the tick that a run starts from.
    ports[1:, mixed] = (rng.random((lanes, answers)) < 0.5)[mixed]
    return ports


def fit_free_runs(
    twin: RecurrentTwin | ResidualTwin,
    train: Sequence[Series],
    validation: Sequence[Series],
    spec: FreeRunSpec,
    on_event: Callable[[FreeRunProgress], None] | None = None,
    run: KeyedRun | None = None,
    trained: bool = False,
) -> FittedTwin:
    """Train on free runs, choose by free runs of the validation part.

    Args:
        twin: untrained, or trained before; it is changed.
        train: training segments.
        validation: segments that choose among the weights on the way.
        spec: settings of the training.
        on_event: called with progress, after each validation.
        run: folder and key of the run; where given, a checkpoint after each validation makes it resumable.
        trained: whether the twin was trained before: its weights as they are take part in the choice.

    Raises:
        DataError: segments that are too short.
        FreeRunDiverged: a gradient is not finite any more.
        StorageError: a checkpoint is damaged, or of another run.
    """
    torch.set_num_threads(1)  # the products of a tick are too small to share
    with one_blas_thread():
        return _fit_stages(twin, train, validation, spec, on_event, run, trained)


def _fit_stages(
    twin: RecurrentTwin | ResidualTwin,
    train: Sequence[Series],
    validation: Sequence[Series],
    spec: FreeRunSpec,
    on_event: Callable[[FreeRunProgress], None] | None,
    run: KeyedRun | None,
    trained: bool,
) -> FittedTwin:
    rate, network = twin.channels.rate_hz, twin.network
    lengths = [max(1, round(length * rate)) for length in spec.lengths_s]
    if max(lengths) + twin.prefix_ticks > MOST_TICKS:
        raise ConfigError(
            f"free runs: {typed(max(spec.lengths_s))} s at {typed(rate)} Hz are more than {MOST_TICKS:,} ticks"
        )
    ticks = np.repeat(lengths, spec.updates)
    longest = twin.prefix_ticks + max(lengths)
    scaled = [
        replace(part, inputs=twin.drive(part.inputs), targets=twin.scaled(part.targets))
        for part in train
        if part.samples > longest
    ]
    if not scaled:
        raise DataError(
            f"no stretch is longer than prefix and free run, {typed(longest / rate)} s; give longer recordings, or "
            "shorter free runs (training.lengths_s)"
        )
    judge = FreeRunValidation(twin, validation, round(spec.validation_s * rate), spec.batch)
    optimizer = spec.optimizer.build(network.named_parameters())
    rates = [group["lr"] for group in optimizer.param_groups]
    weight = torch.from_numpy(answer_weights(twin, spec))
    progress, chosen = _load_checkpoint(run, network, optimizer)
    if trained and not progress.updates:
        progress.best_score = judge.error()
    before, began = progress.seconds, time.process_time()
    while progress.updates < len(ticks) and not _is_stalled(progress, spec, len(ticks)):
        share = _rate(progress.updates / len(ticks), spec.warmup)
        for group, base in zip(optimizer.param_groups, rates, strict=True):
            group["lr"] = base * share
        loss = _update(twin, scaled, spec, (int(ticks[progress.updates]), progress.updates), weight, optimizer)
        progress.updates += 1
        if progress.updates % spec.validate_every and progress.updates != len(ticks):
            continue
        error = judge.error()
        if error < progress.best_score:
            progress.best_score, progress.best_epoch = error, progress.updates
            chosen = copy.deepcopy(network.state_dict())
        progress.seconds = before + time.process_time() - began
        length_s = float(ticks[progress.updates - 1]) / rate
        row = {"update": progress.updates, "length_s": length_s, "loss": loss, "validation": error}
        best = progress.best_epoch == progress.updates
        progress.history.append(row | {"best": best, "seconds": round(progress.seconds, 2)})
        if run is not None:
            weights = Weights(network.state_dict(), {}, chosen, torch.zeros(0))
            save_checkpoint(run.folder.file(FILE), run.key, progress, weights, optimizer)
        if on_event is not None:
            worked = ticks + twin.prefix_ticks
            left = worked[progress.updates :].sum() / worked[: progress.updates].sum()
            on_event(FreeRunProgress(progress.updates, len(ticks), length_s, progress.seconds * left, error, best))
    network.load_state_dict(chosen)
    return FittedTwin(twin, progress.history, progress.seconds)


def _load_checkpoint(
    run: KeyedRun | None, network: CellWeights, optimizer: torch.optim.Optimizer
) -> tuple[TrainingPosition, dict[str, Tensor]]:
    """Return the position and best weights of a run; network and optimiser are restored."""
    checkpoint = None if run is None else load_checkpoint(run.folder.file(FILE), run.key)
    if run is None or checkpoint is None:
        return TrainingPosition(), copy.deepcopy(network.state_dict())
    progress, weights, state = checkpoint
    try:
        network.load_state_dict(weights.current)
        optimizer.load_state_dict(state)
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        raise damaged(run.folder.file(FILE), error) from error
    return progress, weights.best


def _is_stalled(progress: TrainingPosition, spec: FreeRunSpec, total: int) -> bool:
    """Return whether the last stage has gone on for too long without an improvement."""
    since = sum(row["update"] > progress.best_epoch for row in progress.history)
    judged = progress.history[-1]["update"] if progress.history else 0
    return bool(spec.patience) and since >= spec.patience and judged > total - spec.updates[-1]


def answer_weights(twin: Twin, spec: FreeRunSpec) -> Array:
    """Return the weight of each output's error in standard deviations ``(output,)``."""
    channels = twin.channels
    counts = (len(channels.velocities), len(channels.strokes), len(channels.pressures))
    return np.repeat(np.array([1.0, spec.stroke_weight, spec.pressure_weight], np.float32), counts)


def _update(
    twin: RecurrentTwin | ResidualTwin,
    train: Sequence[Series],
    spec: FreeRunSpec,
    now: tuple[int, int],
    weight: Tensor,
    optimizer: torch.optim.Optimizer,
) -> float:
    """Run one update on scaled segments and return the loss; `now`: ticks of the free run, updates done before."""
    ticks, done = now
    rng = np.random.default_rng([spec.seed, done])
    windows = random_windows(train, twin.prefix_ticks + ticks, spec.batch, rng)
    drawn = MeasuredWindows.read(windows, twin.prefix_ticks + ticks)
    driven, truth = (np.ascontiguousarray(values.swapaxes(0, 1)) for values in (drawn.commands, drawn.outputs))
    ports = draw_measured_ports(spec, truth[1:].shape, twin.prefix_ticks, rng)
    commands, measured, port = (torch.from_numpy(a) for a in (driven, truth[:-1], ports))
    answers = twin.free_run(commands, measured, port)
    loss = huber((answers - torch.from_numpy(truth[1:])) * weight, spec.delta).mean()
    optimizer.zero_grad()
    loss.backward()
    norm = torch.nn.utils.clip_grad_norm_(twin.network.parameters(), spec.clip_norm)
    if not torch.isfinite(norm):
        raise FreeRunDiverged(
            f"the gradient of update {done + 1} is not finite; lower optimizer.learning_rate or the lengths of the runs"
        )
    optimizer.step()
    return float(loss.detach())


def _rate(progress: float, warmup: float) -> float:
    """Share of the learning rate: a ramp, then half a cosine down to zero."""
    if progress < warmup:
        return (progress + 1e-3) / warmup
    return 0.5 * (1.0 + math.cos(math.pi * (progress - warmup) / max(1e-9, 1.0 - warmup)))


class FreeRunValidation:
    """Free runs from evenly spaced starts in the validation segments.

    Args:
        twin: twin to evaluate.
        series: validation segments.
        ticks: length of a free run in samples; cut to the longest segment.
        lanes: number of runs at most.

    Raises:
        DataError: no segment is longer than the prefix.
    """

    def __init__(self, twin: Twin, series: Sequence[Series], ticks: int, lanes: int) -> None:
        self.twin, prefix = twin, twin.prefix_ticks
        longest = max((part.samples for part in series), default=0)
        ticks = min(ticks, longest - prefix - 1)
        if ticks < 1:
            raise DataError(
                f"the longest validation stretch has {longest} ticks; more than prefix_ticks = {prefix} must hold: "
                "give longer recordings, or set a shorter prefix"
            )
        whole_run = prefix + ticks + 1
        usable = [part for part in series if part.samples >= whole_run]
        each = max(1, lanes // len(usable))
        runs = MeasuredWindows.read(even_starts(twin, usable, whole_run, each), whole_run - 1)
        self.commands, self.truth = runs.commands, runs.outputs

    def error(self) -> float:
        """Return the error over the free runs in deviations.

        The geometric mean over actuators, of velocities and of strokes.

        By velocities alone weights are chosen that drift: their errors are mostly the sensors' noise, those of strokes
        are not.
        """
        twin, prefix = self.twin, self.twin.prefix_ticks
        state = twin.reset(self.commands[:, :prefix], self.truth[:, :prefix])
        answers, _ = twin.rollout(self.commands[:, prefix:], state)
        count = len(twin.channels.velocities) + len(twin.channels.strokes)
        error = np.abs(answers - self.truth[:, prefix + 1 :])[..., :count] / twin.scales.answer_width[:count]
        return float(np.exp(np.log(np.maximum(error.mean(axis=(0, 1), dtype=np.float64), EXACT)).mean()))
