"""Imitation of an ensemble on feature rows: a student with two perceptrons learns the total output of all learners.

A committee has no memory but its bank of changes, so a row of the bank is all that it reads. The teacher's prediction
is therefore known at every point of that space, not only where something was recorded. The student learns it on
recorded rows, on points of lines through rows that follow one another closely, between them and somewhat beyond, and
on rows that are moved by what changed between two other ones (synthetic rows: Bucila, Caruana and Niculescu-Mizil,
"Model compression", 2006): it has as many examples as it needs, without noise, and knows what its teacher says where a
machine goes further than it was recorded, or moves otherwise from the same place.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from edp.data.prepared import Prepared
from edp.data.series import Series
from edp.errors import ConfigError, DataError
from edp.networks.activations import Identity
from edp.networks.backbones import CommitteeSpec
from edp.networks.committee import Committee
from edp.networks.heads import LinearHead
from edp.networks.outputs import OUTPUTS
from edp.networks.predictor import ModelSpec, Predictor
from edp.signals import KINDS
from edp.training.bagging.spec import BaggingSpec
from edp.training.bagging.table import bank_rows
from edp.training.compression.committee import committee_start
from edp.training.optimizers import Soap
from edp.training.outcome import Diverged, Fitted, TrainingProgress
from edp.training.spec import TrainingSpec
from edp.training.validation import standard_targets

STEPS, CHECKS, BATCH = 5_000, 10, 256
"""Updates, how often they are reported, and recorded rows of each; as many points of lines through rows come with
them."""
RATE, RISE, DECAY = 6e-3, 0.1, 1e-4
"""Largest learning rate of SOAP, the share of the updates over which it rises, and its weight decay: there is no noise
that weights should be held down for. On left-out rows the students of the EMPS axis came nearer to their teacher in
2,000 of its updates than in 4,000 of AdamW at 3e-3, 0.58 in place of 0.84 of the error that the teacher expected."""
POINTS = 40_000
"""Points beside the recorded rows, half of them on lines, half moved rows. 8 on lines for each row instead, 6,000 on
the tanks, left the student 6 % further from its teacher on left-out rows; moved rows in place of half of 40,000 brought
it a third nearer there."""
REACH = 30
"""Rows that a point's two ends lie apart at most: between rows that follow one another the machine passes through."""
BEYOND = 0.5
"""How far points lie beyond the two rows of their line at most, in distances between these."""
PIECE = 4096
"""Rows that a network predicts in one call."""


def imitates(teachers: Sequence[Predictor], model: ModelSpec) -> bool:
    """Return whether a student can learn from the teachers on rows: one ensemble with the same bank."""
    if len(teachers) != 1 or not isinstance(teachers[0].backbone, Committee):
        return False
    specs, own = (teachers[0].spec, model), model.backbone
    plain = all(
        not spec.blocks
        and spec.physics is None
        and isinstance(spec.head, LinearHead)
        and isinstance(spec.activation, Identity)
        and OUTPUTS.name_of(spec.output) == "point"
        for spec in specs
    )
    theirs = teachers[0].spec.backbone
    return (
        plain
        and isinstance(own, CommitteeSpec)
        and isinstance(theirs, CommitteeSpec)
        and (own.lags, own.smoothed) == (theirs.lags, theirs.smoothed)
        and bool(own.activations)
    )


def predict_rows(net: Predictor, rows: Tensor) -> Tensor:
    """Return the outputs of an ensemble on bank rows before the dead band.

    Args:
        net: its settings satisfy `imitates`.
        rows: ``(row, column)``.

    Returns:
        Standardised predictions, ``(row, output)``; outputs are horizons times targets.
    """
    predictions = []
    with torch.inference_mode():
        for piece in rows.split(PIECE):
            x = piece.unsqueeze(0)
            readers = net.backbone.readers().values() if isinstance(net.backbone, Committee) else ()
            representation = torch.cat([x, *(part(x, ())[0] for part in readers)], dim=-1)[0]
            weight, bias = net.heads.weights[0], net.heads.biases[0]  # (target, in, horizon), (target, horizon)
            predictions.append((torch.einsum("ri,gih->rhg", representation, weight) + bias.T).flatten(1))
    return torch.cat(predictions).clone()


class CommitteeImitation:
    """Trains the perceptrons of a student on rows; its linear model is the teacher's.

    The loss is the mean squared difference from the teacher, in spreads of what the teacher says beyond its linear
    model. Truth plays no part: the teacher has weighed it, on rows that its learners had left out.

    Args:
        teacher: a committee trained with cross-validation folds.
        further: series without truth, whose rows count as recorded ones.
        steps: updates, at least one for each of the `CHECKS` reports.
    """

    def __init__(self, teacher: Predictor, further: Sequence[Series] = (), steps: int = STEPS) -> None:
        if steps < CHECKS:
            raise ConfigError(f"imitation: {steps} updates; {CHECKS} or more must hold, one for each report")
        self.teacher, self.further, self.steps = teacher, list(further), steps

    def fit_network(
        self, data: Prepared, model: ModelSpec, spec: TrainingSpec, on_event: Callable[[TrainingProgress], None]
    ) -> Fitted:
        """Train a student; of `spec` only the seed counts here.

        Args:
            data: the training and validation parts give rows.
            model: the student's settings, such that `imitates` holds.
            spec: settings of the training, of which only the seed is used.
            on_event: called with progress.

        Raises:
            DataError: no recording has rows.
            Diverged: the loss is not finite any more.
        """
        began = time.perf_counter()
        net = committee_start(self.teacher, model, data, spec.seed)
        if net is None or not isinstance(net.backbone, Committee):
            raise TypeError("imitation trains a committee; `imitates` refuses any other student")
        draw = torch.Generator().manual_seed(spec.seed)
        rows, truth = self._rows(data)
        points = torch.cat([_sample_lines(rows, POINTS // 2, draw), move_rows(rows, POINTS // 2, draw)])
        beyond = [predict_rows(self.teacher, x) - predict_rows(net, x) for x in (rows, points)]
        spread = beyond[0].std(dim=0, correction=0)
        spread[spread <= 1e-9] = 1.0  # a teacher that is a line leaves nothing
        linear_bias = net.heads.biases[0].detach().clone()
        perceptrons = _Perceptrons(net.backbone, (rows, points), [each / spread for each in beyond], draw, self.steps)
        history: list[dict[str, Any]] = []
        for check in range(1, CHECKS + 1):
            started = time.perf_counter()
            loss = perceptrons.advance(self.steps * (check - 1) // CHECKS, self.steps * check // CHECKS)
            _write(net, perceptrons.last.detach() * spread, linear_bias)
            history.append(
                {
                    "epoch": check,
                    "updates": check * self.steps // CHECKS,
                    "train_loss": loss,
                    **_judge(net, rows, truth, data),
                    "learning_rate": perceptrons.rate,
                    "seconds": round(time.perf_counter() - began, 3),
                    "best": check == CHECKS,
                }
            )
            each = time.perf_counter() - started
            speed = 2 * BATCH * self.steps / CHECKS / max(each, 1e-9)
            on_event(TrainingProgress(check, CHECKS, 1, 1, speed, (CHECKS - check) * each, history[-1]))
        seconds = time.perf_counter() - began
        return Fitted(net.eval(), history, seconds, 2 * BATCH * self.steps / max(seconds, 1e-9), 0)

    def _rows(self, data: Prepared) -> tuple[Tensor, Tensor]:
        """Return bank rows and the standardised targets of the first ones, which come from `data`."""
        reach, skip = data.task.max_horizon, self.teacher.spec.window - 1
        own = [part for part in (*data.train, *data.validation) if part.samples > reach]
        parts = [(part, part.samples - reach) for part in own] + [(part, part.samples) for part in self.further]
        total = sum(ticks for _, ticks in parts)
        if not own:
            raise DataError(
                f"distillation: no recording of the training part is longer than the largest horizon of {reach} ticks; "
                "give longer ones"
            )
        stride = max(1, math.ceil(total / BaggingSpec().max_rows))
        # A filter starts from nothing: what the bank gives of the first ticks no later tick has.
        chosen = [slice(min(skip, ticks // 4), ticks, stride) for _, ticks in parts]
        rows = [bank_rows(self.teacher, part)[of] for (part, _), of in zip(parts, chosen, strict=True)]
        truth = [
            standard_targets(self.teacher, part)[0].flatten(1).numpy()[of]
            for part, of in zip(own, chosen, strict=False)
        ]
        return torch.from_numpy(np.concatenate(rows)), torch.from_numpy(np.concatenate(truth))


class _Perceptrons:
    """Perceptrons of the student during training, with a common last layer."""

    rate = 0.0

    def __init__(
        self,
        committee: Committee,
        inputs: tuple[Tensor, Tensor],
        targets: Sequence[Tensor],
        draw: torch.Generator,
        steps: int,
    ) -> None:
        self.groups, self.draw, self.steps = committee.members, draw, steps
        self.sources, rows = list(zip(inputs, targets, strict=True)), inputs[0]
        still = rows.amin(dim=0) == rows.amax(dim=0)
        with torch.no_grad():
            for group in self.groups:
                # Random weights would answer a channel that moves later for the first time.
                group.weights[0][:, still] = 0.0
        hidden = sum(group.members * group.units for group in self.groups)
        self.last = nn.Parameter(torch.zeros(hidden + 1, targets[0].shape[1]))  # and a bias
        layers = [named for group in self.groups for named in group.named_parameters()]
        self.optimizer = Soap(learning_rate=RATE, weight_decay=DECAY).build([("last", self.last), *layers])

    def advance(self, start: int, stop: int) -> float:
        """Run updates `start` to `stop`, and return their mean loss.

        Raises:
            Diverged: it is not finite.
        """
        total = torch.zeros(())
        for step in range(start, stop):
            share = step / self.steps
            self.rate = RATE * min(1.0, share / RISE) * 0.5 * (1 + math.cos(math.pi * share))
            for options in self.optimizer.param_groups:
                options["lr"] = self.rate
            drawn = [torch.randint(len(x), (BATCH,), generator=self.draw) for x, _ in self.sources]
            x = torch.cat([source[0][of] for source, of in zip(self.sources, drawn, strict=True)])
            y = torch.cat([source[1][of] for source, of in zip(self.sources, drawn, strict=True)])
            hidden = torch.cat([group(x.unsqueeze(0), ())[0][0] for group in self.groups], dim=-1)
            loss = (torch.addmm(self.last[-1], hidden, self.last[:-1]) - y).square().mean()
            self.optimizer.zero_grad(set_to_none=True)
            loss.backward()
            self.optimizer.step()
            total += loss.detach()
        mean = float(total) / (stop - start)
        if not math.isfinite(mean):
            facts = {"epoch": None, "update": stop, "kept_epoch": None}
            raise Diverged(
                f"the loss of the student is {mean} by update {stop}: the training diverged; nothing is kept. Look for "
                "outliers with edp data check",
                None,
                facts,
            )
        return mean


def _sample_lines(rows: Tensor, count: int, draw: torch.Generator) -> Tensor:
    """Return the points on lines through rows that lie at most `REACH` apart, ``(point, column)``."""
    first, second = _neighbours(rows, count, draw)
    share = (1.0 + 2.0 * BEYOND) * torch.rand(count, 1, generator=draw) - BEYOND
    return torch.lerp(rows[first], rows[second], share)


def move_rows(rows: Tensor, count: int, draw: torch.Generator) -> Tensor:
    """Return the rows moved by a part of what changes between two other ones that lie at most `REACH` apart.

    ``(point, column)``.

    Args:
        rows: rows of the bank, ``(row, column)``, in order of time.
        count: number of rows.
        draw: random generator.
    """
    start = torch.randint(len(rows), (count,), generator=draw)
    first, second = _neighbours(rows, count, draw)
    return rows[start] + torch.rand(count, 1, generator=draw) * (rows[second] - rows[first])


def _neighbours(rows: Tensor, count: int, draw: torch.Generator) -> tuple[Tensor, Tensor]:
    first = torch.randint(len(rows), (count,), generator=draw)
    return first, (first + torch.randint(-REACH, REACH + 1, (count,), generator=draw)).clamp(0, len(rows) - 1)


def _write(net: Predictor, last: Tensor, linear_bias: Tensor) -> None:
    """Write the last layer to the perceptron weights of the head.

    Args:
        net: the student.
        last: weights and a bias, in standard deviations of the targets, ``(in + 1, output)``.
        linear_bias: the bias of the linear model, ``(target, horizon)``.
    """
    if not isinstance(net.backbone, Committee):
        raise TypeError("only the head of a committee has weights of perceptrons")
    heads, first = net.heads, net.backbone.bank.columns
    by_horizon = last.unflatten(1, (len(net.task.horizons), len(net.task.targets)))
    with torch.no_grad():
        heads.weights[0][:, first : first + len(last) - 1] = by_horizon[:-1].permute(2, 0, 1)
        heads.biases[0].copy_(linear_bias + by_horizon[-1].T)


def _judge(net: Predictor, rows: Tensor, truth: Tensor, data: Prepared) -> dict[str, Any]:
    """Return the student's error on the recorded training rows."""
    predicted = predict_rows(net, rows[: len(truth)])
    if net.heads.band is not None:
        predicted = net.heads.band(predicted.unflatten(1, net.heads.band.width.shape)).flatten(1)
    error = predicted - truth
    factors = np.tile([KINDS[kind].report_factor for kind in data.target_kinds], len(data.task.horizons))
    each = error.abs().mean(dim=0).numpy() * net.code.width.flatten().numpy() * factors
    return {
        "validation_loss": float(error.square().mean()),
        "validation_score": float(error.abs().mean()),
        "validation_mae": float(each.mean()),
    }
