"""Put the ridge regression on the training data into a linear by-pass before training."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from edp.blocks.linear_bypass import Bypass
from edp.data.series import Series
from edp.models.predictor import Predictor

BLOCK = 8192  # rows of the design matrix at a time: memory stays bounded for any length of data
RIDGE = 1e-4  # relative to the row count, on standardised features


def start_bypass(predictor: Predictor, train: Sequence[Series]) -> None:
    """Set the by-pass to ``argmin sum |y - A x|^2 + ridge |A|^2`` over all training ticks, in double precision.

    Does nothing where the predictor has no by-pass or it starts from zero.
    """
    bypass = predictor.bypass
    if not isinstance(bypass, Bypass) or bypass.spec.start != "ridge":
        return
    taps, features = bypass.spec.taps, bypass.features
    size = taps * features + 1
    outputs = bypass.horizons * bypass.outputs
    gram = torch.zeros(size, size, dtype=torch.float64)
    moment = torch.zeros(size, outputs, dtype=torch.float64)
    rows = 0
    with torch.no_grad():
        for part in train:
            scaled, target = _scaled(predictor, part)
            for start in range(taps - 1, len(target), BLOCK):
                stop = min(start + BLOCK, len(target))
                lags = scaled[start - taps + 1 : stop].unfold(0, taps, 1).flatten(1)
                design = torch.cat([lags, torch.ones(len(lags), 1, dtype=lags.dtype)], dim=1)
                gram += design.T @ design
                moment += design.T @ target[start:stop]
                rows += stop - start
        if rows == 0:
            return
        gram.diagonal()[:-1] += RIDGE * rows
        solution = torch.linalg.solve(gram, moment)
        weight = solution[:-1].T.reshape(outputs, features, taps)
        bypass.weight.copy_(weight.to(bypass.weight))
        bypass.bias.copy_(solution[-1].to(bypass.bias))


def _scaled(predictor: Predictor, part: Series) -> tuple[Tensor, Tensor]:
    """Scaled features ``(time, feature)`` and standardised targets ``(time - reach, horizon * target)``."""
    like = next(predictor.parameters())
    x = torch.from_numpy(part.inputs).to(like)[None]
    features, _ = predictor.front(x, predictor.front.initial_state(1, like))
    horizons = predictor.task.horizons
    ticks = max(0, part.samples - max(horizons))
    values = torch.from_numpy(part.targets).to(like)
    future = torch.stack([values[k : k + ticks] for k in horizons], dim=1)[None]
    code = predictor.code.encode(future, features[:, :ticks])[0].flatten(1)
    return predictor.front.scale(features)[0].double().cpu(), code.double().cpu()
