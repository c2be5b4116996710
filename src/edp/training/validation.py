"""A network on series that it was not trained on: scores that choose the best epoch, and calibration of intervals."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from edp.data.prepared import Prepared
from edp.data.series import Series
from edp.networks.losses import Prediction
from edp.networks.predictor import Predictor
from edp.networks.running import stream_answers
from edp.signals import KINDS
from edp.training.spec import TrainingSpec


def validation_scores(
    net: Predictor, series: Sequence[Series], spec: TrainingSpec, data: Prepared, windowed: bool = False
) -> tuple[float, float, float]:
    """Mean absolute error in standard deviations, in report units, and the loss, streamed over `series`.

    The loss is the main one, without weights and terms. With `windowed` every prediction is from reset over its window.
    """
    # Double precision: sums over hours of ticks in float32 lose the digits in which epochs differ.
    scale = net.code.width.detach().cpu().double()
    factors = torch.tensor([KINDS[kind].report_factor for kind in data.target_kinds], dtype=torch.float64)
    absolute, count, loss = torch.zeros_like(scale), 0, 0.0
    for answer, target in _answers(net, series, spec, windowed):
        absolute += (answer.center - target).abs().sum(dim=(0, 1))
        count += target.shape[1]
        loss += float(spec.loss.evaluate(answer, target).mean(dim=(-1, -2)).sum())
    mean = absolute / max(1, count)
    return float(mean.mean()), float((mean * scale * factors).mean()), loss / max(1, count)


def calibrate(net: Predictor, series: Sequence[Series], spec: TrainingSpec) -> None:
    """Stretch the intervals of a network so that they hold their share of `series`."""
    pairs = list(_answers(net, series, spec))
    first = pairs[0][0]
    answer = replace(
        first,
        center=torch.cat([one.center for one, _ in pairs], dim=1),
        spread=torch.cat([one.spread for one, _ in pairs], dim=1),
    )
    net.output.calibrate(answer, torch.cat([target for _, target in pairs], dim=1))


def _answers(
    net: Predictor, series: Sequence[Series], spec: TrainingSpec, windowed: bool = False
) -> Iterator[tuple[Prediction, Tensor]]:
    """What the network says of each series after start-up, and the standardised targets; batches of one."""
    # Ticks of the start judge the reset and not the network; training gives them no loss either.
    skip = spec.chunks.burn_in if spec.chunks.regime == "chunk" else net.spec.window - 1
    for part, answer in zip(series, stream_answers(net, series, windowed=windowed), strict=True):
        target = standard_targets(net, part)[:, skip:]
        ticks = slice(skip, skip + target.shape[1])
        yield replace(answer, center=answer.center[:, ticks], spread=answer.spread[:, ticks]), target


def standard_targets(net: Predictor, part: Series) -> Tensor:
    """Targets of a whole series as the network is trained on them, ``(1, tick, horizon, output)``, double precision.

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
