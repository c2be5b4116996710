"""The usual range of a network's inputs, and the limits beyond which a stream rejects them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from edp.networks.predictor import Predictor

LIMIT = 1e6
"""Standard widths beyond which an input is rejected: far from any signal, and no sum of float32 overflows."""
LARGEST = 3.0e38
"""Just below the largest float32, so that a limit is a number that C can compare with."""
HOLD_TICKS = 5
"""Missed or bad ticks in a row that are held; a longer gap ends the trust in what the network remembers."""
Array = NDArray[np.float64]


def usual_range(predictor: Predictor) -> tuple[Array, Array]:
    """Return middle and width of each input's usual range in SI units, each ``(input,)``, from the scaler.

    For a channel that is only an input of a derived channel, the width is the width of the derived change. For a
    channel that only a physics base reads, the range is typical for its kind.
    """
    front, features = predictor.front, predictor.task.features
    offset, width = (part.detach().cpu().double().numpy() for part in (front.offset, front.width))
    # Inputs without statistics of their own get a width beyond any sensor, so that only wild values are rejected.
    centre, spread = np.zeros(front.inputs), np.full(front.inputs, 1e6)
    logged, hidden = len(features.channels), len(features.hidden)
    centre[:logged], spread[:logged] = offset[:logged], width[:logged]
    for number, entry in enumerate(features.derived):
        source = features.inputs.index(entry.source)
        # A scaler knows the derived width; over one tick it bounds the change of the hidden source.
        change = width[logged + number] / entry.gain(predictor.task.rate_hz)
        if source >= logged:
            spread[source] = min(spread[source], change)
    first, count = logged + hidden, len(features.init_channels)
    at = slice(front.lasting, front.lasting + count)
    centre[first : first + count], spread[first : first + count] = offset[at], width[at]
    if predictor.physics is not None:
        usual = predictor.physics.usual()
        for column, name in enumerate(predictor.task.inputs[front.sources :], front.sources):
            centre[column], spread[column] = usual.get(name, (centre[column], spread[column]))
    return centre, spread


def input_limits(predictor: Predictor) -> tuple[Array, Array]:
    """Return the least and largest accepted value of each input, SI units, each ``(input,)``."""
    centre, spread = usual_range(predictor)
    # Clipping keeps the limit representable in float32, in which the exported code compares.
    low, high = (np.clip(centre + side * LIMIT * spread, -LARGEST, LARGEST) for side in (-1.0, 1.0))
    return low, high
