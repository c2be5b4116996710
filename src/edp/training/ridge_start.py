"""Put the ridge regression on the training data into a linear skip connection before training."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from edp.data.gathered import LastMade
from edp.data.lags import LagTask, origins
from edp.data.ridge import cross_validate_ridge, ridge_solution
from edp.data.scaling import feature_columns
from edp.data.series import Series
from edp.data.task import Task
from edp.errors import DataError
from edp.networks.blocks.linear_bypass import Bypass
from edp.networks.predictor import Predictor


def start_bypass(predictor: Predictor, train: Sequence[Series], validation: Sequence[Series]) -> bool:
    """Set the skip connection to the ridge regression and silence the heads, so that training starts as that baseline.

    The regression reads the logged channels, and those derived ones that say what no logged channel says: targets, and
    those whose source is not itself a feature. Does nothing without a skip connection or where it starts from zero.

    Args:
        predictor: predictor with its fitted scaler.
        train: the map is fitted here.
        validation: chooses penalty and history for each horizon and target; a crossed start is fitted on it too.

    Returns:
        Whether anything was set.

    Raises:
        DataError: no training segment is as long as the taps plus the largest horizon.
    """
    bypass, task = predictor.bypass, predictor.task
    if not isinstance(bypass, Bypass) or bypass.spec.init == "zero":
        return False
    read = _columns(task)
    # A target that is no feature has no level to start from: the regression then finds it from the features.
    present = tuple(None if column is None else read.index(column) for column in task.present)
    lags = LagTask(task.horizons, present, bypass.spec.taps)
    slot = LastMade()
    series_of_parts = [
        [Series(part.name, feature_columns(task, part, read, slot), part.targets) for part in parts]
        for parts in (train, validation)
    ]
    # Validation alone cannot fit the regression; it only chooses its penalty.
    if not any(len(origins(part, lags)) for part in series_of_parts[0]):
        raise DataError(
            f"linear_bypass: the longest training stretch has {max(part.samples for part in train)} samples, fewer "
            f"than its {bypass.spec.taps} taps plus the horizon of {task.max_horizon}; give longer recordings "
            "or fewer taps"
        )
    crossed = bypass.spec.init == "cross_validated"
    solution = (
        cross_validate_ridge(series_of_parts[0] + series_of_parts[1], lags)
        if crossed
        else ridge_solution(series_of_parts[0], lags, series_of_parts[1])
    )
    # SI to network units: scaled = (x - offset) / width on both sides.
    offset, width = (tensor.double().cpu().numpy() for tensor in (predictor.front.offset, predictor.front.width))
    maps = np.zeros((bypass.spec.taps, len(offset), *solution.intercept.shape))
    maps[:, read] = solution.weights
    if predictor.code.delta:
        for target, column in enumerate(predictor.code.present):
            # In delta mode the network predicts the change: the present value is taken out of lag 0.
            maps[0, column, :, target] -= 1.0
    level = solution.intercept + np.einsum("hfkc,f->kc", maps, offset) - predictor.code.offset.double().cpu().numpy()
    unit = predictor.code.width.double().cpu().numpy()
    weight = (maps * width[:, None, None] / unit).reshape(bypass.spec.taps, len(offset), -1)
    with torch.no_grad():
        # The skip connection filters forward in time: its last tap is lag 0.
        bypass.weight.copy_(torch.from_numpy(weight[::-1].transpose(2, 1, 0).copy()))
        bypass.bias.copy_(torch.from_numpy((level / unit).ravel()))
        # Silent heads: the first validation measures the regression alone, which training must improve on.
        for parameter in (predictor.heads.weights[-1], predictor.heads.biases[-1]):
            parameter.zero_()
    return True


def _columns(task: Task) -> list[int]:
    """Return the features that the regression reads, in order."""
    features = task.features
    new = {entry.name for entry in features.derived if entry.source in features.hidden}
    # Derived columns of measured channels are sums of lags already; only those of hidden channels add something.
    regression_channels = {*features.channels, *new, *task.targets}
    return [column for column, name in enumerate(features.lasting) if name in regression_channels]
