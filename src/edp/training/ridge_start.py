"""Put the ridge regression on the training data into a linear by-pass before training."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from edp.blocks.linear_bypass import Bypass
from edp.data.lags import LagTask, origins
from edp.data.ridge import ridge_solution
from edp.data.series import Series
from edp.errors import DataError
from edp.models.predictor import Predictor


def start_bypass(predictor: Predictor, train: Sequence[Series], validation: Sequence[Series]) -> None:
    """Set the by-pass to the ridge regression on the logged channels, so that training starts from that baseline.

    Does nothing where the predictor has no by-pass, it starts from zero, or no logged channel is a feature.

    Args:
        predictor: with its fitted scaler.
        train: the map is fitted here.
        validation: chooses penalty and history for each horizon and target.

    Raises:
        DataError: no training stretch is as long as the taps plus the largest horizon.
    """
    bypass, task = predictor.bypass, predictor.task
    channels = len(task.features.channels)
    if not isinstance(bypass, Bypass) or bypass.spec.start != "ridge" or channels == 0:
        return
    # A derived feature is no input: the regression then finds that target's level from the channels themselves.
    present = tuple(column if column is not None and column < channels else None for column in task.present)
    lags = LagTask(task.horizons, present, bypass.spec.taps)
    logged = [
        [Series(part.name, part.inputs[:, :channels], part.targets) for part in parts] for parts in (train, validation)
    ]
    if not any(len(origins(part, lags)) for part in logged[0]):
        raise DataError(
            f"linear_bypass: the longest training stretch has {max(part.samples for part in train)} samples, fewer "
            f"than its {bypass.spec.taps} taps plus the horizon of {task.reach}; give longer recordings or fewer taps"
        )
    solution = ridge_solution(logged[0], lags, logged[1])
    # SI to network units: scaled = (x - offset) / width on both sides.
    offset, width = (tensor.double().cpu().numpy() for tensor in (predictor.front.offset, predictor.front.width))
    maps = np.zeros((bypass.spec.taps, len(offset), *solution.intercept.shape))
    maps[:, :channels] = solution.weights
    if predictor.code.delta:
        for target, column in enumerate(predictor.code.present):
            maps[0, column, :, target] -= 1.0
    level = solution.intercept + np.einsum("hfkc,f->kc", maps, offset) - predictor.code.offset.double().cpu().numpy()
    unit = predictor.code.width.double().cpu().numpy()
    weight = (maps * width[:, None, None] / unit).reshape(bypass.spec.taps, len(offset), -1)
    with torch.no_grad():
        # The by-pass filters forward in time: its last tap is lag 0.
        bypass.weight.copy_(torch.from_numpy(weight[::-1].transpose(2, 1, 0).copy()))
        bypass.bias.copy_(torch.from_numpy((level / unit).ravel()))
