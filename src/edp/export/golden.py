"""Golden recordings of a network: random inputs, what PyTorch makes of them, how far another form may be from it."""

from __future__ import annotations

import copy

import numpy as np
import torch
from numpy.typing import NDArray

from edp.networks.input_range import usual_range
from edp.networks.integer import IntegerPredictor
from edp.networks.predictor import Predictor

GOLDEN_TICKS = 200
SHARE = 1e-5
"""How far another form may be from PyTorch, in standard deviations of the target and as a share of the value."""
Rows = NDArray[np.float32]


def tolerance(predictor: Predictor, inputs: Rows, outputs: Rows) -> Rows:
    """How far another form may be from `outputs`, PyTorch's in single precision, for each number of a tick.

    `SHARE` of a standard deviation and of the largest value; where PyTorch in single precision is farther than that
    from itself in double precision (a layer norm of a cell near zero), twice that distance. Integers: nothing.
    """
    if isinstance(predictor, IntegerPredictor):
        return np.zeros(outputs.shape[1], dtype=np.float32)
    exact = stream(copy.deepcopy(predictor).double(), inputs)
    sigma = predictor.code.width.detach().cpu().double().numpy().ravel()
    widths = np.tile(sigma, outputs.shape[1] // len(sigma))
    # Where PyTorch in single precision is itself far from double precision, no other form can be asked for more.
    own = np.abs(outputs - exact).max(axis=0)
    result: Rows = np.maximum(SHARE * (widths + np.abs(outputs).max(axis=0)), 2.0 * own).astype(np.float32)
    return result


def random_inputs(predictor: Predictor, ticks: int, seed: int) -> Rows:
    """Smooth random inputs ``(tick, input)`` in the usual range of each channel, SI units."""
    centre, spread = usual_range(predictor)
    # A private generator: an export draws nothing from the caller's.
    rng = np.random.default_rng(seed)
    noise = rng.normal(size=(ticks, len(centre)))
    value = rng.normal(size=len(centre))
    rows = []
    for kick in noise:
        # A first-order process with near unit variance: signals of machines do not jump like white noise.
        value = 0.9 * value + 0.4 * kick
        rows.append(centre + spread * value)
    return np.asarray(rows, dtype=np.float32)


def stream(predictor: Predictor, inputs: Rows) -> Rows:
    """What PyTorch predicts from reset, ``(tick, number)``: predictions, then lower and upper bounds, SI units."""
    like = next(predictor.parameters())
    x = torch.from_numpy(inputs).to(like).unsqueeze(0)
    with torch.inference_mode():
        prediction, _ = predictor.predict(x, predictor.initial_state(1, x))
        parts = [prediction[0].flatten(1)]
        if predictor.output.coverages:
            bounds, _ = predictor.intervals(x, predictor.initial_state(1, x))
            parts += [bounds[0, :, :, side].flatten(1) for side in (0, 1)]
        return torch.cat(parts, dim=1).float().cpu().numpy()
