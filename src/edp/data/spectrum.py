"""Richness of inputs: persistent excitation by the input Hankel matrix, and power spectral density."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
LAGS = 50
"""Number of block rows of the Hankel matrix: the window of 50 samples of the thesis's networks."""
LAG_STEPS = (1, 2, 3, 5, 8, 12, 16, 20, 25, 30, 35, 40, 45, 50)
FLAT_DB = 10.0
"""Maximum attenuation below the maximum of a spectrum that counts as flat."""
USED_HZ = 4.0
"""Frequency up to which the axes of an excavator follow their commands. Slower logs are evaluated up to 0.4 of their
rate."""
SEGMENT_S = 10.24
"""Length of Welch's segments: a tenth of a hertz at any rate."""


def hankel_gram(inputs: Sequence[Array], lags: int) -> tuple[Array, int]:
    """Return the Gram matrix of the block Hankel matrix of several segments, and its number of columns.

    Column t of the Hankel matrix holds u(t), u(t + 1), ... u(t + lags - 1). Its Gram matrix is block by block a sum of
    products at one distance, so that each block follows from its neighbour by one product less and one more.

    Args:
        inputs: segments, shape ``(time, input)``; segments shorter than `lags` are omitted.
        lags: block rows.

    Returns:
        shape ``(lags * input, lags * input)``; columns.
    """
    width = inputs[0].shape[1]
    gram = np.zeros((lags, width, lags, width))
    columns = 0
    for u in inputs:
        count = len(u) - lags + 1
        if count < 1:
            continue
        columns += count
        for apart in range(lags):
            block = u[:count].T @ u[apart : apart + count]
            for a in range(lags - apart):
                gram[a, :, a + apart, :] += block
                if apart:
                    gram[a + apart, :, a, :] += block.T
                end = a + count
                if end + apart < len(u):
                    block = block - np.outer(u[a], u[a + apart]) + np.outer(u[end], u[end + apart])
    return gram.reshape(lags * width, lags * width), columns


def smallest_singular_values(inputs: Sequence[Array], lags: int = LAGS) -> dict[int, float]:
    """Return the smallest singular value of the input Hankel matrix over the root of its columns, by number of lags.

    Inputs are standardised, so white noise has the value 1. Inputs are persistently exciting of an order if its value
    is above zero; a small value shows that the data cannot distinguish models of this order.

    Args:
        inputs: segments, shape ``(time, input)``; no column is constant.
        lags: the largest number of block rows.
    """
    whole = np.concatenate(inputs)
    mean, deviation = whole.mean(axis=0), whole.std(axis=0)
    gram, columns = hankel_gram([(u - mean) / deviation for u in inputs], lags)
    width = whole.shape[1]
    # Fewer columns than rows make any input look deficient.
    if columns <= lags * width:
        return {}
    steps = [n for n in LAG_STEPS if n < lags] + [lags]
    return {n: float(np.sqrt(max(np.linalg.eigvalsh(gram[: n * width, : n * width] / columns)[0], 0.0))) for n in steps}


def density(stretches: Sequence[Array], rate_hz: float) -> tuple[Array, Array]:
    """Return the power spectral density by Welch's method, averaged over segments by their length.

    Returns:
        frequencies in Hz without zero, shape ``(frequency,)``; density, shape ``(frequency, signal)``. Empty where no
        segment fills a segment.
    """
    # A power of two for the transform, and 16 samples at least for a slow logger.
    size = 1 << round(np.log2(max(SEGMENT_S * rate_hz, 16)))
    fitting = [u for u in stretches if len(u) >= size]
    if not fitting:
        return np.zeros(0), np.zeros((0, stretches[0].shape[1]))
    # Imported at first use: scipy.signal imports scipy.stats, half a second of the start of every command.
    from scipy.signal import welch

    # Process each segment separately: a segment across two recordings would contain an artificial jump.
    parts = [welch(u, rate_hz, nperseg=size, axis=0) for u in fitting]
    power = np.average([p for _, p in parts], axis=0, weights=[len(u) for u in fitting])
    return np.asarray(parts[0][0][1:]), np.asarray(power[1:])


def used_hz(rate_hz: float) -> float:
    """Return the frequency up to which the spectrum of commands should be flat."""
    return min(USED_HZ, 0.4 * rate_hz)


def flat_to(frequency: Array, power: Array, used: float, within_db: float = FLAT_DB) -> tuple[float, float]:
    """Return the flatness of a power density, averaged over a third of an octave.

    Returns:
        the highest frequency up to which it stays within some dB of its maximum, Hz; how far it lies below the maximum
        at `used` Hz, dB. Zeros for silence.
    """
    if len(power) == 0 or not power.max() > 0:
        return 0.0, 0.0
    sixth = 2.0 ** (1.0 / 6.0)
    total = np.concatenate(([0.0], np.cumsum(power)))
    low = np.searchsorted(frequency, frequency / sixth)
    high = np.maximum(np.searchsorted(frequency, frequency * sixth), low + 1)
    smooth = (total[high] - total[low]) / (high - low)
    peak = int(np.argmax(smooth))
    below = np.flatnonzero(smooth[peak:] < smooth[peak] * 10.0 ** (-within_db / 10.0))
    flat = frequency[max(peak + int(below[0]) - 1, 0)] if len(below) else frequency[-1]
    there = smooth[min(int(np.searchsorted(frequency, used)), len(smooth) - 1)]
    drop = 10.0 * np.log10(smooth[peak] / max(there, 1e-30 * smooth[peak]))
    return float(flat), float(drop)
