"""Evaluation of a network on validation series: scores that select the best epoch, calibration of intervals."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from edp.data.prepared import Prepared
from edp.data.series import Series
from edp.data.spread_rows import spread_series
from edp.networks.losses import Prediction
from edp.networks.predictor import Predictor
from edp.networks.running import answer_pieces, stream_answers
from edp.signals import KINDS
from edp.training.spec import TrainingSpec

MAX_VALIDATED = 1 << 20
"""Ticks that evaluate an epoch and calibrate intervals, about; three hours at 100 Hz."""
STARTS_A_STRETCH = 100
"""Times the start-up of a network that a segment is long: of its ticks one per cent are not evaluated."""


def validation_scores(
    net: Predictor, series: Sequence[Series], spec: TrainingSpec, data: Prepared, windowed: bool = False
) -> tuple[float, float, float]:
    """Return the mean absolute error in standard deviations, in report units, and the loss, streamed over `series`.

    The loss is the main one, without weights and terms. With `windowed` every prediction is from reset over its window.
    """
    # Double precision: sums over hours of ticks in float32 lose the digits in which epochs differ.
    scale = net.code.width.detach().cpu().double()
    factors = torch.tensor([KINDS[kind].report_factor for kind in data.target_kinds], dtype=torch.float64)
    series = select_evaluated(net, series, spec)
    absolute, count, loss = torch.zeros(len(series), *scale.shape, dtype=torch.float64), 0, [0.0] * len(series)
    for i, answer, target in _answers(net, series, spec, windowed):
        absolute[i] += (answer.center - target).abs().sum(dim=(0, 1))
        count += target.shape[1]
        loss[i] += float(spec.loss.evaluate(answer, target).mean(dim=(-1, -2)).sum())
    mean = absolute.sum(dim=0) / max(1, count)
    return float(mean.mean()), float((mean * scale * factors).mean()), sum(loss) / max(1, count)


def select_evaluated(net: Predictor, series: Sequence[Series], spec: TrainingSpec) -> list[Series]:
    """Return the data that evaluate epochs: the series, or evenly spaced segments beyond `MAX_VALIDATED` samples.

    Else an epoch of a fixed number of updates would take hours to evaluate where the store is large.
    """
    start_up = max(spec.chunks.burn_in, net.spec.window) + net.task.max_horizon
    return spread_series(series, STARTS_A_STRETCH * start_up, MAX_VALIDATED)


def calibrate(net: Predictor, series: Sequence[Series], spec: TrainingSpec) -> None:
    """Scale the intervals of a network so that they contain their fraction of `series`."""
    answers, targets = [], []
    for _, answer, target in _answers(net, select_evaluated(net, series, spec), spec, windowed=False):
        answers.append(answer)
        targets.append(target)
    answer = replace(
        answers[0],
        center=torch.cat([one.center for one in answers], dim=1),
        spread=torch.cat([one.spread for one in answers], dim=1),
    )
    net.output.calibrate(answer, torch.cat(targets, dim=1))


def _answers(
    net: Predictor, series: Sequence[Series], spec: TrainingSpec, windowed: bool
) -> Iterator[tuple[int, Prediction, Tensor]]:
    """Yield the series number, the network output on a segment, and the standardised targets, without the start-up.

    Batches of one, double precision.
    """
    # Ticks of the start judge the reset and not the network; training gives them no loss either.
    skip = spec.chunks.burn_in if spec.chunks.regime == "chunk" else net.spec.window - 1
    if windowed:
        for i, part in enumerate(series):
            answer = stream_answers(net, [part], windowed=True)[0]
            target = standard_targets(net, part)[:, skip:]
            ticks = slice(skip, skip + target.shape[1])
            yield i, replace(answer, center=answer.center[:, ticks], spread=answer.spread[:, ticks]), target
        return
    for i, start, answer, features in answer_pieces(net, series):
        part = series[i]
        first, stop = max(start, skip), min(start + features.shape[1], part.samples - net.task.max_horizon)
        if first < stop:
            ticks = slice(first - start, stop - start)
            future = np.stack([part.targets[first + k : stop + k] for k in net.task.horizons], axis=1)
            with torch.inference_mode():
                target = net.code.encode(torch.from_numpy(future).unsqueeze(0).to(features), features[:, ticks])
            center, spread = (one[:, ticks].float().cpu().double() for one in (answer.center, answer.spread))
            yield i, replace(answer, center=center, spread=spread), target.cpu().double()


def standard_targets(net: Predictor, part: Series) -> Tensor:
    """Return the targets of a whole series as the network is trained on them, ``(1, tick, horizon, output)``.

    Double precision.

    Ticks whose targets lie beyond the end are left out.
    """
    # All horizons share their ticks, so that errors at different horizons compare.
    ticks = part.samples - net.task.max_horizon
    future = np.stack([part.targets[k : k + ticks] for k in net.task.horizons], axis=1)
    like = next(net.parameters())
    x = torch.from_numpy(part.inputs[:ticks]).unsqueeze(0).to(like)
    with torch.inference_mode():
        features, _ = net.front(x, net.front.initial_state(1, x))
        return net.code.encode(torch.from_numpy(future).unsqueeze(0).to(like), features).cpu().double()
