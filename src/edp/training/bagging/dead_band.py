"""Dead band of predictions: threshold below which a prediction counts as zero, chosen on left-out rows.

A least-squares model says of a machine in steady state what will be on average: a little more than nothing, where
sensors count in steps and mostly nothing happens. Its squared error is least, its absolute error is larger than that of
'no change'.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from edp.data.lags import DoubleArray

WIDTHS = (0.01, 0.02, 0.03, 0.05, 0.07, 0.1, 0.14, 0.2, 0.28, 0.4, 0.56)
"""To choose from, in standard deviations of the change."""
PRICE = 20.0
"""Per cent of absolute error that a per cent of root-mean-square error must buy: squared errors are what is expected
and compared, so that they may hardly rise."""
DEAREST = 1.003
"""Root-mean-square error, over that without a band, that is never exceeded."""
MIN_GAIN = 0.005
"""Share of the absolute error below which a band is not worth its place."""


def band(values: DoubleArray, width: float | DoubleArray) -> DoubleArray:
    """Return the values behind a dead band, as `edp.networks.heads.OutputBand` has it."""
    return np.asarray(values - 2.0 * np.clip(values, -width, width) + np.clip(values, -2.0 * width, 2.0 * width))


def dead_bands(predicted: DoubleArray, truth: DoubleArray, owner: NDArray[np.integer]) -> DoubleArray:
    """Return the dead band width of each output, ``(output,)``; 0 if it brings no gain.

    Args:
        predicted: predictions of left-out rows, standardised, ``(row, output)``.
        truth: measured changes, same shape; zero is no change.
        owner: the fold that left out each row, ``(row,)``. A band must lower the absolute error of every fold: the gain
            of one segment may be chance.
    """
    each = zip(predicted.T, truth.T, strict=True)
    return np.array([_dead_band(values, changes, owner) for values, changes in each])


def _dead_band(predicted: DoubleArray, truth: DoubleArray, owner: NDArray[np.integer]) -> float:
    square, absolute = _errors(predicted, truth, owner)
    best, least = 0.0, -MIN_GAIN
    if not square > 0 or not absolute.sum() > 0:
        return best
    for width in WIDTHS:
        own_square, own_absolute = _errors(band(predicted, width), truth, owner)
        rise = float(np.log(own_square / square)) / 2
        if rise > np.log(DEAREST) or (own_absolute > absolute).any():
            continue
        score = float(np.log(own_absolute.sum() / absolute.sum())) + PRICE * max(0.0, rise)
        if score < least:
            best, least = width, score
    return best


def _errors(predicted: DoubleArray, truth: DoubleArray, owner: NDArray[np.integer]) -> tuple[float, DoubleArray]:
    """Sum of squared errors, and sums of absolute errors of each fold."""
    error = predicted - truth
    return float(error @ error), np.asarray(np.bincount(owner, np.abs(error)), dtype=np.float64)
